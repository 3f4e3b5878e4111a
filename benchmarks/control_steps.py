"""What a control step costs on a machine that other work shares, and the bits that it ends with.

Run: ``python -m benchmarks.control_steps [--environment softmode/LiftSoft-v0] [--steps 120] [--repeats 8]``. Two
versions compare with the same script: ``PYTHONPATH=<the other tree> python benchmarks/control_steps.py``.

The same episode is played several times with the same random actions. Of each step the least processor time counts, so
that what others did to the caches meanwhile is left out: two runs differ by 1 or 2 %, where means differ by 30. The
hash is of all observations: versions with equal hashes make the same bits.
"""

from __future__ import annotations

import argparse
import hashlib
import time

import gymnasium as gym
import numpy as np
import warp as wp

import softmode


def main() -> None:
    """Print one line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--environment", default="softmode/LiftSoft-v0")
    parser.add_argument("--steps", type=int, default=120)
    parser.add_argument("--repeats", type=int, default=8)
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    env = gym.make(options.environment, device="cpu")
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(options.steps)]
    least, seen = np.full(options.steps, np.inf), hashlib.sha256()
    for repeat in range(options.repeats):
        env.reset(seed=0)
        for i, action in enumerate(actions):
            start = time.process_time()
            observation = env.step(action)[0]
            least[i] = min(least[i], time.process_time() - start)
            if repeat == 0:
                for part in observation.values() if isinstance(observation, dict) else [observation]:
                    seen.update(np.ascontiguousarray(part).tobytes())
    print(
        f"{softmode.__file__}, {options.environment}: {1e3 * least.mean():.3f} ms of processor time per control step, "
        f"the least of {options.repeats} each, mean of {options.steps}; bits {seen.hexdigest()[:12]}"
    )


if __name__ == "__main__":
    main()
