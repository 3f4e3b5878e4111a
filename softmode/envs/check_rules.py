"""How a vector environment may behave: seeding, autoreset, isolation of worlds, bad actions, ownership of arrays."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

from softmode.envs.check_episodes import Event, Subject, is_continuous
from softmode.envs.check_values import equal, leaves, world_of
from softmode.errors import EnvironmentCheckError

REFUSALS = (ValueError, TypeError, AssertionError, gym.error.Error)
"""Types of error that refuse an argument; others are crashes."""

DEPTH = 5
"""Steps that a run goes on after a disturbance."""


class Skip(Exception):
    """A rule cannot be checked on this environment; the message says why."""


class Rules:
    """The rules on behaviour, each a method; all compare with one reference run.

    Args:
        subject: The environment.
        max_episode_steps: Time limit; None where there is none.
        exchangeable: Whether world i of ``reset(seed=s)`` is world 0 of ``reset(seed=s + i)``.
        ignored: Keys of infos that may differ from run to run, such as wall-clock times.
    """

    def __init__(
        self, subject: Subject, *, max_episode_steps: int | None, exchangeable: bool, ignored: frozenset[str]
    ) -> None:
        """Make the reference run."""
        self.subject, self.limit, self.exchangeable, self.ignored = subject, max_episode_steps, exchangeable, ignored
        self.reference = subject.run(subject.steps)
        """Events of the reference run; whatever was returned is kept."""
        self._copies = [[(path, _bits(array)) for path, array in leaves(event.returned)] for event in self.reference]
        self.steps = [event for event in self.reference if event.is_step]
        done = [index for index, event in enumerate(self.steps) if event.done.any()]
        self.first_end = done[0] if done else None
        """Index of the first step that ends an episode."""

    # -- seeding ------------------------------------------------------------------------------------------------------

    def same_seed(self) -> None:
        """The same seed and actions give the same trajectory, bit by bit."""
        again = self.subject.run(self.subject.steps)
        self._compare(again, "seeding", "a second run with the same seed and actions", _SEEDED)

    def seed_per_world(self) -> None:
        """World i of ``reset(seed=s)`` is world 0 of ``reset(seed=s + i)``."""
        subject = self.subject
        if not self.exchangeable:
            raise Skip("the worlds are not exchangeable")
        if subject.num_envs == 1:
            raise Skip("there is one world")
        for world in range(1, subject.num_envs):
            moved = [
                subject.replace_action(action, 0, subject.action_of(action, world))
                for action in subject.actions[:DEPTH]
            ]
            events = subject.run(len(moved), seed=subject.seed + world, actions=moved)
            for mine, other in zip(self.reference, events, strict=False):
                if mine.done.any() or other.done.any():
                    break
                if not equal(mine.observation[world], other.observation[0]):
                    raise EnvironmentCheckError(
                        f"seeded {subject.seed} + {world} it sees {mine.observation[world]!r}, "
                        f"world 0 with that seed {other.observation[0]!r}",
                        rule="seeding",
                        world=world,
                        hint="seed world i with seed + i and make draws depend on that seed alone",
                    )

    def seed_list(self) -> None:
        """A list of seeds gives each world its own."""
        subject = self.subject
        seeds = [subject.seed + world for world in range(subject.num_envs)]
        try:
            listed = subject.reset(seed=seeds)
        except REFUSALS as error:
            raise Skip(f"a list of seeds is refused: {error}") from error
        self._same_worlds(self.reference[0], listed, "seeding", f"reset(seed={seeds})", _SEED_LIST)
        if subject.num_envs > 1 and self.exchangeable:
            turned = subject.reset(seed=seeds[::-1])
            for world in range(subject.num_envs):
                if not equal(turned.observation[world], listed.observation[-1 - world]):
                    raise EnvironmentCheckError(
                        f"reset(seed={seeds[::-1]}) does not start it from seed {seeds[-1 - world]}",
                        rule="seeding",
                        world=world,
                        hint=_SEED_LIST,
                    )

    def seed_none(self) -> None:
        """``reset()`` goes on with the random stream; it neither starts the stream again nor takes a fresh seed."""
        subject = self.subject
        seconds = []
        for _ in range(2):
            subject.reset(seed=subject.seed)
            seconds.append(subject.reset())
        self._same_worlds(seconds[0], seconds[1], "seeding", "reset() after the same seed", _STREAM)
        other = subject.reset(seed=subject.seed + 1000)
        first = self.reference[0]
        for world in range(subject.num_envs):
            random = not equal(first.observation[world], other.observation[world])
            if random and equal(first.observation[world], seconds[0].observation[world]):
                raise EnvironmentCheckError(
                    "reset() repeats the first episode of the seed", rule="seeding", world=world, hint=_STREAM
                )

    # -- episodes -----------------------------------------------------------------------------------------------------

    def autoreset(self) -> None:
        """Worlds restart as metadata["autoreset_mode"] says."""
        if self.first_end is None:
            raise Skip(f"no episode ended in {self.subject.steps} steps")
        {
            AutoresetMode.NEXT_STEP: self._next_step,
            AutoresetMode.SAME_STEP: self._same_step,
            AutoresetMode.DISABLED: self._disabled,
        }[self.subject.mode]()

    def _next_step(self) -> None:
        """The step after the last returns the first observation, reward 0 and no flags, and ignores the action."""
        subject, end = self.subject, self.first_end
        assert end is not None
        for index, (event, after) in enumerate(zip(self.steps, self.steps[1:], strict=False)):
            for world in np.flatnonzero(event.done):
                if after.reward[world] != 0.0 or after.done[world]:
                    raise EnvironmentCheckError(
                        f"step {index + 1} follows the end of an episode and returns reward {after.reward[world]}, "
                        f"terminated {after.terminated[world]}, truncated {after.truncated[world]}",
                        rule="autoreset",
                        world=int(world),
                        hint="in NEXT_STEP mode that step only resets: reward 0, both flags False",
                    )
        if end + 1 >= len(self.steps):
            raise Skip("the first episode ended with the last step")
        for world in np.flatnonzero(self.steps[end].done):
            actions = list(subject.actions[: end + 3])
            actions[end + 1] = subject.other_action(actions[end + 1], int(world))
            for mine, other in zip(self.reference, subject.run(end + 3, actions=actions), strict=False):
                part = mine.differs(other, int(world))
                if part:
                    raise EnvironmentCheckError(
                        f"the {part} depends on the action given in the step that resets the world",
                        rule="autoreset",
                        world=int(world),
                        hint="in NEXT_STEP mode ignore the action of a world that is being reset",
                    )
            self._restarted(int(world), self.steps[end + 1], after=end + 1)

    def _same_step(self) -> None:
        """The last step returns the first observation of the next episode, and the last one in the infos."""
        end = self.first_end
        assert end is not None
        event = self.steps[end]
        before = self.reference[end]
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
            self._restarted(world, event, after=end)

    def _disabled(self) -> None:
        """A reset with ``reset_mask`` restarts the finished worlds; the others keep their observation."""
        end = self.first_end
        assert end is not None
        position = next(index for index, event in enumerate(self.reference) if event.done.any())
        if position + 1 >= len(self.reference):
            raise Skip("the first episode ended with the last step")
        event, after = self.reference[position : position + 2]
        for world in range(self.subject.num_envs):
            if event.done[world]:
                self._restarted(world, after, after=end + 1)
            elif not equal(event.observation[world], after.observation[world]):
                raise EnvironmentCheckError(
                    "a reset that its mask excludes it from changed its observation",
                    rule="isolation",
                    world=world,
                    hint=_MASK,
                )

    def _restarted(self, world: int, event: Event, *, after: int) -> None:
        """Compare with a reset of all worlds made at the same point, which draws the same numbers."""
        if not self.exchangeable:
            return
        subject = self.subject
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

    def time_limit(self) -> None:
        """Episodes are truncated at ``max_episode_steps``, neither before nor after."""
        if self.limit is None:
            raise Skip("there is no time limit")
        length = np.zeros(self.subject.num_envs, int)
        pending = np.zeros(self.subject.num_envs, np.bool_)
        reached = False
        for event in self.steps:
            length = np.where(pending, 0, length + 1)
            for world in map(int, np.flatnonzero(event.done | (length >= self.limit))):
                late = length[world] > self.limit or (length[world] == self.limit and not event.done[world])
                if late:
                    raise EnvironmentCheckError(
                        f"an episode goes on after {length[world]} steps, max_episode_steps is {self.limit}",
                        rule="time limit",
                        world=world,
                        hint="count the steps of each world and truncate it; gymnasium.make_vec adds no TimeLimit to "
                        "an environment made by vector_entry_point",
                    )
                early = event.truncated[world] and length[world] < self.limit
                if early:
                    raise EnvironmentCheckError(
                        f"an episode is truncated after {length[world]} steps, max_episode_steps is {self.limit}",
                        rule="time limit",
                        world=world,
                        hint="restart the count when a world is reset",
                    )
                reached |= bool(length[world] == self.limit)
            pending = event.done if self.subject.mode is AutoresetMode.NEXT_STEP else np.zeros_like(pending)
            if self.subject.mode is not AutoresetMode.NEXT_STEP:
                length[event.done] = 0
        if not reached:
            raise Skip(f"no episode reached {self.limit} steps in {self.subject.steps} steps")

    # -- isolation ----------------------------------------------------------------------------------------------------

    def actions_apart(self) -> None:
        """The action of one world changes no other."""
        subject = self.subject
        if subject.num_envs == 1:
            raise Skip("there is one world")
        for world in (0, subject.num_envs - 1):
            actions = [subject.other_action(action, world) for action in subject.actions[:DEPTH]]
            for mine, other in zip(self.reference, subject.run(DEPTH, actions=actions), strict=False):
                if mine.done.any() or other.done.any():
                    break
                self._same_worlds(
                    mine, other, "isolation", f"another action of world {world}", _APART, without=world, same=True
                )

    def partial_reset(self) -> None:
        """``reset(options={"reset_mask": mask})`` restarts the worlds of the mask and leaves the others alone."""
        subject = self.subject
        if subject.num_envs == 1:
            raise Skip("there is one world")
        start = max(1, min(3, self.first_end or 1, subject.steps - 1))
        if self.first_end is not None and start > self.first_end:
            raise Skip("an episode ends in the first step")
        world = subject.num_envs - 1
        mask = np.arange(subject.num_envs) == world
        before = subject.run(start)[-1]
        full = subject.reset()
        subject.run(start)
        try:
            event = subject.reset(options={"reset_mask": mask})
        except REFUSALS as error:
            if subject.mode is AutoresetMode.DISABLED:
                raise EnvironmentCheckError(
                    f"reset(options={{'reset_mask': ...}}) is refused: {error}", rule="isolation", hint=_MASK
                ) from error
            raise Skip(f"reset_mask is refused: {error}") from error
        kept = [equal(before.observation[i], event.observation[i]) for i in range(world)]
        if not any(kept) and equal(full.observation, event.observation) and subject.mode is not AutoresetMode.DISABLED:
            raise Skip("reset_mask is ignored, which only DISABLED mode forbids")
        if not all(kept):
            raise EnvironmentCheckError(
                f"a reset of world {world} changed its observation",
                rule="isolation",
                world=kept.index(False),
                hint=_MASK,
            )
        if self.exchangeable and not equal(full.observation[world], event.observation[world]):
            raise EnvironmentCheckError(
                "reset by its mask it sees something else than after a reset of all worlds",
                rule="isolation",
                world=world,
                hint=_MASK,
            )
        # `start` is at most the first end, so events and steps still agree in number.
        for mine, action in zip(self.steps[start:], subject.actions[start : start + DEPTH], strict=False):
            other = subject.step(action)
            self._same_worlds(mine, other, "isolation", f"a reset of world {world}", _MASK, without=world, same=True)
            if mine.done.any() or other.done.any():
                break

    # -- actions ------------------------------------------------------------------------------------------------------

    def nan_action(self) -> str | None:
        """NaN is refused before anything moves, or harms no other world and is gone after a reset."""
        self._for_floats()
        subject = self.subject
        world, at = subject.num_envs - 1, self._quiet_step()
        bad = subject.replace_action(
            subject.actions[at],
            world,
            np.full_like(subject.action_of(subject.actions[at], world), np.nan),
        )
        subject.run(at)
        note = None
        try:
            event = self._quietly(bad, lenient=world)
        except EnvironmentCheckError:
            raise
        except Exception as error:
            self._refused(error, at, "NaN")
        else:
            what = f"NaN in the action of world {world}"
            self._same_worlds(self.steps[at], event, "bad actions", what, _NAN, without=world, same=True)
            if any(array.dtype.kind == "f" and np.isnan(array).any() for _, array in leaves(event.observation[world])):
                note = "NaN in an action is accepted, and its world's observation is NaN until the next reset"
        self._same_worlds(self.reference[0], subject.reset(seed=subject.seed), "bad actions", "a reset after NaN", _NAN)
        return note

    def large_action(self) -> None:
        """Actions beyond the bounds are clipped or refused."""
        self._for_floats()
        subject = self.subject
        space = subject.env.action_space
        assert isinstance(space, gym.spaces.Box)
        for sign in (1.0, -1.0):
            bound = np.where(np.isfinite(space.high), np.abs(space.high), 1.0)
            subject.run(0)
            try:
                self._quietly((sign * (10.0 * bound + 10.0)).astype(space.dtype))
            except EnvironmentCheckError:
                raise
            except REFUSALS:
                pass
        self._same_worlds(
            self.reference[0],
            subject.reset(seed=subject.seed),
            "bad actions",
            "a reset after actions beyond the bounds",
            "clip actions to the bounds, or refuse them by a ValueError",
        )

    def wrong_shape(self) -> str | None:
        """Actions of another shape are refused before anything moves."""
        subject = self.subject
        self._not_async()
        action = subject.actions[self._quiet_step()]
        items = [subject.action_of(action, world) for world in range(subject.num_envs)]
        shapes = {f"{subject.num_envs + 1} worlds": (items[0], *items)}
        if isinstance(action, np.ndarray):
            shapes = {f"{subject.num_envs + 1} worlds": np.concatenate([action[:1], action])}
            if action.ndim > 1 and not subject.composed:
                shapes["one number more"] = np.concatenate([action, action[..., :1]], axis=-1)
            if not subject.composed and action.ndim > 1:
                shapes["no axis of worlds"] = action[0]
        for name, bad in shapes.items():
            subject.run(self._quiet_step())
            try:
                self._quietly(bad)
            except EnvironmentCheckError:
                raise
            except Exception as error:
                self._refused(error, self._quiet_step(), f"an action of {name}")
            else:
                raise EnvironmentCheckError(
                    f"an action of {name} is accepted",
                    rule="bad actions",
                    hint="compare the action's shape with action_space.shape and raise a ValueError that names both",
                )
        return "the shape of a single world's action is left to the single environments" if subject.composed else None

    def _for_floats(self) -> None:
        """Skip where actions are no floats."""
        self._not_async()
        if not is_continuous(self.subject.env.action_space):
            raise Skip("actions are not floating-point numbers")

    def _not_async(self) -> None:
        """Skip where an error ends the worker process."""
        if isinstance(self.subject.env.unwrapped, AsyncVectorEnv):
            raise Skip("an error in a worker closes an AsyncVectorEnv")

    def _quiet_step(self) -> int:
        """Return the index of an early step in which no episode ends."""
        return next((i for i in (2, 1, 0) if i < len(self.steps) and self._no_end(i)), 0)

    def _no_end(self, index: int) -> bool:
        """Whether no episode ended up to a step."""
        return not any(event.done.any() for event in self.steps[: index + 1])

    def _quietly(self, action: Any, lenient: int | None = None) -> Event:
        """Step without the warnings that bad numbers cause."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return self.subject.step(action, lenient=lenient)

    def _refused(self, error: Exception, at: int, what: str) -> None:
        """Check that an error is a refusal and that nothing moved."""
        subject = self.subject
        if not isinstance(error, REFUSALS):
            raise EnvironmentCheckError(
                f"{what} raises {type(error).__name__}: {error}",
                rule="bad actions",
                hint="check actions first and raise a ValueError or TypeError that says what was expected",
            ) from error
        if subject.composed:
            return  # single environments are stepped in turn, so those before the bad one have moved
        self._same_worlds(
            self.steps[at],
            subject.step(subject.actions[at]),
            "bad actions",
            f"{what}, refused,",
            "check actions before any world moves",
            same=True,
        )

    # -- arrays -------------------------------------------------------------------------------------------------------

    def no_shared_buffers(self) -> None:
        """What was returned never changes again, shares no memory with later results, and may be written to."""
        kept = [list(leaves(event.returned)) for event in self.reference]
        for index, (arrays, copies) in enumerate(zip(kept, self._copies, strict=True)):
            for (path, array), (_, copy) in zip(arrays, copies, strict=True):
                if _bits(array) != copy:
                    raise EnvironmentCheckError(
                        f"{_part(path, self.reference[index])} of call {index} changed after it was returned",
                        rule="no shared buffers",
                        hint=_OWN,
                    )
        for index in range(1, min(len(kept), 6)):
            for path, array in kept[index]:
                for earlier, other in kept[index - 1]:
                    if _share(array, other):
                        raise EnvironmentCheckError(
                            f"{_part(path, self.reference[index])} of call {index} shares memory with "
                            f"{_part(earlier, self.reference[index - 1])} of the call before",
                            rule="no shared buffers",
                            hint=_OWN,
                        )
        what = "a run whose returned arrays the caller writes to"
        try:
            again = self.subject.run(self.subject.steps, overwrite=True)
        except EnvironmentCheckError as error:
            raise EnvironmentCheckError(f"{what} fails: {error}", rule="no shared buffers", hint=_OWN) from error
        self._compare(again, "no shared buffers", what, _OWN)

    # -- comparing ----------------------------------------------------------------------------------------------------

    def _compare(self, events: list[Event], rule: str, what: str, hint: str) -> None:
        """Compare a whole run with the reference."""
        for index, (mine, other) in enumerate(zip(self.reference, events, strict=False)):
            for world in range(self.subject.num_envs):
                part = mine.differs(other, world, ignored=self.ignored, infos=True)
                if part:
                    raise EnvironmentCheckError(
                        f"{part} of call {index} differs in {what}", rule=rule, world=world, hint=hint
                    )

    def _same_worlds(
        self,
        mine: Event,
        other: Event,
        rule: str,
        what: str,
        hint: str,
        *,
        without: int | None = None,
        same: bool = False,
    ) -> None:
        """Compare two events world by world: the observations, and with ``same`` rewards and flags as well."""
        for world in range(self.subject.num_envs):
            if world == without:
                continue
            part = mine.differs(other, world) if same else ""
            if part or not equal(mine.observation[world], other.observation[world]):
                raise EnvironmentCheckError(
                    f"{what} changes its {part or 'observation'}", rule=rule, world=world, hint=hint
                )


