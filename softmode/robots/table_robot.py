"""A robot from a file as the tasks have it: standing at the table, with a tool between its fingers and a home pose."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import newton
import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softmode.checks import require_fields, require_number
from softmode.errors import ConfigError
from softmode.robots.arm import ArmDescription, ArmIndices, GripperDescription
from softmode.robots.chain import SerialChain, serial_chain
from softmode.robots.description import RobotDescription, RobotIndices
from softmode.robots.hand import settled
from softmode.robots.jaws import ParallelJaw, dry_friction_of, finger_names, gap_of, measured

Array = NDArray[np.float64]

JOINT_MAX = 8
"""Most joints between base and tool."""
_OPENINGS = 17
"""At how many openings the gap between the fingers is measured."""
_DOWN = np.diag([-1.0, 1.0, -1.0])
"""Orientation of a tool that points down with yaw 0: z down, fingers close along y."""
_YAW = 1.4
"""How far the tool must turn about the vertical to either side over the home position [rad]."""
_NEAR = 2.0e-3
"""Error of the inverse kinematics that counts as reached [m]."""
_SHARES = (1.0, 0.75, 0.5, 0.3)
"""Shares of the ranges that are tried in turn."""
_HEIGHTS = (0.0, 0.15, 0.3, 0.45)
"""How high above the table the base is tried, in turn [m]."""
_POSES = 4000
"""Most poses that a search for a base tries."""
_FIRST = 25
"""Steps of the inverse kinematics after which a pose is given up that is farther off than `_HOPE`."""
_HOPE = 0.03
"""See `_FIRST` [m]."""
_FREE = 5.7
"""Range of an upright first joint from which on the base needs not be turned [rad]."""
_LOW = 0.13
"""Lowest tool position of the home pose that a robot of small reach gets [m]: over what stands on the table."""
_BENT = ((0.0, -1.0, 1.0, -1.0, -1.0, 0.0), (0.0, -1.0, -1.0, 1.0, 1.0, 0.0), (0.0, 0.3, 0.0, -1.0, 0.0, 1.0))
"""Poses in which the search begins, in quarters of the ranges of the joints: shoulder, elbow and wrist bent."""
_ROOM = 0.1
"""How far every joint of the home pose should be from the ends of its range [rad]."""
_STEP = 0.01
"""A step of the simulation, in which a drive must not swing [s]."""
_STUCK = 0.5e-3
"""How far dry friction of its joints may hold a finger from where its drive aims [m]."""


@dataclass
class _Search:
    """What a search may still do: its work is bounded, not its time, so that all machines find the same."""

    left: int = field(default_factory=lambda: _POSES)
    """Poses to be tried yet."""


@dataclass(frozen=True, kw_only=True)
class TableRobot:
    """A loaded robot at the table; made by :func:`place_robot`, and what ``TableSceneConfig.arm`` takes."""

    robot: RobotDescription
    """The robot; its home pose is the one at the table."""
    base: tuple[float, float, float, float]
    """Where its base stands: x, y, z [m] and the rotation about the vertical [rad]."""
    jaw: ParallelJaw
    """Its fingers, with the frame of tasks between the pads: x across the fingers, y along the closing axis, z out."""
    home_position: tuple[float, float, float]
    """Tool position of the home pose in the world [m]; the tool points down."""
    home_opening: float
    """Distance between the pads there [m]."""
    gaps: tuple[float, ...] = field(repr=False)
    """Distance between the fingers [m] at openings from 0 to 1 of the gripper, evenly spaced and ascending."""
    grip_force: float
    """Largest force of a finger on what it holds [N]."""
    grip_friction: float
    """Dry friction of a finger's joints along the closing axis [N], which its drive overcomes besides."""
    grip_stiffness: float
    """Stiffness of a finger along the closing axis [N/m]."""
    share: float
    """Share of a task's ranges of places that it reaches, 1 for all."""

    def __post_init__(self) -> None:
        """Check what a caller may replace."""
        require_fields(self, ("base",), count=4)
        require_fields(self, ("home_position",), count=3)
        require_number("home_opening", self.home_opening, at_least=0.0, at_most=self.jaw.opening + 1e-9, unit="m")

    @property
    def gripper(self) -> GripperDescription:
        """What tasks and scripted policies ask of a gripper: sizes, and the drive of one finger."""
        return GripperDescription(
            stroke=self.jaw.opening,
            finger_length=max(self.jaw.reach, self.jaw.pad_length),
            pad_size=(self.jaw.pad_width, self.jaw.thickness, self.jaw.pad_length),
            force_limit=self.grip_force + self.grip_friction,
            drive_stiffness=self.grip_stiffness,
            friction=self.jaw.friction,
        )

    @property
    def chain(self) -> SerialChain:
        """The chain to the frame of tasks, in the base frame, with the opening of the home pose."""
        return serial_chain(self.robot, self.jaw.frame_at(self.home_opening))

    @property
    def joint_count(self) -> int:
        """Joints between base and tool."""
        return len(self.chain.joints)

    @property
    def tool_stiffness(self) -> float:
        """Vertical stiffness of the drives between base and tool in the home pose, at the tool [N/m].

        1 / k = sum over the joints of (dz / dq)^2 / k_joint.
        """
        chain = self.chain
        vertical = chain.jacobian(chain.home[None])[0, 2]
        drives = [self.robot.drives[j] for j in chain.joints]
        stiffness = np.array([np.inf if drive is None else drive.stiffness for drive in drives])
        return float(1.0 / max(np.sum(vertical**2 / stiffness), 1.0e-12))

    def with_tool_stiffness(self, stiffness: float) -> TableRobot:
        """Return the robot with drives of another vertical stiffness at the tool [N/m] and the same damping ratios."""
        factor = stiffness / self.tool_stiffness
        drives = list(self.robot.drives)
        for j in self.chain.joints:
            drive = drives[j]
            if drive is not None:
                softer = {"stiffness": factor * drive.stiffness, "damping": math.sqrt(factor) * drive.damping}
                drives[j] = replace(drive, **softer)
        return replace(self, robot=replace(self.robot, drives=tuple(drives)))

    def opening_at(self, gap: float) -> float:
        """Return the opening, 0 to 1, at which the fingers are so far apart [m]."""
        return float(np.interp(gap, self.gaps, np.linspace(0.0, 1.0, len(self.gaps))))

    def joint_q_over(self, position: Sequence[float], yaw: float = 0.0) -> Array:
        """Return the joint coordinates that hold the tool at a point of the world, pointing down.

        Args:
            position: Tool position in the world [m], shape (3,).
            yaw: Rotation about the vertical [rad].

        Returns:
            Coordinates of the joints between base and tool, shape (joint_count,).

        Raises:
            ConfigError: If the point is out of reach.
        """
        q, error = self._held(np.array([position], float), yaw)
        if error[0] > _NEAR:
            raise ConfigError(
                f"robot {self.robot.name!r} cannot hold its tool at {tuple(position)} m pointing down with yaw {yaw}",
                hint="choose a point nearer to its base, or place it anew: softmode.robots.place_robot(robot, ...)",
            )
        return q[0]

    def turn_at(self, positions: Array, yaw: float) -> float | None:
        """Return a yaw, or the one half a turn away, with which the tool gets to points (N, 3) [m]; None if neither."""
        turns = (yaw, yaw - math.copysign(math.pi, yaw))
        return next((turn for turn in turns if (self._held(positions, turn)[1] <= _NEAR).all()), None)

    def _held(self, positions: Array, yaw: float) -> tuple[Array, Array]:
        """Return coordinates that hold the tool at points, pointing down with a yaw, and what is missing [m]."""
        chain = self.chain
        start = np.array(self.robot.home)[list(chain.joints)]
        return _reach(chain, np.array([self.base]), positions, np.full(len(positions), yaw), start, _Search())

    def add_to(
        self, builder: newton.ModelBuilder, *, xform: Sequence[float] | None = None, label: str = "arm"
    ) -> RobotIndices:
        """Add the robot in its home pose to a builder; `xform` places its base elsewhere."""
        newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
        if self.base[2] > 0.0 and xform is None:  # a pedestal, only to be seen
            x, y, z = self.base[:3]
            config = newton.ModelBuilder.ShapeConfig(density=0.0, has_shape_collision=False)
            config.has_particle_collision = False
            look = {"color": (0.30, 0.31, 0.33), "label": f"{label}/pedestal"}
            place = wp.transform(wp.vec3(x, y, 0.5 * z), wp.quat_identity())
            builder.add_shape_box(-1, xform=place, hx=0.08, hy=0.08, hz=0.5 * z, cfg=config, **look)
        return self.robot.add_to(builder, xform=base_pose(self.base) if xform is None else xform, label=label)


