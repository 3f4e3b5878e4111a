"""Behaviour cloning: record scripted demonstrations as a LeRobot dataset, learn them, count the successes.

While recording, the robot is pushed off its way now and then, and the script's corrections are what is learnt (DART,
Laskey et al. 2017). Then the clone plays for short whiles between the script's steps, and the script shows what it
would do where the clone goes (DAgger, Ross et al. 2011); without that, errors add up. The clone is a policy like those
that ``softmode train`` writes: ``softmode evaluate``, ``play --policy``, ``export`` and ``train --init`` take it.

Needs the extras data and rl. Writes out/behaviour_cloning/ENV/dataset and clone.npz.
Run: ``python examples/behaviour_cloning.py [--env ID] [--env-options JSON] [--demonstrations N] [--short]``
"""

import argparse
import json
from pathlib import Path
from typing import Any

import gymnasium as gym

import softmode
from softmode.demonstrations import DatasetWriter, environment_features, read_dataset, record_episodes
from softmode.learning import Evaluation, clone, evaluate, load_policy, policy_factory, write_checkpoint

NOISE, ROUNDS = 0.3, 5  # pushes while recording; how often the clone is learnt and takes part in more demonstrations


def test_final(script: Evaluation, learnt: Evaluation, short: bool) -> None:
    """The script succeeds, and the clone, given enough to learn from, half as often."""
    assert script.success_rate and learnt.success_rate is not None
    assert short or learnt.success_rate > 0.5 * script.success_rate


def main() -> None:
    """Record, learn, evaluate."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--env", default="softmode/LiftSoft-v0", choices=softmode.ENVIRONMENTS)
    parser.add_argument("--env-options", type=json.loads, default={}, help="""as JSON, like '{"preset": "gentle"}'""")
    for name, count in (("--demonstrations", 300), ("--episodes", 50), ("--steps", 10_000)):
        parser.add_argument(name, type=int, default=count)
    parser.add_argument("--device", default="cpu", help="of learning")
    parser.add_argument("--out", type=Path, help="folder of dataset and clone")
    parser.add_argument("--short", action="store_true", help="two demonstrations, one episode")
    args = parser.parse_args()
    rounds, demonstrations, episodes, steps = ROUNDS, args.demonstrations, args.episodes, args.steps
    if args.short:
        rounds, demonstrations, episodes, steps = 1, 2, 1, 50
    env = gym.make(args.env, **args.env_options)
    out = args.out or Path("out", "behaviour_cloning", args.env.replace("/", "_"))
    script, learner = policy_factory("scripted", env), None
    given: dict[str, Any] = {"task": softmode.ENVIRONMENTS[args.env], "noise": NOISE}
    for number in range(rounds + 1):
        wanted = demonstrations * (number + 1) // (rounds + 1)
        with DatasetWriter(out / "dataset", environment_features(env), fps=30, append=True) as writer:
            have = writer.episode_count  # an interrupted run left some
            if have < wanted:
                record_episodes(env, script, writer, episodes=wanted - have, seed=have, learner=learner, **given)
        data = read_dataset(out / "dataset")
        learnt = clone(
            env, args.env_options, data.observations(), data.columns["action"], steps=steps, device=args.device
        )
        write_checkpoint(learnt, out / "clone.npz")
        learner = load_policy(out / "clone.npz")
        print(f"{data.episode_count} demonstrations, {learnt.progress}")
    found = [evaluate(env, policy, episodes) for policy in (script(0), learner)]
    print(f"{args.env}\n  script: {found[0]}\n  clone:  {found[1]}\nwrote {out / 'clone.npz'}")
    test_final(*found, args.short)


if __name__ == "__main__":
    main()
