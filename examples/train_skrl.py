"""Train with skrl: PPO and its sequential trainer, all tensors on the device of the simulation.

The lines are those of its documentation, with `SkrlWrapper` in the place of `wrap_env`.

Run: ``python examples/train_skrl.py --env softmode/LiftSoft-v0 --device cuda:0 --num-envs 4096``, or ``--short``
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from gymnasium.vector import AutoresetMode
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.memories.torch import RandomMemory
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model

import softmode  # noqa: F401  (registers the environments)
from softmode.envs import SkrlWrapper

ROLLOUTS = 24
"""Steps of every world between two updates."""


def make_agent(env: SkrlWrapper, out: Path, interval: int) -> PPO:
    """Return PPO with a Gaussian policy and a value function."""
    spaces: Any = {"observation_space": env.observation_space, "action_space": env.action_space, "device": env.device}
    network: Any = [{"name": "net", "input": "OBSERVATIONS", "layers": [256, 128], "activations": "elu"}]
    models: Any = {
        "policy": gaussian_model(**spaces, network=network, output="ACTIONS", initial_log_std=-0.5),
        "value": deterministic_model(**spaces, network=network, output="ONE"),
    }
    for model in models.values():  # its layers are sized by the first batch
        model.act({"observations": env.reset()[0]})
    cfg = PPO_CFG(rollouts=ROLLOUTS, learning_epochs=5, mini_batches=8, discount_factor=0.98, learning_rate=1e-3)
    cfg.experiment.directory, cfg.experiment.experiment_name = str(out.parent), out.name
    cfg.experiment.write_interval = cfg.experiment.checkpoint_interval = interval
    memory = RandomMemory(memory_size=ROLLOUTS, num_envs=env.num_envs, device=env.device)
    return PPO(models=models, memory=memory, cfg=cfg, **spaces)


def parameters(agent: PPO) -> torch.Tensor:
    """Return all parameters of the policy as one vector."""
    return torch.cat([value.detach().flatten() for value in agent.policy.parameters()])


def test_final(before: torch.Tensor, agent: PPO, file: Path) -> None:
    """The policy has learned something finite, and what was saved is what was trained."""
    after = parameters(agent).clone()
    assert torch.isfinite(after).all() and (after != before).float().mean() > 0.5
    with torch.no_grad():
        for value in agent.policy.parameters():
            value.zero_()
    agent.load(str(file))
    assert torch.equal(parameters(agent), after)


def main(arguments: list[str] | None = None) -> None:
    """Train, save, and play."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--env", default="softmode/PushSoft-v0")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--num-envs", type=int, default=16)
    parser.add_argument("--timesteps", type=int, default=7200, help="steps of every world")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/skrl"))
    parser.add_argument("--short", action="store_true", help="a few seconds")
    options = parser.parse_args(arguments)
    limit = {}
    if options.short:
        options.num_envs, options.timesteps, limit = 4, 3 * ROLLOUTS, {"max_episode_steps": 30}

    set_seed(options.seed)
    envs = gym.make_vec(
        options.env,
        num_envs=options.num_envs,
        device=options.device,
        output="torch",
        autoreset_mode=AutoresetMode.SAME_STEP,
        **limit,
    )
    env = SkrlWrapper(envs)

    agent = make_agent(env, options.out, options.timesteps // 3)
    before = parameters(agent).clone()
    cfg = {"timesteps": options.timesteps, "headless": True, "close_environment_at_exit": False}
    trainer = SequentialTrainer(cfg=cfg, env=env, agents=agent)
    trainer.train()
    file = options.out / "agent.pt"
    agent.save(str(file))

    length = envs.unwrapped.max_episode_steps  # type: ignore[attr-defined]
    total, won = torch.zeros(env.num_envs, 1, device=env.device), torch.zeros(env.num_envs, dtype=torch.bool)
    observations, infos = env.reset()
    with torch.no_grad():
        for _ in range(length):
            mean = agent.policy.act({"observations": observations}, role="policy")[1]["mean_actions"]
            observations, rewards, _, _, infos = env.step(mean.clamp(-1.0, 1.0))
            total += rewards
            won |= (infos["is_success"] | infos["final_info"]["is_success"]).cpu()
    print(f"reward {float(total.mean()) / length:.3f} per step, success in {int(won.sum())} of {env.num_envs} worlds")
    test_final(before, agent, file)
    env.close()


if __name__ == "__main__":
    main()
