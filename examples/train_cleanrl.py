"""Train with PPO in one file, after CleanRL's `ppo_continuous_action`: from the environment to the policy, no library.

All stays on the device of the worlds, as tensors. The step after an episode's end only resets (NEXT_STEP) and is left
out of the loss; what the time limit cut off is bootstrapped. `softmode train` adds checkpoints, pixels, several GPUs.

Run: ``python examples/train_cleanrl.py --env-id softmode/LiftSoft-v0 --device cuda:0 --num-envs 4096``, or ``--short``
"""

import argparse
from typing import Any

import gymnasium as gym
import torch
from gymnasium.wrappers.vector import RescaleAction
from torch import nn
from torch.distributions import Normal

import softmode

GAMMA, GAE_LAMBDA, CLIP_COEF, ENT_COEF, EPOCHS, MINIBATCHES, RATE = 0.98, 0.95, 0.2, 0.002, 5, 8, 1.0e-3


class Agent(nn.Module):
    """A Gaussian policy and a value function, of observations in units of their running standard deviation."""

    def __init__(self, observed: int, acted: int) -> None:
        """Build two perceptrons; the policy starts near zero."""
        super().__init__()
        self.rms = nn.BatchNorm1d(observed, momentum=None, affine=False)  # no momentum: the mean over all rollouts
        self.actor_mean, self.critic = (
            nn.Sequential(nn.Linear(observed, 256), nn.ELU(), nn.Linear(256, 128), nn.ELU(), nn.Linear(128, out))
            for out in (acted, 1)
        )
        nn.init.normal_(self.actor_mean[-1].weight, std=0.01)  # type: ignore[arg-type]
        self.actor_logstd = nn.Parameter(torch.full((acted,), -0.5))

    def forward(self, x: torch.Tensor) -> tuple[Normal, torch.Tensor]:
        """Return the distribution of actions and the value, shape (...)."""
        mean, variance = self.rms.running_mean, self.rms.running_var
        x = ((x - mean) / (variance + 1e-6).sqrt()).clamp(-10.0, 10.0)  # type: ignore[operator]
        return Normal(self.actor_mean(x), self.actor_logstd.clamp(-3.0, 0.0).exp()), self.critic(x)[..., 0]


def update(agent: Agent, adam: torch.optim.Adam, columns: list[torch.Tensor]) -> None:
    """Improve policy and value with a rollout whose steps are rows."""
    for _ in range(EPOCHS):
        for index in torch.randperm(len(columns[0]), device=columns[0].device).chunk(MINIBATCHES):
            obs, action, logprob, advantage, target, valid = (column[index] for column in columns)
            policy, value = agent(obs)
            ratio = (policy.log_prob(action).sum(-1) - logprob).exp()
            gain = torch.minimum(advantage * ratio, advantage * ratio.clamp(1.0 - CLIP_COEF, 1.0 + CLIP_COEF))
            loss = (valid * ((value - target) ** 2 - gain - ENT_COEF * policy.entropy().sum(-1))).mean()
            adam.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 1.0)
            adam.step()


def test_final(history: list[float]) -> None:
    """The return of episodes has grown: the mean of the last three beats that of the first by a tenth of its size."""
    first, last = (sum(part) / len(part) for part in (history[:3], history[-3:]))
    assert last > first + 0.1 * abs(first), history


def main(arguments: list[str] | None = None) -> None:
    """Train."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    defaults = {"env-id": "softmode/PushSoft-v0", "device": "cpu", "num-envs": 16, "total-timesteps": 10_000_000}
    for name, value in defaults.items():
        parser.add_argument(f"--{name}", type=type(value), default=value)
    parser.add_argument("--short", action="store_true", help="a few seconds, on the pendulum, which it has to learn")
    args = parser.parse_args(arguments)
    if args.short:
        args.env_id, args.total_timesteps = "Pendulum-v1", 45_000
    torch.manual_seed(0)
    soft, device, count = args.env_id in softmode.ENVIRONMENTS, torch.device(args.device), args.num_envs
    envs: Any = gym.make_vec(args.env_id, count, **({"device": args.device, "output": "torch"} if soft else {}))
    envs = envs if soft else RescaleAction(envs, -1.0, 1.0)
    agent = Agent(envs.single_observation_space.shape[0], envs.single_action_space.shape[0]).to(device)
    adam, num_steps = torch.optim.Adam(agent.parameters(), lr=RATE), max(2048 // count, 16)
    next_obs = torch.as_tensor(envs.reset(seed=0)[0], device=device)
    running, history = torch.zeros(count, device=device), []
    over, iterations = running > 0.0, args.total_timesteps // (num_steps * count)
    for iteration in range(iterations):
        adam.param_groups[0]["lr"] = RATE * (1.0 - iteration / iterations)
        rows, ended = [], torch.zeros(3, device=device)  # episodes, their returns, their successes
        for _ in range(num_steps):
            with torch.no_grad():
                action = (policy := agent(next_obs)[0]).sample()
            obs, valid, clipped = next_obs, ~over, action.clamp(-1.0, 1.0)
            *step, infos = envs.step(clipped if soft else clipped.cpu().numpy())
            next_obs, reward, terminated, truncated = (torch.as_tensor(x, device=device) for x in step)
            reward, over = reward.float(), terminated | truncated
            rows.append((obs, action, policy.log_prob(action).sum(-1), reward, terminated, over, valid.float()))
            running += reward * valid
            ended += torch.stack([over, over * running, over * infos.get("is_success", 0.0 * running)]).sum(1)
            running *= ~over
        obs, action, logprob, reward, dead, done, valid = map(torch.stack, zip(*rows, strict=True))
        agent.rms(obs.flatten(0, 1))
        if iteration == 0:  # the first rollout tells the scales only
            spread = reward.std() / (1.0 - GAMMA) ** 0.5 + 1e-3
            continue
        with torch.no_grad():  # generalised advantage estimation
            values, last, advantage = agent(torch.cat([obs, next_obs[None]]))[1], 0.0, torch.zeros_like(reward)
            for t in reversed(range(num_steps)):
                delta = reward[t] / spread + GAMMA * values[t + 1] * ~dead[t] - values[t]
                advantage[t] = last = delta + GAMMA * GAE_LAMBDA * ~done[t] * last
        scaled = (advantage - advantage[valid > 0].mean()) / advantage[valid > 0].std()
        update(agent, adam, [x.flatten(0, 1) for x in (obs, action, logprob, scaled, advantage + values[:-1], valid)])
        (episodes, total, won), steps = ended.tolist(), (iteration + 1) * num_steps * count
        if episodes:
            history.append(total / episodes)
            print(f"{steps:>10,} steps  return {history[-1]:.2f}  success {won / episodes:.2f}", flush=True)
    envs.close()
    if args.short:
        test_final(history)


if __name__ == "__main__":
    main()
