"""Rule ``seeding``: what a seed determines, and what happens without one."""

from __future__ import annotations

from softmode.errors import EnvironmentCheckError
from softmode.vector_check.reference import DEPTH, REFUSALS, Reference, Skip
from softmode.vector_check.values import equal

_SEEDED = "draw every random number from generators that reset(seed=...) seeds, and clear all state in reset"
_SEED_LIST = "with a list of seeds give world i the i-th"
_STREAM = "seed the generators only when a seed is given, and let reset() draw on from them"


def same_seed(run: Reference) -> None:
    """The same seed and actions give the same trajectory, bit by bit."""
    again = run.subject.run(run.subject.steps)
    run.compare(again, "seeding", "a second run with the same seed and actions", _SEEDED)


def seed_per_world(run: Reference) -> None:
    """World i of ``reset(seed=s)`` is world 0 of ``reset(seed=s + i)``."""
    subject = run.subject
    if not run.exchangeable:
        raise Skip("the worlds are not exchangeable")
    if subject.num_envs == 1:
        raise Skip("there is one world")
    for world in range(1, subject.num_envs):
        moved = [
            subject.replace_action(action, 0, subject.action_of(action, world)) for action in subject.actions[:DEPTH]
        ]
        events = subject.run(len(moved), seed=subject.seed + world, actions=moved)
        for mine, other in zip(run.events, events, strict=False):
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


def seed_list(run: Reference) -> None:
    """A list of seeds gives each world its own."""
    subject = run.subject
    seeds = [subject.seed + world for world in range(subject.num_envs)]
    try:
        listed = subject.reset(seed=seeds)
    except REFUSALS as error:
        raise Skip(f"a list of seeds is refused: {error}") from error
    run.same_worlds(run.events[0], listed, "seeding", f"reset(seed={seeds})", _SEED_LIST)
    if subject.num_envs > 1 and run.exchangeable:
        turned = subject.reset(seed=seeds[::-1])
        for world in range(subject.num_envs):
            if not equal(turned.observation[world], listed.observation[-1 - world]):
                message = f"reset(seed={seeds[::-1]}) does not start it from seed {seeds[-1 - world]}"
                raise EnvironmentCheckError(message, rule="seeding", world=world, hint=_SEED_LIST)


def seed_none(run: Reference) -> None:
    """``reset()`` goes on with the random stream; it neither starts the stream again nor takes a fresh seed."""
    subject = run.subject
    seconds = []
    for _ in range(2):
        subject.reset(seed=subject.seed)
        seconds.append(subject.reset())
    run.same_worlds(seconds[0], seconds[1], "seeding", "reset() after the same seed", _STREAM)
    other = subject.reset(seed=subject.seed + 1000)
    first = run.events[0]
    for world in range(subject.num_envs):
        random = not equal(first.observation[world], other.observation[world])
        if random and equal(first.observation[world], seconds[0].observation[world]):
            raise EnvironmentCheckError(
                "reset() repeats the first episode of the seed", rule="seeding", world=world, hint=_STREAM
            )