def tip_length(arm: ArmDescription | TableRobot) -> float:
    """Return the distance from the tool point to the finger tips [m]."""
    if isinstance(arm, TableRobot):
        return arm.jaw.tip
    return arm.hand_length + arm.gripper.finger_length - arm.tool_length


def finger_links(description: ArmDescription | TableRobot, arm: ArmIndices | RobotIndices) -> NDArray[np.int64]:
    """Return the bodies of both fingers in the builder, shape (2, links of a finger), -1 for none."""
    if not isinstance(description, TableRobot) or isinstance(arm, ArmIndices):
        return np.asarray(arm.finger_bodies)[:, None]
    sides = finger_names(description.robot)
    bodies = dict(zip(description.robot.link_names, arm.link_bodies, strict=True))
    table = np.full((2, max(map(len, sides))), -1)
    for f, side in enumerate(sides):
        table[f, : len(side)] = [bodies[name] for name in side]
    return table


def base_pose(base: Sequence[float]) -> tuple[float, ...]:
    """Return position and quaternion (xyzw) of a base at x, y, z [m], turned about the vertical [rad]."""
    return (*base[:3], 0.0, 0.0, math.sin(0.5 * base[3]), math.cos(0.5 * base[3]))


def place_robot(
    robot: RobotDescription,
    *,
    home_position: Sequence[float] = (0.45, 0.0, 0.25),
    home_opening: float = 0.08,
    over: Sequence[float] = (0.45, 0.0),
    ranges: Sequence[float] = (0.09, 0.16),
    height: float = 0.24,
    also: Sequence[Sequence[float]] = (),
    base: Sequence[float] | None = None,
    grip_force: float = 40.0,
    grip_way: float | None = 0.01,
) -> TableRobot:
    """Place a loaded robot at the table, so that it reaches what a task needs with the tool pointing down.

    Distance, direction and height of the base are searched: the most places first, then the least height, then the
    middle of what serves. Where not all is in reach, the ranges shrink about their middle, and so do the heights of
    home pose and places; `TableRobot.share` says by how much.

    Args:
        robot: The robot, with a gripper of two fingers.
        home_position: Tool position of the home pose [m], shape (3,).
        home_opening: Distance between the pads in the home pose [m]; the widest one if it is less.
        over: Middle of the places on the table [m], shape (2,).
        ranges: Half-widths of the places in x and y [m].
        height: Highest place over the table [m].
        also: Places that do not move where the ranges shrink [m], shape (N, 3).
        base: Where the base stands, x, y, z [m] and rotation [rad]; searched if omitted.
        grip_force: Largest force of a finger on what it holds [N]; what the file's drive leaves over after the dry
            friction of the finger's joints, if that is less.
        grip_way: How far past the object a finger's drive aims for that force [m], by which softer drives of the file
            are stiffened: models of grippers often have a servo so soft that it cannot press, where the device
            controls the force. They are stiffened likewise where dry friction would hold a finger away from where its
            drive aims. None keeps the file's drives.

    Returns:
        The robot at the table.

    Raises:
        ConfigError: If it has no gripper of two fingers, too few or too many joints, or cannot reach the table.
    """
    if robot.gripper is None:
        raise ConfigError(
            f"robot {robot.name!r} has no gripper, which this task needs",
            hint="name its joints: load(..., gripper={'joint': (closed, open)}), or give it a hand: load(..., hand=)",
        )
    robot, jaw = measured(robot)
    home_opening = min(home_opening, jaw.opening)
    chain = serial_chain(robot, jaw.frame_at(home_opening))
    if not 5 <= len(chain.joints) <= JOINT_MAX:
        raise ConfigError(
            f"robot {robot.name!r} has {len(chain.joints)} joints between base and tool, expected 5 to {JOINT_MAX}",
            hint="hold a base that floats (floating=False), or write control.joint_target_q yourself (with_opening)",
        )
    loose = [robot.joint_names[j] for j in chain.joints if robot.drives[j] is None]
    if loose:
        raise ConfigError(
            f"joints between base and tool of robot {robot.name!r} have no drive: {', '.join(loose)}",
            hint="give each an actuator in the file; a base that floats is held with load(..., floating=False)",
        )
    # The fingers may change sides: half a turn about the tool, which may free the last joint's range.
    half = Rotation.from_quat(jaw.frame[3:]) * Rotation.from_rotvec([0.0, 0.0, np.pi])
    other = (*jaw.frame[:3], *half.as_quat().tolist())
    jaws = [jaw, replace(jaw, frame=other, follow=-jaw.follow)]
    bases = [[tuple(map(float, base))]] if base is not None else [_bases(chain, over, up) for up in _HEIGHTS]
    best: list[tuple[float, ParallelJaw, Any, Array, float, Array]] = []
    search = _Search()
    for share, every in itertools.product(_SHARES, bases):
        home = np.array(home_position, float)
        if share < 1.0:
            home[2] = max(share * home_position[2], min(home_position[2], _LOW))
        box = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [0.02, max(share * height, home[2])], indexing="ij"), -1)
        places = box.reshape(-1, 3) * [share * ranges[0], share * ranges[1], 1.0] + [*over, 0.0]
        points = np.concatenate([home[None], places, np.reshape(np.array(also, float), (-1, 3))])
        far = np.linalg.norm(points[:, None] - _shoulders(chain, every), axis=2).max(axis=0)
        some = [one for one, distance in zip(every, far, strict=True) if distance < chain.reach + _NEAR]
        tried = [_placed(robot, one, home_opening, some, points, search) for one in jaws]
        best = [(*one, share, home) for one in tried if one is not None]
        if best or search.left <= 0:
            break
    if not best:
        spent = f", in the {_POSES} poses that are tried" if search.left <= 0 else ""
        raise ConfigError(
            f"robot {robot.name!r}, whose tool reaches {chain.reach:.2f} m, finds no place from which it points down "
            f"at {tuple(home_position)} m, turned by {_YAW} rad to either side, and around {tuple(over)} m{spent}",
            hint="use a larger robot, a lower home_position, or name its tool: load(..., end_effector=, tool_offset=)",
        )
    _, jaw, placed, q, share, home = min(best, key=lambda one: one[0])
    gaps = np.maximum.accumulate([gap_of(robot, jaw, s) for s in np.linspace(0.0, 1.0, _OPENINGS)])
    gaps = np.maximum(gaps, 0.0) + 1.0e-7 * np.arange(_OPENINGS)  # ascending
    jaw = replace(jaw, opening=float(gaps[-1]))
    opening = min(home_opening, jaw.opening)
    fraction = float(np.interp(opening, gaps, np.linspace(0.0, 1.0, _OPENINGS)))
    pose = robot.home_joint_q
    pose[list(chain.joints)] = q
    pose = _closed_loops(robot, robot.with_opening(fraction, pose.tolist()))
    robot = replace(robot, home=tuple(pose.tolist()))
    travel = 0.5 * float(gaps[-1] - gaps[0])
    friction = 0.5 * dry_friction_of(robot) / travel
    robot, force, stiffness = _with_grip(_steady(robot), travel, friction, grip_force, grip_way)
    return TableRobot(
        robot=robot,
        base=placed,
        jaw=jaw,
        home_position=(float(home[0]), float(home[1]), float(home[2])),
        home_opening=opening,
        gaps=tuple(gaps.tolist()),
        grip_force=force,
        grip_friction=friction,
        grip_stiffness=stiffness,
        share=share,
    )


