"""Train with rsl_rl: PPO of `OnPolicyRunner`, all tensors on the device of the simulation.

The lines are those of its documentation, with `RslRlVecEnv` as the environment. TensorBoard shows each reward term.

Run: ``python examples/train_rsl_rl.py --env softmode/LiftSoft-v0 --device cuda:0 --num-envs 4096``, or ``--short``
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from gymnasium.vector import AutoresetMode
from rsl_rl.runners import OnPolicyRunner

import softmode  # noqa: F401  (registers the environments)
from softmode.envs import RslRlVecEnv


def make_config(steps_per_env: int) -> dict[str, Any]:
    """Return the runner's configuration."""
    network = {"class_name": "MLPModel", "hidden_dims": [256, 128], "activation": "elu", "obs_normalization": True}
    return {
        "num_steps_per_env": steps_per_env,
        "save_interval": 100,
        "obs_groups": {"actor": ["policy"], "critic": ["critic"]},
        "algorithm": {
            "class_name": "PPO",
            "learning_rate": 1e-3,
            "schedule": "adaptive",
            "desired_kl": 0.01,
            "gamma": 0.98,
            "lam": 0.95,
            "entropy_coef": 0.002,
            "num_learning_epochs": 5,
            "num_mini_batches": 8,
        },
        "actor": {**network, "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.6}},
        "critic": network,
    }


def parameters(runner: OnPolicyRunner) -> torch.Tensor:
    """Return all parameters of the actor as one vector."""
    return torch.cat([value.detach().flatten() for value in runner.alg.actor.parameters()])  # type: ignore[union-attr]


def test_final(before: torch.Tensor, runner: OnPolicyRunner, file: Path, iterations: int) -> None:
    """The policy has learned something finite, every iteration was made, and what was saved is what was trained."""
    after = parameters(runner)
    assert torch.isfinite(after).all() and (after != before).float().mean() > 0.5
    assert runner.current_learning_iteration == iterations - 1
    with torch.no_grad():
        for value in runner.alg.actor.parameters():  # type: ignore[union-attr]
            value.zero_()
    runner.load(str(file))
    assert torch.equal(parameters(runner), after)


def main(arguments: list[str] | None = None) -> None:
    """Train, save, and play."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--env", default="softmode/PushSoft-v0")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--num-envs", type=int, default=16)
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/rsl_rl"))
    parser.add_argument("--short", action="store_true", help="a few seconds")
    options = parser.parse_args(arguments)
    limit, steps = {}, 24
    if options.short:
        options.num_envs, options.iterations, limit, steps = 4, 3, {"max_episode_steps": 30}, 16

    envs = gym.make_vec(
        options.env,
        num_envs=options.num_envs,
        device=options.device,
        output="torch",
        autoreset_mode=AutoresetMode.SAME_STEP,
        **limit,
    )
    torch.manual_seed(options.seed)
    env = RslRlVecEnv(envs, seed=options.seed)

    runner = OnPolicyRunner(env, make_config(steps), log_dir=str(options.out), device=options.device)
    before = parameters(runner)
    runner.learn(num_learning_iterations=options.iterations, init_at_random_ep_len=True)
    file = options.out / "policy.pt"
    runner.save(str(file))

    policy = runner.get_inference_policy(device=options.device)
    obs, _ = env.reset()
    total, won = torch.zeros(env.num_envs, device=env.device), torch.zeros((), device=env.device)
    with torch.inference_mode():
        for _ in range(env.max_episode_length):
            obs, rewards, _dones, extras = env.step(policy(obs))
            total += rewards
            won = torch.maximum(won, extras["log"]["/episode/is_success"])  # of the episodes that ended
    print(f"return {float(total.mean()):.2f}, success {100.0 * float(won):.0f} % of the last episodes")
    test_final(before, runner, file, options.iterations)
    env.close()


if __name__ == "__main__":
    main()
