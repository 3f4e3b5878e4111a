"""A policy of LiftSoft's beam, played untouched where MuJoCo-Warp and VBD move arm and beam (`peers_vbd`).

Run: ``python -m benchmarks.sim_to_sim policies/lift_beam.npz [--episodes 16] [--device cuda:0]``; without a policy the
scripted one. Controller, goals, observations and success are those of the environment, the physics is Newton's: other
joints, another solid (44 particles), other contacts. Both engines play the same seeds at E = 2e5 Pa, with the forces of
the fingers as they are, as zeros, and with noise of 1 N. VBD tells no forces: they are what the drives push with, less
the fingers' inertia.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import newton
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.baselines.vbd import kuhn_interpolation
from benchmarks.peers_vbd import CELLS, DT, PLACE, RADIUS, SIZE, STEPS, SUBSTEPS, Peer, without_adjoints
from benchmarks.robustness import last_infos
from softmode.envs import scripted_policy
from softmode.learning.intervals import wilson_interval
from softmode.learning.policy import EVALUATION_SEED, load_policy
from softmode.objects.task_objects import BEAM_MATERIAL

FORCES = ("as they are", "zeros", "with noise")
DEAD = 0.3
"""Force below which the drives tell nothing [N]."""


class OtherPhysics:
    """The step of a task whose worlds another simulator moves; takes the place of `Task.graph`.

    Args:
        task: LiftSoft with the beam, without autoreset.
    """

    def __init__(self, task: Any) -> None:
        """Make the worlds and say where the beam's samples are in its cells."""
        self.task, self.scene, worlds = task, task.scene, task.world_count
        self.peer = peer = Peer(worlds, self.scene.device)
        lines = [np.linspace(-0.5 * size, 0.5 * size, cells + 1) for size, cells in zip(SIZE, CELLS, strict=True)]
        points = self.scene.soft.body.surface.points
        half = 0.4999 * np.array(SIZE)
        self.samples = kuhn_interpolation(lines, np.clip(points - 0.5 * (points.min(0) + points.max(0)), -half, half))
        friction = np.sqrt(self.scene.config.material.friction * self.scene.config.arm.gripper.friction)
        peer.model.soft_contact_mu = float(friction)
        self.mass = peer.model.particle_mass.numpy().reshape(worlds, -1, 1)
        self.rest = peer.model.particle_q.numpy().reshape(worlds, -1, 3) - [*PLACE, RADIUS + 0.5 * SIZE[2]]
        self.before: Any = None

    def begin(self, parameters: np.ndarray, columns: dict[str, int]) -> None:
        """Put arm and beam of every world where a reset has put them."""
        turn = Rotation.from_euler("z", parameters[:, columns["yaw"], None]).as_matrix()
        place = np.einsum("wab,wib->wia", turn, self.rest)
        place[..., :2] += parameters[:, None, columns["position"] : columns["position"] + 2]
        place[..., 2] += RADIUS + 0.5 * SIZE[2]
        state = self.peer.state
        state.particle_q.assign(place.reshape(-1, 3).astype(np.float32))
        for array in (state.particle_qd, state.joint_qd):
            array.zero_()
        state.joint_q.assign(self.scene.state.joint_q)
        self.peer.target.assign(self.scene.controller.commanded_q)
        newton.eval_fk(self.peer.model, state.joint_q, state.joint_qd, state)
        self.before = np.zeros((self.task.world_count, 2))

    def launch(self) -> None:
        """Advance a control step: command, physics, what is measured, judgement."""
        scene, peer = self.scene, self.peer
        scene.controller.command(scene.actions, scene.state)
        old, new = (array.numpy() for array in (scene.controller.previous_q, scene.controller.commanded_q))
        for k in range(STEPS * SUBSTEPS):
            peer.target.assign(old + (new - old) * (k + 1) / (STEPS * SUBSTEPS))
            self.before = self.fingers()[1]
            peer.substep()
        self.measure()
        self.task.judge(self.task.episodes.never)

    def fingers(self) -> tuple[np.ndarray, np.ndarray]:
        """Return places and speeds of the fingers, (worlds, 2) [m, m/s]."""
        arrays = (self.peer.state.joint_q, self.peer.state.joint_qd)
        q, qd = (array.numpy().reshape(self.task.world_count, -1)[:, -2:] for array in arrays)
        return q, qd

    def measure(self) -> None:
        """Write what observations are made of."""
        scene, peer, gripper = self.scene, self.peer, self.scene.config.arm.gripper
        scene.state.joint_q.assign(peer.state.joint_q)
        scene.controller.measure(scene.state)
        arrays = (peer.state.particle_q, peer.state.particle_qd)
        place, speed = (array.numpy().reshape(self.mass.shape[0], -1, 3) for array in arrays)
        total = self.mass.sum(axis=1)
        for array, values in ((scene.object_position, place), (scene.object_velocity, speed)):
            array.assign(((self.mass * values).sum(axis=1) / total).astype(np.float32).reshape((*array.shape, 3)))
        samples = np.stack([self.samples @ values for values in place])
        scene.state.particle_q.assign(samples.reshape(-1, 3).astype(np.float32))
        q, qd = self.fingers()
        push = gripper.drive_stiffness * (peer.target.numpy()[:, -2:] - q) - gripper.drive_damping * qd
        push = np.clip(push, -gripper.force_limit, gripper.force_limit) - gripper.damping * qd
        felt = (gripper.finger_mass + gripper.armature) * (qd - self.before) / (DT / SUBSTEPS) - push
        forces = np.zeros((*felt.shape, 3), np.float32)
        forces[..., 1] = np.where(felt > DEAD, felt, 0.0)
        scene.finger_force.assign(forces)


