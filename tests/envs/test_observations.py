"""Every number of every observation is recomputed on the host, from Newton's state and what was drawn at reset."""

from __future__ import annotations

from collections.abc import Callable

import newton
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softmode.deformables.contact.pairs import thickness
from softmode.envs.scripted import scripted_policy
from softmode.envs.soft_env import SoftEnv
from softmode.robots import ArmDescription
from tests.envs.conftest import MakeEnv

Vector = NDArray[np.float64]
Numbers = dict[str, Vector]

TOLERANCE = {"rtol": 1.0e-5, "atol": 5.0e-6}
"""Ten transforms in a row, of lengths of order one in float32: about 40 eps."""
MATERIAL = ("youngs_modulus", "poissons_ratio", "scale")
"""What a dent depends on."""
VISIBLE = 1.0e-4
"""Size from which a wrong sign of a number shows."""


class HostState:
    """What there is to see in world 0, in float64, without a kernel of the environments.

    Args:
        env: The environment.
    """

    def __init__(self, env: SoftEnv) -> None:
        """Read the state."""
        scene = env.task.scene
        arm = scene.arm.description
        assert isinstance(arm, ArmDescription)
        self.env, self.scene, self.arm = env, scene, arm
        model, state = scene.model, scene.state
        fresh = model.state()
        newton.eval_fk(model, state.joint_q, state.joint_qd, fresh)
        pose = fresh.body_q.numpy()[scene.arm.hand_body].astype(float)
        turn = Rotation.from_quat(pose[3:])
        self.tool = pose[:3] + turn.apply([0.0, 0.0, self.arm.tool_length])
        x_axis = turn.apply([1.0, 0.0, 0.0])
        self.yaw = np.arctan2(-x_axis[1], -x_axis[0])
        self.joint_q = state.joint_q.numpy().astype(float)
        self.joint_target = scene.control.joint_target_q.numpy().astype(float)
        self.finger_force = scene.solver.body_wrench.numpy()[list(scene.arm.finger_bodies), :3].astype(float)
        starts, q, qd = model.softmode.function_start.numpy(), state.softmode.q.numpy(), state.softmode.qd.numpy()
        spans = [slice(a, a + thing.body.function_count) for a, thing in zip(starts, scene.objects, strict=True)]
        bodies = [thing.body for thing in scene.objects]
        self.q = q[spans[0]]
        self.centres = np.array([body.mean_basis @ q[span] for body, span in zip(bodies, spans, strict=True)])
        self.velocity = bodies[0].mean_basis @ qd[spans[0]]
        self.rest = bodies[0].surface.points[env.task.points]
        # the contacts of a step that an earlier test took are still in the tables after a reset
        stepped = env.task.episodes.elapsed.numpy()[0] > 0
        dents = self.dents()[env.task.points] if stepped else np.zeros((len(env.task.points), 3))
        self.dented = float(np.abs(dents).max())
        self.points = self.deformed(self.rest) + dents
        self.drawn = {
            name: env.task.table.values.numpy()[0, env.task.table.columns(name)].astype(float)
            for name in env.task.table.parameters
        }

    def deformed(self, rest: Vector) -> Vector:
        """Return where rest points of object 0 are [m], x = X + sum_k b_k(X) q_k, shape (N, 3)."""
        return rest + self.scene.soft.body.evaluate(rest)[0] @ self.q

    def dents(self) -> Vector:
        """Return how far the skin at the surface samples of object 0 lies outside of `deformed` [m], shape (N, 3).

        By the law: a contact sinks in by p, of which a bed of springs of at most w = 0.35 min((V / n)^(1/3), 0.6 t)
        (1 - nu^2) / E under the part of the cell that is pressed takes its part in series with the penalty, along the
        normal; less where more of the neighbourhood touches, as the solver says, and from where the sample itself
        touches on. Soft bodies that touch object 0 are
        refused.
        """
        body, view, data = self.scene.soft.body, self.scene.solver.view, self.scene.model.softmode
        young, ratio, scale = (float(getattr(data, name).numpy()[0]) for name in MATERIAL)
        size = (body.volume / (body.function_count - body.driven_count)) ** (1.0 / 3.0)
        free = np.abs(body.surface.basis[:, body.driven_count :]).max(axis=1) > 1.0e-6  # the clamped foot has none
        w = 0.35 * scale * np.minimum(size, 0.6 * thickness(body)) * (1.0 - ratio**2) / young * free
        c = view.constraints
        assert not c.pair_count.numpy()[0]
        held = slice(int(view.instances.pin_count.numpy()[0]), int(c.count.numpy()[0]))
        sample = c.partner_row.numpy()[0, held] - int(view.instances.row_start.numpy()[0])
        normal, moved = c.normal.numpy()[0, held], c.offset.numpy()[0, held] + c.displacement.numpy()[0, held]
        give = c.dent_compliance.numpy()[0, held]
        pressed = scale**2 * body.surface.areas[sample] * view.samples.part.numpy()[0, sample].min(axis=1)
        assert (give * pressed <= (1.0 + 1.0e-5) * w[sample]).all()
        softer = c.stiffness.numpy()[0, held] * give
        penetration = -np.einsum("ek,ek->e", normal, moved)
        depth = softer / (1.0 + softer) * np.maximum(penetration - c.lead.numpy()[0, held], 0.0)
        out = np.zeros((body.surface_count, 3))
        for s, n, v in zip(sample, normal, depth, strict=True):
            out[s] += max(v - n @ out[s], 0.0) * n
        return out


