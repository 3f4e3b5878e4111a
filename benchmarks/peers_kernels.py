"""Random motion of what holds the beam of ``peers_vbd`` and of ``peers_flex``."""

import warp as wp


@wp.kernel(enable_backward=False)
def act_arm(
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
def act_hand(step: wp.array[int], home: wp.array[float], ctrl: wp.array2d[float]):
    """Move the hand at random around its home; close the fingers in five of six spells of sixteen steps."""
    world = wp.tid()
    rng = wp.rand_init(1234 + step[0], world)
    for axis in range(3):
        target = ctrl[world, axis] + 0.003 * (2.0 * wp.randf(rng) - 1.0)
        ctrl[world, axis] = wp.clamp(target, home[axis] - 0.01, home[axis] + 0.01)
    grip = wp.where((step[0] // 16) % 6 == 0, 0.0, -0.027)
    ctrl[world, 3] = grip
    ctrl[world, 4] = grip


@wp.kernel(enable_backward=False)
def count_step(step: wp.array[int]):
    """Count a control step."""
    step[0] = step[0] + 1
