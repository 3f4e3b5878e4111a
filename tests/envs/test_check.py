"""`check_vector_env`: passes what keeps the rules, and names the rule, the world and the remedy where one is broken."""

# ruff: noqa: D101, D102
from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from softmode.envs import check_vector_env
from softmode.errors import ConfigError, EnvironmentCheckError, SoftmodeError
from softmode.vector_check import RULES, VALUES
from tests.envs.walks import WalkVectorEnv

MODES = pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.name)
STEPS = 20


# -- what passes ------------------------------------------------------------------------------------------------------


@MODES
@pytest.mark.parametrize(
    ("name", "kwargs", "unchecked"),
    [
        # The action of CartPole is a whole number; none of its episodes is long enough for the time limit.
        ("CartPole-v1", {}, {"time limit", "large action", "nan action"}),
        ("Pendulum-v1", {"max_episode_steps": 7}, set()),
    ],
)
def test_sync_vector_env_passes(mode: AutoresetMode, name: str, kwargs: dict[str, Any], unchecked: set[str]) -> None:
    """Gymnasium's own vector environment keeps the rules in all modes, and hardly one of them is skipped."""

    def make(count: int) -> VectorEnv:
        return gym.make_vec(
            name, num_envs=count, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **kwargs
        )

    report = check_vector_env(make, steps=60 if unchecked else STEPS)
    assert set(report.skipped) == unchecked
    assert set(report.checked) == {*RULES, *VALUES, "batch size", "close"} - unchecked
    assert report.autoreset_mode == mode.name and mode.name in str(report) and report.num_envs == 3


def test_async_vector_env_passes() -> None:
    """So do worker processes; bad actions are left out, since an error in a worker closes the environment."""
    report = check_vector_env(lambda count: gym.make_vec("CartPole-v1", count, "async"), steps=40)
    assert set(report.skipped) == {"time limit", "large action", "wrong shape", "nan action"}


@MODES
@pytest.mark.parametrize("output", ["numpy", "torch"])
def test_native_vector_env_passes(mode: AutoresetMode, output: str) -> None:
    """An environment without single ones inside, with arrays or tensors, passes every rule."""
    if output == "torch":
        pytest.importorskip("torch")
    report = check_vector_env(
        lambda count: WalkVectorEnv(count, autoreset_mode=mode, output=output), steps=STEPS, max_episode_steps=6
    )
    assert not report.skipped and not report.notes
    assert set(report.checked) == {*RULES, *VALUES, "batch size", "close"}


def test_an_environment_itself_stays_open() -> None:
    """Given an environment instead of a function, the check leaves it open and says what it could not check."""
    env = gym.make_vec("CartPole-v1", num_envs=2, vectorization_mode="sync")
    report = check_vector_env(env, steps=40)
    assert {"batch size", "close"} <= set(report.skipped) and not env.closed
    env.close()


def test_wrapped_and_dict_environments_pass() -> None:
    """Wrappers that add infos with wall-clock times, Dict observations, and bounds that differ from world to world."""

    class Keys(gym.ObservationWrapper):
        def __init__(self, env: gym.Env) -> None:
            super().__init__(env)
            inner = env.observation_space
            self.observation_space = gym.spaces.Dict({"a": inner, "b": gym.spaces.Tuple((inner, inner))})

        def observation(self, observation: Any) -> Any:
            return {"a": observation, "b": (observation, 0 * observation)}

    def make(count: int) -> VectorEnv:
        single = [lambda: Keys(gym.make("CartPole-v1"))] * count
        env = SyncVectorEnv(single, autoreset_mode=AutoresetMode.SAME_STEP)
        return gym.wrappers.vector.RecordEpisodeStatistics(env)

    report = check_vector_env(make, steps=40)
    assert "autoreset" in report.checked
    different = [lambda low=low: gym.wrappers.RescaleObservation(gym.make("Pendulum-v1"), low, 1) for low in (-1, -2)]
    assert (
        "spaces"
        in check_vector_env(SyncVectorEnv(different, observation_mode="different"), steps=3, exchangeable=False).checked
    )


