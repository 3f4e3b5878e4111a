"""A compiled robot and what is read from it: home pose, tool, gripper, and position drives for its joints.

Position servos are turned into joint drives, because the joint solve with soft bodies knows the damping of drives but
not that of actuators:

- an affine actuator on a joint, tau = clamp(g u - k q - d qd), becomes a drive of stiffness k and damping d;
- joints tied by a linear equality q_i = a_i + s_i q_0 (the fingers of most grippers) each get a share of the drive that
  acts on q_0, directly or through a tendon: k_i = k / (n s_i^2), d_i and the effort limit alike. Moving together they
  answer as the tied pair did; the tie itself is dropped, so a finger that is pushed alone yields by its own drive.
"""

from __future__ import annotations

import copy
import functools
import importlib
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softmode.deformables.coupling.rigid_solver import mujoco_warnings
from softmode.errors import AssetError, ConfigError
from softmode.robots.assets import RobotAsset
from softmode.robots.description import JointDrive, RobotGripper, ToolPose, followed
from softmode.robots.hand import find_end_effector, find_gripper

_HELD_OFF = 0.02
"""How far dry friction may hold a joint without servo from its target [rad or m]."""
_LEAST_LAG = 0.01
"""Least damping of such a drive over its stiffness [s], with which a step of the simulation resolves it."""


