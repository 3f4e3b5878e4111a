"""What is found in a robot's file where nobody names it: the end effector, and the joints that close the gripper."""

from __future__ import annotations

import copy
import fnmatch
import importlib
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from softmode.deformables.coupling.rigid_solver import mujoco_warnings

if TYPE_CHECKING:
    from softmode.robots.description import JointDrive

Array = NDArray[np.float64]


class Compiled(Protocol):
    """What the search asks of a compiled robot, see `softmode.robots.compiled.CompiledRobot`."""

    model: Any
    joint_names: tuple[str, ...]
    reference: Array
    ties: tuple[list[int], list[float], list[float]]
    passive: list[int]
    lower: Array
    upper: Array

    def link(self, body: int) -> str:
        """Return the name of a link."""
        ...

    def behind(self, link: int) -> list[int]:
        """Return a link and all links behind it."""
        ...

    def home(self, given: Sequence[float] | None) -> Array:
        """Return the home pose."""
        ...


_NAMES = (
    "pinch pinch_site grasp_site grasp gripperframe link_tcp tcp tool tool0 ee_site end_effector ee gripper "
    "attachment_site hand Fixed_Jaw"
).split()
"""Names of sites, then of bodies, that are taken for the tool as they are; the first one present."""
_PATTERNS = (
    "*tcp *tcp_site *_tool0 *tool_frame *pinch* *grasp_site *grasp_frame *grip_site *gripper_frame* *gripperframe* "
    "grasp* *tool_center* *ee_site *end_effector* *endeffector* *_eef *_ee *ee_link *eef_link *ee_frame *attachment* "
    "*_hand *hand_link *palm *palm_link *gripper_base* *gripper_link *gripper *tool_link *tool *flange"
).split()
"""Patterns of the last part of such a name, in small letters, tried after the names."""
_BESIDE = 0.7
"""How far a hand's own jaw must stand out beside the one that moves, as a share of that one's length."""
_POINTS = 400
"""How many corners of a finger the closing test looks at."""
_SPREAD = 0.1
"""Share of the largest such change under which a joint of a hand does not close it."""
_LEAST_WAY = 5.0e-4
"""Least change of the mean distance between the fingers, from end to end of a joint, that counts as closing [m]."""


def find_end_effector(robot: Compiled, drives: Sequence[JointDrive | None]) -> tuple[str, str]:
    """Return the name of a site or link that carries the tool, and how it was found.

    Names, then patterns, each among the sites first; then the link in which two fingers that close on each other meet;
    then the last link of the chain with the most joints. If that is the jaw of a hand that moves: what is before it.
    """
    name, how = _found(robot, drives)
    links = {robot.link(b): b for b in range(1, robot.model.nbody)}
    if name in links and _is_jaw(robot, drives, links[name]):
        return robot.link(robot.model.body_parentid[links[name]]), f"link on whose own jaw {name!r} closes"
    return name, how


def _found(robot: Compiled, drives: Sequence[JointDrive | None]) -> tuple[str, str]:
    """Return the name of a site or link by its name or place, and how it was found."""
    model = robot.model
    sites = [model.site(s).name for s in range(model.nsite)]
    links = [robot.link(b) for b in range(1, model.nbody)]
    for group, what in ((sites, "site"), (links, "link")):
        for name in _NAMES:
            if name in group:
                return name, f"{what} by its usual name"
    for pattern in _PATTERNS:
        for group, what in ((sites, "site"), (links, "link")):
            found = [name for name in group if fnmatch.fnmatchcase(_last_part(name), pattern)]
            if found:
                more = f", the first of {len(found)}" if len(found) > 1 else ""
                return found[0], f"{what} that fits {pattern!r}{more}"
    depth = [0] * model.nbody
    for b in range(1, model.nbody):
        depth[b] = depth[int(model.body_parentid[b])] + int(model.body_jntnum[b])
    last = max(range(1, model.nbody), key=lambda b: depth[b])
    # A finger is no end effector: the link from which it and others stand out is.
    for palm in above(model, last):
        joints = _limited(robot, drives, palm)
        longest = max((depth[b] - depth[palm] for b in robot.behind(palm)), default=0)
        fingers = {branch(model, palm, j) for j in joints}
        if len(fingers) < 2 or longest > (2 if len(fingers) == 2 else 5):
            continue
        if closing_ends(robot, drives, robot.home(None), palm, joints):
            return robot.link(palm), f"link in which {len(fingers)} fingers meet that close on each other"
    return robot.link(last), "last link of the longest chain; it has no usual name"