_SEEDED = "draw every random number from generators that reset(seed=...) seeds, and clear all state in reset"
_SEED_LIST = "with a list of seeds give world i the i-th"
_STREAM = "seed the generators only when a seed is given, and let reset() draw on from them"
_APART = "let a world's state depend on its own action and seed alone"
_MASK = "reset only the worlds of options['reset_mask'] and return the others' present observations"
_NAN = "refuse actions that are not finite, or end the episode of their world alone"
_OWN = "return a copy of internal arrays from every call"


def _bits(array: Any) -> bytes:
    """Return an array's content."""
    if hasattr(array, "detach"):
        array = array.detach().cpu().numpy()
    return np.asarray(array).tobytes()


def _share(a: Any, b: Any) -> bool:
    """Whether two arrays share memory."""
    if hasattr(a, "untyped_storage") and hasattr(b, "untyped_storage"):
        return a.numel() > 0 and a.untyped_storage().data_ptr() == b.untyped_storage().data_ptr()
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.size > 0 and b.size > 0 and bool(np.shares_memory(a, b))
    return False


def _part(path: str, event: Event) -> str:
    """Name an array of what a call returned."""
    names = ("the observation", "the reward", "terminated", "truncated", "the infos")
    number, _, rest = path[1:].partition("]")
    return f"{names[int(number) if event.is_step else 4 * int(number)]}{rest}"
