"""The same scenes of rigid bodies and soft cubes under three couplings, with what the benchmark measures of them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo, SolverVBD
from newton.solvers.experimental.coupled import SolverCoupledProxy  # pyright: ignore[reportMissingImports]

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.coupling.solver_coupled import SolverCoupledReduced
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body, register_custom_attributes
from tests import reference
from tests.bodies import cube
from tests.scenes import rotation

SchemeName = Literal["joint", "VBD x1", "VBD x3"]
SCHEMES: tuple[SchemeName, ...] = ("joint", "VBD x1", "VBD x3")
"""The joint solve; Newton's SolverCoupledProxy with one and three lagged passes around its SolverVBD on tetrahedra."""

VBD_CELLS = 4
"""Cells of the tetrahedral cube along an edge, five tetrahedra each."""
VBD_SWEEPS = 30
"""Sweeps of block descent in a step, as in Newton's own gripper example."""
VBD_CONTACT = 2.0e4
"""Contact stiffness of a vertex [N/m]: a face of 25 vertices, 0.1 m wide, is as stiff as softmode's 5e7 Pa/m."""
VBD_RADIUS = 1.0e-3
"""Radius of the vertices [m]."""


@dataclass(frozen=True, kw_only=True)
class Cube:
    """A soft cube and where it starts."""

    edge: float
    material: Material
    position: tuple[float, float, float]
    yaw: float = 0.0


@dataclass(frozen=True, kw_only=True)
class World:
    """One world: a soft cube, what adds the rigid bodies, and which of these may touch the cube."""

    soft: Cube
    add_rigid: Callable[[newton.ModelBuilder], Any]
    touching: tuple[int, ...]


