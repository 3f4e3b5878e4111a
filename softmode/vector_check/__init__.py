"""`check_vector_env`: does a vector environment keep Gymnasium's vector API?"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace

from gymnasium.vector import VectorEnv

from softmode.errors import ConfigError, EnvironmentCheckError
from softmode.vector_check import actions, autoreset, isolation, seeding
from softmode.vector_check.episodes import Event, Subject
from softmode.vector_check.reference import DEPTH, Reference, Skip
from softmode.vector_check.values import equal

RULES: dict[str, Callable[[Reference], str | None]] = {
    "same seed": seeding.same_seed,
    "isolation of actions": isolation.actions_apart,
    "seed per world": seeding.seed_per_world,
    "seed list": seeding.seed_list,
    "seed none": seeding.seed_none,
    "autoreset": autoreset.autoreset,
    "time limit": autoreset.time_limit,
    "partial reset": isolation.partial_reset,
    "no shared buffers": isolation.no_shared_buffers,
    "large action": actions.large_action,
    "wrong shape": actions.wrong_shape,
    "nan action": actions.nan_action,
}
"""The checks on behaviour, by the name that reports and ``skip`` use."""

VALUES: tuple[str, ...] = ("spaces", "autoreset mode", "observations", "rewards", "flags", "array kind", "info masks")
"""The rules that every call is held to."""


@dataclass(frozen=True, kw_only=True)
class VectorEnvReport:
    """What `check_vector_env` looked at; it raises at the first broken rule, so all of this holds."""

    env: str
    """The environment."""
    num_envs: int
    """Number of worlds."""
    autoreset_mode: str
    """Name of its autoreset mode."""
    checked: tuple[str, ...]
    """Rules that were checked."""
    skipped: dict[str, str] = field(default_factory=dict)
    """Rules that could not be checked, and why."""
    notes: tuple[str, ...] = ()
    """What is allowed but good to know."""

    def __str__(self) -> str:
        """Return a few lines for people."""
        lines = [f"{self.env}, {self.autoreset_mode}: checked {', '.join(self.checked)}"]
        lines += [f"  skipped {name}: {reason}" for name, reason in self.skipped.items()]
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])


def check_vector_env(
    env: VectorEnv | Callable[[int], VectorEnv],
    *,
    num_envs: int = 3,
    steps: int = 100,
    seed: int = 0,
    max_episode_steps: int | None = None,
    exchangeable: bool = True,
    skip: Collection[str] = (),
    ignored_infos: Collection[str] = ("episode",),
) -> VectorEnvReport:
    """Check any `gymnasium.vector.VectorEnv` against Gymnasium's vector API, as `check_env` does for single ones.

    Spaces, dtypes and shapes, info masks, the three autoreset modes, seeding, time limits, isolation of the worlds, bad
    actions and ownership of the arrays: docs/vector_envs.md lists the rules. Environments that return torch tensors are
    checked as well. It takes about ten times ``steps`` steps.

    Args:
        env: The environment, or a function from the number of worlds to one. Only with a function can closing and a
            single world be checked; an environment is left open, in the middle of an episode.
        num_envs: Worlds to ask a function for.
        steps: Steps of the longest runs; choose it so that episodes end, or autoreset is skipped.
        seed: First seed, of resets and actions.
        max_episode_steps: Time limit; None takes that of ``env.spec``.
        exchangeable: Whether world i of ``reset(seed=s)`` should behave as world 0 of ``reset(seed=s + i)``: the worlds
            are alike and have random streams of their own.
        skip: Checks to leave out, keys of `RULES`.
        ignored_infos: Keys of infos that may differ between equal runs, such as wall-clock times.

    Returns:
        What was checked, and what could not be and why.

    Raises:
        EnvironmentCheckError: At the first broken rule; names it, the world and the remedy.
        ConfigError: If an argument is unknown, or ``env`` is no vector environment.
    """
    unknown = sorted(set(skip) - {*RULES, "batch size", "close"})
    if unknown:
        raise ConfigError(f"skip names unknown checks {unknown}", hint=f"choose from {', '.join(RULES)}")
    if num_envs < 2 or steps < 2:
        raise ConfigError(f"num_envs is {num_envs} and steps is {steps}", hint="give at least 2 of both")

    def check(candidate: object) -> tuple[VectorEnvReport, list[Event]]:
        if not isinstance(candidate, VectorEnv):
            raise ConfigError(
                f"env is a {type(candidate).__name__}, expected a gymnasium.vector.VectorEnv or a function that makes "
                "one of a given number of worlds",
                hint="check a single environment with gymnasium.utils.env_checker.check_env",
            )
        limit = max_episode_steps or _time_limit(candidate)
        subject = Subject(candidate, steps=steps, seed=seed)
        run = Reference(subject, max_episode_steps=limit, exchangeable=exchangeable, ignored=frozenset(ignored_infos))
        return _apply(subject, run, skip), run.events

    if isinstance(env, VectorEnv):
        report, _ = check(env)
        reasons = dict.fromkeys(("batch size", "close"), "give a function to check it")
        return replace(report, skipped=report.skipped | reasons)
    if not callable(env):
        check(env)
    assert not isinstance(env, VectorEnv)
    many = env(num_envs)
    try:
        report, reference = check(many)
        if many.num_envs != num_envs:
            raise EnvironmentCheckError(
                f"num_envs is {many.num_envs}, asked for {num_envs}", rule="spaces", hint="hand the number on"
            )
        if "batch size" not in skip:
            one = env(1)
            try:
                check(one)
                if exchangeable:
                    _check_batch_size(one, many, reference, steps, seed)
            finally:
                one.close()
    finally:
        many.close()
    if "close" not in skip:
        _check_close(many)
    done = tuple(name for name in ("batch size", "close") if name not in skip)
    return replace(report, checked=report.checked + done)


def _time_limit(env: VectorEnv) -> int | None:
    """Read the time limit off the specification; `make_vec` leaves a limit that it was given in the kwargs."""
    if env.spec is None:
        return None
    limit = env.spec.kwargs.get("max_episode_steps", env.spec.max_episode_steps)
    return limit if limit is not None and limit > 0 else None


def _apply(subject: Subject, run: Reference, skip: Collection[str]) -> VectorEnvReport:
    """Apply the rules in turn."""
    checked, skipped, notes = [*VALUES], {}, []
    for name, rule in RULES.items():
        if name in skip:
            skipped[name] = "asked to"
            continue
        try:
            note = rule(run)
        except Skip as reason:
            skipped[name] = str(reason)
            continue
        checked.append(name)
        if note:
            notes.append(note)
    return VectorEnvReport(
        env=str(subject.env),
        num_envs=subject.num_envs,
        autoreset_mode=subject.mode.name,
        checked=tuple(checked),
        skipped=skipped,
        notes=tuple(notes),
    )


def _check_batch_size(one: VectorEnv, many: VectorEnv, reference: list[Event], steps: int, seed: int) -> None:
    """Rule ``batch size``: world 0 of many is the single world."""
    alone, among = (Subject(env, steps=steps, seed=seed) for env in (one, many))
    actions = [
        alone.replace_action(mine, 0, among.action_of(theirs, 0))
        for mine, theirs in zip(alone.actions[:DEPTH], among.actions, strict=False)
    ]
    for index, (mine, theirs) in enumerate(zip(alone.run(DEPTH, actions=actions), reference, strict=False)):
        if theirs.done.any() or mine.done.any():
            break
        if not equal(mine.observation[0], theirs.observation[0]) or not equal(mine.reward[:1], theirs.reward[:1]):
            message = f"call {index} returns something else with num_envs=1 than in world 0 of {many.num_envs}"
            hint = "let nothing that a world computes depend on how many worlds there are"
            raise EnvironmentCheckError(message, rule="batch size", world=0, hint=hint)


def _check_close(env: VectorEnv) -> None:
    """Rule ``close``: closing again does nothing."""
    if not env.closed:
        raise EnvironmentCheckError(
            "closed is False after close()", rule="close", hint="override close_extras, not close"
        )
    try:
        env.close()
    except Exception as error:
        message = f"the second close() raises {type(error).__name__}: {error}"
        hint = "return at once where self.closed is set"
        raise EnvironmentCheckError(message, rule="close", hint=hint) from error