def _with_grip(
    robot: RobotDescription, travel: float, friction: float, most: float, way: float | None
) -> tuple[RobotDescription, float, float]:
    """Return the robot with drives of the fingers that press, the force [N] and the stiffness [N/m] of one finger.

    A joint that moves by R while its finger travels by T acts on it with the lever r = T / R: a force f = torque / r,
    a stiffness k / r^2. Dry friction [N] takes its part of that force.
    """
    fingers = robot.gripper
    assert fingers is not None
    index = [robot.joint_names.index(name) for name in fingers.joints]
    drives = [drive for drive in (robot.drives[j] for j in index) if drive is not None]
    if len(drives) < len(index):
        raise ConfigError(
            f"a gripper joint of robot {robot.name!r} has no drive", hint="name driven joints: load(..., gripper=)"
        )
    lever = travel / np.maximum(np.abs(np.array(fingers.open) - np.array(fingers.closed)), 1.0e-9)
    shared = 0.5 * len(index)  # joints of a finger
    limit = np.array([drive.effort_limit for drive in drives]) / lever * shared
    force = float(min(most, limit.min() - friction))
    if force <= 0.0:
        raise ConfigError(
            f"the gripper of robot {robot.name!r} cannot close: its drives give {limit.min():.1f} N per finger, dry "
            f"friction of its joints takes {friction:.1f} N",
            hint="raise the force limit of its drives in the file, or lower frictionloss there",
        )
    stiffness = np.array([drive.stiffness for drive in drives])
    damping = np.array([drive.damping for drive in drives])
    if way is not None:
        wanted = max(force / way, friction / _STUCK) * lever**2 / shared
        inertia = robot.joint_inertias()[index]
        # A finger that weighs little swings within a step of the simulation unless it is damped more.
        critical = np.maximum(2.0 * np.sqrt(np.maximum(wanted, stiffness) * inertia), _STEP * wanted)
        damping = np.where(wanted > stiffness, np.maximum(damping, critical), damping)
        stiffness = np.maximum(stiffness, wanted)
    changed = list(robot.drives)
    for k, j in enumerate(index):
        bounded = (force + friction) * lever[k] / shared
        new = {"stiffness": float(stiffness[k]), "damping": float(damping[k]), "effort_limit": float(bounded)}
        changed[j] = replace(drives[k], **new)
    along = float((stiffness / lever**2).sum() / 2.0)
    return replace(robot, drives=tuple(changed)), force, along


