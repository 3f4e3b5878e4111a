"""Several processes train as one."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from softmode.learning.hyperparameters import Hyperparameters
from softmode.learning.spaces import Interface
from tests.needs import needs

if TYPE_CHECKING:
    from softmode.learning.distributed import Ranks

pytestmark = needs("torch")

ROOT = Path(__file__).resolve().parents[2]
CODE = """
import sys
from pathlib import Path
import numpy as np, torch
from softmode.learning import trainer
from softmode.learning.distributed import Ranks
from tests.learning.test_distributed import updated
from tests.learning.test_runs import run
folder = Path(sys.argv[1])
ranks = Ranks.start(torch.device("cpu"))
rank, found = ranks.rank, {"updated": updated(ranks)}
ranks.stop()
finish = trainer._Run.finish
def keep(self):
    found["value"] = self.ppo.optimizer.value.numpy()
    found["moments"] = self.model.actor.encoder.moments["state"].mean.numpy()
    found["seen"] = self.collector.observation["state"].numpy()
    return finish(self)
trainer._Run.finish = keep
result = run(folder / "run", 2048)
np.savez(folder / f"rank{rank}.npz", steps=result.env_steps, **found)
"""
"""What each process does: an update of its share, then training of its worlds."""


LOST = """
import os, signal, sys
from pathlib import Path
from softmode.errors import WorkerError
from softmode.learning import trainer
from tests.learning.test_runs import run
update = trainer._Run._update
def die(self, *given):
    if self.ranks.rank == 1 and self.iteration == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return update(self, *given)
trainer._Run._update = die
try:
    run(Path(sys.argv[1]) / "lost", 1 << 20, checkpoint_seconds=1e9)
except WorkerError as error:
    print("told:", error)
"""
"""One process is killed in the third iteration, in which the other one waits for it."""


def torchrun(folder: Path, code: str = CODE, processes: int = 2) -> list[str]:
    """Run the code in processes that know of each other as torchrun's do, each on a machine of its own.

    Returns what each said, with its exit status.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "MASTER_ADDR": "127.0.0.1"}
    environment |= {"MASTER_PORT": port, "WORLD_SIZE": str(processes)}
    started = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(folder)],
            env={**environment, "RANK": str(rank), "LOCAL_RANK": "0"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for rank in range(processes)
    ]
    return [f"{process.communicate()[0]}exit {process.returncode}" for process in started]


def updated(ranks: Ranks) -> np.ndarray:
    """Return the parameters after one update with this rank's share of a rollout of eight worlds."""
    import torch

    from softmode.learning.networks import ActorCritic
    from softmode.learning.ppo import PPO
    from softmode.learning.rollout import Rollout

    interface = Interface(vectors={"state": 3}, pictures={}, action_low=(-1.0, -1.0), action_high=(1.0, 1.0))
    options = Hyperparameters(hidden=(8,), epochs=1, minibatches=1)
    torch.manual_seed(0)
    ppo = PPO(ActorCritic(interface, 0, options), options, ranks)
    share = slice(8 * ranks.rank // ranks.count, 8 * (ranks.rank + 1) // ranks.count)
    whole = torch.Generator().manual_seed(1)
    rollout = Rollout(6, {"state": torch.zeros(8, 3)}, 2, False)
    rollout.observation["state"].normal_(generator=whole)
    for array in (rollout.sample, rollout.mean, rollout.reward):
        array.normal_(generator=whole)
    rollout.terminated.copy_(torch.rand(6, 8, generator=whole) < 0.2)
    rollout.valid.copy_(torch.rand(6, 8, generator=whole) < 0.7)  # unequal numbers on the ranks
    mine = Rollout(6, {"state": torch.zeros(share.stop - share.start, 3)}, 2, False)
    mine.observation["state"].copy_(rollout.observation["state"][:, share])
    for name in ("sample", "mean", "reward", "terminated", "truncated", "valid"):
        getattr(mine, name).copy_(getattr(rollout, name)[:, share])
    ppo.reward_moments.update(mine.reward.flatten(), ranks)
    ppo.model.actor.encoder.moments["state"].update(mine.observation["state"].flatten(0, 1), ranks)  # type: ignore[operator]
    ppo.model.critic.encoder.moments["state"].update(mine.observation["state"].flatten(0, 1), ranks)  # type: ignore[operator]
    ppo.update(mine, torch.Generator(), 0.0, True)
    return ppo.optimizer.value.numpy().copy()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return where two processes have left what they hold."""
    made = tmp_path_factory.mktemp("ranks")
    told = torchrun(made)
    assert all(text.endswith("exit 0") for text in told), "\n".join(told)
    return made


@pytest.fixture
def ranks(folder: Path) -> list[Any]:
    """Return what each of the two processes holds."""
    return [np.load(folder / f"rank{rank}.npz") for rank in range(2)]


def test_two_processes_stay_equal(folder: Path, ranks: list[Any]):
    """After training both hold the same bits, from worlds of their own; steps count those of both."""
    first, second = ranks
    assert np.array_equal(first["value"], second["value"]) and np.array_equal(first["moments"], second["moments"])
    assert not np.array_equal(first["seen"], second["seen"])
    assert int(first["steps"]) == int(second["steps"]) == 2048
    assert {path.name for path in (folder / "run").iterdir()} == {
        "config.json",
        "progress.csv",
        "latest.npz",
        "best.npz",
    }


def test_two_processes_update_as_one_with_all_worlds(ranks: list[Any]):
    """One update of two halves equals that of the whole up to rounding: scales, advantages, gradients, divergence."""
    from softmode.learning.distributed import Ranks

    first, second = (rank["updated"] for rank in ranks)
    assert np.array_equal(first, second)
    alone = updated(Ranks())
    # Adam's first step is the learning rate times the sign of the gradient, whose rounding errs by 1e-6 at most.
    np.testing.assert_allclose(first, alone, rtol=0.0, atol=2e-5)


@pytest.mark.rest
def test_a_lost_process_ends_the_run_with_its_last_iteration(tmp_path: Path):
    """The other one says what was lost and how to go on, and its checkpoint is whole."""
    from softmode.learning.checkpoints import read_checkpoint

    first, second = torchrun(tmp_path, LOST)
    assert "told: a process of the run was lost after iteration 2" in first and first.endswith("exit 0")
    assert "--resume" in first and second.endswith("exit -9")
    assert read_checkpoint(tmp_path / "lost" / "latest.npz").progress["iteration"] == 2
