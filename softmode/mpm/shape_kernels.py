"""Device side of rigid shapes on the grid: what they do to the velocities of nodes inside of them, and the adjoint."""

from typing import Any

import warp as wp

from softmode.deformables.contact.detection_kernels import Shapes
from softmode.deformables.contact.shape_query_kernels import HEIGHTFIELD, PLANE, query_heightfield, query_shape
from softmode.deformables.model.declare import struct
from softmode.mpm.step_kernels import fail

wp.set_module_options({"enable_backward": False})

STICK = wp.constant(0)
SLIP = wp.constant(1)
INSIDE = wp.constant(4)
"""Failure: a particle began inside of a shape."""


@struct
class Obstacles:
    """The shapes that particles meet."""

    shapes: Shapes
    index: wp.array[int]  # (S,), of the shape in the model
    world: wp.array[int]  # (S,), -1 for all worlds
    boundary: wp.array[int]  # (S,): STICK, SLIP, or else separate


@struct
class Touch:
    """What a shape asks of a node."""

    inside: int
    normal: wp.vec3  # outward, unit
    velocity: wp.vec3  # of the shape there [m/s]
    arm: wp.vec3  # from the centre of mass of the shape's body, or from the origin [m]


@wp.func
def touch(obstacles: Obstacles, s: int, world: int, x: wp.vec3, time: float):
    """Return whether a point lies in a shape or its margin; bodies move on with their velocities from the start."""
    out = Touch()
    if obstacles.world[s] >= 0 and obstacles.world[s] != world:
        return out
    shape = obstacles.index[s]
    body = obstacles.shapes.body[shape]
    pose = obstacles.shapes.transform[shape]
    turn = wp.quat_identity()
    centre = wp.vec3()
    before = x  # the point that moves with the shape, at the start
    out.arm = x
    if body >= 0:
        place = obstacles.shapes.body_q[body]
        twist = obstacles.shapes.body_qd[body]
        spin = wp.spatial_bottom(twist)
        centre = wp.transform_point(place, obstacles.shapes.body_com[body])
        out.arm = x - centre - time * wp.spatial_top(twist)
        out.velocity = wp.spatial_top(twist) + wp.cross(spin, out.arm)
        rate = wp.length(spin)
        if rate > 0.0:
            turn = wp.quat_from_axis_angle(spin / rate, rate * time)
        before = centre + wp.quat_rotate_inv(turn, out.arm)
        pose = place * pose
    local = wp.transform_point(wp.transform_inverse(pose), before)
    kind = obstacles.shapes.kind[shape]
    margin = obstacles.shapes.margin[shape]
    lower = obstacles.shapes.lower[shape]
    upper = obstacles.shapes.upper[shape]
    if kind != PLANE and kind != HEIGHTFIELD:
        if wp.min(local - lower) < -margin or wp.min(upper - local) < -margin:
            return out
    far = wp.length(upper - lower) + margin
    query = query_shape(kind, obstacles.shapes.scale[shape], obstacles.shapes.source[shape], local, far)
    if kind == HEIGHTFIELD:
        query = query_heightfield(local, obstacles.shapes.fields, obstacles.shapes.fields.index[shape], 1.0e6)
    if query.distance < margin:
        out.inside = 1
        out.normal = wp.quat_rotate(turn, wp.transform_vector(pose, query.normal))
    return out


@wp.func
def collide(v: Any, at: Touch, boundary: int, friction: float):
    """Return the velocity of a node in a shape: the shape's, or without the part along the normal.

    A node that separates goes freely; one that comes in is slowed along the shape by Coulomb friction.
    """
    moving = type(v)(at.velocity)
    if boundary == STICK:
        return moving
    n = wp.normalize(type(v)(at.normal))
    u = v - moving
    along = wp.dot(u, n)
    slide = u - along * n
    if boundary == SLIP:
        return moving + slide
    if along >= type(along)(0.0):
        return v
    speed = wp.length(slide)
    grip = -type(along)(friction) * along
    if speed <= grip:
        return moving
    return moving + (type(along)(1.0) - grip / speed) * slide


@wp.func
def collide_adjoint(v: Any, at: Touch, boundary: int, friction: float, bar: Any):
    """Return dL/dv before :func:`collide` from dL/dv after it.

    Where the node slides, v' = P u + mu (u.n) t with P = I - n n^T and t = P u / |P u|.
    """
    if boundary == STICK:
        return type(v)()
    n = wp.normalize(type(v)(at.normal))
    u = v - type(v)(at.velocity)
    along = wp.dot(u, n)
    slide = u - along * n
    flat = bar - wp.dot(bar, n) * n
    if boundary == SLIP:
        return flat
    if along >= type(along)(0.0):
        return bar
    speed = wp.length(slide)
    mu = type(along)(friction)
    if speed <= -mu * along:
        return type(v)()
    t = slide / speed
    return flat + (mu * along / speed) * (flat - wp.dot(flat, t) * t) + (mu * wp.dot(t, bar)) * n


