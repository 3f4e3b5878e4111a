"""Random motion of the arms that hold the beam of ``peers_vbd``."""

import warp as wp


@wp.kernel(enable_backward=False)
def act(
    step: wp.array[int],
    home: wp.array[float],  # (9,)
    opened: float,
    closed: float,
    target: wp.array2d[float],  # (world_count, 9)
):
    """Move the joints at random around their home; close the fingers in five of six spells of sixteen steps."""
    world = wp.tid()
    rng = wp.rand_init(1234 + step[0], world)
    for joint in range(7):
        moved = target[world, joint] + 0.005 * (2.0 * wp.randf(rng) - 1.0)
        target[world, joint] = wp.clamp(moved, home[joint] - 0.02, home[joint] + 0.02)
    grip = wp.where((step[0] // 16) % 6 == 0, opened, closed)
    target[world, 7] = grip
    target[world, 8] = grip


@wp.kernel(enable_backward=False)
def count_step(step: wp.array[int]):
    """Count a control step."""
    step[0] = step[0] + 1
