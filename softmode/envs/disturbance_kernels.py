"""Device side of `disturbances`: delayed actions and observations, noise and bias, drives that differ."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Disturbance:
    """Columns of the parameters, -1 for what is off, and what is kept from step to step, the newest first."""

    action_delay: int  # [control steps]
    observation_delay: int
    observation_noise: int  # in units of `scale`
    observation_bias: int
    gain: int  # of stiffness and damping of the drives
    drive_friction: int  # share of the effort limit
    effort: int  # of that limit
    last_actions: int  # column of the observation, -1 for none
    scale: wp.array[float]  # of noise and bias of each number of the observation
    actions: wp.array3d[float]  # (world_count, steps, action_size)
    seen: wp.array3d[float]  # (world_count, steps, D)
    age: wp.array[int]  # control steps of the episode
    recorded: wp.array[int]  # the age whose observation was recorded last, -1 for none


@wp.struct
class Drives:
    """Properties of the drives, and what they are by default; degrees of freedom of one world after another."""

    joint_target_ke: wp.array[float]
    joint_target_kd: wp.array[float]
    joint_friction: wp.array[float]
    joint_effort_limit: wp.array[float]
    stiffness: wp.array[float]
    damping: wp.array[float]
    own_friction: wp.array[float]
    effort: wp.array[float]


@wp.func
def drawn(parameters: wp.array2d[float], world: int, column: int, otherwise: float):
    """Return a parameter of a world, or what holds where it is off."""
    if column < 0:
        return otherwise
    return parameters[world, column]


@wp.func
def push(history: wp.array3d[float], world: int, k: int, value: float):
    """Put a number in front of those of earlier steps."""
    for i in range(history.shape[1] - 1, 0, -1):
        history[world, i, k] = history[world, i - 1, k]
    history[world, 0, k] = value


@wp.func
def delayed(history: wp.array3d[float], world: int, k: int, delay: float):
    """Return a number as it was some steps ago, interpolated between two."""
    whole = int(delay)
    last = history.shape[1] - 1
    now = history[world, wp.min(whole, last), k]
    return now + (delay - float(whole)) * (history[world, wp.min(whole + 1, last), k] - now)


@wp.kernel
def delay_actions(
    parameters: wp.array2d[float],
    given: Disturbance,
    # In, out:
    actions: wp.array2d[float],
):
    """Remember the actions of a control step and put those in their place that arrive now."""
    w = wp.tid()
    given.age[w] = given.age[w] + 1
    delay = drawn(parameters, w, given.action_delay, 0.0)
    for k in range(actions.shape[1]):
        push(given.actions, w, k, wp.where(wp.isfinite(actions[w, k]), wp.clamp(actions[w, k], -1.0, 1.0), 0.0))
        actions[w, k] = delayed(given.actions, w, k, delay)


@wp.kernel
def disturb_observation(
    parameters: wp.array2d[float],
    seed: wp.array[int],
    episode: wp.array[int],
    given: Disturbance,
    # In, out:
    observation: wp.array2d[float],
):
    """Add noise and bias, and put what is seen with delay in their place; the last actions as they were sent.

    A second call in the same control step changes nothing.
    """
    w = wp.tid()
    noise = drawn(parameters, w, given.observation_noise, 0.0)
    bias = drawn(parameters, w, given.observation_bias, 0.0)
    delay = drawn(parameters, w, given.observation_delay, 0.0)
    own = seed[w] ^ 0x5BD1E995
    of_episode = wp.rand_init(own, -1 - episode[w])
    of_step = wp.rand_init(own, episode[w] * 100003 + given.age[w])
    for k in range(observation.shape[1]):
        offset = bias * wp.randn(of_episode) + noise * wp.randn(of_step)
        value = observation[w, k] + given.scale[k] * offset
        if given.recorded[w] < 0:
            for i in range(given.seen.shape[1]):
                given.seen[w, i, k] = value
        elif given.recorded[w] != given.age[w]:
            push(given.seen, w, k, value)
        if given.scale[k] >= 0.0:
            observation[w, k] = delayed(given.seen, w, k, delay)
    given.recorded[w] = given.age[w]
    if given.last_actions >= 0:
        size = given.actions.shape[2]
        for k in range(size):
            for i in range(3):
                observation[w, given.last_actions + i * size + k] = given.actions[w, i, k]


@wp.kernel
def begin_disturbance(world_mask: wp.array[wp.bool], given: Disturbance):
    """Forget actions and observations of the masked worlds."""
    w = wp.tid()
    if world_mask[w]:
        given.age[w] = 0
        given.recorded[w] = -1
        for i in range(given.actions.shape[1]):
            for k in range(given.actions.shape[2]):
                given.actions[w, i, k] = 0.0


@wp.kernel
def set_drives(parameters: wp.array2d[float], stride: int, given: Disturbance, drives: Drives):
    """Write the drives of every world."""
    w, d = wp.tid()
    i = w * stride + d
    gain = drawn(parameters, w, given.gain, 1.0)
    drives.joint_target_ke[i] = gain * drives.stiffness[i]
    drives.joint_target_kd[i] = gain * drives.damping[i]
    drives.joint_effort_limit[i] = drawn(parameters, w, given.effort, 1.0) * drives.effort[i]
    dry = drawn(parameters, w, given.drive_friction, 0.0) * drives.effort[i]
    drives.joint_friction[i] = drives.own_friction[i] + dry
