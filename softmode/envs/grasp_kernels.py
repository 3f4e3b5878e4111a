"""What a touch and a grasp are, for rewards."""

import warp as wp

TOUCH_FORCE = wp.constant(0.02)
"""Force from which a finger counts as touching [N]."""


@wp.func
def grasped(finger_force: wp.array2d[wp.vec3], world: int):
    """Return whether both fingers feel the object."""
    return wp.length(finger_force[world, 0]) > TOUCH_FORCE and wp.length(finger_force[world, 1]) > TOUCH_FORCE


@wp.func
def touched(finger_force: wp.array2d[wp.vec3], world: int):
    """Return whether any finger feels an object."""
    return wp.length(finger_force[world, 0]) > TOUCH_FORCE or wp.length(finger_force[world, 1]) > TOUCH_FORCE