def common(seen: HostState) -> Numbers:
    """Return the segments that all tasks have."""
    controller = seen.scene.controller
    centre = seen.centres[0]
    return {
        "tool_position": seen.tool,
        "tool_heading": np.array([np.cos(seen.yaw), np.sin(seen.yaw)]),
        "opening": seen.joint_q[7:9].sum(keepdims=True),
        "finger_force": np.linalg.norm(seen.finger_force, axis=1),
        "joint_angles": seen.joint_q[:7],
        "command_lead": controller.target_position.numpy()[0] - seen.tool,
        "command_turn": np.sin(controller.target_yaw.numpy()[:1] - seen.yaw),
        "command_opening": seen.joint_target[7:9].sum(keepdims=True),
        "object_position": centre,
        "object_velocity": seen.velocity,
        "object_offset": centre - seen.tool,
        "object_points": (seen.points - centre).ravel(),
    }


def lift_soft(seen: HostState) -> Numbers:
    """The goal: a place, and a rise over the height at rest."""
    return {"goal": seen.drawn["goal"] + [0.0, 0.0, seen.scene.soft.height * seen.drawn["scale"][0]]}


def push_soft(seen: HostState) -> Numbers:
    """The goal on the table, and the rotation from its heading to the object's, of complex numbers."""
    distance, direction = seen.drawn["goal"]
    goal = seen.drawn["position"] + distance * np.array([np.cos(direction), np.sin(direction)])
    yaw = (seen.drawn["yaw"] + seen.drawn["goal_yaw"])[0]
    centre = seen.centres[0]
    wanted = (seen.rest[:, 0] + 1j * seen.rest[:, 1]) * np.exp(1j * yaw)
    found = seen.points - centre
    heading = np.sum(np.conj(wanted) * (found[:, 0] + 1j * found[:, 1]))
    heading /= np.abs(heading)
    way = goal - centre[:2]
    surface = seen.scene.soft.body.surface.points
    back = seen.drawn["scale"][0] * (np.hypot(*surface[:, :2].T).max() + 0.5 * seen.arm.gripper.pad_size[0])
    behind = centre[:2] - back * way / np.linalg.norm(way)
    height = seen.env.config.scene.control.workspace_lower[2] + 0.006
    return {
        "goal": goal,
        "goal_heading": np.array([np.cos(yaw), np.sin(yaw)]),
        "goal_offset": goal - seen.tool[:2],
        "object_goal": way,
        "object_heading": np.array([heading.real, heading.imag]),
        "push_offset": np.array([*behind, height]) - seen.tool,
    }


def press_soft(seen: HostState) -> Numbers:
    """The vertical force on both fingers together."""
    goal, force = seen.drawn["goal_force"], seen.finger_force[:, 2].sum(keepdims=True)
    return {"goal_force": goal, "contact_force": force, "missing_force": goal - force}


def place_in_bin(seen: HostState) -> Numbers:
    """The middle of the bin's opening, and the other objects."""
    given = seen.env.task.config.bin  # type: ignore[attr-defined]
    rim = np.array([*given.position, given.height])
    return {
        "goal": rim,
        "goal_offset": rim - seen.tool,
        "object_goal": rim - seen.centres[0],
        "other_offsets": (seen.centres[1:] - seen.centres[0]).ravel(),
    }


def rope_route(seen: HostState) -> Numbers:
    """The winding is what the direction from a peg to the axis sweeps, without jumps of a turn."""
    pegs = np.array([peg.position[:2] for peg in seen.env.task.config.pegs])  # type: ignore[attr-defined]
    side = np.where(np.arange(len(pegs)) % 2 == 0, 1.0, -1.0) * (-1.0 if seen.drawn["route"][0] < 0.0 else 1.0)
    aside, beyond = seen.drawn["goal"]
    goal = pegs[-1] + [side[-1] * aside, beyond]
    half = 0.5 * np.ptp(np.array(seen.scene.soft.body.bounds)[:, 0])
    along = np.linspace(-half, half, 25)
    axis = seen.deformed(np.column_stack([along, np.zeros((25, 2))]))
    grasp, end = axis[np.abs(along - (half - 0.03)).argmin()], axis[-1]
    sight = axis[:, None, :2] - pegs
    angle = np.unwrap(np.arctan2(sight[..., 1], sight[..., 0]), axis=0)
    return {
        "goal": goal,
        "goal_offset": goal - seen.tool[:2],
        "side": side,
        "grasp_offset": grasp - seen.tool,
        "end_offset": end - grasp,
        "end_goal": goal - end[:2],
        "winding": side * (angle[-1] - angle[0]),
    }