# -- what does not ----------------------------------------------------------------------------------------------------

NEXT, SAME, DISABLED = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED
CASES: list[Any] = []


def broken(mode: AutoresetMode, rule: str, message: str, *, world: int | None = None) -> Callable[[type], type]:
    """Register a class that breaks one rule, and what the error says."""

    def register(cls: type) -> type:
        CASES.append(pytest.param(cls, mode, rule, message, world, id=f"{cls.__name__}-{mode.name}"))
        return cls

    return register


@broken(NEXT, "spaces", "observation_space is")
class WrongBatch(WalkVectorEnv):
    def __init__(self, num_envs: int, **kwargs: Any) -> None:
        super().__init__(num_envs, **kwargs)
        self.observation_space = gym.spaces.Box(-8.0, 9.0, (num_envs, 3), np.float32)


@broken(NEXT, "spaces", "single_action_space is None")
class NoSingleSpace(WalkVectorEnv):
    def __init__(self, num_envs: int, **kwargs: Any) -> None:
        super().__init__(num_envs, **kwargs)
        self.single_action_space = None  # type: ignore[assignment]


@broken(NEXT, "spaces", "asked for 3")
class OneTooMany(WalkVectorEnv):
    def __init__(self, num_envs: int, **kwargs: Any) -> None:
        super().__init__(num_envs + 1, **kwargs)


@broken(NEXT, "autoreset mode", "'next'")
class ModeAsText(WalkVectorEnv):
    def __init__(self, num_envs: int, **kwargs: Any) -> None:
        super().__init__(num_envs, **kwargs)
        self.metadata = {"autoreset_mode": "next"}


@broken(NEXT, "observations", "float64")
class DoubleObservations(WalkVectorEnv):
    def observe(self) -> np.ndarray:
        return super().observe().astype(np.float64)


@broken(NEXT, "observations", "outside", world=1)
class OutsideSpace(WalkVectorEnv):
    def observe(self) -> np.ndarray:
        observation = super().observe()
        observation[1:, 0] += 10.0
        return observation


@broken(NEXT, "observations", "outside", world=2)
class NanObservation(WalkVectorEnv):
    def observe(self) -> np.ndarray:
        observation = super().observe()
        observation[2:, 0] = np.nan
        return observation


@broken(NEXT, "observations", r"\(2, 3\)")
class TooFewObservations(WalkVectorEnv):
    def observe(self) -> np.ndarray:
        return super().observe()[: self.num_envs - 1]


@broken(NEXT, "rewards", "int64")
class WholeRewards(WalkVectorEnv):
    def step(self, actions: Any) -> Any:
        observation, reward, *rest = super().step(actions)
        return observation, reward.astype(np.int64), *rest


@broken(NEXT, "rewards", r"\(3, 1\)")
class RewardColumn(WalkVectorEnv):
    def step(self, actions: Any) -> Any:
        observation, reward, *rest = super().step(actions)
        return observation, reward[:, None], *rest


@broken(NEXT, "rewards", "inf", world=0)
class EndlessReward(WalkVectorEnv):
    def reward(self) -> np.ndarray:
        return np.where(np.arange(self.num_envs) == 0, np.inf, super().reward())


@broken(NEXT, "flags", "truncated, expected bool")
class NumbersAsFlags(WalkVectorEnv):
    def step(self, actions: Any) -> Any:
        *front, truncated, infos = super().step(actions)
        return *front, truncated.astype(np.uint8), infos


@broken(NEXT, "array kind", "reward: torch")
class MixedLibraries(WalkVectorEnv):
    def step(self, actions: Any) -> Any:
        torch = pytest.importorskip("torch")
        observation, reward, *rest = super().step(actions)
        return observation, torch.from_numpy(reward), *rest


@broken(NEXT, "info masks", r"infos\['distance'\] has no mask '_distance'")
class NoMask(WalkVectorEnv):
    def infos(self, mask: np.ndarray) -> dict[str, Any]:
        infos = super().infos(mask)
        del infos["_distance"]
        return infos


