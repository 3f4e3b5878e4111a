"""Allocation of what a step writes, once per solver."""

from typing import Any

import numpy as np
import warp as wp

from softmode.deformables.model.lane_kernels import vec8d
from softmode.deformables.model.struct_kernels import SLOTS, Entries, Motion, Points, Progress, Samples, vec6


def make_motion(functions: tuple[int, int], device: Any) -> Any:
    """Return the per-unknown data of a step for (instance_count, 3 block_count) blocks."""
    motion = Motion()
    for name in ("q_start", "qd_start", "q_rate", "q_inertial", "change", "force"):
        setattr(motion, name, wp.zeros(functions, dtype=vec8d, device=device))
    motion.rate = wp.ones(functions[0], dtype=wp.float64, device=device)
    return motion


def make_points(instance_count: int, point_max: int, device: Any) -> Any:
    """Return the results at the cubature points."""
    points, shape = Points(), (instance_count, point_max)
    points.energy = wp.zeros(shape, dtype=wp.float64, device=device)
    points.stress = wp.zeros(shape, dtype=wp.mat33d, device=device)
    points.hessian = wp.zeros((instance_count, 6, point_max), dtype=wp.mat33, device=device)
    points.volume_ratio = wp.ones(shape, dtype=float, device=device)
    return points


def make_samples(instance_count: int, sample_max: int, team: int, device: Any) -> Any:
    """Return the surface samples of a step and the contacts they find."""
    samples, shape = Samples(), (instance_count, sample_max)
    samples.position = wp.zeros(shape, dtype=wp.vec3d, device=device)
    samples.drift = wp.zeros(shape, dtype=wp.vec3, device=device)
    samples.shape = wp.zeros((*shape, SLOTS), dtype=int, device=device)
    samples.gap = wp.zeros((*shape, SLOTS), dtype=wp.float64, device=device)
    samples.normal = wp.zeros((*shape, SLOTS), dtype=wp.vec3, device=device)
    samples.entry = wp.full((*shape, SLOTS), -1, dtype=int, device=device)
    for name in ("lower", "upper", "drift_lower", "drift_upper"):
        setattr(samples, name, wp.zeros(instance_count, dtype=wp.vec3, device=device))
    samples.reach = wp.zeros((instance_count, team, 4), dtype=wp.vec3, device=device)
    samples.tally = wp.zeros((instance_count, team, 2), dtype=int, device=device)
    return samples


def make_entries(instance_count: int, entry_max: int, rigid_max: int, device: Any) -> Any:
    """Return the point constraints of a step."""
    entries, shape = Entries(), (instance_count, entry_max)
    entries.count, entries.pair_count = (wp.zeros(instance_count, dtype=int, device=device) for _ in range(2))
    for names, dtype in (
        (("row", "shape", "body", "dof_begin", "dof_end", "partner", "partner_row"), int),
        (("arm",), wp.vec3),
        (("normal", "offset", "force", "anchor", "slip"), wp.vec3d),
        (("stiffness", "friction", "stick", "normal_force", "energy"), wp.float64),
        (("hessian",), wp.mat33),
    ):
        for name in names:
            setattr(entries, name, wp.zeros(shape, dtype=dtype, device=device))
    for name in ("jacobian", "coupling"):
        setattr(entries, name, wp.zeros((*shape, max(rigid_max, 1)), dtype=wp.vec3, device=device))
    return entries


def make_progress(instance_start: np.ndarray, functions: tuple[int, int], device: Any) -> Any:
    """Return the state of Newton's iteration."""
    progress, world_count = Progress(), len(instance_start) - 1
    progress.instance_start = wp.array(instance_start, dtype=int, device=device)
    for name in (
        "active",
        "searching",
        "last",
        "touching",
        "renew",
        "project",
        "failures",
        "exact",
        "kept",
        "iteration",
        "status",
    ):
        setattr(progress, name, wp.zeros(world_count, dtype=int, device=device))
    for name in ("potential", "slope", "step_length", "reached"):
        setattr(progress, name, wp.zeros(world_count, dtype=wp.float64, device=device))
    progress.kept_q = wp.zeros(functions, dtype=vec8d, device=device)
    progress.kept_for = wp.zeros(functions[0], dtype=vec6, device=device)
    progress.any_active, progress.any_searching = (wp.zeros(1, dtype=int, device=device) for _ in range(2))
    return progress
