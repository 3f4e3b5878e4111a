"""Training of policies: PPO on vectorised environments, runs that resume, policies that load anywhere.

Names are imported when they are first used; most need PyTorch (``pip install 'softmode[rl]'``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.learning.checkpoints import Checkpoint, read_checkpoint, write_checkpoint
    from softmode.learning.environments import make_vector_env
    from softmode.learning.hyperparameters import Hyperparameters, preset
    from softmode.learning.networks import ActorCritic
    from softmode.learning.players import policy_factory
    from softmode.learning.policy import Evaluation, Policy, evaluate, load_policy
    from softmode.learning.train_options import TrainOptions, TrainResult
    from softmode.learning.trainer import train

__all__ = [
    "ActorCritic",
    "Checkpoint",
    "Evaluation",
    "Hyperparameters",
    "Policy",
    "TrainOptions",
    "TrainResult",
    "evaluate",
    "load_policy",
    "make_vector_env",
    "policy_factory",
    "preset",
    "read_checkpoint",
    "train",
    "write_checkpoint",
]

__getattr__, __dir__ = lazy_names(__name__)
