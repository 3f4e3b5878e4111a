"""Rules ``autoreset`` and ``time limit``: how episodes end and begin."""

from __future__ import annotations

import numpy as np
from gymnasium.vector import AutoresetMode

from softmode.errors import EnvironmentCheckError
from softmode.vector_check.episodes import Event
from softmode.vector_check.reference import MASK_HINT, Reference, Skip
from softmode.vector_check.tensors import world_of
from softmode.vector_check.values import equal


def autoreset(run: Reference) -> None:
    """Worlds restart as metadata["autoreset_mode"] says."""
    if run.first_end is None:
        raise Skip(f"no episode ended in {run.subject.steps} steps")
    check = {
        AutoresetMode.NEXT_STEP: _next_step,
        AutoresetMode.SAME_STEP: _same_step,
        AutoresetMode.DISABLED: _disabled,
    }
    check[run.subject.mode](run)


def _next_step(run: Reference) -> None:
    """The step after the last returns the first observation, reward 0 and no flags, and ignores the action."""
    subject, end = run.subject, run.first_end
    assert end is not None
    for index, (event, after) in enumerate(zip(run.steps, run.steps[1:], strict=False)):
        for world in np.flatnonzero(event.done):
            if after.reward[world] != 0.0 or after.done[world]:
                raise EnvironmentCheckError(
                    f"step {index + 1} follows the end of an episode and returns reward {after.reward[world]}, "
                    f"terminated {after.terminated[world]}, truncated {after.truncated[world]}",
                    rule="autoreset",
                    world=int(world),
                    hint="in NEXT_STEP mode that step only resets: reward 0, both flags False",
                )
    if end + 1 >= len(run.steps):
        raise Skip("the first episode ended with the last step")
    for world in np.flatnonzero(run.steps[end].done):
        actions = list(subject.actions[: end + 3])
        actions[end + 1] = subject.other_action(actions[end + 1], int(world))
        for mine, other in zip(run.events, subject.run(end + 3, actions=actions), strict=False):
            part = mine.differs(other, int(world))
            if part:
                message = f"the {part} depends on the action given in the step that resets the world"
                hint = "in NEXT_STEP mode ignore the action of a world that is being reset"
                raise EnvironmentCheckError(message, rule="autoreset", world=int(world), hint=hint)
        _restarted(run, int(world), run.steps[end + 1], after=end + 1)


def _same_step(run: Reference) -> None:
    """The last step returns the first observation of the next episode, and the last one in the infos."""
    end = run.first_end
    assert end is not None
    event = run.steps[end]
    before = run.events[end]
    for world in map(int, np.flatnonzero(event.done)):
        first, last = event.observation[world], world_of(event.infos["final_obs"], world)
        if equal(first, last) and not equal(before.observation[world], first):
            raise EnvironmentCheckError(
                "the observation of the step that ends an episode equals infos['final_obs']",
                rule="autoreset",
                world=world,
                hint="in SAME_STEP mode return the new episode's first observation and put the old one's last "
                "into infos['final_obs']",
            )
        _restarted(run, world, event, after=end)


def _disabled(run: Reference) -> None:
    """A reset with ``reset_mask`` restarts the finished worlds; the others keep their observation."""
    end = run.first_end
    assert end is not None
    position = next(index for index, event in enumerate(run.events) if event.done.any())
    if position + 1 >= len(run.events):
        raise Skip("the first episode ended with the last step")
    event, after = run.events[position : position + 2]
    for world in range(run.subject.num_envs):
        if event.done[world]:
            _restarted(run, world, after, after=end + 1)
        elif not equal(event.observation[world], after.observation[world]):
            message = "a reset that its mask excludes it from changed its observation"
            raise EnvironmentCheckError(message, rule="isolation", world=world, hint=MASK_HINT)


def _restarted(run: Reference, world: int, event: Event, *, after: int) -> None:
    """Compare with a reset of all worlds made at the same point, which draws the same numbers."""
    if not run.exchangeable:
        return
    subject = run.subject
    subject.run(0)
    at_once = subject.reset()
    # `run` restarts what ended in DISABLED mode, so the full reset comes before that.
    subject.run(after - 1 if subject.mode is AutoresetMode.DISABLED else after)
    if subject.mode is AutoresetMode.DISABLED:
        subject.step(subject.actions[after - 1])
    here = subject.reset()
    if subject.mode is AutoresetMode.SAME_STEP and not equal(at_once.observation[world], here.observation[world]):
        return  # steps draw random numbers too, and this reset comes one step before the one in question
    if not equal(here.observation[world], event.observation[world]):
        raise EnvironmentCheckError(
            f"after the end of an episode it sees {event.observation[world]!r}, reset() at that point gives "
            f"{here.observation[world]!r}",
            rule="autoreset",
            world=world,
            hint="return the first observation of the new episode, drawn from the world's own random stream",
        )


def time_limit(run: Reference) -> None:
    """Episodes are truncated at ``max_episode_steps``, neither before nor after."""
    if run.limit is None:
        raise Skip("there is no time limit")
    length = np.zeros(run.subject.num_envs, int)
    pending = np.zeros(run.subject.num_envs, np.bool_)
    reached = False
    for event in run.steps:
        length = np.where(pending, 0, length + 1)
        for world in map(int, np.flatnonzero(event.done | (length >= run.limit))):
            late = length[world] > run.limit or (length[world] == run.limit and not event.done[world])
            if late:
                raise EnvironmentCheckError(
                    f"an episode goes on after {length[world]} steps, max_episode_steps is {run.limit}",
                    rule="time limit",
                    world=world,
                    hint="count the steps of each world and truncate it; gymnasium.make_vec adds no TimeLimit to "
                    "an environment made by vector_entry_point",
                )
            early = event.truncated[world] and length[world] < run.limit
            if early:
                message = f"an episode is truncated after {length[world]} steps, max_episode_steps is {run.limit}"
                hint = "restart the count when a world is reset"
                raise EnvironmentCheckError(message, rule="time limit", world=world, hint=hint)
            reached |= bool(length[world] == run.limit)
        pending = event.done if run.subject.mode is AutoresetMode.NEXT_STEP else np.zeros_like(pending)
        if run.subject.mode is not AutoresetMode.NEXT_STEP:
            length[event.done] = 0
    if not reached:
        raise Skip(f"no episode reached {run.limit} steps in {run.subject.steps} steps")
