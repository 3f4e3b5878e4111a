"""Device side of `Occupancy`: which objects a reset draws."""

import warp as wp

wp.set_module_options({"enable_backward": False})

DRAWN = wp.constant(-2)
"""In the place of an object that a reset is to draw."""


@wp.kernel
def draw_choice(
    world_mask: wp.array[wp.bool],
    seed: wp.array[int],
    episode: wp.array[int],  # before it is counted
    ends: wp.array[float],  # (objects,) where the share of each ends in [0, 1]
    least: int,  # objects that a world has
    slots: int,  # most of them
    wanted: wp.array[int],  # (world_count * slots,) the objects that were asked for, -1 for none; DRAWN to draw
    # Out:
    choice: wp.array[int],  # (world_count * slots,), -1 for none
    row: wp.array[int],  # (world_count,), the first
):
    """Draw the objects of an episode by the weights; parameters, whose offsets are not negative, draw from others."""
    w = wp.tid()
    if not world_mask[w]:
        return
    random = wp.rand_init(seed[w], -2 - episode[w])
    number = slots
    for slot in range(slots):
        chosen = wanted[w * slots + slot]
        if chosen == DRAWN:
            u = wp.randf(random)
            chosen = int(0)
            while chosen < ends.shape[0] - 1 and u >= ends[chosen]:
                chosen += 1
            if slot == 0 and least < slots:
                number = wp.min(least + int(float(slots + 1 - least) * wp.randf(random)), slots)
            if slot >= number:
                chosen = -1
        choice[w * slots + slot] = chosen
    row[w] = choice[w * slots]