@broken(NEXT, "info masks", r"infos\['reward_terms'\]\['_x'\].*expected a mask")
class NumberMaskInside(WalkVectorEnv):
    def infos(self, mask: np.ndarray) -> dict[str, Any]:
        infos = super().infos(mask)
        infos["reward_terms"]["_x"] = mask.astype(np.float32)
        return infos


@broken(NEXT, "info masks", "masks nothing")
class OrphanMask(WalkVectorEnv):
    def infos(self, mask: np.ndarray) -> dict[str, Any]:
        return super().infos(mask) | {"_other": mask}


@broken(NEXT, "info masks", "an array of 3 values")
class ScalarInfo(WalkVectorEnv):
    def infos(self, mask: np.ndarray) -> dict[str, Any]:
        return super().infos(mask) | {"mean": np.array(1.0), "_mean": mask}


@broken(NEXT, "info masks", "was float32")
class ChangingForm(WalkVectorEnv):
    def infos(self, mask: np.ndarray) -> dict[str, Any]:
        kind = np.float32 if self.count[0] < 3 else np.float64
        return super().infos(mask) | {"distance": np.zeros(self.num_envs, kind)}


@broken(NEXT, "info masks", "list")
class ListOfInfos(WalkVectorEnv):
    def infos(self, mask: np.ndarray) -> Any:
        return [{}] * self.num_envs


@broken(NEXT, "seeding", "second run with the same seed", world=0)
class GlobalRandom(WalkVectorEnv):
    def move(self, actions: np.ndarray, fresh: np.ndarray) -> None:
        super().move(actions, fresh)
        self.place[0] += np.random.default_rng().normal() * 1e-3


@broken(NEXT, "seeding", r"infos\['calls'\].* second run with the same seed")
class CallCounter(WalkVectorEnv):
    calls = 0

    def infos(self, mask: np.ndarray) -> dict[str, Any]:
        self.calls += 1
        return super().infos(mask) | {"calls": np.full(self.num_envs, self.calls), "_calls": mask}


@broken(NEXT, "seeding", r"seeded 0 \+ 1", world=1)
class OneSeedForAll(WalkVectorEnv):
    def seed_worlds(self, seed: Any, mask: np.ndarray) -> None:
        super().seed_worlds(seed if seed is None or isinstance(seed, list) else [seed] * self.num_envs, mask)


@broken(NEXT, "seeding", r"reset\(seed=\[0, 1, 2\]\)", world=0)
class ListIgnored(WalkVectorEnv):
    def seed_worlds(self, seed: Any, mask: np.ndarray) -> None:
        super().seed_worlds(7 if isinstance(seed, list) else seed, mask)


@broken(NEXT, "seeding", r"reset\(seed=\[2, 1, 0\]\)", world=0)
class ListReadAsRange(WalkVectorEnv):
    def seed_worlds(self, seed: Any, mask: np.ndarray) -> None:
        super().seed_worlds(min(seed) if isinstance(seed, list) else seed, mask)


@broken(NEXT, "seeding", "after the same seed", world=0)
class FreshWithoutSeed(WalkVectorEnv):
    def seed_worlds(self, seed: Any, mask: np.ndarray) -> None:
        super().seed_worlds(int(np.random.default_rng().integers(99999)) if seed is None else seed, mask)


@broken(NEXT, "seeding", "repeats the first episode", world=0)
class SameWithoutSeed(WalkVectorEnv):
    last: Any = None

    def seed_worlds(self, seed: Any, mask: np.ndarray) -> None:
        self.last = self.last if seed is None else seed
        super().seed_worlds(self.last, mask)


@broken(NEXT, "autoreset", "reward -1.0")
class RewardOfReset(WalkVectorEnv):
    def step(self, actions: Any) -> Any:
        fresh = self.finished.copy()
        observation, reward, *rest = super().step(actions)
        reward[fresh] = -1.0
        return observation, reward, *rest


@broken(NEXT, "autoreset", "depends on the action")
class MovesWhileResetting(WalkVectorEnv):
    def move(self, actions: np.ndarray, fresh: np.ndarray) -> None:
        super().move(actions, fresh)
        self.push = np.where(fresh[:, None], 0.1 * actions, 0.0)

    def begin(self, mask: np.ndarray) -> None:
        super().begin(mask)
        self.place += getattr(self, "push", 0.0)
        self.push = 0.0