class Coupled:
    """Worlds under one scheme, captured as a graph of two steps.

    Args:
        scheme: The coupling.
        worlds: The worlds, with equal numbers of bodies; the cubes of equal size.
        dt: Step [s].
        gravity: Acceleration along -z [m/s^2].
        ground: Friction of a ground plane z = 0, or None for no ground.
    """

    def __init__(
        self,
        scheme: SchemeName,
        worlds: Sequence[World],
        *,
        dt: float,
        gravity: float = 0.0,
        ground: float | None = None,
    ) -> None:
        """Build model, solver and graph."""
        self.worlds, self.dt, self.ground = worlds, dt, ground
        self.vbd = scheme.startswith("VBD")
        self.body: ReducedBody = cube(worlds[0].soft.edge)
        self.model: Any = self._build(gravity)
        bodies_per_world = self.model.body_count // len(worlds)
        self.touching = [bodies_per_world * w + b for w, world in enumerate(worlds) for b in world.touching]
        self.solver: Any
        if scheme == "joint":
            rigid = SolverMuJoCo(self.model, njmax=64, nconmax=32)
            self.solver = SolverCoupledReduced(self.model, [self.body], rigid=rigid)
        else:
            self.solver = self._couple(int(scheme[-1]))
        self.control: Any = self.model.control()
        self.state: Any = self.model.state()
        self.other: Any = self.model.state()
        for state in (self.state, self.other):
            newton.eval_fk(self.model, self.model.joint_q, self.model.joint_qd, state)
        with wp.ScopedCapture(device="cpu") as capture:
            self.solver.step(self.state, self.other, self.control, None, dt)
            self.solver.step(self.other, self.state, self.control, None, dt)
        self.graph: Any = capture.graph

    def replay(self) -> None:
        """Take two steps."""
        wp.capture_launch(self.graph)

    # -- construction -------------------------------------------------------------------------------------------------

    def _build(self, gravity: float) -> Any:
        builder = newton.ModelBuilder()
        register = [SolverMuJoCo.register_custom_attributes]
        register.append(SolverVBD.register_custom_attributes if self.vbd else register_custom_attributes)
        for each in register:
            each(builder)
        for world in self.worlds:
            one = newton.ModelBuilder()
            for each in register:
                each(one)
            world.add_rigid(one)
            if self.vbd:
                _add_tetrahedra(one, world.soft)
                one.color()
            else:
                R = rotation((0, 0, 1), world.soft.yaw)
                soft = world.soft
                add_reduced_body(one, self.body, material=soft.material, position=soft.position, rotation=R)
            builder.add_world(one)
        if self.ground is not None:
            builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=self.ground))
        model: Any = builder.finalize(device="cpu")
        model.set_gravity((0.0, 0.0, -gravity))
        if self.vbd:
            # it takes the root of the product of the model's coefficient and the shape's, softmode of the body's and
            # the shape's, which are equal here
            model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = VBD_CONTACT, 0.0, 1.0
            model.shape_material_ke.fill_(VBD_CONTACT)
            model.shape_material_kd.fill_(0.0)
            model.shape_material_mu.assign(model.shape_material_mu.numpy() ** 2)
        return model

    def _couple(self, iterations: int) -> SolverCoupledProxy:
        model, Entry = self.model, SolverCoupledProxy.Entry
        bodies, particles = list(range(model.body_count)), list(range(model.particle_count))
        joints = list(range(model.joint_count))
        rigid = Entry(
            "rigid",
            lambda view: SolverMuJoCo(view, njmax=64, nconmax=32),
            bodies=bodies,
            joints=joints,
        )
        proxy = functools.partial(
            SolverCoupledProxy.Proxy, source="rigid", destination="soft", bodies=self.touching, mode="lagged"
        )
        soft = Entry("soft", _ReportingVBD, particles=particles)
        pipe = functools.partial(
            newton.CollisionPipeline,
            broad_phase="explicit",
            soft_contact_max=128 * len(self.worlds),
            soft_contact_gap=0.01,
            verify_buffers=False,
        )
        proxies = [proxy(collision_pipeline=pipe, collide_interval=1)]
        return SolverCoupledProxy(model, [rigid, soft], SolverCoupledProxy.Config(proxies, iterations=iterations))

    # -- what is measured ---------------------------------------------------------------------------------------------

    def contact_force(self) -> np.ndarray:
        """Return the soft contact force on every touching body [N], shape (world_count, touching, 3)."""
        if self.vbd:
            wrench = self.solver.solver("soft").harvested.numpy()[self.touching]
        else:
            wrench = self.solver.body_wrench.numpy()[self.touching]
        return wrench[:, :3].reshape(len(self.worlds), -1, 3)

    def status(self) -> np.ndarray:
        """Return softmode's status bits per world, zero for others."""
        if self.vbd:
            return np.zeros(len(self.worlds), int)
        return self.solver.reduced.status.numpy()

    def points(self) -> np.ndarray:
        """Return the particles, shape (world_count, particle_count, 3) [m]."""
        return self.state.particle_q.numpy().reshape(len(self.worlds), -1, 3).astype(float)

    def totals(self) -> tuple[np.ndarray, float]:
        """Return momentum [kg m/s] and energy [J] of the first world, soft and rigid together, without gravity."""
        twist = self.state.body_qd.numpy()[0].astype(float)
        mass = float(self.model.body_mass.numpy()[0])
        p, kinetic = mass * twist[:3], 0.5 * mass * twist[:3] @ twist[:3]
        if self.vbd:
            m, v = self.model.particle_mass.numpy().astype(float), self.state.particle_qd.numpy().astype(float)
            return p + m @ v, kinetic + 0.5 * m @ (v * v).sum(axis=1) + self._tetrahedral_energy()
        data = self.state.softmode
        material = reference.with_float32(self.worlds[0].soft.material)
        twin = reference.FreeBody(body=self.body, material=material, dt=self.dt)
        mass, qd = material.density * self.body.volume, data.qd.numpy()
        kinetic += 0.5 * mass * (qd**2).sum() + twin.elastic_energy(data.q.numpy())
        return p + mass * self.body.mean_basis @ qd, kinetic

    def _tetrahedral_energy(self) -> float:
        """Return VBD's stable Neo-Hookean energy of the tetrahedra, none at rest [J]."""
        model, x = self.model, self.state.particle_q.numpy().astype(float)
        index, inverse = model.tet_indices.numpy().reshape(-1, 4), model.tet_poses.numpy().astype(float)
        mu, lam = model.tet_materials.numpy()[:, :2].astype(float).T
        edges = (x[index[:, 1:]] - x[index[:, :1]]).transpose(0, 2, 1)
        F = edges @ inverse
        volume = 1.0 / (6.0 * np.linalg.det(inverse))
        alpha = 1.0 + mu / lam
        J = np.linalg.det(F)
        density = 0.5 * mu * ((F**2).sum(axis=(1, 2)) - 3.0) + 0.5 * lam * ((J - alpha) ** 2 - (1.0 - alpha) ** 2)
        return float(volume @ density)

    def penetration(self) -> np.ndarray:
        """Return how deep the deepest particle of every world is inside a box or the ground [m].

        Measured from where contact begins: the vertices of VBD have a radius.
        """
        x = self.points()
        margin = VBD_RADIUS if self.vbd else 0.0
        depth = margin - x[:, :, 2].min(axis=1) if self.ground is not None else np.full(len(x), -np.inf)
        pose = self.state.body_q.numpy().astype(float)
        shape_body, scale = self.model.shape_body.numpy(), self.model.shape_scale.numpy().astype(float)
        per_world = len(self.touching) // len(self.worlds)
        for k, body in enumerate(self.touching):
            world = k // per_world
            half = scale[int(np.flatnonzero(shape_body == body)[0])]
            a, b, c, w = pose[body, 3:]
            # rows of the rotation matrix of the quaternion
            R = np.array(
                [
                    [1 - 2 * (b * b + c * c), 2 * (a * b - c * w), 2 * (a * c + b * w)],
                    [2 * (a * b + c * w), 1 - 2 * (a * a + c * c), 2 * (b * c - a * w)],
                    [2 * (a * c - b * w), 2 * (b * c + a * w), 1 - 2 * (a * a + b * b)],
                ]
            )
            local = (x[world] - pose[body, :3]) @ R
            depth[world] = max(depth[world], (half - np.abs(local)).min(axis=1).max() + margin)
        return np.maximum(depth, 0.0)


