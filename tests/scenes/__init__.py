"""Small scenes that several test files share, and the runner that steps them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.contact.dents import contact_dents
from softmode.deformables.coupling.solver_coupled import SolverCoupledReduced
from softmode.deformables.model.authoring import register_custom_attributes
from softmode.deformables.solver.solver_reduced import SolverReduced, SolverReducedOptions

GRAVITY = 9.81
"""Standard gravity of every scene that has any [m/s^2]."""
RIGID_GAP = 1.0e-4
"""Distance at which bodies that are about to touch are placed [m]."""


class Scene:
    """A model of equal worlds, its solver and a pair of states.

    Args:
        populate: Fills the builder of one world; bodies it adds must be listed in ``bodies``.
        bodies: The reduced bodies.
        world_count: Number of copies.
        gravity: Gravity [m/s^2]; default none.
        ground: Friction of a ground plane z = 0, or None for no ground.
        coupled: Two-way with MuJoCo; MuJoCo alone where there are no reduced bodies.
        options: Solver options.
        dt: Step [s].
        finish: Called with the model before the solver is built, to change what the builder cannot.
        mujoco: Arguments of SolverMuJoCo besides the model, or in place of these defaults.
        device: Where it lies.
    """

    def __init__(
        self,
        populate: Callable[[newton.ModelBuilder], Any],
        bodies: Sequence[ReducedBody],
        *,
        world_count: int = 1,
        gravity: Sequence[float] = (0.0, 0.0, 0.0),
        ground: float | None = None,
        coupled: bool = False,
        options: SolverReducedOptions | None = None,
        dt: float = 0.004,
        finish: Callable[[newton.Model], Any] | None = None,
        mujoco: dict[str, Any] | None = None,
        device: str = "cpu",
    ) -> None:
        """Build model, solver and states."""
        world = newton.ModelBuilder()
        builder = newton.ModelBuilder()
        for target in (world, builder):
            register_custom_attributes(target)
            if coupled:
                SolverMuJoCo.register_custom_attributes(target)
        populate(world)
        builder.replicate(world, world_count)
        if ground is not None:
            builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=ground))
        self.bodies = list(bodies)
        self.dt = dt
        self.model: Any = builder.finalize(device=device)
        self.model.set_gravity(tuple(gravity))
        if finish is not None:
            finish(self.model)
        self.solver: Any
        if coupled:
            rigid = SolverMuJoCo(self.model, **{"njmax": 64, "nconmax": 32} | (mujoco or {}))
            self.solver = rigid
            if bodies:
                self.solver = SolverCoupledReduced(self.model, bodies, rigid=rigid, options=options)
                self.reduced: SolverReduced = self.solver.reduced
        else:
            self.solver = self.reduced = SolverReduced(self.model, bodies, options=options)
        self.control: Any = self.model.control()
        self.restart()

    def restart(self) -> None:
        """Return to the initial state."""
        self.state: Any = self.model.state()
        self.next_state: Any = self.model.state()
        if self.model.joint_count:
            for state in (self.state, self.next_state):
                newton.eval_fk(self.model, self.model.joint_q, self.model.joint_qd, state)

    def step(self, count: int = 1) -> None:
        """Take steps, launching kernel by kernel; forces set in the state act in the first step only."""
        for _ in range(count):
            self.solver.step(self.state, self.next_state, self.control, None, self.dt)
            self.state, self.next_state = self.next_state, self.state
            self.next_state.clear_forces()

    def capture(self) -> Callable[[], None]:
        """Record two steps, there and back between the two states, and return what replays them."""
        with wp.ScopedCapture(device=self.model.device) as capture:
            self.solver.step(self.state, self.next_state, self.control, None, self.dt)
            self.solver.step(self.next_state, self.state, self.control, None, self.dt)
        self.solver.reset(self.state)
        return lambda: wp.capture_launch(capture.graph)

    # -- what the tests measure ---------------------------------------------------------------------------------------

    def _slice(self, instance: int) -> slice:
        start = int(self.reduced.parameters.function_start.numpy()[instance])
        return slice(start, start + int(self.reduced.view.instances.function_count.numpy()[instance]))

    def body(self, instance: int = 0) -> ReducedBody:
        """Return the asset of an instance."""
        return self.bodies[self.reduced.view.layout.asset[instance]]

    def q(self, instance: int = 0) -> np.ndarray:
        """Return coordinates (n, 3) [m]."""
        return self.state.softmode.q.numpy()[self._slice(instance)].copy()

    def qd(self, instance: int = 0) -> np.ndarray:
        """Return velocities (n, 3) [m/s]."""
        return self.state.softmode.qd.numpy()[self._slice(instance)].copy()

    def set(self, q: np.ndarray | None = None, qd: np.ndarray | None = None, instance: int = 0) -> None:
        """Set coordinates and velocities of one instance."""
        for name, value in (("q", q), ("qd", qd)):
            if value is not None:
                array = getattr(self.state.softmode, name)
                host = array.numpy()
                host[self._slice(instance)] = value
                array.assign(host)
        self.reduced.update_particles(self.state)

    def set_parameter(self, name: str, value: float | Sequence[float]) -> None:
        """Change a material parameter of all instances at run time."""
        array = getattr(self.model.softmode, name)
        array.assign(np.broadcast_to(np.asarray(value, np.float32), array.shape).copy())
        self.solver.notify_model_changed(0)

    def mass(self, instance: int = 0) -> float:
        """Return the mass of an instance [kg]."""
        return float(self.reduced.view.instances.mass.numpy()[instance])

    def centre(self, instance: int = 0) -> np.ndarray:
        """Return the centre of mass [m]."""
        return self.body(instance).mean_basis @ self.q(instance)

    def momentum(self, instance: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Return linear [kg m/s] and angular momentum about the world's origin [kg m^2/s] of a soft body.

        x = sum_k b_k y_k with y = q + c, c the coordinates of the identity map; the basis is mass-orthonormal, so
        L = int rho x cross v = m sum_k y_k cross qd_k.
        """
        body, qd = self.body(instance), self.qd(instance)
        y = self.q(instance) + body.linear_coordinates[:, :3]
        return self.mass(instance) * body.mean_basis @ qd, self.mass(instance) * np.cross(y, qd).sum(axis=0)

    def kinetic_energy(self, instance: int = 0) -> float:
        """Return m/2 |qd|^2 [J]."""
        return 0.5 * self.mass(instance) * float((self.qd(instance) ** 2).sum())

    def dents(self, instance: int = 0) -> tuple[np.ndarray, float]:
        """Return the dents at the contacts of the last step [m], shape (count,), and their energy [J]."""
        c, pins = self.reduced.view.constraints, int(self.reduced.view.instances.pin_count.numpy()[instance])
        mine = slice(pins, int(c.count.numpy()[instance]))
        dent, give = contact_dents(c)[instance, mine], c.dent_compliance.numpy()[instance, mine]
        return dent, float(0.5 * (dent**2 / np.where(give > 0.0, give, 1.0)).sum())

    def rigid_momentum(self, body: int = 0) -> tuple[np.ndarray, np.ndarray, float]:
        """Return linear and angular momentum about the world's origin and the kinetic energy of a rigid body."""
        mass = float(self.model.body_mass.numpy()[body])
        inertia = self.model.body_inertia.numpy()[body].astype(float)
        pose, twist = self.state.body_q.numpy()[body].astype(float), self.state.body_qd.numpy()[body].astype(float)
        R = rotation_of(pose[3:])
        x = pose[:3] + R @ self.model.body_com.numpy()[body]
        v, omega = twist[:3], twist[3:]
        spin = R @ inertia @ R.T @ omega
        return mass * v, mass * np.cross(x, v) + spin, 0.5 * mass * v @ v + 0.5 * omega @ spin