@broken(NEXT, "autoreset", "after the end of an episode it sees")
class LastObservationAgain(WalkVectorEnv):
    def step(self, actions: Any) -> Any:
        fresh, before = self.finished.copy(), self.observe()
        observation, *rest = super().step(actions)
        observation[fresh] = before[fresh]
        return observation, *rest


@broken(SAME, "autoreset", "'_final_obs'")
class NoFinalObservation(WalkVectorEnv):
    def with_final(self, infos: dict[str, Any], final: np.ndarray, done: np.ndarray) -> dict[str, Any]:
        infos = super().with_final(infos, final, done)
        return {key: value for key, value in infos.items() if not key.endswith("final_obs")}


@broken(SAME, "autoreset", "'_final_obs'.* goes on")
class FinalForAll(WalkVectorEnv):
    def with_final(self, infos: dict[str, Any], final: np.ndarray, done: np.ndarray) -> dict[str, Any]:
        return super().with_final(infos, final, done) | {"_final_obs": np.ones(self.num_envs, bool)}


@broken(SAME, "autoreset", "'_final_info'")
class NoFinalInfo(WalkVectorEnv):
    def with_final(self, infos: dict[str, Any], final: np.ndarray, done: np.ndarray) -> dict[str, Any]:
        infos = super().with_final(infos, final, done)
        return {key: value for key, value in infos.items() if not key.endswith("final_info")}


@broken(SAME, "autoreset", r"equals infos\['final_obs'\]")
class FinalIsFirst(WalkVectorEnv):
    def with_final(self, infos: dict[str, Any], final: np.ndarray, done: np.ndarray) -> dict[str, Any]:
        return super().with_final(infos, self.observe(), done)


@broken(SAME, "autoreset", "after the end of an episode it sees")
class ReturnsTheLast(WalkVectorEnv):
    def step(self, actions: Any) -> Any:
        observation, reward, terminated, truncated, infos = super().step(actions)
        done = terminated | truncated
        if done.any():
            observation[done] = 0.0
        return observation, reward, terminated, truncated, infos


@broken(DISABLED, "isolation", "changed its observation")
class MaskIgnored(WalkVectorEnv):
    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return super().reset(seed=seed)


@broken(DISABLED, "isolation", "is refused")
class MaskRefused(WalkVectorEnv):
    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        if options and not options["reset_mask"].all() and not self.finished.any():
            raise ValueError("no masks")
        return super().reset(seed=seed, options=options)


@broken(SAME, "isolation", "reset of world 2 changes its", world=0)
class MaskLeaks(WalkVectorEnv):
    def begin(self, mask: np.ndarray) -> None:
        if not mask.all() and not mask[0] and not self.finished.any():
            self.count[0] += 1  # shows in the next step
        super().begin(mask)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        before = self.observe()
        observation, infos = super().reset(seed=seed, options=options)
        if options:
            observation[~options["reset_mask"]] = before[~options["reset_mask"]]
        return observation, infos


@broken(SAME, "isolation", "something else than after a reset of all")
class MaskSeedsAnew(WalkVectorEnv):
    def seed_worlds(self, seed: Any, mask: np.ndarray) -> None:
        super().seed_worlds(seed if mask.all() else 99, mask)


@broken(NEXT, "isolation", "another action of world 0", world=1)
class ActionsLeak(WalkVectorEnv):
    def move(self, actions: np.ndarray, fresh: np.ndarray) -> None:
        super().move(actions, fresh)
        self.place[1:] += 1e-4 * actions[0]


@broken(NEXT, "time limit", "goes on after 6 steps", world=0)
class NeverLate(WalkVectorEnv):
    def late(self) -> np.ndarray:
        return self.count >= 9


@broken(NEXT, "time limit", "truncated after 4 steps", world=0)
class TooEarly(WalkVectorEnv):
    def late(self) -> np.ndarray:
        return self.count >= 4


