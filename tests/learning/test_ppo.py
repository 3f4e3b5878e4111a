"""The update of PPO and its parts."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from softmode.errors import ConfigError
from softmode.learning.hyperparameters import Hyperparameters, preset
from softmode.learning.train_options import TrainOptions
from tests.learning.point_env import PointVectorEnv
from tests.needs import needs

pytestmark = needs("torch")

FAST = Hyperparameters(
    rollout_steps=16, epochs=4, minibatches=4, discount=0.9, hidden=(64, 64), learning_rate=2e-3, desired_kl=0.02
)


def run(tmp_path, steps, *, worlds=64, options=FAST, mode=AutoresetMode.NEXT_STEP, seed=0, **kwargs):
    """Train on the point environment; return the result."""
    from softmode.learning.trainer import train

    obs_type = kwargs.pop("obs_type", "state")
    return train(
        TrainOptions(
            env="Point",
            num_envs=worlds,
            total_steps=steps,
            seed=seed,
            hyperparameters=options,
            run_dir=tmp_path / "run",
            tensorboard=False,
            eval_episodes=100,
            **kwargs,
        ),
        make=lambda name, count, device, _: PointVectorEnv(count, mode=mode, obs_type=obs_type),
        report=lambda line: None,
    )


def rate(result) -> float:
    """Return the success rate of the evaluation."""
    return result.evaluation.success_rate


@pytest.mark.parametrize(
    "mode", [AutoresetMode.NEXT_STEP, pytest.param(AutoresetMode.SAME_STEP, marks=pytest.mark.rest)]
)
def test_learns_to_reach(tmp_path, mode):
    """Of 100 fresh episodes nearly all end at the goal; an untrained policy reaches it in a few.

    That advantages are the same in both modes is tested in test_rollout.
    """
    before = run(tmp_path / "before", 1, mode=mode)
    after = run(tmp_path / "after", 80_000, mode=mode)
    assert rate(before) < 0.2
    assert rate(after) > 0.9


def test_learns_from_pixels_with_a_critic_that_sees_the_state(tmp_path):
    """The goal is in the picture alone; the critic reads the full state, and features learn to predict it."""
    options = Hyperparameters(
        rollout_steps=16,
        epochs=3,
        minibatches=8,
        discount=0.9,
        learning_rate=2e-3,
        hidden=(64,),
        features=64,
        state_prediction_coefficient=1.0,
    )
    after = run(tmp_path, 16_000, options=options, obs_type="pixels_agent_pos")
    from softmode.learning.checkpoints import read_checkpoint

    checkpoint = read_checkpoint(after.run_dir / "latest.npz")
    assert checkpoint.privileged == 4
    assert any(name.startswith("predict.") for name in checkpoint.arrays)
    assert not any("pictures" in name for name in checkpoint.arrays if name.startswith("critic."))
    assert rate(after) > 0.5


def test_the_same_seed_gives_the_same_bits(tmp_path):
    """Two runs of one seed end with equal networks, another seed with others."""
    from softmode.learning.checkpoints import read_checkpoint

    runs = [run(tmp_path / str(k), 4096, seed=seed) for k, seed in enumerate((0, 0, 1))]
    first, second, other = (read_checkpoint(r.run_dir / "latest.npz").arrays for r in runs)
    assert all(np.array_equal(first[name], second[name]) for name in first)
    assert not np.array_equal(first["actor.mean.0.weight"], other["actor.mean.0.weight"])


def test_adam_is_adam():
    """Steps on the flat buffer equal those of torch's Adam with clipped gradients."""
    import torch

    from softmode.learning.optimizer import FlatAdam

    torch.manual_seed(0)
    ours = torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.Tanh(), torch.nn.Linear(8, 2))
    theirs = torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.Tanh(), torch.nn.Linear(8, 2))
    theirs.load_state_dict(ours.state_dict())
    adam = torch.optim.Adam(theirs.parameters(), lr=1e-2)
    flat = FlatAdam(ours.parameters(), 1e-2, 0.5)
    for k in range(20):
        flat.zero()
        adam.zero_grad()
        x = torch.randn(16, 4, generator=torch.Generator().manual_seed(k))
        for model in (ours, theirs):
            (10.0 * model(x).square().sum()).backward()
        expected = torch.nn.utils.clip_grad_norm_(theirs.parameters(), 0.5)
        adam.step()
        torch.testing.assert_close(flat.step(), expected, rtol=1e-4, atol=0.0)
    for a, b in zip(ours.parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=0.0, atol=1e-5)


