"""The policies of the repository load, and succeed in the present environments as often as their results say."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.needs import needs

pytestmark = needs("torch")

FOLDER = Path(__file__).parents[2] / "policies"
LEAST = {
    "lift_soft": (18, 20),
    "lift_soft_gentle": (18, 20),
    "lift_soft_robust": (18, 20),
    "lift_beam": (16, 20),
    "press_soft": (17, 20),
    "push_soft": (15, 20),
    "push_soft_robust": (18, 20),
    "place_in_bin": (16, 20),
    "place_in_bin_gentle": (18, 20),
    "lift_soft_pixels": (8, 10),
}
"""Fewest successes in as many episodes. PressSoft's policy had 18, 19, 18 and 15 of 20 with seeds 0 to 3 before rows
answered beside damping as MuJoCo's do, 17, 19, 18 and 15 since: one episode in eighty changed, with the seed below."""


def test_all_are_tested():
    """The folder holds these policies, small ones."""
    assert {path.stem for path in FOLDER.glob("*.npz")} == LEAST.keys()
    assert all(path.stat().st_size < 2.5e6 for path in FOLDER.glob("*.npz"))


@pytest.mark.parametrize("name", LEAST)
def test_loads(name: str):
    """Each holds a policy and nothing that only training needs."""
    from softmode.learning.policy import load_policy

    policy = load_policy(FOLDER / f"{name}.npz")
    assert policy.env.startswith("softmode/") and all(key.startswith("actor.") for key in policy.checkpoint.arrays)


def test_lifts():
    """An episode of LiftSoft."""
    from softmode.learning.policy import evaluate, load_policy

    policy = load_policy(FOLDER / "lift_soft.npz")
    env = policy.make()
    try:
        policy.check(env)
        assert evaluate(env, policy, 1, seed=0).success_rate == 1.0
    finally:
        env.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", LEAST)
def test_success(name: str):
    """Episodes with random stiffness and pose end in success."""
    from softmode.learning.environments import make_vector_env
    from softmode.learning.policy import evaluate, load_policy

    least, episodes = LEAST[name]
    policy = load_policy(FOLDER / f"{name}.npz")
    env = make_vector_env(policy.env, 2, "cpu", policy.env_options)
    try:
        policy.check(env)
        found = evaluate(env, policy, episodes, seed=0)
        assert found.success_rate is not None and round(found.success_rate * episodes) >= least, str(found)
    finally:
        env.close()