@dataclass
class CompiledRobot:
    """A compiled robot and what is read from it; joint coordinates are Newton's, zero in the reference pose."""

    model: Any
    asset: RobotAsset
    at_home: dict[str, float]
    bandwidth: float = 8.0
    """Natural frequency of the drives of joints without a servo [Hz]."""
    undriven: Collection[str] = ()
    """Joints that get no drive by default: those of a base that floats."""

    def __post_init__(self) -> None:
        """Check that every link has at most one hinge or slide."""
        self.mujoco = importlib.import_module("mujoco")
        model = self.model
        self.joint_names = tuple(model.joint(j).name for j in range(model.njnt))
        scalar = (int(self.mujoco.mjtJoint.mjJNT_HINGE), int(self.mujoco.mjtJoint.mjJNT_SLIDE))
        for j, name in enumerate(self.joint_names):
            if int(model.jnt_type[j]) not in scalar:
                kind = self.mujoco.mjtJoint(int(model.jnt_type[j])).name.removeprefix("mjJNT_").lower()
                hint = "use a robot on a fixed base whose joints are hinges and slides"
                raise AssetError(f"robot file {self.asset.path}: joint {name!r} is a {kind} joint", hint=hint)
        for b in range(model.nbody):
            if model.body_jntnum[b] > 1:
                raise AssetError(
                    f"robot file {self.asset.path}: link {self.link(b)!r} has {model.body_jntnum[b]} joints",
                    hint="put each joint into a link of its own",
                )
        if not model.njnt:
            raise AssetError(f"robot file {self.asset.path} holds no joint", hint="give it a hinge or a slide")
        self._check_numbers()
        limited = model.jnt_limited.astype(bool)
        reference = model.qpos0[: model.njnt]
        self.reference = reference
        self.lower = np.where(limited, model.jnt_range[:, 0] - reference, -math.inf)
        self.upper = np.where(limited, model.jnt_range[:, 1] - reference, math.inf)
        self.dropped: set[str] = set()
        self.notes: list[str] = []
        """What was chosen where the file does not say."""
        said = [tie for e in range(model.neq) if (tie := self._tie(e)) is not None]
        self.bound = self._joined(list(dict.fromkeys(said)))
        """Per joint its leader by the file's ties, and ratio and offset of q_joint = offset + ratio q_leader."""
        self.ties = self._joined(self._pulled(), self.bound)
        """The same with the joints of a tendon that one servo pulls, which nothing else ties."""
        self._bind_ranges()
        self.passive: list[int] = []
        """Joints without a drive, known after `drives`."""

    def _check_numbers(self) -> None:
        """Refuse masses and gains that are none, and ranges that are NaN."""
        signed = ("qpos0", "actuator_gainprm", "actuator_biasprm", "actuator_gear")
        positive = ("body_mass", "body_inertia", "dof_damping", "dof_armature", "dof_frictionloss")
        ranges = ("jnt_range", "jnt_actfrcrange", "actuator_ctrlrange", "actuator_forcerange")
        for names, low, high in ((signed, -1e9, 1e9), (positive, 0.0, 1e9), (ranges, -math.inf, math.inf)):
            for name in names:
                values = getattr(self.model, name)
                if not np.all((values >= low) & (values <= high)):
                    text = f"robot file {self.asset.path}: {name} is not all from {low} to {high}"
                    raise AssetError(text, hint="mend its masses, gains and ranges")

    def link(self, body: int) -> str:
        """Return the name of a link."""
        return self.model.body(int(body)).name

    def behind(self, link: int) -> list[int]:
        """Return a link and all links behind it."""
        found = {link}
        for b in range(link + 1, self.model.nbody):
            if int(self.model.body_parentid[b]) in found:
                found.add(b)
        return sorted(found)

    def home(self, given: Sequence[float] | None) -> np.ndarray:
        """Return the home pose within the joint limits."""
        if given is None:
            values = np.array([self.at_home.get(name, 0.0) for name in self.joint_names]) - self.reference
            return np.clip(followed(np.clip(values, self.lower, self.upper), *self.bound), self.lower, self.upper)
        values = np.asarray(given, float)
        if values.shape != (len(self.joint_names),) or not np.all(np.isfinite(values)):
            hint = f"give one number for each of {', '.join(self.joint_names)}"
            raise ConfigError(f"home has shape {values.shape} or holds a value that is not finite", hint=hint)
        tied = followed(values, *self.bound)
        for j in np.flatnonzero(np.abs(tied - values) > 1.0e-6):
            leader = self.joint_names[self.bound[0][j]]
            self.notes.append(f"home: {self.joint_names[j]!r} follows {leader!r}, so it is {tied[j]:.4g}")
        return tied

    def data(self, joint_q: np.ndarray) -> Any:
        """Return the kinematics at a pose."""
        data = self.mujoco.MjData(self.model)
        data.qpos[:] = joint_q + self.reference
        with mujoco_warnings():
            self.mujoco.mj_forward(self.model, data)
        return data

    def tool(
        self, name: str | None, offset: np.ndarray, drives: Sequence[JointDrive | None] = ()
    ) -> tuple[int, ToolPose]:
        """Return the link that carries the tool, and the tool's pose in it."""
        model = self.model
        sites = {model.site(s).name: s for s in range(model.nsite)}
        bodies = {self.link(b): b for b in range(1, model.nbody)}
        if name is None:
            name, how = find_end_effector(self, drives)
            self.notes.append(f"end effector {name!r}: {how}")
        if name not in sites and name not in bodies:
            leaves = [n for n, b in bodies.items() if b not in model.body_parentid]
            known = ", ".join(repr(n) for n in [*filter(None, sites), *leaves][:12])
            raise ConfigError(
                f"robot {self.asset.name!r} has no site or body {name!r} for end_effector",
                hint=f"pass end_effector= a site or body, like {known}",
            )
        if name in sites:
            s = sites[name]
            link, position, (w, x, y, z) = int(model.site_bodyid[s]), model.site_pos[s], model.site_quat[s]
        else:
            link, position, (w, x, y, z) = bodies[name], np.zeros(3), (1.0, 0.0, 0.0, 0.0)
        turned = np.zeros(3)
        self.mujoco.mju_rotVecQuat(turned, offset, np.array([w, x, y, z]))
        px, py, pz = (position + turned).tolist()
        return link, (px, py, pz, float(x), float(y), float(z), float(w))

    # -- drives -------------------------------------------------------------------------------------------------------

    def drives(self) -> tuple[JointDrive | None, ...]:
        """Turn actuators into joint drives."""
        model = self.model
        owner, ratio, shift = self.ties
        count = model.njnt
        drives: list[JointDrive | None] = [None] * count
        driven = [j for j in range(count) if self.joint_names[j] not in self.undriven]
        torque_limit: dict[int, float] = {} if model.nu else dict.fromkeys(driven, math.inf)
        for a in range(model.nu):
            arms, name = self._transmission(a), f"actuator {model.actuator(a).name or a!r}"
            if not arms or len({owner[j] for j in arms}) != 1:
                kind = self.mujoco.mjtTrn(int(model.actuator_trntype[a])).name.removeprefix("mjTRN_").lower()
                what = "adhesion, which" if kind == "body" else f"a {kind} actuator that" if not arms else "one that"
                self.notes.append(f"{name} is left out: {what} drives no joint and no group of tied joints")
                continue
            dynamics = self.mujoco.mjtDyn(int(model.actuator_dyntype[a])).name.removeprefix("mjDYN_").lower()
            if dynamics != "none":
                self.notes.append(f"{name}: its activation ({dynamics}) is left out, it acts at once")
            leader = owner[next(iter(arms))]
            limit = float(np.min(np.abs(model.actuator_forcerange[a]))) if model.actuator_forcelimited[a] else math.inf
            # The force on the leader's coordinate, each joint's part bounded by its own limit.
            total = sum(min(limit * abs(c), self._joint_limit(j)) * abs(ratio[j]) for j, c in arms.items() if c)
            stiffness, damping = -model.actuator_biasprm[a, 1], -model.actuator_biasprm[a, 2]
            affine = int(model.actuator_biastype[a]) == int(self.mujoco.mjtBias.mjBIAS_AFFINE)
            if affine and (stiffness < 0.0 or damping < 0.0):
                text = f"robot file {self.asset.path}: actuator {model.actuator(a).name!r} has negative gains"
                raise AssetError(text, hint="give it kp and kv of at least zero")
            if not affine or stiffness <= 0.0:
                torque_limit[leader] = total
                continue
            lever = sum(c * ratio[j] for j, c in arms.items())
            if lever == 0.0:
                self.notes.append(f"{name} is left out: the joints that it pulls cancel")
                continue
            zero = sum(c * (shift[j] + self.reference[j]) for j, c in arms.items())
            ends = [-math.inf, math.inf]
            if model.actuator_ctrllimited[a]:
                wanted = model.actuator_gainprm[a, 0] * model.actuator_ctrlrange[a] + model.actuator_biasprm[a, 0]
                ends = sorted(((wanted / stiffness - zero) / lever).tolist())
            group = [j for j in range(count) if owner[j] == leader]
            for j in group:
                share = 1.0 / (len(group) * ratio[j] ** 2)
                low, high = sorted((shift[j] + ratio[j] * ends[0], shift[j] + ratio[j] * ends[1]))
                # Several servos on one coordinate act together.
                before = drives[j] or JointDrive(stiffness=0.0, damping=0.0, effort_limit=0.0)
                drives[j] = JointDrive(
                    stiffness=float(before.stiffness + stiffness * lever**2 * share),
                    damping=float(before.damping + damping * lever**2 * share),
                    effort_limit=float(before.effort_limit + total / (len(group) * abs(ratio[j]))),
                    lower=float(max(low, self.lower[j], before.lower)),
                    upper=float(min(high, self.upper[j], before.upper)),
                )
        for j, drive in enumerate(drives):
            if drive is None and owner[j] in torque_limit:
                drives[j] = self._default_drive(j, min(torque_limit[owner[j]], self._joint_limit(j)))
        self.passive = [j for j in range(count) if drives[j] is None]
        for name, drive in zip(self.joint_names, drives, strict=True):
            if drive is not None and drive.effort_limit == 0.0:
                self.notes.append(f"the drive of joint {name!r} has force limit 0: it does not move it")
        # A tie between driven joints is what their drives replace; one between passive joints stays.
        loops = (int(self.mujoco.mjtEq.mjEQ_CONNECT), int(self.mujoco.mjtEq.mjEQ_WELD))
        if any(int(kind) in loops for kind in model.eq_type):
            self.notes.append("loops are held by rows that give a little: a slider-crank passes on .990 of its force")
        for e in range(model.neq):
            name, tie = model.equality(e).name, self._tie(e)
            if tie is None and int(model.eq_type[e]) not in loops:
                self.notes.append(
                    f"equality {name!r} is left out: it ties no two joints in proportion, or is not active"
                )
            if (drives[tie[0]] is not None) if tie else int(model.eq_type[e]) not in loops:
                self.dropped.add(name)
        return tuple(drives)

    def _tie(self, e: int) -> tuple[int, int, float, float] | None:
        """Return (joint, leader, offset, ratio) of a linear equality between two joints, or None."""
        model = self.model
        linear = int(model.eq_type[e]) == int(self.mujoco.mjtEq.mjEQ_JOINT) and model.eq_obj2id[e] >= 0
        if not linear or np.any(model.eq_data[e, 2:5]) or model.eq_data[e, 1] == 0.0 or not model.eq_active0[e]:
            return None
        offset, ratio = model.eq_data[e, :2]
        return int(model.eq_obj1id[e]), int(model.eq_obj2id[e]), float(offset), float(ratio)

    def _pulled(self) -> list[tuple[int, int, float, float]]:
        """Return ties for servos on tendons: each moves its joints alike, each by the sign of its coefficient."""
        ties: list[tuple[int, int, float, float]] = []
        for a in range(self.model.nu):
            first, *others = [(j, c) for j, c in self._transmission(a).items() if c] or [(0, 1.0)]
            ties += [(j, first[0], 0.0, math.copysign(1.0, c * first[1])) for j, c in others]
        return ties

    def _bind_ranges(self) -> None:
        """Give tied joints the range that all of them can reach together."""
        owner, ratio, shift = (np.array(part) for part in self.bound)
        for leader in np.flatnonzero(np.bincount(owner) > 1):
            group = owner == leader
            ends = np.sort((np.array([self.lower, self.upper]) - shift)[:, group] / ratio[group], axis=0)
            low, high = ends[0].max(), ends[1].min()
            if low >= high:
                names = ", ".join(repr(self.joint_names[j]) for j in np.flatnonzero(group))
                raise AssetError(
                    f"robot file {self.asset.path}: {names} are tied, and their ranges have no pose in common",
                    hint="widen their limits, or mend ratio and offset of the tie",
                )
            reached = np.sort(shift[group] + np.outer([low, high], ratio[group]), axis=0)
            self.lower[group], self.upper[group] = reached

    def _joined(
        self,
        ties: list[tuple[int, int, float, float]],
        before: tuple[list[int], list[float], list[float]] | None = None,
    ) -> tuple[list[int], list[float], list[float]]:
        """Return per joint its leader, and ratio and offset of q_joint = offset + ratio q_leader.

        Args:
            ties: Joint, leader, offset and ratio.
            before: Ties that hold already; others that they imply or contradict are left out. Without them, ties in a
                circle are refused.
        """
        count = self.model.njnt
        owner, ratio, shift = copy.deepcopy(before) if before else (list(range(count)), [1.0] * count, [0.0] * count)
        for joint, leader, offset, slope in ties:
            if owner[joint] == owner[leader] and before is not None:
                continue
            if owner[joint] == owner[leader]:
                names = f"{self.joint_names[joint]!r} and {self.joint_names[leader]!r}"
                raise AssetError(
                    f"robot file {self.asset.path}: {names} follow each other in a circle",
                    hint="take one of their ties (<mimic>, <equality>) out of the file",
                )
            # q_joint = offset + slope q_leader, in terms of the leader's own leader; then all that followed the joint.
            top, slope, offset = owner[leader], slope * ratio[leader], offset + slope * shift[leader]
            old, old_ratio, old_shift = owner[joint], ratio[joint], shift[joint]
            a, b = slope / old_ratio, (offset - old_shift) / old_ratio
            for j in range(count):
                if owner[j] == old:
                    owner[j], shift[j], ratio[j] = top, shift[j] + ratio[j] * b, ratio[j] * a
        return owner, ratio, shift

    def _transmission(self, a: int) -> dict[int, float]:
        """Return d(actuator length)/d(joint coordinate) of an actuator on a joint or a fixed tendon."""
        model, kind = self.model, self.mujoco.mjtTrn
        target, gear = int(model.actuator_trnid[a, 0]), float(model.actuator_gear[a, 0])
        transmission = int(model.actuator_trntype[a])
        if transmission in (int(kind.mjTRN_JOINT), int(kind.mjTRN_JOINTINPARENT)):
            return {target: gear}
        if transmission == int(kind.mjTRN_TENDON):
            wraps = range(model.tendon_adr[target], model.tendon_adr[target] + model.tendon_num[target])
            if all(int(model.wrap_type[w]) == int(self.mujoco.mjtWrap.mjWRAP_JOINT) for w in wraps):
                return {int(model.wrap_objid[w]): gear * float(model.wrap_prm[w]) for w in wraps}
        return {}

    def _joint_limit(self, j: int) -> float:
        """Return the largest actuator force on a joint."""
        limited = self.model.jnt_actfrclimited[j]
        return float(np.min(np.abs(self.model.jnt_actfrcrange[j]))) if limited else math.inf

    @functools.cached_property
    def _inertias(self) -> np.ndarray:
        """What each joint accelerates, the others held [kg or kg m^2], shape (joint_count,).

        In the home pose; where that is zero, also in a bent one: the larger number of both.
        """
        poses = [self.home(None)]
        if not any(self.at_home.values()):  # a straight arm: what its axes carry stands off them once it bends
            low, high = np.maximum(self.lower, -math.pi), np.minimum(self.upper, math.pi)
            hinge = self.model.jnt_type == int(self.mujoco.mjtJoint.mjJNT_HINGE)
            poses.append(np.where(hinge, np.clip(0.25 * math.pi, 0.75 * low + 0.25 * high, high), 0.0))
        masses = np.zeros((len(poses), self.model.nv, self.model.nv))
        for mass, pose in zip(masses, poses, strict=True):
            self.mujoco.mj_fullM(self.model, self.data(followed(pose, *self.bound)), mass)
        return masses.diagonal(axis1=1, axis2=2).max(axis=0)

    def _default_drive(self, j: int, limit: float) -> JointDrive:
        """Return a critically damped drive for a joint without servo."""
        mass, omega, loss = self._inertias[j], 2.0 * math.pi * self.bandwidth, self.model.dof_damping[j]
        # Against much viscous friction the joint would creep to its target; dry friction would hold it away from it.
        stiffness = float(max(mass * omega**2, 0.5 * loss * omega, self.model.dof_frictionloss[j] / _HELD_OFF))
        return JointDrive(
            stiffness=stiffness,
            damping=float(max(2.0 * mass * omega - loss, _LEAST_LAG * stiffness - loss, 0.0)),
            effort_limit=limit,
            lower=float(self.lower[j]),
            upper=float(self.upper[j]),
        )

    # -- gripper ------------------------------------------------------------------------------------------------------

    def gripper(
        self,
        given: Mapping[str, tuple[float, float]] | None,
        drives: tuple[JointDrive | None, ...],
        start: np.ndarray,
        link: int,
    ) -> tuple[RobotGripper | None, int]:
        """Return the gripper as given, or as found behind the end effector, and the link from which the hand begins."""
        palm = link
        if given is None:
            given, palm, notes = find_gripper(self, drives, start, link)
            self.notes += notes
            if given:
                self.notes.append(f"gripper {', '.join(map(repr, given))}: found by closing it")
        unknown = [name for name in given if name not in self.joint_names]
        if unknown:
            raise ConfigError(
                f"gripper names the joint {unknown[0]!r}, which robot {self.asset.name!r} does not have",
                hint=f"its joints are {', '.join(self.joint_names)}",
            )
        if not given:
            return None, link
        closed, wide = ([float(pair[k]) for pair in given.values()] for k in (0, 1))
        return RobotGripper(joints=tuple(given), closed=tuple(closed), open=tuple(wide)), palm