def play(env: Any, other: OtherPhysics | None, policy: Any, forces: str, seed: int) -> dict[str, np.ndarray]:
    """Play an episode in every world; return what the last infos say."""
    task, random = env.unwrapped.task, np.random.default_rng(seed)
    observation, _ = env.reset(seed=seed, options={"youngs_modulus": BEAM_MATERIAL.youngs_modulus})
    if other is not None:
        other.begin(task.table.values.numpy(), {name: task.table.column(name) for name in ("yaw", "position")})
    columns = task.segments["finger_force"][0]

    def player(seen: np.ndarray) -> np.ndarray:
        seen = seen.copy()
        if forces == "zeros":
            seen[:, columns] = 0.0
        elif forces == "with noise":
            seen[:, columns] = np.maximum(seen[:, columns] + random.normal(0.0, 1.0, seen[:, columns].shape), 0.0)
        return policy(seen)

    return last_infos(env, player, observation)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("policy", type=Path, nargs="?")
    parser.add_argument("--episodes", type=int, default=16)
    parser.add_argument("--seed", type=int, default=EVALUATION_SEED)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    without_adjoints()
    trained = None if args.policy is None else load_policy(args.policy)
    options: dict[str, Any] = {"preset": "beam"} if trained is None else {**trained.env_options, "preset": "beam"}
    name = "softmode/LiftSoft-v0" if trained is None else trained.env
    env: Any = gym.make_vec(name, num_envs=args.episodes, autoreset_mode="Disabled", device=args.device, **options)
    task = env.unwrapped.task
    own = task.graph
    print("| engine | forces of the fingers | success | 95 % |\n|---|---|---|---|")
    for engine in ("softmode", "MuJoCo-Warp and VBD"):
        other = None if engine == "softmode" else OtherPhysics(task)
        task.graph = own if other is None else other
        for forces in FORCES if trained is not None else FORCES[:1]:
            policy = scripted_policy(env) if trained is None else trained
            won = play(env, other, policy, forces, args.seed)["is_success"]
            low, high = (100.0 * bound for bound in wilson_interval(won.sum(), len(won)))
            print(f"| {engine} | {forces} | {100.0 * won.mean():.0f} % | {low:.0f} to {high:.0f} % |", flush=True)
    env.close()


if __name__ == "__main__":
    main()