@wp.func
def node_at(i: int, j: int, k: int, origin: Any, dx: Any):
    """Return where a node is."""
    return wp.vec3(origin + dx * type(origin)(type(dx)(i), type(dx)(j), type(dx)(k)))


@wp.kernel(enable_backward=False, module="unique")
def collide_grid(
    obstacles: Obstacles,
    grid_mass: wp.array4d[Any],
    least_mass: Any,
    origin: Any,
    dx: Any,
    first: wp.array[wp.vec3i],
    time: float,
    # In and out:
    grid_velocity: wp.array4d[Any],
    # Out, added to:
    impulse: wp.array3d[wp.spatial_vectord],
):
    """Let the shapes act on the nodes inside of them, one after another; add what they get back."""
    world, i, j, k = wp.tid()
    m = grid_mass[world, i, j, k]
    if m > least_mass:
        x = node_at(i + first[0][0], j + first[0][1], k + first[0][2], origin, dx)
        v = grid_velocity[world, i, j, k]
        for s in range(obstacles.index.shape[0]):
            at = touch(obstacles, s, world, x, time)
            if at.inside != 0:
                shape = obstacles.index[s]
                after = collide(v, at, obstacles.boundary[s], obstacles.shapes.friction[shape])
                push = wp.vec3d(m * (v - after))
                turn = wp.cross(wp.vec3d(at.arm), push)
                both = wp.spatial_vectord(push[0], push[1], push[2], turn[0], turn[1], turn[2])
                wp.atomic_add(impulse, 0, world, shape, both)
                v = after
        grid_velocity[world, i, j, k] = v


@wp.kernel(enable_backward=False, module="unique")
def collide_grid_adjoint(
    obstacles: Obstacles,
    grid_mass: wp.array4d[Any],
    least_mass: Any,
    origin: Any,
    dx: Any,
    first: wp.array[wp.vec3i],
    time: float,
    free_velocity: wp.array4d[Any],
    # In: bar of the velocity after the shapes; out: of that before.
    grid_bar: wp.array4d[Any],
):
    """Adjoint of :func:`collide_grid`: the shapes in reverse, each with the velocity that the others before it left."""
    world, i, j, k = wp.tid()
    if grid_mass[world, i, j, k] > least_mass:
        x = node_at(i + first[0][0], j + first[0][1], k + first[0][2], origin, dx)
        both = grid_bar[world, i, j, k]
        bar = type(origin)(both[0], both[1], both[2])
        count = obstacles.index.shape[0]
        for back in range(count):
            last = count - 1 - back
            at = touch(obstacles, last, world, x, time)
            if at.inside != 0:
                v = free_velocity[world, i, j, k]
                for s in range(last):
                    earlier = touch(obstacles, s, world, x, time)
                    if earlier.inside != 0:
                        friction = obstacles.shapes.friction[obstacles.index[s]]
                        v = collide(v, earlier, obstacles.boundary[s], friction)
                friction = obstacles.shapes.friction[obstacles.index[last]]
                bar = collide_adjoint(v, at, obstacles.boundary[last], friction, bar)
        grid_bar[world, i, j, k] = grid_bar.dtype(bar[0], bar[1], bar[2], both[3])


@wp.kernel(enable_backward=False, module="unique")
def find_inside(obstacles: Obstacles, x: wp.array2d[Any], mass: wp.array2d[Any], failure: wp.array2d[int]):
    """Note particles that begin inside of a shape."""
    world, p = wp.tid()
    if mass[world, p] > type(mass[world, p])(0.0):
        for s in range(obstacles.index.shape[0]):
            if touch(obstacles, s, world, wp.vec3(x[world, p]), 0.0).inside != 0:
                fail(failure, world, INSIDE, 0, p)


@wp.kernel(enable_backward=False)
def add_wrenches(
    impulse: wp.array3d[wp.spatial_vectord],
    duration: wp.float64,
    shape_body: wp.array[int],
    # Out, added to:
    body_f: wp.array[wp.spatial_vector],
):
    """Add the mean wrench of a run to the bodies whose shapes got it."""
    shape = wp.tid()
    body = shape_body[shape]
    if body >= 0:
        total = wp.spatial_vectord()
        for step in range(impulse.shape[0]):
            for world in range(impulse.shape[1]):
                total += impulse[step, world, shape]
        mean = wp.spatial_vector()
        for row in range(6):
            mean[row] = float(total[row] / duration)
        wp.atomic_add(body_f, body, mean)