def test_a_gradient_that_is_not_finite_changes_nothing():
    """Parameters and moments keep their bits, and the step is counted as skipped."""
    import torch

    from softmode.learning.optimizer import FlatAdam

    layer = torch.nn.Linear(3, 3)
    flat = FlatAdam(layer.parameters(), 1e-2, 1.0)
    layer(torch.ones(1, 3)).sum().backward()
    flat.step()
    before = {name: value.clone() for name, value in {**flat.state(), "value": flat.value}.items()}
    flat.gradient[4] = float("nan")
    flat.step()
    assert float(flat.skipped) == 1.0
    for name, value in {**flat.state(), "value": flat.value}.items():
        assert torch.equal(value, before[name])


def test_learning_rate_follows_the_divergence():
    """It falls above twice the desired divergence, rises below half of it, and stays in its bounds."""
    import torch

    from softmode.learning.optimizer import FlatAdam

    flat = FlatAdam(torch.nn.Linear(1, 1).parameters(), 1e-3, 1.0)
    for divergence, expected in ((0.03, 1e-3 / 1.5), (0.015, 1e-3 / 1.5), (0.001, 1e-3), (0.0, 1e-3)):
        flat.adapt(torch.tensor(divergence), 0.01, (1e-5, 5e-3))
        assert float(flat.learning_rate) == pytest.approx(expected)
    for _ in range(20):
        flat.adapt(torch.tensor(1.0), 0.01, (1e-5, 5e-3))
    assert float(flat.learning_rate) == pytest.approx(1e-5)


def test_densities_are_those_of_a_gaussian():
    """Log density and divergence equal torch.distributions'."""
    import torch

    from softmode.learning import ppo as module

    generator = torch.Generator().manual_seed(0)
    sample, mean, other = (torch.randn(7, 3, generator=generator) for _ in range(3))
    log_std, other_log_std = torch.tensor([-1.0, 0.0, 0.3]), torch.tensor([-0.5, 0.2, 0.1])
    first = torch.distributions.Normal(mean, log_std.exp())
    second = torch.distributions.Normal(other, other_log_std.exp())
    torch.testing.assert_close(module._log_probability(sample, mean, log_std), first.log_prob(sample).sum(-1))
    expected = torch.distributions.kl_divergence(first, second).sum(-1)
    torch.testing.assert_close(module._divergence(mean, log_std, other, other_log_std), expected)


def test_moments_are_those_of_all_samples():
    """Merged batches give the mean and the variance of their union; samples of weight 0 do not count."""
    import torch

    from softmode.learning.distributed import Ranks
    from softmode.learning.moments import RunningMoments

    rng = np.random.default_rng(0)
    moments = RunningMoments((3,))
    seen = []
    for size in (5, 1, 40):
        batch, weight = rng.normal(3.0, 2.0, (size, 3)), rng.random(size) < 0.7
        weight[0] = True
        moments.update(torch.tensor(batch), Ranks(), torch.tensor(weight))
        seen.append(batch[weight])
    union = np.concatenate(seen)
    np.testing.assert_allclose(moments.mean, union.mean(0), rtol=1e-12)
    np.testing.assert_allclose(moments.variance, union.var(0), rtol=1e-12)
    assert float(moments.count) == len(union)


@pytest.mark.parametrize("count", [1, 8, 16, 256, 4096, 8192])
def test_presets_hold_for_every_number_of_worlds(count):
    """A rollout fills its minibatches."""
    options = preset(count)
    assert options.rollout_steps * count >= options.minibatches
    assert Hyperparameters.from_json(options.to_json()) == options


def test_the_bound_of_the_noise_falls_geometrically():
    """Half-way through the run it is the root of both ends' product."""
    from softmode.learning.networks import Actor
    from softmode.learning.spaces import Interface

    options = Hyperparameters(initial_std=0.8, max_std=0.8, final_std=0.2)
    actor = Actor(Interface.of(PointVectorEnv(1)), options)
    for progress, bound in ((0.0, 0.8), (0.5, 0.4), (1.0, 0.2)):
        actor.bound_std(progress)
        assert actor.log_std.exp().detach().numpy() == pytest.approx(bound, rel=1e-5)


@pytest.mark.parametrize(
    "wrong",
    [
        {"discount": 1.5},
        {"clip": 0.0},
        {"epochs": 0},
        {"hidden": (0,)},
        {"encoder": "resnet"},
        {"initial_std": 2.0},
        {"final_std": 2.0},
        {"learning_rate": float("nan")},
        {"rollout_steps": True},
        {"clip_value": -1.0},
    ],
)
def test_hyperparameters_are_checked(wrong):
    """A value outside its range is refused by name."""
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        Hyperparameters(**wrong)