def _steady(robot: RobotDescription) -> RobotDescription:
    """Return the robot with softer drives where they would swing within a step of the simulation."""
    drives = list(robot.drives)
    for j, (drive, inertia, loss) in enumerate(
        zip(drives, robot.joint_inertias(), robot.model.dof_damping.tolist(), strict=True)
    ):
        fast = drive is not None and drive.stiffness * _STEP**2 > inertia
        if drive is not None and fast and drive.damping + loss < drive.stiffness * _STEP:
            stiffness = 0.25 * float(inertia) / _STEP**2
            drives[j] = replace(drive, stiffness=stiffness, damping=stiffness * _STEP)
    return replace(robot, drives=tuple(drives))


def _placed(
    robot: RobotDescription,
    jaw: ParallelJaw,
    opening: float,
    bases: list[Any],
    points: Array,
    search: _Search,
) -> tuple[float, ParallelJaw, Any, Array] | None:
    """Return how far from home, the jaw, the base, and the coordinates over the first point; None if none reaches all.

    The middle of the distances that serve is taken, in the direction that asks for the least change of the home pose
    and leaves the last joint room to turn the tool.
    """
    if not bases:
        return None
    chain = serial_chain(robot, jaw.frame_at(opening))
    places, over_home = np.array(bases), np.tile(points[0], (len(bases), 1))
    at_home, error = _reach(chain, places, over_home, np.zeros(1), chain.home, search, bent=True)
    reached = error <= _NEAR
    # Opposite corners are what most bases do not reach. Turned by half a turn, the fingers change sides.
    sides = [(points[:1], (turn, turn - math.copysign(math.pi, turn))) for turn in (_YAW, -_YAW)]
    for some, turns in ((points[[1, 6]], (0.0,)), (points[1:], (0.0,)), *sides):
        left = np.flatnonzero(reached)
        reached[left] = False
        for turn in turns:
            left = left[~reached[left]]
            if not len(left):
                break
            base, start = (np.repeat(rows[left], len(some), axis=0) for rows in (places, at_home))
            rows = np.tile(some, (len(left), 1))
            _, error = _reach(chain, base, rows, np.full(len(rows), turn), start, search)
            reached[left] = (error.reshape(-1, len(some)) <= _NEAR).all(axis=1)
    middles = []
    for turn in dict.fromkeys(one[3] for one in bases):
        chosen = [k for k in np.flatnonzero(reached) if bases[k][3] == turn]
        middles += [chosen[len(chosen) // 2]] if chosen else []
    if not middles:
        return None
    low, high = chain.span
    room = np.minimum(at_home - low, high - at_home)[:, -1]  # of the joint that turns the tool
    change = {k: float(np.abs(at_home[k] - chain.home).sum() + 3.0 * max(0.0, _YAW - room[k])) for k in middles}
    k = min(middles, key=lambda k: change[k])
    return change[k], jaw, bases[k], at_home[k]


def _bases(chain: SerialChain, over: Sequence[float], up: float) -> list[Any]:
    """Return places of the base: at a height, at several distances on the near side, turned by quarter turns."""
    low, high = chain.span
    # The first joint of most arms turns the base by itself.
    upright = abs(chain.axis[0, 2]) > 0.99 and not chain.slide[0]
    free = upright and high[0] - low[0] > _FREE
    turns = (0.0,) if free else (0.0, 0.5 * math.pi, -0.5 * math.pi, math.pi)
    aside = _about_z(np.array(turns)).apply(chain.anchor[0] if upright else np.zeros(3))  # from the base to its axis
    return [
        (float(over[0] - share * chain.reach - x), float(over[1] - y), up, turn)
        for turn, (x, y, _) in zip(turns, aside, strict=True)
        for share in np.linspace(0.25, 0.95, 15)
    ]


def _shoulders(chain: SerialChain, bases: list[Any]) -> Array:
    """Return where the first joint is with the base at places, shape (N, 3) [m]."""
    return np.array([one[:3] for one in bases]) + _about_z(np.array(bases)[:, 3]).apply(chain.anchor[0])


def _reach(
    chain: SerialChain, base: Array, points: Array, yaw: Array, start: Array, search: _Search, *, bent: bool = False
) -> tuple[Array, Array]:
    """Return coordinates that hold the tool at points of the world, pointing down, and what is missing [m].

    The iteration begins in the home pose, then in other ones for what was not reached. A joint below the table's top
    counts as not reached.

    Args:
        chain: The chain in the base frame.
        base: Where the base stands for each point, x, y, z [m] and rotation [rad], shape (N or 1, 4).
        points: The points, shape (N, 3).
        yaw: Rotation of the tool about the vertical there [rad], shape (N,).
        start: The home pose, shape (n,) or (N, n).
        search: What may still be tried.
        bent: Whether more poses are tried: with the elbow up, down and to the sides.
    """
    base, yaw = np.broadcast_to(base, (len(points), 4)), np.broadcast_to(yaw, len(points))
    local = _about_z(-base[:, 3]).apply(points - base[:, :3])
    turns = _about_z(yaw - base[:, 3]).as_matrix() @ _DOWN
    low, high = chain.span
    middle, quarter = 0.5 * (low + high), 0.25 * (high - low)
    odd = np.arange(len(low)) % 2
    starts = [middle, middle + quarter * odd]
    if bent:
        starts += [middle + quarter * np.resize(signs, len(low)) for signs in _BENT]

    def solved(rows: NDArray[np.int64], begin: Array) -> tuple[Array, Array]:
        search.left -= len(rows)
        q, error = chain.inverse(local[rows], turns[rows], begin, iterations=_FIRST)
        near = np.flatnonzero(error < _HOPE)  # what is far off by then stays there
        q[near], error[near] = chain.inverse(local[rows[near]], turns[rows[near]], q[near], iterations=80 - _FIRST)
        return q, np.where(chain.lowest(q) + base[rows, 2] < 0.0, np.inf, error)

    def ranked(q: Array, error: Array) -> Array:
        """Return the error, larger where a pose to begin with is at the end of a joint's range: the last choice."""
        return error + _NEAR * (np.minimum(q - low, high - q).min(axis=1) < _ROOM) if bent else error

    q, error = solved(np.arange(len(points)), start)
    for other in starts:
        rank = ranked(q, error)
        left = np.flatnonzero(rank > _NEAR)
        if not len(left) or search.left <= 0:
            break
        again, missing = solved(left, other)
        better = ranked(again, missing) < rank[left]
        q[left[better]], error[left[better]] = again[better], missing[better]
    return q, error


def _about_z(angle: Array) -> Rotation:
    """Return rotations about the vertical [rad], shape (N,)."""
    return Rotation.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0]))


def _closed_loops(robot: RobotDescription, joint_q: Array) -> Array:
    """Return joint coordinates with the loops closed by the passive joints, within the limits."""
    model = robot.model
    passive = [robot.joint_names.index(name) for name in robot.passive_joints]
    data = settled(model, model.qpos0 + joint_q, passive)
    return np.clip(np.asarray(data.qpos) - model.qpos0, robot.joint_lower, robot.joint_upper)
