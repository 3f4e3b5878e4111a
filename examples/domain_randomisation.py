"""Domain randomisation: every world has its own stiffness, size, weight, friction, camera and light.

Draws happen on the device at every reset, from ranges in the configuration. Here they are read back: are they spread
as asked, independent of each other, and does the physics follow? Then every world is looked at through its own camera.

Run: ``python examples/domain_randomisation.py [--worlds 12] [--short]``; writes ``out/domain_randomisation.png``
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import warp as wp
from PIL import Image
from scipy import stats

import softmode  # noqa: F401  (registers the environments)
from softmode.envs import LiftSoftConfig
from softmode.splats import CameraRandomization

COLUMNS, GRAVITY = 4, 9.81
RANGES: dict[str, tuple[float, float]] = {
    "youngs_modulus": (5.0e3, 5.0e5),  # log-uniform, like the density
    "density": (100.0, 400.0),
    "friction": (0.3, 1.2),
    "scale": (0.75, 1.2),
}
VIEWS = CameraRandomization(
    rotation=0.05,
    translation=0.02,
    focal=0.08,
    sky=0.15,
    light=0.4,
    light_tint=0.2,
    splat_brightness=0.2,
    splat_tint=0.15,
)


def make_worlds(count: int, edge: int) -> Any:
    """Return the vector environment; zero actions leave arm and toy alone."""
    ranges: dict[str, Any] = {f"{name}_range": limits for name, limits in RANGES.items()}
    config = LiftSoftConfig(camera_randomization=VIEWS, image_size=edge, mesh_samples=4, **ranges)
    return gym.make_vec("softmode/LiftSoft-v0", count, obs_type="pixels", config=config)


def draw(envs: Any, resets: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return what was drawn in all worlds and resets, (resets * worlds,) by name, and the pictures of the first."""
    drawn, pictures = [], None
    for k in range(resets):
        observation, info = envs.reset(seed=0 if k == 0 else None)
        drawn.append({name: info["parameters"][name] for name in RANGES})
        pictures = observation if pictures is None else pictures
    assert pictures is not None
    return {name: np.concatenate([part[name] for part in drawn]) for name in RANGES}, pictures


def sink(envs: Any) -> tuple[np.ndarray, np.ndarray]:
    """Let the toys settle for half a second; return how far their centres sank and rho g h^2 / E [m]."""
    _, info = envs.reset(seed=0)
    scene, drawn = envs.unwrapped.task.scene, info["parameters"]
    before = scene.object_position.numpy()[:, 0, 2].copy()
    action = np.zeros(envs.action_space.shape, np.float32)
    action[:, -1] = 1.0  # the gripper stays open
    for _ in range(15):
        envs.step(action)
    height = drawn["scale"] * scene.soft.height
    return before - scene.object_position.numpy()[:, 0, 2], (
        drawn["density"] * GRAVITY * height**2 / drawn["youngs_modulus"]
    )


def test_final(
    drawn: dict[str, np.ndarray], pictures: np.ndarray, again: np.ndarray, sank: np.ndarray, law: np.ndarray
) -> None:
    """Draws are distributed as asked and independent, seeds repeat them, views differ, soft toys sink more."""
    unit = {}
    for name, (low, high) in RANGES.items():
        scale = np.log if name in ("youngs_modulus", "density") else np.asarray
        unit[name] = (scale(drawn[name]) - scale(low)) / (scale(high) - scale(low))
        p = stats.kstest(unit[name], "uniform").pvalue
        print(f"{name:15s} {drawn[name].min():10.4g} .. {drawn[name].max():10.4g}, Kolmogorov-Smirnov p = {p:.2f}")
        assert p > 1.0e-3
    correlation = np.corrcoef(list(unit.values())) - np.eye(len(unit))
    assert np.abs(correlation).max() < 4.0 / np.sqrt(len(drawn["scale"]))
    np.testing.assert_array_equal(pictures, again)
    assert all(np.abs(pictures[i].astype(float) - pictures[0]).mean() > 2.0 for i in range(1, len(pictures)))
    rank: Any = stats.spearmanr(sank, law)[0]
    print(f"toys sank {1e3 * sank.min():.2f} to {1e3 * sank.max():.2f} mm, in the order of rho g h^2 / E: {rank:.2f}")
    assert rank > 0.8


def main(arguments: list[str] | None = None) -> None:
    """Draw, check, save a grid of pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=12)
    parser.add_argument("--short", action="store_true", help="8 worlds in small pictures")
    given = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    count = 8 if given.short else given.worlds
    envs = make_worlds(count, 64 if given.short else 224)
    drawn, pictures = draw(envs, -(-200 // count))
    again, _ = envs.reset(seed=0)
    sank, law = sink(envs)
    Path("out").mkdir(exist_ok=True)
    rows = [np.concatenate(list(pictures[k : k + COLUMNS]), axis=1) for k in range(0, count - COLUMNS + 1, COLUMNS)]
    Image.fromarray(np.concatenate(rows, axis=0)).save("out/domain_randomisation.png")
    test_final(drawn, pictures, again, sank, law)


if __name__ == "__main__":
    main()