class _ReportingVBD(SolverVBD):
    """SolverVBD that keeps what the coupler harvested of it."""

    def __init__(self, view: Any) -> None:
        vector: Any = wp.spatial_vector
        super().__init__(
            view,
            iterations=VBD_SWEEPS,
            particle_enable_self_contact=False,
            particle_enable_tile_solve=False,
            rigid_body_particle_contact_buffer_size=256,
        )
        self.harvested = wp.zeros(view.parent.body_count, dtype=vector, device=view.device)

    def coupling_harvest_proxy_wrenches(self, body_local_to_proxy_global: Any, out_body_f: Any, **options: Any) -> None:
        """Harvest and copy."""
        super().coupling_harvest_proxy_wrenches(body_local_to_proxy_global, out_body_f, **options)
        wp.copy(self.harvested, out_body_f)


def _add_tetrahedra(builder: newton.ModelBuilder, soft: Cube) -> None:
    """Add the cube as a grid of linear tetrahedra of the same mass, and of the same size with its vertices' radius."""
    first, n = builder.particle_count, VBD_CELLS
    E, nu, half = soft.material.youngs_modulus, soft.material.poissons_ratio, 0.5 * soft.edge - VBD_RADIUS
    axis: Any = wp.vec3(0.0, 0.0, 1.0)
    turn: Any = wp.quat_from_axis_angle(axis, soft.yaw)
    corner = np.array(soft.position) - rotation((0, 0, 1), soft.yaw) @ np.full(3, half)
    builder.add_soft_grid(
        pos=wp.vec3(*corner),
        rot=turn,
        vel=wp.vec3(0.0, 0.0, 0.0),
        dim_x=n,
        dim_y=n,
        dim_z=n,
        cell_x=2.0 * half / n,
        cell_y=2.0 * half / n,
        cell_z=2.0 * half / n,
        density=1.0,
        k_mu=E / (2.0 * (1.0 + nu)),
        k_lambda=E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu)),
        k_damp=0.0,
        particle_radius=VBD_RADIUS,
    )
    # every vertex weighs as much as a whole cell
    scale = soft.material.density * soft.edge**3 / sum(builder.particle_mass[first:])
    for i in range(first, builder.particle_count):
        builder.particle_mass[i] *= scale