def _is_jaw(robot: Compiled, drives: Sequence[JointDrive | None], link: int) -> bool:
    """Return whether a link that ends a chain is a jaw: at an end of its range it lies along what is in front of it."""
    model, front = robot.model, int(robot.model.body_parentid[link])
    j = int(model.body_jntadr[link])
    if j < 0 or j not in _limited(robot, drives, front) or _limited(robot, drives, link):
        return False
    rest = [b for b in range(1, model.nbody) if model.body_weldid[b] == model.body_weldid[front]]
    for q in (robot.lower[j], robot.upper[j]):
        joint_q = robot.home(None)
        joint_q[j] = q
        data = settled(model, joint_q + robot.reference, ())
        jaw, fixed = (surface_corners(model, data, side) - data.xanchor[j] for side in (robot.behind(link), rest))
        if not len(jaw) or not len(fixed):
            return False
        out = jaw.mean(0) / np.linalg.norm(jaw.mean(0))
        forward = out @ (data.xanchor[j] - data.xpos[model.body_weldid[front]]) > 0.0  # not folded back
        if forward and abs(out @ data.xaxis[j]) < 0.5 and (fixed @ out).max() > _BESIDE * (jaw @ out).max():
            return True
    return False


def find_gripper(
    robot: Compiled, drives: Sequence[JointDrive | None], start: Array, link: int
) -> tuple[dict[str, tuple[float, float]], int, list[str]]:
    """Return the coordinates (closed, open) of the joints that close, the link that carries them, and notes.

    They stand behind the end effector, or behind a link to which it is fixed.
    """
    model = robot.model
    palm, joints = link, _limited(robot, drives, link)
    while not joints and not model.body_jntnum[palm] and model.body_parentid[palm] > 0:
        palm = int(model.body_parentid[palm])
        joints = _limited(robot, drives, palm)
    if not joints:
        return {}, link, []
    while len(inner := {branch(model, palm, j) for j in joints}) == 1 and not model.body_jntnum[min(inner)]:
        palm = min(inner)  # a mount between them
    ends = closing_ends(robot, drives, start, palm, joints)
    left = [repr(robot.joint_names[j]) for j in joints if j not in ends]
    notes = [f"left out behind the end effector, as they close nothing: {', '.join(left)}"] if left else []
    return {robot.joint_names[j]: pair for j, pair in ends.items()}, palm if ends else link, notes


