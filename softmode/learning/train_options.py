"""What a training run is asked for, and how it ended."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softmode.checks import SEED_MAX, require_number
from softmode.envs.catalogue import is_soft
from softmode.errors import ConfigError
from softmode.learning.hyperparameters import Hyperparameters, preset

if TYPE_CHECKING:
    from softmode.learning.policy import Evaluation

DEFAULT_STEPS = 10_000_000
"""Environment steps of a run without a limit."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunOptions:
    """What a training run is asked for, in Python and on the command line alike."""

    env: str
    """Id of the environment, for example softmode/LiftSoft-v0, or module:id of your own."""
    num_envs: int = 16
    """Worlds of each rank: 16 on a CPU, 4096 on a GPU."""
    device: str = "cpu"
    """cpu, cuda:0, or cuda under torchrun."""
    seed: int = 0
    """Seed of networks, exploration and worlds."""
    time_limit: float | None = None
    """Seconds of training after which it ends, those before a resumption included."""
    run_dir: Path | None = None
    """Folder of the run, not there yet; runs/<Env>/<time>[_name] if omitted."""
    name: str | None = None
    """Suffix of the folder's name."""
    resume: bool = False
    """Go on with the run in the folder after it was ended or killed: with its worlds, seed and hyperparameters."""
    init: Path | None = None
    """Checkpoint of the same environment whose networks training starts from."""
    teacher: Path | None = None
    """Checkpoint of a policy on the state of the same environment, whose actions one from pixels is drawn to."""
    nan_guard: bool = False
    """Check every observation and reward; dump the last steps of worlds that are not finite, and stop."""
    eval_episodes: int = 200
    """Episodes of an evaluation; none with 0."""
    eval_every: int = 0
    """Iterations between two evaluations without noise, on seeds of their own, by which the best checkpoint is chosen;
    with 0 the noisy episodes of training choose it."""
    video_every: int = 0
    """Evaluations from one film of a failed episode to the next; no films with 0."""
    checkpoint_seconds: float = 30.0
    """Seconds between two checkpoints."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainOptions(RunOptions):
    """What to train, how long, and where the run is kept.

    Raises:
        ConfigError: If an option lies outside its range.
    """

    processes: int = 1
    """Child processes that share the worlds of a rank, on a CPU; their steps are the same bits for any number."""
    total_steps: int | None = None
    """Environment steps of all worlds together after which training ends; ten million if no limit is given."""
    env_options: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Keyword arguments of the environment as JSON values, for example obs_type; config as a dict of its fields."""
    hyperparameters: Hyperparameters | None = None
    """The preset of the number of worlds if omitted."""
    overrides: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Hyperparameters that differ from those."""
    tensorboard: bool = True
    """Write scalars for TensorBoard where it is installed; progress.csv is always written."""

    def __post_init__(self) -> None:
        """Check every range."""
        require_number("num_envs", self.num_envs, at_least=1, hint="give a count like 16")
        require_number("processes", self.processes, at_least=1, hint="give the number of cores to use")
        require_number("seed", self.seed, at_least=0, at_most=SEED_MAX, hint="give a whole number like 0")
        if self.total_steps is not None:
            require_number("total_steps", self.total_steps, at_least=1, hint="give a count like 1e6")
        if self.time_limit is not None:
            require_number("time_limit", self.time_limit, above=0.0, unit="s", hint="give seconds like 300")
        require_number("eval_episodes", self.eval_episodes, at_least=0, hint="0 evaluates nothing")
        require_number("eval_every", self.eval_every, at_least=0, hint="give a count of iterations like 20")
        require_number("video_every", self.video_every, at_least=0, hint="give a count of evaluations like 5")
        if self.eval_every and not self.eval_episodes:
            raise ConfigError(f"eval_every is {self.eval_every} with no episodes", hint="give --eval-episodes too")
        if self.video_every and not self.eval_every:
            raise ConfigError(f"video_every is {self.video_every} without evaluations", hint="give --eval-every too")
        require_number("checkpoint_seconds", self.checkpoint_seconds, at_least=0.0, unit="s", hint="give seconds")
        if self.resume and self.run_dir is None:
            raise ConfigError("resume needs the folder of the run", hint="name it with --run-dir")
        if self.resume and self.init is not None:
            raise ConfigError("resume and init exclude each other", hint="drop --init: the run has its own networks")
        if self.name is not None and ("/" in self.name or self.name in ("", ".", "..")):
            raise ConfigError(f"name {self.name!r} is no suffix of a folder", hint="give a word like baseline")
        try:
            json.dumps(self.env_options)
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f"env_options hold what JSON cannot ({error})", hint="give config as a dict of the fields that differ"
            ) from error

    def world_options(self) -> dict[str, Any]:
        """Return keyword arguments of the worlds: those of the environment, and what shares them among processes.

        Raises:
            ConfigError: If several processes are asked for an environment that is not softmode's.
        """
        if self.processes == 1:
            return self.env_options
        if not is_soft(self.env):
            raise ConfigError(f"processes is {self.processes} for {self.env}", hint="leave it at 1")
        return {"processes": self.processes, "output": "numpy", **self.env_options}

    def resolved(self, worlds: int) -> Hyperparameters:
        """Return the hyperparameters of a run with this many worlds on all ranks together.

        Raises:
            ConfigError: If an override is unknown or outside its range.
        """
        pixels = "pixels" in str(self.env_options.get("obs_type", ""))
        base = self.hyperparameters or preset(worlds, pixels=pixels)
        return Hyperparameters.from_json({**base.to_json(), **self.overrides})


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainResult:
    """How a run ended."""

    run_dir: Path
    """Folder of the run."""
    env_steps: int
    """Environment steps of all worlds together."""
    seconds: float
    """Seconds of training."""
    evaluation: Evaluation | None
    """Evaluation of the last policy; None on other ranks than the first, or if it was switched off."""
