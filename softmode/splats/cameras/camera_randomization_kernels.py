"""Device code of `camera_randomization`: draws per view, keyed by seed, draw and camera."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def stream(seed: int, episode: int, index: int) -> int:
    """Return the key of an independent stream of random numbers; each step hashes."""
    return int(wp.rand_init(int(wp.rand_init(seed, episode)), index))


@wp.func
def spread(key: int, quantity: int) -> float:
    """Return a uniform number in [-1, 1); a quantity keeps its draw when others are added."""
    return wp.randf(wp.rand_init(key, quantity), -1.0, 1.0)


@wp.func
def spread3(key: int, quantity: int) -> wp.vec3:
    """Return three uniform numbers in [-1, 1)."""
    state = wp.rand_init(key, quantity)
    x = wp.randf(state, -1.0, 1.0)
    y = wp.randf(state, -1.0, 1.0)
    z = wp.randf(state, -1.0, 1.0)
    return wp.vec3(x, y, z)


@wp.func
def unit_range(c: wp.vec3) -> wp.vec3:
    """Clamp a colour to 0..1."""
    return wp.vec3(wp.clamp(c[0], 0.0, 1.0), wp.clamp(c[1], 0.0, 1.0), wp.clamp(c[2], 0.0, 1.0))


@wp.kernel
def draw_views(
    world_mask: wp.array[wp.bool],  # (world_count,)
    seed: wp.array[int],  # (world_count,)
    episode: wp.array[int],  # (world_count,) draws so far
    # Described:
    lens: wp.array[wp.vec4],  # (camera_count,) [px]
    horizon: wp.vec3,
    zenith: wp.vec3,
    # Half widths:
    rotation: float,  # [rad]
    translation: float,  # [m]
    focal: float,
    principal_point: float,  # [px]
    sky: float,
    light: float,
    light_tint: float,
    splat_opacity: float,
    splat_brightness: float,
    splat_tint: float,
    # Out:
    offset_out: wp.array[wp.transform],  # (view_count,)
    intrinsics_out: wp.array[wp.vec4],  # (view_count,) [px]
    horizon_out: wp.array[wp.vec3],  # (world_count,)
    zenith_out: wp.array[wp.vec3],  # (world_count,)
    light_gain_out: wp.array[wp.vec3],  # (world_count,)
    splat_gain_out: wp.array[wp.vec4],  # (view_count,)
):
    """Draw each view's pose and lens from the camera's stream, the rest from the stream of its world."""
    view = wp.tid()
    world_count = world_mask.shape[0]
    world = view % world_count
    if not world_mask[world]:
        return
    camera = view / world_count
    own = stream(seed[world], episode[world], camera + 1)
    turn = rotation * spread3(own, 0)
    angle = wp.length(turn)
    quat = wp.quat_identity()
    if angle > 0.0:
        quat = wp.quat_from_axis_angle(turn / angle, angle)
    offset_out[view] = wp.transform(translation * spread3(own, 1), quat)
    k = lens[camera]
    zoom = 1.0 + focal * spread(own, 2)
    x = k[2] + principal_point * spread(own, 3)
    y = k[3] + principal_point * spread(own, 4)
    intrinsics_out[view] = wp.vec4(zoom * k[0], zoom * k[1], x, y)

    shared = stream(seed[world], episode[world], 0)
    low = unit_range(horizon + sky * spread3(shared, 0))
    high = unit_range(zenith + sky * spread3(shared, 1))
    ones = wp.vec3(1.0, 1.0, 1.0)
    gain = (1.0 + light * spread(shared, 2)) * (ones + light_tint * spread3(shared, 3))
    opacity = 1.0 + splat_opacity * spread(shared, 4)
    color = (1.0 + splat_brightness * spread(shared, 5)) * (ones + splat_tint * spread3(shared, 6))
    splat_gain_out[view] = wp.vec4(color[0], color[1], color[2], opacity)
    if camera == 0:
        horizon_out[world] = low
        zenith_out[world] = high
        p = 1.0 / 2.2
        light_gain_out[world] = wp.vec3(wp.pow(gain[0], p), wp.pow(gain[1], p), wp.pow(gain[2], p))


@wp.kernel
def count_draw(
    world_mask: wp.array[wp.bool],
    # Out:
    episode_out: wp.array[int],
):
    """Count the draws of the masked worlds."""
    world = wp.tid()
    if world_mask[world]:
        episode_out[world] += 1
