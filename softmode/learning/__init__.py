"""Training of policies: PPO on vectorised environments, runs that resume, policies that load anywhere.

Names are imported when they are first used; most need PyTorch (``pip install 'softmode[rl]'``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.learning.checkpoints import Checkpoint as Checkpoint
    from softmode.learning.checkpoints import read_checkpoint as read_checkpoint
    from softmode.learning.checkpoints import write_checkpoint as write_checkpoint
    from softmode.learning.environments import make_vector_env as make_vector_env
    from softmode.learning.field_training import train_field as train_field
    from softmode.learning.hyperparameters import Hyperparameters as Hyperparameters
    from softmode.learning.hyperparameters import preset as preset
    from softmode.learning.networks import ActorCritic as ActorCritic
    from softmode.learning.players import policy_factory as policy_factory
    from softmode.learning.policy import Evaluation as Evaluation
    from softmode.learning.policy import Policy as Policy
    from softmode.learning.policy import evaluate as evaluate
    from softmode.learning.policy import load_policy as load_policy
    from softmode.learning.train_options import TrainOptions as TrainOptions
    from softmode.learning.train_options import TrainResult as TrainResult
    from softmode.learning.trainer import train as train

__getattr__, __dir__ = lazy_names(__name__)
