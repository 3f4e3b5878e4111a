"""A training run from its first step to its evaluation."""

from __future__ import annotations

import dataclasses
import json
import math
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from softmode import __version__
from softmode.errors import (
    CheckpointError,
    ConfigError,
    MissingExtraError,
    RunError,
    SoftmodeError,
    TrainingDiverged,
    WorkerError,
    needs_extra,
)

with needs_extra("rl", "training needs torch"):
    import torch

from softmode.learning.checkpoints import Checkpoint, check_env, read_checkpoint, same_env, write_checkpoint
from softmode.learning.config_values import located_options, pinned_options
from softmode.learning.distributed import Ranks, local_device
from softmode.learning.environments import make_vector_env
from softmode.learning.nan_guard import NanGuard
from softmode.learning.networks import Actor, ActorCritic
from softmode.learning.policy import EVALUATION_SEED, SELECTION_SEED, Policy, actor_of, evaluate, film_episode
from softmode.learning.ppo import MIN_LEARNING_RATE, PPO, STATE
from softmode.learning.rollout import Collector, Rollout
from softmode.learning.run_folder import BEST, LATEST, RunFolder
from softmode.learning.train_options import DEFAULT_STEPS, TrainOptions, TrainResult
from softmode.learning.training_log import WINDOW, TrainingLog, describe
from softmode.learning.vector_tensors import TensorVectorEnv

Report = Callable[[str], None]
MakeVectorEnv = Callable[[str, int, torch.device, dict[str, Any]], gym.vector.VectorEnv]


def train(options: TrainOptions, *, make: MakeVectorEnv = make_vector_env, report: Report = print) -> TrainResult:
    """Train a policy.

    Under torchrun every process steps its own worlds, gradients are averaged, and the first process writes.

    Args:
        options: What to train.
        make: Makes the worlds of this process: id, number of worlds, device, options of the environment.
        report: Takes one line per iteration, on the first rank.

    Raises:
        ConfigError: If an option lies outside its range or the device is not there.
        CheckpointError: If the checkpoint to start from cannot be used.
        RunError: If the folder exists, is missing, or cannot be written; earlier checkpoints stay intact.
        TrainingDiverged: If a value is not finite; earlier checkpoints stay intact.
        WorkerError: If another process of the run is lost; the last whole iteration is kept.
    """
    device = local_device(options.device)
    ranks = Ranks.start(device)
    run = None
    try:
        options, start = _starting_point(options)
        if ranks.rank == 0 and not options.resume and options.run_dir is not None and options.run_dir.exists():
            RunFolder(options.run_dir, resume=False)  # refuses, before the worlds are built
        worlds = make(options.env, options.num_envs, device, options.world_options())
        try:
            run = _Run(options, TensorVectorEnv(worlds, device), ranks, start, report, make)
            run.loop()
            return run.finish()
        finally:
            worlds.close()
            if run is not None:
                run.folder.close()
                if run.judges is not None:
                    run.judges.close()
    finally:
        ranks.stop()


def _starting_point(options: TrainOptions) -> tuple[TrainOptions, Checkpoint | None]:
    """Return the options, those of the run that goes on where they are its own, and the checkpoint to start from."""
    if not options.resume:
        options = dataclasses.replace(options, env_options=pinned_options(options.env, options.env_options))
        return options, None if options.init is None else read_checkpoint(options.init)
    assert options.run_dir is not None
    config = RunFolder(options.run_dir, resume=True).read_config()
    start = read_checkpoint(options.run_dir / LATEST)
    if not same_env(start.env, options.env):
        raise CheckpointError(
            f"the run in {options.run_dir} trains {start.env}, not {options.env}", hint=f"train {start.env}"
        )
    try:
        for name in ("iteration", "env_steps", "seconds", "resumed", "best_success", "best_return"):
            if not isinstance(start.progress[name], int | float):
                raise TypeError(name)
        return dataclasses.replace(
            options,
            num_envs=int(config["num_envs"]),
            seed=int(config["seed"]),
            env_options=located_options(start.env_options, options.run_dir.absolute()),
            teacher=options.teacher or (Path(config["teacher"]) if config.get("teacher") else None),
            hyperparameters=start.hyperparameters,
        ), start
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(
            f"the run in {options.run_dir} cannot go on: {error} is missing or of another type",
            hint="start a new run, with --init if its policy is worth it",
        ) from error