def closing_ends(
    robot: Compiled, drives: Sequence[JointDrive | None], start: Array, palm: int, joints: Sequence[int]
) -> dict[int, tuple[float, float]]:
    """Return (closed, open) of those joints that move a finger towards the other finger, or towards the palm.

    Joints close if the mean distance of the nearest points of both sides differs between their ends. Those that are
    tied move, and close, together; loops are closed.
    """
    model = robot.model
    owner, ratio, shift = robot.ties
    fingers = {b: side_of(model, palm, b) for b in sorted({branch(model, palm, j) for j in joints})}
    moved = {b for side in fingers.values() for b in side}
    rest = [palm, *(b for b in robot.behind(palm) if b not in moved and _fixed_to(model, b, palm))]
    ends: dict[int, tuple[float, float]] = {}
    way: dict[int, float] = {}

    def posed(j: int, q: float) -> Any:
        """Return where everything is with a joint, and all that moves with it, at a coordinate."""
        group = [i for i in range(model.njnt) if owner[i] == owner[j]]
        joint_q = start.copy()
        joint_q[group] = [shift[i] + ratio[i] * (q - shift[j]) / ratio[j] for i in group]
        return settled(model, joint_q + robot.reference, robot.passive)

    driven = [(j, drive) for j in joints if (drive := drives[j]) is not None]
    sides = [set(side) for side in fingers.values()]
    if len(sides) > 2 and len({owner[j] for j, _ in driven}) == 1:
        j, drive = driven[0]
        sides = opposed(posed(j, drive.lower), posed(j, drive.upper), sides)
    for j, drive in driven:
        first = next(i for i in joints if owner[i] == owner[j])
        own = next(sorted(side) for side in sides if branch(model, palm, j) in side)
        others = [b for side in sides for b in sorted(side) if b not in own]
        # Two fingers close on each other, one on the palm's own jaw, several on the palm.
        towards = others if len(sides) == 2 and others else rest
        gaps = [_mean_gap(model, posed(j, q), (own, towards)) for q in (drive.lower, drive.upper)]
        way[first] = way.get(first, 0.0) + (gaps[1] - gaps[0]) * np.sign(ratio[j])
        ends[j] = (float(drive.lower), float(drive.upper))
    # The fingers of a hand also spread: that changes the distance a little.
    most = max(map(abs, way.values()), default=0.0)
    least = max(_LEAST_WAY, _SPREAD * most if len(sides) > 2 else 0.0)
    found = {}
    for j, (low, high) in ends.items():
        opens = way[next(i for i in joints if owner[i] == owner[j])] * np.sign(ratio[j])
        if abs(opens) >= least:
            found[j] = (low, high) if opens > 0.0 else (high, low)
    return found


@mujoco_warnings()
def settled(model: Any, joint_q: Array, moving: Sequence[int]) -> Any:
    """Return the kinematics of a robot whose loops are closed, by Gauss-Newton steps of its passive joints.

    Args:
        model: The compiled robot; one hinge or slide per link.
        joint_q: Coordinates in MuJoCo's sense, shape (joint_count,).
        moving: The joints that a loop may move.
    """
    mujoco = importlib.import_module("mujoco")
    loops = [int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)]
    closed = any(int(kind) in loops for kind in model.eq_type)
    if closed and len(moving):
        model = copy.copy(model)
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        model.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
    data = mujoco.MjData(model)
    data.qpos[:] = joint_q
    mujoco.mj_kinematics(model, data)
    if not closed or not len(moving):
        return data
    free = list(moving)
    for _ in range(40):
        mujoco.mj_fwdPosition(model, data)
        rows = data.efc_type[: data.nefc] == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        error = data.efc_pos[: data.nefc][rows]
        if not error.size or np.abs(error).max() < 1.0e-8:
            break
        jacobian = data.efc_J[: data.nefc * model.nv].reshape(data.nefc, model.nv)[rows][:, free]
        # Weakly damped: some passive joints may be held by nothing.
        normal = jacobian.T @ jacobian + 1.0e-10 * np.eye(len(free))
        data.qpos[free] += np.clip(-np.linalg.solve(normal, jacobian.T @ error), -0.3, 0.3)
    mujoco.mj_kinematics(model, data)
    return data


def surface_corners(model: Any, data: Any, links: Sequence[int]) -> Array:
    """Return corners of the colliding shapes of links in the world, (N, 3) [m]: a mesh's vertices, else of its box."""
    return in_world(data, {geom: geom_corners(model, geom) for geom in colliding(model, links)})


def in_world(data: Any, points: dict[int, Array]) -> Array:
    """Return points that are given in the frames of shapes in the world, (N, 3) [m]."""
    found = [data.geom_xpos[geom] + local @ data.geom_xmat[geom].reshape(3, 3).T for geom, local in points.items()]
    return np.concatenate(found) if found else np.empty((0, 3))


def geom_corners(model: Any, geom: int) -> Array:
    """Return corners of a shape in its frame, (N, 3) [m]."""
    mesh = int(model.geom_dataid[geom])
    if mesh >= 0:
        start = model.mesh_vertadr[mesh]
        return np.asarray(model.mesh_vert[start : start + model.mesh_vertnum[mesh]], float)
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    return model.geom_aabb[geom, :3] + signs * model.geom_aabb[geom, 3:]


