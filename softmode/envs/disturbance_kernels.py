"""Device side of `disturbances`: delayed actions and observations, noise and bias, drives that differ."""

from enum import IntEnum

import warp as wp

wp.set_module_options({"enable_backward": False})

Disturbed = IntEnum(
    "Disturbed",
    "action_delay observation_delay observation_noise observation_bias gain drive_friction effort",
    start=0,
)


@wp.struct
class Disturbance:
    """Where the parameters stand, and what is kept from step to step, the newest first."""

    first: int  # column of the parameters; `Disturbed` counts from there
    last_actions: int  # column of the observation, -1 for none
    scale: wp.array[float]  # of noise and bias of each number of the observation
    actions: wp.array3d[float]  # (world_count, steps, action_size)
    seen: wp.array3d[float]  # (world_count, steps, D)
    age: wp.array[int]  # control steps of the episode
    recorded: wp.array[int]  # the age whose observation was recorded last, -1 for none


@wp.func
def push(history: wp.array3d[float], world: int, k: int, value: float):
    """Put a number in front of those of earlier steps."""
    for i in range(history.shape[1] - 1, 0, -1):
        history[world, i, k] = history[world, i - 1, k]
    history[world, 0, k] = value


@wp.func
def delayed(history: wp.array3d[float], world: int, k: int, delay: float):
    """Return a number as it was some steps ago, interpolated between two."""
    i = int(delay)
    later = history[world, i, k]
    if delay == float(i):
        return later
    return later + (delay - float(i)) * (history[world, i + 1, k] - later)


@wp.kernel
def delay_actions(parameters: wp.array2d[float], given: Disturbance, actions: wp.array2d[float]):
    """Remember the actions of a control step and put those in their place that arrive now."""
    w = wp.tid()
    given.age[w] = given.age[w] + 1
    for k in range(actions.shape[1]):
        push(given.actions, w, k, wp.where(wp.isfinite(actions[w, k]), wp.clamp(actions[w, k], -1.0, 1.0), 0.0))
        actions[w, k] = delayed(given.actions, w, k, parameters[w, given.first + Disturbed.action_delay])


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
    noise = parameters[w, given.first + Disturbed.observation_noise]
    bias = parameters[w, given.first + Disturbed.observation_bias]
    own = seed[w] ^ 0x5BD1E995
    of_episode = wp.rand_init(own, -1 - episode[w])
    of_step = wp.rand_init(own, episode[w] * 100003 + given.age[w])
    for k in range(observation.shape[1]):
        error = given.scale[k] * (bias * wp.randn(of_episode) + noise * wp.randn(of_step))
        if given.recorded[w] != given.age[w]:
            push(given.seen, w, k, observation[w, k] + error)
        if given.recorded[w] < 0:  # before the first there was nothing else
            for i in range(1, given.seen.shape[1]):
                given.seen[w, i, k] = given.seen[w, 0, k]
        observation[w, k] = delayed(given.seen, w, k, parameters[w, given.first + Disturbed.observation_delay])
    given.recorded[w] = given.age[w]
    if given.last_actions >= 0:
        size = given.actions.shape[2]
        for k in range(3 * size):
            observation[w, given.last_actions + k] = given.actions[w, k / size, k % size]


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
def set_drives(
    parameters: wp.array2d[float],
    first: int,
    own: wp.array2d[float],  # what follows, as it is by default, (4, degrees of freedom of one world after another)
    # Out:
    stiffness: wp.array[float],
    damping: wp.array[float],
    friction: wp.array[float],
    effort: wp.array[float],
):
    """Write the drives of every world."""
    i = wp.tid()
    w = i / (own.shape[1] / parameters.shape[0])
    stiffness[i] = parameters[w, first + Disturbed.gain] * own[0, i]
    damping[i] = parameters[w, first + Disturbed.gain] * own[1, i]
    friction[i] = own[2, i] + parameters[w, first + Disturbed.drive_friction] * own[3, i]
    effort[i] = parameters[w, first + Disturbed.effort] * own[3, i]