class _Run:
    """The state of a run."""

    def __init__(
        self,
        options: TrainOptions,
        env: TensorVectorEnv,
        ranks: Ranks,
        start: Checkpoint | None,
        report: Report,
        make: MakeVectorEnv,
    ) -> None:
        self.make, self.judges = make, None
        self.options, self.env, self.ranks, self.device = options, env, ranks, env.device
        self.report = report if ranks.rank == 0 else lambda line: None
        self.iteration = self.env_steps = self.resumed = 0
        self.seconds_before = 0.0
        self.best = (-sys.float_info.max, -sys.float_info.max)
        self.evaluations, window = 0, []
        if start is not None and options.resume:
            progress = start.progress
            self.iteration, self.env_steps = int(progress["iteration"]), int(progress["env_steps"])
            self.seconds_before, self.resumed = float(progress["seconds"]), int(progress["resumed"]) + 1
            self.best = (float(progress["best_success"]), float(progress["best_return"]))
            window = progress.get("window", [])
        worlds = options.num_envs * ranks.count
        self.hyperparameters = options.resolved(worlds)
        torch.manual_seed(options.seed)
        # Worlds of all ranks, seeds and resumptions have seeds of their own.
        first_seed = ((options.seed * 1009 + self.resumed) * worlds + ranks.rank * options.num_envs) % EVALUATION_SEED
        first = env.reset(first_seed)
        self.privileged = self._privileged_size()
        self.model = ActorCritic(env.interface, self.privileged, self.hyperparameters).to(self.device)
        self.ppo = PPO(self.model, self.hyperparameters, ranks, self._teacher())
        if start is not None:
            self._load(start)
        steps, discount = self.hyperparameters.rollout_steps, self.hyperparameters.discount
        self.collector = Collector(env, self.model, first, steps, discount)
        self.log = TrainingLog(self.collector.statistics, self.ppo, ranks, window)
        self.generator = torch.Generator(self.device)
        self.guard = NanGuard() if options.nan_guard else None
        self.warm_until = self.iteration + self._stagger_iterations(start is None)
        self.folder = self._open_folder()

    def _privileged_size(self) -> int:
        """Return the length of the state that the critic reads beside what the actor sees, 0 for none."""
        if not (self.hyperparameters.asymmetric_critic and self.env.interface.pictures):
            return 0
        state = self.env.privileged()
        if state is None:
            return 0
        if self.env.same_step:
            raise ConfigError(
                "the critic reads the full state, which SAME_STEP does not give for last steps",
                hint="make the environment with AutoresetMode.NEXT_STEP, or set asymmetric_critic=false",
            )
        return int(state.shape[1])

    def _teacher(self) -> Actor | None:
        """Return the actor to learn from, if one is given."""
        path = self.options.teacher
        if path is None:
            return None
        checkpoint = read_checkpoint(path)
        if not same_env(checkpoint.env, self.options.env):
            raise CheckpointError(f"teacher {path} plays {checkpoint.env}", hint=f"give one of {self.options.env}")
        seen = checkpoint.interface
        if dict(seen.vectors) != {STATE: self.privileged} or seen.action_size != self.env.interface.action_size:
            raise CheckpointError(
                f"teacher {path} sees {dict(seen.vectors)}, and this run offers a state of {self.privileged} numbers",
                hint="train the teacher with obs_type state, and from pixels with an asymmetric critic",
            )
        return actor_of(checkpoint, self.device, path)

    def _stagger_iterations(self, fresh: bool) -> int:
        """Return how many rollouts pass before the first update.

        They spread the worlds over their episodes, so that a rollout shorter than an episode holds all of its parts,
        and tell the scale of observations and rewards.
        """
        steps = self.hyperparameters.rollout_steps
        limit = self.env.episode_steps
        if limit is None or steps >= limit:
            return int(fresh)
        self.collector.stagger(limit)
        return -(-limit // steps)

    def _load(self, start: Checkpoint) -> None:
        """Take over networks, and what else the run needs to go on."""
        options = self.options
        path = options.init or options.run_dir
        check_env(start, path, options.env, self.env.interface)
        if start.env_options != options.env_options:
            self.report(f"{path} was trained with other options of the environment: {json.dumps(start.env_options)}")
        try:
            for name, module in self._modules().items():
                arrays = {key: torch.from_numpy(array) for key, array in start.part(name).items()}
                fits = {k: v.shape for k, v in module.state_dict().items()} == {k: v.shape for k, v in arrays.items()}
                if fits or name == "actor" or options.resume:  # else a critic of another kind, which starts anew
                    module.load_state_dict(arrays, strict=True)
            if options.resume:
                self.ppo.optimizer.load({k: torch.from_numpy(a) for k, a in start.part("optimizer").items()})
            elif "initial_std" in options.overrides:
                self.model.actor.log_std.data.fill_(math.log(self.hyperparameters.initial_std))
        except (RuntimeError, ValueError) as error:
            raise CheckpointError(
                f"checkpoint {path} holds other networks than this run ({error})",
                hint="use the hyperparameters of the run that wrote it",
            ) from error

    def _modules(self) -> dict[str, torch.nn.Module]:
        modules: dict[str, torch.nn.Module] = {"actor": self.model.actor, "critic": self.model.critic}
        modules["reward"] = self.ppo.reward_moments
        return modules | ({} if self.model.predict is None else {"predict": self.model.predict})

    def _open_folder(self) -> RunFolder:
        """Return the folder; the first rank makes it, and an error there reaches all."""
        options = self.options
        path = options.run_dir or RunFolder.name_for(Path("runs"), options.env, options.name)
        folder, error = None, None
        try:
            if self.ranks.rank == 0:
                folder = RunFolder(path, resume=options.resume)
                if options.resume:
                    folder.forget_after(self.iteration)
                else:
                    folder.write_config(self._config())
        except RunError as caught:
            error = caught
        if self.ranks.sum(torch.tensor([float(error is not None)], device=self.device)).item() > 0:
            raise error or RunError("the first rank could not open the run folder", hint="see its message")
        folder = folder or RunFolder(path, resume=options.resume, writes=False)
        if self.ranks.rank == 0 and options.tensorboard:
            try:
                folder.start_tensorboard(self.env_steps if options.resume else None)
            except MissingExtraError as missing:
                self.report(f"{missing}; progress.csv is written")
        self.report(f"run folder {path}")
        return folder

    def _config(self) -> dict[str, Any]:
        options, cuda = self.options, self.device.type == "cuda"
        return {
            "env": options.env,
            "env_options": options.env_options,
            "num_envs": options.num_envs,
            "processes": options.processes,
            "ranks": self.ranks.count,
            "seed": options.seed,
            "device": str(self.device),
            "device_name": torch.cuda.get_device_name(self.device) if cuda else platform.machine(),
            "total_steps": options.total_steps,
            "time_limit": options.time_limit,
            "init": None if options.init is None else str(options.init),
            "teacher": None if options.teacher is None else str(options.teacher),
            "interface": self.env.interface.to_json(),
            "privileged": self.privileged,
            "hyperparameters": self.hyperparameters.to_json(),
            "versions": {
                "softmode": __version__,
                **{package.__name__: package.__version__ for package in (torch, gym, np)},
                "python": platform.python_version(),
            },
            "command": sys.argv,
            "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        }

    def loop(self) -> None:
        """Collect and update until a limit is reached; an interruption writes the last whole iteration."""
        self.started = time.perf_counter()
        self._kept = self._checkpoint()
        try:
            try:
                self._iterate()
            except RuntimeError as error:
                time.sleep(1.0)  # what ends all processes of a run may end one that this one waits for before this one
                if self.ranks.count == 1 or isinstance(error, SoftmodeError):
                    raise
                what = f"a process of the run was lost {self._keep()} ({str(error).partition(chr(10))[0]})"
                raise WorkerError(what, hint=f"go on with --run-dir {self.folder.path} --resume") from error
        except KeyboardInterrupt:
            if self.ranks.rank == 0:
                self.report(f"interrupted {self._keep()}; go on with --run-dir {self.folder.path} --resume")
            raise

    def _keep(self) -> str:
        """Write the last whole iteration, on the first rank, and say which it is."""
        if self.ranks.rank == 0:
            self._save(self._kept)
        return f"after iteration {self._kept.progress['iteration']}"

    def _iterate(self) -> None:
        """Collect and update until a limit is reached."""
        saved = self.started
        per_rollout = self.hyperparameters.rollout_steps * self.options.num_envs * self.ranks.count
        progress = self._progress()
        while progress < 1.0:
            clock = time.perf_counter()
            self.iteration += 1
            seed = (self.options.seed * 1_000_003 + self.iteration) * 4099 + self.ranks.rank
            self.generator.manual_seed(seed)
            rollout = self.collector.collect(self.generator)
            collected = time.perf_counter()
            bad = self.guard.bad(rollout).any() if self.guard else torch.zeros((), device=self.device)
            losses = self._update(rollout, progress)
            self.env_steps += per_rollout
            row, progress, any_bad = self.log.read(losses, bad, self._progress())
            now = time.perf_counter()
            told = {"iteration": self.iteration, "env_steps": self.env_steps, "seconds": self._seconds()}
            told |= {"steps_per_second": per_rollout / (now - clock)}
            row = {**told, "update_share": (now - collected) / (now - clock), **row}
            if any_bad or row["skipped_updates"]:
                raise self._diverged(rollout, any_bad, bool(bad))
            if self.guard:
                self.guard.keep(rollout)
            if self.ranks.rank == 0:
                self.folder.log(row)
                self.report(describe(row))
                every = self.options.eval_every
                due = every and (self.iteration % every == 0 or progress >= 1.0)
                if due or progress >= 1.0 or now - saved >= self.options.checkpoint_seconds:
                    better = self._evaluate() if due else not every and self._is_best(row)
                    self._save(self._checkpoint(), better)
                    saved = now
                self._kept = self._checkpoint()

    def _update(self, rollout: Rollout, progress: float) -> torch.Tensor:
        """Update networks, then the scales of observations and rewards, which thus are those of the whole rollout."""
        if self.iteration <= self.warm_until:
            losses = torch.zeros(len(PPO.LOSSES), device=self.device)
        else:
            after = self.iteration - self.warm_until - self.hyperparameters.critic_warmup
            train_actor = after > 0 or self.resumed > 0
            if after == 1 and self.options.init is not None:
                # What an actor has learnt is lost in a few large steps; the schedule finds how large they may be.
                adaptive = self.hyperparameters.schedule == "adaptive"
                self.ppo.optimizer.restart(MIN_LEARNING_RATE if adaptive else self.hyperparameters.learning_rate)
            losses = self.ppo.update(rollout, self.generator, progress, train_actor)
        self.collector.update_moments(self.ppo.reward_moments, self.ranks)
        return losses

    def _seconds(self) -> float:
        return self.seconds_before + time.perf_counter() - self.started

    def _progress(self) -> float:
        """Return how much of the run is over, 1 at its end."""
        steps, seconds = self.options.total_steps, self.options.time_limit
        if steps is None and seconds is None:
            steps = DEFAULT_STEPS
        by_steps = 0.0 if steps is None else self.env_steps / steps
        return min(max(by_steps, 0.0 if seconds is None else self._seconds() / seconds), 1.0)

    def _diverged(self, rollout: Rollout, known: bool, here: bool) -> TrainingDiverged:
        """Return the error of values that are not finite, the guard's file written where they are."""
        if known and self.guard and here:
            return self.guard.dump(rollout, self.folder, self.iteration, self.ranks.rank)
        if known:
            return TrainingDiverged("worlds of another rank are not finite", hint="see its message")
        return TrainingDiverged(
            f"iteration {self.iteration}: the loss is not finite",
            hint=f"find the cause with --run-dir {self.folder.path} --resume --nan-guard, or lower the learning rate",
        )

    def _is_best(self, row: dict[str, Any]) -> bool:
        """Return whether no checkpoint before was as good, and note how good this is."""
        # JSON has no infinity.
        success, mean = (-sys.float_info.max if row[name] is None else row[name] for name in ("success", "return"))
        score = (success, mean)
        better = self.log.episodes >= min(WINDOW, 2 * self.options.num_envs) and score > self.best
        if better:
            self.best = score
        return better

    def _evaluate(self) -> bool:
        """Play episodes of which training knows nothing; return whether no checkpoint before was as good.

        Of every `video_every`-th time the first episode that failed is filmed.
        """
        options, path = self.options, self.folder.path / LATEST
        policy = Policy(self._checkpoint(), self.device, path)
        if self.judges is None:
            count = min(options.num_envs, max(options.eval_episodes, options.processes))
            self.judges = self.make(options.env, count, self.device, options.world_options())
        found = evaluate(self.judges, policy, options.eval_episodes, seed=SELECTION_SEED, device=self.device)
        self.evaluations += 1
        self.report(f"evaluation at iteration {self.iteration}, {found}")
        if options.video_every and self.evaluations % options.video_every == 0 and found.failed_seeds:
            seed = found.failed_seeds[0]
            with self.folder.writing("film"):
                self.report(
                    f"wrote {film_episode(policy, seed, self.folder.path / f'failed-{self.iteration}-{seed}.mp4')}"
                )
        score = (-sys.float_info.max if found.success_rate is None else found.success_rate, found.mean_return)
        better, self.best = score > self.best, max(score, self.best)
        return better

    def _save(self, checkpoint: Checkpoint, better: bool = False) -> None:
        """Write the latest checkpoint, and the best where this is it or there is none."""
        for name in (LATEST, BEST) if better or not (self.folder.path / BEST).exists() else (LATEST,):
            with self.folder.writing(name):
                write_checkpoint(checkpoint, self.folder.path / name)

    def _checkpoint(self) -> Checkpoint:
        """Return what the run goes on from, in memory of its own."""
        arrays: dict[str, torch.Tensor] = {}
        for prefix, module in self._modules().items():
            arrays |= {f"{prefix}.{key}": value for key, value in module.state_dict().items()}
        arrays |= {f"optimizer.{key}": value for key, value in self.ppo.optimizer.state().items()}
        progress = {"iteration": self.iteration, "env_steps": self.env_steps, "seconds": self._seconds()}
        progress |= {"seed": self.options.seed, "resumed": self.resumed, "window": list(self.log.window)}
        progress |= {"best_success": self.best[0], "best_return": self.best[1]}
        return Checkpoint(
            env=self.options.env,
            env_options=self.options.env_options,
            interface=self.env.interface,
            privileged=self.privileged,
            hyperparameters=self.hyperparameters,
            progress=progress,
            arrays={name: value.cpu().numpy().copy() for name, value in arrays.items()},
        )

    def finish(self) -> TrainResult:
        """Evaluate the last policy on the first rank."""
        seconds, evaluation = self._seconds(), None
        if self.ranks.rank == 0 and self.options.eval_episodes:
            path = self.folder.path / LATEST
            policy = Policy(read_checkpoint(path), self.device, path)
            evaluation = evaluate(self.env.env, policy, self.options.eval_episodes, device=self.device)
            self.report(f"evaluation of the last policy, {evaluation}")
            result = {"env_steps": self.env_steps, "train_seconds": seconds, "first_seed": EVALUATION_SEED}
            result |= dataclasses.asdict(evaluation)
            self.folder.write("evaluation.json", json.dumps(result, indent=2).encode() + b"\n")
        self.ranks.barrier()
        return TrainResult(run_dir=self.folder.path, env_steps=self.env_steps, seconds=seconds, evaluation=evaluation)