@broken(NEXT, "bad actions", "NaN raises IndexError")
class NanCrashes(WalkVectorEnv):
    def checked(self, actions: Any) -> np.ndarray:
        if np.isnan(actions).any():
            raise IndexError("index -9223372036854775808 is out of bounds")
        return super().checked(actions)


@broken(NEXT, "bad actions", "NaN, refused, changes its", world=0)
class MovesBeforeRefusal(WalkVectorEnv):
    def step(self, actions: Any) -> Any:
        if actions.shape == self.action_space.shape:
            self.count += np.isnan(actions).any()
        return super().step(actions)


@broken(NEXT, "bad actions", "NaN in the action of world 2 changes its", world=0)
class NanSpreads(WalkVectorEnv):
    def checked(self, actions: Any) -> np.ndarray:
        bad = np.isnan(actions).any()
        return super().checked(np.nan_to_num(actions)) * (0.0 if bad else 1.0)


@broken(NEXT, "bad actions", "a reset after NaN changes its", world=2)
class NanStays(WalkVectorEnv):
    poisoned = False

    def checked(self, actions: Any) -> np.ndarray:
        self.poisoned |= bool(np.isnan(actions).any())
        return super().checked(np.nan_to_num(actions))

    def observe(self) -> np.ndarray:
        observation = super().observe()
        observation[2:] *= 0.5 if self.poisoned else 1.0
        return observation


@broken(NEXT, "observations", "outside")
class LargeBreaks(WalkVectorEnv):
    def checked(self, actions: Any) -> np.ndarray:
        super().checked(actions)
        return np.array(actions) * 3.0


@broken(NEXT, "bad actions", "4 worlds is accepted")
class TakesMore(WalkVectorEnv):
    def checked(self, actions: Any) -> np.ndarray:
        return super().checked(np.asarray(actions)[: self.num_envs])


@broken(NEXT, "bad actions", "one number more is accepted")
class TakesWider(WalkVectorEnv):
    def checked(self, actions: Any) -> np.ndarray:
        return super().checked(np.asarray(actions)[..., :2])


@broken(NEXT, "bad actions", "no axis of worlds is accepted")
class Broadcasts(WalkVectorEnv):
    def checked(self, actions: Any) -> np.ndarray:
        actions = np.asarray(actions)
        return super().checked(np.tile(actions, (self.num_envs, 1)) if actions.ndim == 1 else actions)


@broken(NEXT, "no shared buffers", "the observation of call 0 changed after it was returned")
class OneBuffer(WalkVectorEnv):
    def observe(self) -> np.ndarray:
        if not hasattr(self, "buffer"):
            self.buffer = super().observe()
        self.buffer[:] = super().observe()
        return self.buffer


@broken(NEXT, "no shared buffers", r"the infos\['reward_terms'\]\['x'\] of call 0 changed")
class InfoIsAView(WalkVectorEnv):
    def infos(self, mask: np.ndarray) -> dict[str, Any]:
        infos = super().infos(mask)
        infos["reward_terms"]["x"] = self.place[:, 0]
        return infos


@broken(NEXT, "no shared buffers", "shares memory with terminated of the call before")
class SharedFlags(WalkVectorEnv):
    def __init__(self, num_envs: int, **kwargs: Any) -> None:
        super().__init__(num_envs, **kwargs)
        self.never = np.zeros(num_envs, bool)

    def step(self, actions: Any) -> Any:
        observation, reward, terminated, truncated, infos = super().step(actions)
        return observation, reward, self.never, truncated | terminated, infos


@broken(NEXT, "no shared buffers", "the caller writes to")
class ReadsBack(WalkVectorEnv):
    """Its state is the array it returned last."""

    def reset(self, **kwargs: Any) -> Any:
        self.place = self.place.copy()
        return super().reset(**kwargs)

    def step(self, actions: Any) -> Any:
        self.place = self.place.copy()
        result = super().step(actions)
        self.place = result[0][:, :2]
        return result


@broken(NEXT, "no shared buffers", "wrote into the action")
class ClipsInPlace(WalkVectorEnv):
    def step(self, actions: Any) -> Any:
        result = super().step(actions)
        actions *= 0.5
        return result


