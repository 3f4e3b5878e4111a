"""What PPO is run with, and presets by the number of environments."""

from __future__ import annotations

import dataclasses
import typing
from typing import Any, Literal

from softmode.checks import require_choice, require_fields, require_number
from softmode.errors import ConfigError
from softmode.learning.config_values import config_of


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hyperparameters:
    """Hyperparameters of PPO.

    Raises:
        ConfigError: If one lies outside its range.
    """

    rollout_steps: int = 32
    """Control steps of every world between two updates."""
    epochs: int = 5
    """Passes over the rollout per update."""
    minibatches: int = 4
    """Parts of the rollout per pass."""
    discount: float = 0.98
    """Discount per control step."""
    gae_lambda: float = 0.95
    """Decay of generalised advantage estimation (Schulman et al. 2016, equation 16)."""
    learning_rate: float = 1e-3
    """Learning rate of Adam at the start."""
    schedule: Literal["adaptive", "linear", "constant"] = "adaptive"
    """adaptive follows the divergence of the policy, linear falls to a twentieth at the end of the run."""
    desired_kl: float = 0.02
    """Divergence from the old policy that the adaptive schedule aims at [nat]."""
    max_learning_rate: float = 5e-3
    """Bound of the adaptive schedule."""
    clip: float = 0.2
    """Clip range of the probability ratio."""
    clip_value: float | None = None
    """Clip range of the value (in units of scaled rewards); no clipping if omitted."""
    value_coefficient: float = 1.0
    """Weight of the value loss."""
    entropy_coefficient: float = 0.002
    """Weight of the entropy bonus at the start of the run; it falls linearly to a tenth at the end."""
    bound_coefficient: float = 0.01
    """Weight of the penalty on means outside the action range (bound="clamp")."""
    max_gradient_norm: float = 1.0
    """Gradients are shortened to this Euclidean norm."""
    hidden: tuple[int, ...] = (256, 128, 64)
    """Widths of the hidden layers of actor and critic."""
    activation: Literal["elu", "tanh", "relu"] = "elu"
    """Activation of the hidden layers."""
    encoder: Literal["nature", "impala"] = "nature"
    """Convolutional encoder of pixels (Mnih et al. 2015; Espeholt et al. 2018)."""
    features: int = 256
    """Features that the encoder of pixels ends with."""
    initial_std: float = 0.6
    """Standard deviation of actions at the start, in units of half the action range; where training starts from a
    checkpoint it is that one's, unless this is given."""
    min_std: float = 0.03
    """Lower bound of the standard deviation."""
    max_std: float = 1.0
    """Upper bound of the standard deviation at the start of the run."""
    final_std: float | None = None
    """That at its end, to which it falls geometrically; it stays if omitted. Noise of a gripper is force."""
    bound: Literal["clamp", "tanh"] = "clamp"
    """How actions are kept in range: clamped on the way to the environment, or squashed."""
    normalize_observations: bool = True
    """Normalise state observations by their running moments."""
    scale_rewards: bool = True
    """Divide rewards by the running standard deviation of the discounted return."""
    asymmetric_critic: bool = True
    """Let the critic read the full state where the environment offers it beside the observation."""
    state_prediction_coefficient: float = 0.1
    """Weight of predicting the full state from the features of pixels, where the environment offers it."""
    teacher_coefficient: float = 2.0
    """Weight, at the start of the run, of staying near a teacher's actions; it falls linearly to 0 at the end."""
    critic_warmup: int = 0
    """Updates at the start that train the critic alone, for actors that begin with what they learnt elsewhere."""
    mixed_precision: bool = True
    """Run the encoder of pixels in bfloat16 on CUDA."""

    def __post_init__(self) -> None:
        """Check every range."""
        for name in ("rollout_steps", "epochs", "minibatches", "features"):
            _require(name, getattr(self, name), _is_count(getattr(self, name)), "a whole number >= 1")
        _require("critic_warmup", self.critic_warmup, self.critic_warmup == 0 or _is_count(self.critic_warmup), ">= 0")
        require_fields(self, ("discount", "gae_lambda"), at_least=0.0, at_most=1.0, hint="change it")
        positive = ("learning_rate", "desired_kl", "max_learning_rate", "clip", "max_gradient_norm", "initial_std")
        require_fields(self, (*positive, "min_std", "max_std"), above=0.0, hint="change it")
        coefficients = ("value", "entropy", "bound", "state_prediction", "teacher")
        names = (f"{word}_coefficient" for word in coefficients)
        require_fields(self, names, at_least=0.0, hint="change it")
        if self.clip_value is not None:
            require_number("clip_value", self.clip_value, above=0.0, hint="give a number, or none")
        ok = self.min_std <= self.initial_std <= self.max_std
        _require("initial_std", self.initial_std, ok, f"from min_std {self.min_std} to max_std {self.max_std}")
        if self.final_std is not None:
            ok = self.min_std <= self.final_std <= self.max_std
            _require("final_std", self.final_std, ok, f"from min_std {self.min_std} to max_std {self.max_std}")
        _require("hidden", self.hidden, all(_is_count(width) for width in self.hidden), "widths >= 1")
        hints = typing.get_type_hints(type(self))
        for name in ("schedule", "activation", "encoder", "bound"):
            require_choice(name, getattr(self, name), typing.get_args(hints[name]))

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON values."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Hyperparameters:
        """Return the hyperparameters that :meth:`to_json` wrote.

        Raises:
            ConfigError: If a field is unknown or has another type.
        """
        return config_of(cls, values)


def preset(num_envs: int, *, pixels: bool = False) -> Hyperparameters:
    """Return hyperparameters that learn fast with this many worlds.

    A thousand worlds and more (a GPU) take short rollouts and large batches; a few worlds (a CPU), where simulated
    steps are dear and updates cheap, take long rollouts and go over them more often.

    Args:
        num_envs: Number of worlds on all ranks together.
        pixels: Whether the observation holds pictures.

    Raises:
        ConfigError: If ``num_envs`` is not at least 1.
    """
    if not _is_count(num_envs):
        raise ConfigError(f"num_envs must be a whole number >= 1, got {num_envs!r}", hint="give a count like 16")
    if num_envs >= 512:
        base = Hyperparameters(rollout_steps=16, epochs=4, minibatches=8)
    else:
        # Rollouts of about 2,048 steps in minibatches of about 256.
        steps = min(max(2048 // num_envs, 32), 512)
        base = Hyperparameters(
            rollout_steps=steps,
            epochs=10,
            minibatches=max(steps * num_envs // 256, 1),
            learning_rate=5e-4,
            max_learning_rate=2e-3,
            hidden=(128, 128),
        )
    if pixels:
        base = dataclasses.replace(base, epochs=max(base.epochs // 2, 2), learning_rate=5e-4, max_learning_rate=1e-3)
    return base


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1


def _require(name: str, value: object, ok: bool, expected: str) -> None:
    if not ok:
        raise ConfigError(f"{name} must be {expected}, got {value!r}", hint=f"change {name}")
