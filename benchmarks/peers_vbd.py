"""MuJoCo-Warp with VBD in many worlds: LiftSoft's arm holds the beam, coupled by Newton's proxies.

Run: ``python -m benchmarks.peers_vbd [--device cuda:0] [--worlds 64 1024 4096]``. The rows stand beside those of
``softmode bench --preset beam --actions grasp`` in ``benchmarks/JOURNAL.md``.

Arm, table, beam and material are those of LiftSoft's preset "beam": 0.30 x 0.04 x 0.04 m, E = 2e5 Pa, nu = 0.3. The
physics has the settings of Isaac Lab's `Isaac-Lift-Soft-Franka`: steps of 1/120 s in two coupled substeps, four to a
control step, ten iterations of VBD, MuJoCo-Warp with elliptic cones, hand and fingers as proxies, contact of the whole
surface. The beam is ten cells of six tetrahedra, 44 particles. The hand moves at random around it, and the fingers
close in five of six spells. There are no observations, rewards or resets, so the peer has less to do than LiftSoft.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo, SolverVBD

from benchmarks.baselines.vbd import kuhn_mesh
from benchmarks.clock import in_spells, replayed
from benchmarks.peers_kernels import act_arm, count_step
from softmode.envs.tasks.lift_soft.task import LiftSoftConfig
from softmode.objects.task_objects import BEAM_MATERIAL
from softmode.scenes.fixture import Fixture, add_fixture
from softmode.scenes.table_scene import TABLE_PLACE, TABLE_SIZE

CELLS = (10, 1, 1)
SIZE = (0.30, 0.04, 0.04)
PLACE = (0.5, 0.0)
"""Where the beam lies [m]."""
RADIUS = 0.0025
"""Radius of a particle [m]."""
DT, STEPS, SUBSTEPS, ITERATIONS = 1.0 / 120.0, 4, 2, 10
SOFT_MAX, RIGID_MAX = 512, 32
"""Contacts per world that have room."""


def main() -> None:
    """Print a line per number of worlds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, nargs="+", default=None, help="default 64 1024 4096, on CPU 1")
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--warmup", type=int, default=40, help="control steps before the clock starts")
    options = parser.parse_args()
    without_adjoints()
    wp.set_device(options.device)
    device = wp.get_device(options.device)
    print(f"{device.name or device}: Newton {newton.__version__}")
    for count in options.worlds or ([64, 1024, 4096] if device.is_cuda else [1]):
        report(count, device, options)


def without_adjoints() -> None:
    """Compile Newton's kernels without adjoints, which take minutes."""
    wp.config.log_level = wp.LOG_WARNING
    for name in [name for name in sys.modules if name.startswith("newton._src.")]:
        wp.set_module_options({"enable_backward": False}, module=sys.modules[name])
    surface = importlib.import_module("newton._src.geometry.soft_contacts_sdf")
    for kernel in (surface.create_soft_edge_contacts, surface.create_soft_face_contacts):
        kernel.module.options["enable_backward"] = False  # modules of their own