def shape_soft(seen: HostState) -> Numbers:
    """The target: between the nearest recorded directions and displacements, turned into the wanted direction."""
    displacement, direction = seen.drawn["goal"]
    targets = seen.env.task.targets  # type: ignore[attr-defined]
    table = targets.points.numpy()[0, :, :, : len(seen.rest)].astype(float)
    directions, levels = table.shape[:2]
    alpha = direction - 0.5 * np.pi
    at = ((seen.drawn["yaw"][0] - alpha) / (2.0 * np.pi)) % 1.0 * directions
    depth = displacement / targets.displacement_max.numpy()[0] * (levels - 1)
    j, k = int(at), min(int(depth), levels - 2)
    between = [(1.0 - depth + k) * table[m, k] + (depth - k) * table[m, k + 1] for m in (j, (j + 1) % directions)]
    shape = (1.0 - at + j) * between[0] + (at - j) * between[1]
    foot = np.array([*seen.drawn["position"], 0.0])
    arm = common(seen)
    names = ("tool_position", "tool_heading", "opening", "finger_force", "joint_angles", "command_lead")
    return {
        "desired_goal": Rotation.from_rotvec([0.0, 0.0, alpha]).apply(shape).ravel(),
        "achieved_goal": (seen.points - foot).ravel(),
        "arm": np.concatenate([arm[name] for name in (*names, "command_turn", "command_opening")]),
    }


TASKS: dict[str, Callable[[HostState], Numbers]] = {
    "LiftSoft": lift_soft,
    "PushSoft": push_soft,
    "PressSoft": press_soft,
    "PlaceInBin": place_in_bin,
    "RopeRoute": rope_route,
    "ShapeSoft": shape_soft,
}
"""What each task adds."""
EPISODES = {
    "PushSoft": ({"goal_yaw": 0.7, "yaw": -2.5},),
    "ShapeSoft": ({"goal": (0.05, 1.0)}, {"goal": (0.05, 1.0 - np.pi)}),
}
"""Options of the episodes: PushSoft draws no yaw of a goal by itself, and its finger is to dent points that are seen;
in ShapeSoft a finger touches the post, the other one on its way back."""
STILL = {"PressSoft": {"opening", "command_opening"}}
"""Segments that stay zero: the fingers of PressSoft are closed."""


@pytest.mark.parametrize("name", TASKS)
def test_every_segment_is_what_the_state_says(make_env: MakeEnv, name: str) -> None:
    """Before, in and after contact, then under random actions, every segment equals its NumPy twin within float32.

    Every number of every segment is far from zero at some time, so that a wrong sign or column of it shows.
    """
    own = TASKS[name]
    env = make_env(name).unwrapped
    assert isinstance(env, SoftEnv)
    segments, largest, touched, dented = env.task.segments, np.zeros(len(env.task.layout.low)), False, 0.0

    def check() -> None:
        nonlocal touched, dented
        seen = HostState(env)
        dented = max(dented, seen.dented)
        touched |= bool(np.linalg.norm(seen.finger_force, axis=1).max() > 0.05)
        expected = common(seen) | own(seen)
        assert expected.keys() == segments.keys()
        found = env.task.observation.numpy()[0]
        for segment, (columns, bounds) in segments.items():
            wanted = np.clip(expected[segment], bounds.low, bounds.high)
            np.testing.assert_allclose(found[columns], wanted, **TOLERANCE, err_msg=segment)
            largest[columns] = np.maximum(largest[columns], np.abs(wanted))

    random = np.random.default_rng(4)
    for options in EPISODES.get(name, ({},)):
        env.reset(seed=2, options=options)
        check()
        policy = scripted_policy(env)
        for step in range(60):
            env.step(policy(None))
            if step % 10 == 9:
                check()
        for _ in range(10):
            env.step(random.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32))
            check()
    assert touched and (dented > 2.0 * TOLERANCE["atol"] or name == "RopeRoute")  # whose samples ride in their cells
    small = {segment for segment, (columns, _) in segments.items() if (largest[columns] < VISIBLE).any()}
    assert small <= STILL.get(name, set()), {segment: largest[segments[segment][0]] for segment in small}