def colliding(model: Any, links: Sequence[int]) -> list[int]:
    """Return the shapes of links that touch: those that collide, or all of links of which none does.

    Links without a joint between them are one: what is only seen of one does not touch if another collides.
    """
    own = [geom for geom in range(model.ngeom) if int(model.geom_bodyid[geom]) in links]
    mask = model.geom_contype | model.geom_conaffinity
    rigid = model.body_weldid[model.geom_bodyid]
    solid = {int(rigid[geom]) for geom in own if mask[geom]}
    return [geom for geom in own if mask[geom] or int(rigid[geom]) not in solid]


def _last_part(name: str) -> str:
    return re.split(r"[/\\:]", name)[-1].lower()


def _limited(robot: Compiled, drives: Sequence[JointDrive | None], link: int) -> list[int]:
    """Return the driven joints with limits behind a link."""
    behind = set(robot.behind(link)) - {link}
    found = []
    for j, b in enumerate(robot.model.jnt_bodyid):
        drive = drives[j]
        if int(b) in behind and drive is not None and np.isfinite(drive.lower) and np.isfinite(drive.upper):
            found.append(j)
    return found


def above(model: Any, link: int) -> list[int]:
    """Return the links between a link and the world, nearest first."""
    found = []
    while (link := int(model.body_parentid[link])) > 0:
        found.append(link)
    return found


def branch(model: Any, palm: int, joint: int) -> int:
    """Return the link next to the palm on the way to a joint's link."""
    link = int(model.jnt_bodyid[joint])
    while int(model.body_parentid[link]) != palm:
        link = int(model.body_parentid[link])
    return link


def side_of(model: Any, palm: int, branch: int) -> list[int]:
    """Return the links of a finger: a branch of the palm, and those that a loop ties to it."""
    mujoco = importlib.import_module("mujoco")
    loops = [int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)]

    def top(link: int) -> int:
        while link > 0 and int(model.body_parentid[link]) != palm:
            link = int(model.body_parentid[link])
        return link

    tops = {branch}
    for _ in range(3):
        for e in range(model.neq):
            if int(model.eq_type[e]) in loops and int(model.eq_objtype[e]) == int(mujoco.mjtObj.mjOBJ_BODY):
                pair = {top(int(model.eq_obj1id[e])), top(int(model.eq_obj2id[e]))} - {0}
                tops |= pair if pair & tops else set()
    return [b for b in range(1, model.nbody) if top(b) in tops]


def _fixed_to(model: Any, link: int, palm: int) -> bool:
    """Return whether no joint lies between a link and the palm in front of it."""
    while link != palm:
        if model.body_jntnum[link]:
            return False
        link = int(model.body_parentid[link])
    return True


def opposed(first: Any, last: Any, sides: Sequence[set[int]]) -> list[set[int]]:
    """Return the fingers of a hand that one motor closes: branches of the palm that move in the same direction.

    Args:
        first: Where everything is at one end of its travel.
        last: Where everything is at the other.
        sides: The links of each branch.
    """
    moved = np.array([(last.xipos - first.xipos)[sorted(side)].mean(0) for side in sides])
    moved = moved - moved.mean(0)  # what they do alike, such as to come out, tells nothing
    along = moved @ np.linalg.svd(moved)[2][0] > 0.0
    groups = [set[int]().union(*(side for side, one in zip(sides, along, strict=True) if one == k)) for k in (1, 0)]
    return [group for group in groups if group]


def _mean_gap(model: Any, data: Any, sides: Sequence[Sequence[int]]) -> float:
    """Return the mean distance of the points of both sides from the nearest one of the other [m]."""
    clouds = []
    for side in sides:
        points = surface_corners(model, data, side)
        if not len(points):
            points = data.xipos[list(side)]
        clouds.append(points[:: max(1, len(points) // _POINTS)])
    both = (KDTree(clouds[1]).query(clouds[0])[0], KDTree(clouds[0]).query(clouds[1])[0])
    return float(np.mean([distances.mean() for distances in both]))
