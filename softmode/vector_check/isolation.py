"""Rules ``isolation`` and ``no shared buffers``: worlds, and the caller's arrays, are left alone."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from softmode.errors import EnvironmentCheckError
from softmode.vector_check.episodes import Event
from softmode.vector_check.reference import DEPTH, MASK_HINT, REFUSALS, Reference, Skip, bits
from softmode.vector_check.values import equal, leaves

_APART = "let a world's state depend on its own action and seed alone"
_OWN = "return a copy of internal arrays from every call"


def actions_apart(run: Reference) -> None:
    """The action of one world changes no other."""
    subject = run.subject
    if subject.num_envs == 1:
        raise Skip("there is one world")
    for world in (0, subject.num_envs - 1):
        actions = [subject.other_action(action, world) for action in subject.actions[:DEPTH]]
        for mine, other in zip(run.events, subject.run(DEPTH, actions=actions), strict=False):
            if mine.done.any() or other.done.any():
                break
            run.same_worlds(
                mine, other, "isolation", f"another action of world {world}", _APART, without=world, same=True
            )


def partial_reset(run: Reference) -> None:
    """``reset(options={"reset_mask": mask})`` restarts the worlds of the mask and leaves the others alone."""
    subject = run.subject
    if subject.num_envs == 1:
        raise Skip("there is one world")
    start = max(1, min(3, run.first_end or 1, subject.steps - 1))
    if run.first_end is not None and start > run.first_end:
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
                f"reset(options={{'reset_mask': ...}}) is refused: {error}", rule="isolation", hint=MASK_HINT
            ) from error
        raise Skip(f"reset_mask is refused: {error}") from error
    kept = [equal(before.observation[i], event.observation[i]) for i in range(world)]
    if not any(kept) and equal(full.observation, event.observation) and subject.mode is not AutoresetMode.DISABLED:
        raise Skip("reset_mask is ignored, which only DISABLED mode forbids")
    if not all(kept):
        message = f"a reset of world {world} changed its observation"
        raise EnvironmentCheckError(message, rule="isolation", world=kept.index(False), hint=MASK_HINT)
    if run.exchangeable and not equal(full.observation[world], event.observation[world]):
        message = "reset by its mask it sees something else than after a reset of all worlds"
        raise EnvironmentCheckError(message, rule="isolation", world=world, hint=MASK_HINT)
    # `start` is at most the first end, so events and steps still agree in number.
    for mine, action in zip(run.steps[start:], subject.actions[start : start + DEPTH], strict=False):
        other = subject.step(action)
        run.same_worlds(mine, other, "isolation", f"a reset of world {world}", MASK_HINT, without=world, same=True)
        if mine.done.any() or other.done.any():
            break


def no_shared_buffers(run: Reference) -> None:
    """What was returned never changes again, shares no memory with later results, and may be written to."""
    kept = [list(leaves(event.returned)) for event in run.events]
    for index, (arrays, copies) in enumerate(zip(kept, run.copies, strict=True)):
        for (path, array), (_, copy) in zip(arrays, copies, strict=True):
            if bits(array) != copy:
                message = f"{_part(path, run.events[index])} of call {index} changed after it was returned"
                raise EnvironmentCheckError(message, rule="no shared buffers", hint=_OWN)
    for index in range(1, min(len(kept), 6)):
        for path, array in kept[index]:
            for earlier, other in kept[index - 1]:
                if _share(array, other):
                    raise EnvironmentCheckError(
                        f"{_part(path, run.events[index])} of call {index} shares memory with "
                        f"{_part(earlier, run.events[index - 1])} of the call before",
                        rule="no shared buffers",
                        hint=_OWN,
                    )
    what = "a run whose returned arrays the caller writes to"
    try:
        again = run.subject.run(run.subject.steps, overwrite=True)
    except EnvironmentCheckError as error:
        raise EnvironmentCheckError(f"{what} fails: {error}", rule="no shared buffers", hint=_OWN) from error
    run.compare(again, "no shared buffers", what, _OWN)


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