@broken(NEXT, "batch size", "with num_envs=1", world=0)
class KnowsTheCrowd(WalkVectorEnv):
    def reward(self) -> np.ndarray:
        return super().reward() / self.num_envs


@broken(NEXT, "close", "closed is False")
class NeverClosed(WalkVectorEnv):
    def close(self, **kwargs: Any) -> None:
        pass


@broken(NEXT, "close", "second close.. raises RuntimeError")
class ClosesOnce(WalkVectorEnv):
    def close(self, **kwargs: Any) -> None:
        if self.closed:
            raise RuntimeError("closed")
        self.closed = True


@pytest.mark.parametrize(("cls", "mode", "rule", "message", "world"), CASES)
def test_a_broken_rule_is_caught(
    cls: type[WalkVectorEnv], mode: AutoresetMode, rule: str, message: str, world: int | None
) -> None:
    """Each of these environments breaks one rule, and the error names it, the world if there is one, and a remedy."""
    with pytest.raises(EnvironmentCheckError, match=message) as caught:
        check_vector_env(lambda count: cls(count, autoreset_mode=mode), steps=STEPS, max_episode_steps=6)
    error = caught.value
    assert error.rule == rule
    assert world is None or error.world == world
    assert error.hint and error.hint.lower()[:20] in str(error).lower()
    assert isinstance(error, SoftmodeError) and isinstance(error, AssertionError)


def test_every_rule_has_a_breaker() -> None:
    """No rule is without an environment that breaks it, so that none of the checks can rot unseen."""
    rules = {case.values[2] for case in CASES}
    assert rules == {*VALUES, "seeding", "autoreset", "isolation", "time limit", "bad actions", "no shared buffers",
                     "batch size", "close"}  # fmt: skip


def test_shared_tensors_are_seen() -> None:
    """A tensor that is returned twice is found as an array is."""
    pytest.importorskip("torch")

    class OneTensor(WalkVectorEnv):
        def give(self, value: Any) -> Any:
            given = super().give(value)
            if not isinstance(given, dict) and given.shape[-1:] == (3,) and given.dim() == 2:
                self.kept = getattr(self, "kept", given).copy_(given)
                return self.kept
            return given

    with pytest.raises(EnvironmentCheckError, match="observation of call 0 changed"):
        check_vector_env(lambda count: OneTensor(count, output="torch"), steps=STEPS, max_episode_steps=6)


def test_sync_vector_env_without_copies_fails() -> None:
    """``SyncVectorEnv(copy=False)`` reuses its observations, by design, and is told so; the check can be left out."""
    env = SyncVectorEnv([lambda: gym.make("CartPole-v1")] * 2, copy=False)
    with pytest.raises(EnvironmentCheckError, match="no shared buffers"):
        check_vector_env(env, steps=30)
    assert check_vector_env(env, steps=30, skip={"no shared buffers"}).skipped["no shared buffers"] == "asked to"


# -- arguments --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("env", "kwargs", "message"),
    [
        (lambda count: gym.make("CartPole-v1"), {}, "check_env"),
        (3, {}, "env is a int"),
        (WalkVectorEnv, {"skip": {"weather"}}, "weather"),
        (WalkVectorEnv, {"steps": 1}, "steps is 1"),
        (WalkVectorEnv, {"num_envs": 1}, "num_envs is 1"),
    ],
)
def test_bad_arguments_are_refused(env: Any, kwargs: dict[str, Any], message: str) -> None:
    """Wrong arguments raise ConfigError, not EnvironmentCheckError."""
    with pytest.raises(ConfigError, match=message):
        check_vector_env(env, **kwargs)


def test_the_checker_imports_neither_torch_nor_warp() -> None:
    """It recognises tensors by their methods; looking at arrays alone, it loads no library of tensors."""
    script = (
        "import sys, gymnasium as gym, softmode.envs as e;"
        "e.check_vector_env(lambda n: gym.make_vec('CartPole-v1', n, 'sync'), steps=5);"
        "assert not {'torch', 'warp', 'newton'} & set(sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