def rotation_of(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of a unit quaternion xyzw."""
    x, y, z, w = np.asarray(quaternion, float)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotation(axis: Sequence[float], angle: float) -> np.ndarray:
    """Return the rotation matrix about an axis by an angle [rad] (Rodrigues)."""
    a = np.asarray(axis, float) / np.linalg.norm(axis)
    K = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Return a random rotation matrix."""
    Q, R = np.linalg.qr(rng.normal(size=(3, 3)))
    Q = Q * np.sign(np.diag(R))
    return Q * np.sign(np.linalg.det(Q))


def add_free_box(
    builder: newton.ModelBuilder,
    half: Sequence[float],
    mass: float,
    position: Sequence[float],
    *,
    velocity: Sequence[float] = (0.0, 0.0, 0.0),
    friction: float = 0.5,
) -> int:
    """Add a free rigid box; return its body."""
    h = np.asarray(half, float)
    inertia = mass / 3.0 * np.diag((h**2).sum() - h**2)
    body = builder.add_body(
        xform=wp.transform(wp.vec3(*position), wp.quat_identity()),
        mass=mass,
        inertia=wp.mat33(inertia),
        lock_inertia=True,
    )
    config = newton.ModelBuilder.ShapeConfig(density=0.0, mu=friction)
    builder.add_shape_box(body, hx=h[0], hy=h[1], hz=h[2], cfg=config)
    builder.joint_qd[-6:-3] = list(velocity)
    return body


GRIPPER = {"stiffness": 1000.0, "damping": 20.0, "finger_mass": 0.1, "squeeze": 0.03, "lift": 0.1}
"""Drive of each finger [N/m, N s/m], its mass [kg], how far past contact it is driven and the palm lifted [m]."""


def add_gripper(builder: newton.ModelBuilder, half_width: float, friction: float = 0.8) -> tuple[int, int, int]:
    """Add a palm on a vertical slide with two fingers that close along Y; return the bodies palm, left, right."""
    config = newton.ModelBuilder.ShapeConfig(density=0.0, mu=friction)

    def link(position: Sequence[float], mass: float) -> int:
        inertia = wp.mat33(np.eye(3) * mass * 0.03**2)
        return builder.add_link(xform=wp.transform(wp.vec3(*position), wp.quat_identity()), mass=mass, inertia=inertia)

    def slide(parent: int, child: int, axis: Sequence[float], anchor: Sequence[float], ke: float, kd: float) -> int:
        return builder.add_joint_prismatic(
            parent=parent,
            child=child,
            axis=axis,
            parent_xform=wp.transform(wp.vec3(*anchor), wp.quat_identity()),
            target_ke=ke,
            target_kd=kd,
            limit_lower=-1.0,
            limit_upper=1.0,
        )

    offset = half_width + 0.015
    palm = link((0.0, 0.0, 0.15), 1.0)
    fingers = [link((0.0, side * offset, 0.04), GRIPPER["finger_mass"]) for side in (1.0, -1.0)]
    for finger in fingers:
        builder.add_shape_box(finger, hx=0.02, hy=0.015, hz=0.02, cfg=config)
    joints = [slide(-1, palm, (0, 0, 1), (0, 0, 0.15), 5.0e4, 500.0)]
    for finger, side in zip(fingers, (1.0, -1.0), strict=True):
        anchor = (0.0, side * offset, -0.11)
        joints.append(slide(palm, finger, (0, -side, 0), anchor, GRIPPER["stiffness"], GRIPPER["damping"]))
    builder.add_articulation(joints)
    return palm, fingers[0], fingers[1]