class Peer:
    """Worlds of arm and beam, and a control step of them all.

    Args:
        worlds: How many.
        device: Where.
    """

    def __init__(self, worlds: int, device: wp.Device) -> None:
        """Build model, solvers and states."""
        self.worlds, self.device = worlds, device
        arm = LiftSoftConfig.preset("beam").scene.arm
        height = RADIUS + 0.5 * SIZE[2]
        home = np.append(arm.joint_q_over((*PLACE, height)), (0.5 * arm.home_opening,) * 2)
        world = newton.ModelBuilder()
        SolverMuJoCo.register_custom_attributes(world)
        SolverVBD.register_custom_attributes(world)
        indices = arm.add_to(world)
        world.joint_q[-len(home) :] = [float(value) for value in home]
        robot = [list(range(count)) for count in (world.body_count, world.joint_count, world.shape_count)]
        proxies = [indices.hand_body, *indices.finger_bodies]
        self.particles = add_beam(world)
        add_fixture(world, Fixture(label="table", position=TABLE_PLACE, size=TABLE_SIZE, color=(0.4, 0.5, 0.5)))
        world.color()
        sizes = (world.body_count, world.joint_count, world.shape_count)
        builder = newton.ModelBuilder()
        SolverMuJoCo.register_custom_attributes(builder)
        SolverVBD.register_custom_attributes(builder)
        builder.replicate(world, worlds)
        self.model: Any = builder.finalize(device=device)
        self.model.soft_contact_ke, self.model.soft_contact_kd, self.model.soft_contact_mu = 8.0e3, 1.0e-2, 10.0
        bodies, joints, shapes = (everywhere(part, size, worlds) for part, size in zip(robot, sizes, strict=True))
        self.solver = self._coupled(bodies, joints, shapes, everywhere(proxies, sizes[0], worlds))
        self.contacts = self.solver.get_proxy_contacts("rigid", "soft")
        self.state, self._next, self.control = self.model.state(), self.model.state(), self.model.control()
        for state in (self.state, self._next):
            newton.eval_fk(self.model, self.model.joint_q, self.model.joint_qd, state)
        self._step: Any = wp.zeros(1, dtype=int, device=device)
        self._home: Any = wp.array(home, dtype=float, device=device)
        self._grip = 0.5 * arm.home_opening, 0.5 * SIZE[1] - 0.002
        self.target = self.control.joint_target_q.reshape((worlds, len(home)))

    def _coupled(self, bodies: list[int], joints: list[int], shapes: list[int], proxies: list[int]) -> Any:
        """Return MuJoCo-Warp and VBD, coupled by proxies of hand and fingers."""

        def pipeline(view: Any) -> Any:
            return newton.CollisionPipeline(
                view,
                broad_phase="explicit",
                soft_contact_max=SOFT_MAX * self.worlds,
                rigid_contact_max=RIGID_MAX * self.worlds,
                enable_rigid_soft_full_surface_contact=True,
                verify_buffers=False,
            )

        def rigid(view: Any) -> Any:
            options: dict[str, Any] = {"ls_iterations": 20, "njmax": 96, "nconmax": RIGID_MAX}
            return SolverMuJoCo(model=view, cone="elliptic", integrator="implicitfast", **options)

        def soft(view: Any) -> Any:
            return SolverVBD(model=view, iterations=ITERATIONS, rigid_body_particle_contact_buffer_size=256)

        coupled: Any = importlib.import_module("newton.solvers.experimental.coupled").SolverCoupledProxy
        entry = coupled.Entry
        shared = coupled.Proxy(
            source="rigid", destination="soft", bodies=proxies, collision_pipeline=pipeline, collide_interval=1
        )
        return coupled(
            model=self.model,
            entries=[
                entry(name="rigid", solver=rigid, bodies=bodies, joints=joints, shapes=shapes),
                entry(name="soft", solver=soft, particles=list(range(self.model.particle_count))),
            ],
            coupling=coupled.Config(proxies=[shared], iterations=1),
        )

    def pressed(self) -> float:
        """Return the share of worlds in which something keeps both fingers from where they are driven, by 0.1 mm."""
        apart = self.state.joint_q.numpy().reshape(self.worlds, -1)[:, -2:] - self.target.numpy()[:, -2:]
        return float((apart > 1.0e-4).all(axis=1).mean())

    def control_step(self) -> None:
        """Launch the steps of a control step, an even number."""
        wp.launch(act_arm, self.worlds, [self._step, self._home, *self._grip], [self.target], device=self.device)
        wp.launch(count_step, 1, [self._step], device=self.device)
        for _ in range(STEPS * SUBSTEPS):
            self.substep()

    def substep(self) -> None:
        """Launch a step of both solvers."""
        self.state.clear_forces()
        self.solver.step(self.state, self._next, self.control, None, DT / SUBSTEPS)
        self.state, self._next = self._next, self.state


def add_beam(world: newton.ModelBuilder) -> int:
    """Add the beam; return the number of its particles."""
    lines = [np.linspace(-0.5 * size, 0.5 * size, cells + 1) for size, cells in zip(SIZE, CELLS, strict=True)]
    vertices, tetrahedra = kuhn_mesh(lines)
    E, nu = BEAM_MATERIAL.youngs_modulus, BEAM_MATERIAL.poissons_ratio
    identity: Any = wp.quat_identity()
    world.add_soft_mesh(
        pos=wp.vec3(*PLACE, RADIUS + 0.5 * SIZE[2]),
        rot=identity,
        scale=1.0,
        vel=wp.vec3(0.0, 0.0, 0.0),
        vertices=[wp.vec3(*vertex) for vertex in vertices],
        indices=tetrahedra.ravel().tolist(),
        density=BEAM_MATERIAL.density,
        k_mu=E / (2.0 * (1.0 + nu)),
        k_lambda=E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu)),
        k_damp=0.0,
        particle_radius=RADIUS,
    )
    return len(vertices)


def everywhere(part: list[int], size: int, worlds: int) -> list[int]:
    """Return indices of one world in all of them."""
    return (np.arange(worlds)[:, None] * size + np.array(part)).ravel().tolist()


def report(worlds: int, device: wp.Device, options: argparse.Namespace) -> None:
    """Make the worlds, hold the beams, time control steps."""
    clock = time.perf_counter()
    peer = Peer(worlds, device)
    play = replayed(peer.control_step, device)
    made = time.perf_counter() - clock
    play(options.warmup)
    contacts, pressed = [], []

    def look() -> None:
        contacts.append(int(peer.contacts.soft_contact_count.numpy()[0]) / worlds)
        pressed.append(peer.pressed())

    spent, steps = in_spells(play, options.steps, device, look)
    place = peer.state.particle_q.numpy().reshape(worlds, peer.particles, 3)
    finite = np.isfinite(place).all(axis=(1, 2))
    full = " (FULL)" if max(contacts) > SOFT_MAX else ""
    memory = f", {wp.get_mempool_used_mem_current(device) / 1e6:,.0f} MB" if device.is_cuda else ""
    print(
        f"VBD, {worlds} worlds, {peer.particles} particles: {worlds * steps / spent:,.0f} env-steps/s, "
        f"{1e3 * spent / steps:.2f} ms per control step; {np.mean(contacts):.0f} contacts{full}; "
        f"fingers are held open in {100 * np.mean(pressed):.0f} %, finite in {finite.sum()} of {worlds}, "
        f"centre {np.round(place[finite].mean(axis=(0, 1)), 3)}{memory}, made in {made:.1f} s",
        flush=True,
    )


if __name__ == "__main__":
    main()
