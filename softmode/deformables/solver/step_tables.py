"""The tables of a step, allocated once: what every phase reads and writes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.contact.cell_kernels import Surface
from softmode.deformables.contact.dents import sample_room, surface_table
from softmode.deformables.contact.detection_kernels import Shapes
from softmode.deformables.contact.pairs import SoftPairs
from softmode.deformables.contact.shape_tables import candidate_shapes, shape_table
from softmode.deformables.model.beside import Beside
from softmode.deformables.model.declare import WRENCH, Kernel, launch, launch_teams
from softmode.deformables.model.lane_kernels import LANES, WARP, team_size
from softmode.deformables.model.layout import Layout, lay_out, lay_out_bases, lay_out_instances, surface_stiffness
from softmode.deformables.model.namespaces import SoftModel, soft
from softmode.deformables.model.newton_step_kernels import NewtonArrays, NewtonOptions, NewtonStep
from softmode.deformables.model.rigid_dofs import RigidDofs
from softmode.deformables.model.scaled_quantities import ScaledQuantities
from softmode.deformables.model.struct_kernels import (
    SLOTS,
    Basis,
    Instances,
    Motion,
    NewtonState,
    PointConstraints,
    Points,
    Samples,
)
from softmode.deformables.model.tables import allocate
from softmode.deformables.newton import one_launch_kernels as fused
from softmode.deformables.newton.round_kernels import BESIDE, LEVELS
from softmode.deformables.potential.spin_kernels import Spin
from softmode.deformables.solver.options import SolverReducedOptions
from softmode.deformables.system.assembly_cpu_kernels import cache_slabs
from softmode.deformables.system.factor import BlockCholesky
from softmode.deformables.system.shared_system_kernels import shared_bytes
from softmode.deformables.system.systems import join_systems
from softmode.deformables.system.tile_kernels import TILE, chunk_count
from softmode.errors import ConfigError

CUDA_THREADS = 2**16
"""Threads that keep a GPU busy: sums over points are split until there are about so many."""
ONE_LAUNCH_BLOCKS = 7
"""Blocks of eight functions up to which a body is small enough for a team of threads on CUDA; on CPU any is."""
ROUNDS = 10
"""Most rounds of launches before the one launch where worlds are many: measured, see ``benchmarks/JOURNAL.md``.

The one launch alone loses 16 and 9 % of the steps (plush, grasps and random actions of 4,096 worlds on one H200), 10
and 7 % (beam)."""
ROUND_WORLDS = 12
"""Worlds for each multiprocessor from which on they are many."""
FEW_WORLDS = 64
"""Bodies up to which those of many functions get larger teams, and more and smaller blocks of threads, on CUDA."""
LARGE_TEAM = 256
"""Threads of these teams."""
LARGE_BLOCK = 128
"""Threads of these blocks."""
RESERVED_BYTES = 12 * 1024
"""Shared memory that the one launch needs besides its system, with what CUDA keeps for itself."""

_POINTS = {"": "instance point", "hessian": "instance 6 point"}
_MOTION = {"": "instance unknown", "rate": "instance"}
_SAMPLES = {
    "position drift near": "instance sample",
    "shape gap normal part constraint": "instance sample slot",
    "lower upper drift_lower drift_upper": "instance",
    "reach": "instance team 4",
    "tally": "instance team 2",
}
_CONSTRAINTS = {
    "": "instance constraint",
    "count pair_count acting_count": "instance",
    "jacobian coupling": "instance constraint rigid",
}
_NEWTON = {
    "": "world",
    "cached_q": "instance unknown",
    "cached_key": "instance",
    "any_active any_searching any_left rounds_left": "1",
    "level_count": f"{LEVELS}",
}
_ARRAYS = {
    "": "instance unknown",
    "gradient_chunk": "instance gradient_chunk unknown",
    "stiffness": "instance stiffness_chunk row unknown",
    "pins": "pin_instance pin_row pin_block",
    "turn turn_centre turn_shift": "instance",
}
FILLED = {"rate": 1, "volume_ratio": 1, "constraint": -1, "near": -1}
"""What arrays of motion, points and samples hold at the start, where that is not zero."""


@dataclass(frozen=True, eq=False)
class StepTables:
    """What the phases of a step read and write, one owner per solver; allocated once and never replaced."""

    model: newton.Model
    """The model."""
    options: SolverReducedOptions
    """How the step is solved."""
    layout: Layout
    """Counts, and which body is where."""
    instances: Instances
    """Where instances find their data, and their parameters."""
    basis: Basis
    """The bases of all bodies."""
    scaled: ScaledQuantities
    """What follows from density and scale."""
    motion: Motion
    """The motion of the step per unknown."""
    spin: Spin
    """How each instance turns in the step."""
    points: Points
    """Results at the cubature points."""
    samples: Samples
    """Surface samples and what they found."""
    constraints: PointConstraints
    """Pins and contacts."""
    newton: NewtonState
    """Where Newton's iteration stands."""
    arrays: NewtonArrays
    """Iterates, gradient, Hessian and the linear systems."""
    step: NewtonStep
    """All of these, for Newton's kernels."""
    rigid: RigidDofs
    """Joint dofs that take part in the solve."""
    surface: Surface
    """What contact knows of the surface samples of all bodies."""
    shapes: Shapes
    """The rigid shapes."""
    meshes: list[Any]
    """What keeps the meshes of ``shapes`` alive."""
    candidate: wp.array
    """Shapes that each instance may touch, int (instance_count, candidate_max); -1 pads."""
    near: wp.array
    """Which of them are near in this step, likewise."""
    pairs: SoftPairs | None
    """Contact between soft bodies, None where there is never any."""
    system: BlockCholesky
    """The linear systems."""
    body_wrench: wp.array
    """Contact wrench on every rigid body about its centre of mass [N, N m], (body_count,)."""
    instance_force: wp.array
    """Contact force on every soft body [N], vec3d (instance_count,)."""
    parameter_flags: wp.array
    """What :func:`softmode.deformables.tools.parameters.set_parameters` had to clamp, int (instance_count,)."""
    every_world: wp.array
    """The mask that selects all worlds, bool (world_count + 1,)."""
    team: int
    """Threads that share one system."""
    lanes: int
    """Threads that share a point or a constraint in a launch per phase: one, or on CUDA a warp."""
    block: int
    """Threads of a block on CUDA where a launch does not say."""
    one_launch: bool
    """Whether a team of threads, on CPU one, takes a world through all of its Newton iterations in one launch."""
    fused_kernel: Kernel
    """The kernel of that launch."""
    world_team: int
    """Threads of that team."""
    round_team: int
    """Threads of the team that takes a world through a round."""
    rounds: int
    """Most rounds of launches before it, which take worlds through their first iterations; 0 where there are none."""
    held: int
    """Worlds that the one launch takes at a time: no more rounds where no more worlds are left."""
    beside: Beside
    """Takes launches that do not wait for those which follow them."""
    room: int
    """Most worlds that go beside the rounds."""
    shared: bool
    """Whether the systems of that launch are assembled and solved in shared memory."""
    tiled: bool
    """Whether elastic stiffness is assembled by tiles of functions, see ``tile_kernels``."""

    @property
    def parameters(self) -> SoftModel:
        """Parameters, initial state and targets of the soft bodies, ``model.softmode``."""
        return soft(self.model)

    @property
    def notes(self) -> tuple[str, ...]:
        """What keeps Newton's iteration from its fast path on a GPU, a sentence each; none on a CPU."""
        if not self.model.device.is_cuda:
            return ()
        return newton_notes(
            self.system.size, one_launch=self.one_launch, shared=self.shared, by_panels=self.system.by_panels
        )

    @property
    def unknowns(self) -> tuple[int, int]:
        """Shape of an array over the unknowns in blocks of eight."""
        return self.layout.instance_count, 3 * self.layout.block_count

    @property
    def point_tasks(self) -> tuple[int, int]:
        """Shape of a launch over the points: on CPU a thread takes eight of them."""
        return self._tasks(self.layout.point_max)

    @property
    def sample_tasks(self) -> tuple[int, int]:
        """Shape of a launch that evaluates the functions at the samples: on CPU a thread takes eight of them."""
        return self._tasks(self.layout.sample_max)

    def _tasks(self, count: int) -> tuple[int, int]:
        return self.layout.instance_count, count if self.model.device.is_cuda else -(-count // LANES)

    @property
    def pin_arrays(self) -> tuple[wp.array | None, wp.array | None]:
        """Which rigid bodies the pins follow and how stiffly, None where there are no pins."""
        return getattr(self.parameters, "pin_body", None), getattr(self.parameters, "pin_stiffness", None)

    def newton_step(self, dt: float) -> NewtonStep:
        """Return what Newton's iteration reads and writes in a step of ``dt`` [s]."""
        self.step.options.dt, self.step.options.stick_range = dt, self.options.stick_velocity * dt
        return self.step

    def launch(self, kernel: Kernel, dim: int | Sequence[int], *arguments: object, block_dim: int = 0) -> None:
        """Launch a kernel on the model's device; see :func:`softmode.deformables.model.declare.launch`."""
        launch(self.model.device, kernel, dim, *arguments, block_dim=block_dim or self.block)

    def launch_teams(self, kernel: Kernel, count: int, *arguments: object) -> None:
        """Launch one team of threads per world or instance, each in a block of its own."""
        launch_teams(self.model.device, kernel, count, self.team, *arguments)


def allocate_tables(
    model: newton.Model, bodies: Sequence[ReducedBody], options: SolverReducedOptions, rigid: RigidDofs
) -> StepTables:
    """Allocate everything that the steps of a model need.

    Args:
        model: Finalised model that holds reduced bodies.
        bodies: Its bodies, in any order.
        options: How a step is solved.
        rigid: Joint dofs that take part in the solve.

    Raises:
        ConfigError: If a body of the model is not among ``bodies``, a shape cannot be touched, or contact_max is less
            than what the samples of a body need.
    """
    device = model.device
    wanted = max((sample_room(body, options.contact_margin) for body in bodies), default=0)
    room = options.contact_room(wanted)
    layout = lay_out(model, bodies, pair_max=room // 2 if options.soft_contact else 0)
    if room < wanted and (model.shape_count or layout.pair_max):
        raise ConfigError(
            f"contact_max is {room}, and {wanted} samples of a body may touch something at a time",
            hint=f"give contact_max={wanted} or more, or None, which has room for all; or build with fewer samples",
        )
    row_max = room + layout.pin_max if model.shape_count else 0
    instances, basis = lay_out_instances(model, layout), lay_out_bases(model, layout, row_max)
    scaled = ScaledQuantities(
        model,
        layout,
        instances,
        tolerance=options.tolerance,
        margin=options.contact_margin,
        smoothing=options.contact_smoothing,
    )
    candidate = wp.array(candidate_shapes(model, layout), dtype=int, device=device)
    shapes, meshes = shape_table(model)
    first_row = layout.first_pin_row + int(layout.pin_count.sum())
    surface = surface_table(layout.bodies, surface_stiffness(layout.bodies), first_row, row_max, device)
    pairs = None
    if layout.pair_max:
        pairs = SoftPairs(layout, instances, basis, options.stick_ratio, scaled.spacing, surface, device)
    system_start, system = join_systems(layout, instances, rigid.count_max + 1, device)

    blocks, count, square = layout.block_count, layout.instance_count, 3 * layout.block_count**2
    joined = layout.part_count > 1
    one_launch = device.is_cpu or (not joined and blocks <= ONE_LAUNCH_BLOCKS)
    one_each = count == layout.world_count and layout.pin_max == 0
    driven = any(body.driven_count for body in layout.bodies)
    round_team = fused.team_of(layout.point_max, layout.world_count, device)
    size = (3 * layout.stride, 3 * layout.stride + 4 * -(-(rigid.count_max + 1) // 4))
    shared = device.is_cuda and one_launch and one_each and not driven
    shared = shared and fits_in_shared_memory(device.max_shared_memory_per_block, *size)
    tiled = device.is_cuda and not one_launch and layout.stride >= TILE
    few = tiled and count <= FEW_WORLDS
    rounds = ROUNDS if shared and layout.world_count >= ROUND_WORLDS * device.sm_count else 0
    world_team = fused.TAIL_TEAM if rounds and round_team == fused.SMALL_TEAM else round_team

    def chunks(threads: int, tasks: int) -> int:
        """Return into how many parts sums over points are split where a kernel has so many threads, a body tasks."""
        if rounds or not device.is_cuda:
            return 1
        return int(np.clip(world_team // tasks if one_launch else CUDA_THREADS // threads, 1, 64 if few else 16))

    sizes = {
        "instance": count,
        "world": layout.world_count,
        "unknown": 3 * blocks,
        "row": 3 * layout.stride,
        "point": layout.point_max,
        "sample": layout.sample_max,
        "slot": SLOTS,
        "team": LARGE_TEAM if few else team_size(device),
        "constraint": room + layout.pin_max,
        "rigid": rigid.count_max,
        "gradient_chunk": world_team // WARP if shared else chunks(count * blocks, blocks),
        "stiffness_chunk": chunk_count(count, layout.stride)
        if tiled
        else chunks(count * square, square + (square + 3 * blocks) // 2),
        "pin_instance": count if layout.pin_max else 1,
        "pin_row": layout.stride if layout.pin_max else 1,
        "pin_block": blocks if layout.pin_max else 1,
    }
    given = {"instance_start": layout.instance_start, "friction_lag": options.friction_lag}
    of_system = {"rigid_tolerance": scaled.rigid_tolerance, "system_start": system_start, "systems": system.table}
    if layout.part_count == 1:
        of_system["direction"] = system.table.solution
    structs: dict[str, Any] = {
        "instances": instances,
        "basis": basis,
        "motion": allocate(Motion, _MOTION, sizes, device, fill=FILLED),
        "points": allocate(Points, _POINTS, sizes, device, fill=FILLED),
        "constraints": allocate(PointConstraints, _CONSTRAINTS, sizes, device),
        "arrays": allocate(NewtonArrays, _ARRAYS, sizes, device, given=of_system),
    }
    state = allocate(NewtonState, _NEWTON, sizes, device, given=given)
    constant = _newton_options(options, rigid, system, slabs=cache_slabs(blocks, layout.point_max))
    step = allocate(
        NewtonStep, "", {}, device, given={**structs, "rigid": rigid.table, "state": state, "options": constant}
    )
    return StepTables(
        model=model,
        options=options,
        layout=layout,
        scaled=scaled,
        samples=allocate(Samples, _SAMPLES, sizes, device, fill=FILLED),
        **structs,
        spin=allocate(Spin, "instance", sizes, device),
        newton=state,
        step=step,
        rigid=rigid,
        surface=surface,
        shapes=shapes,
        meshes=meshes,
        candidate=candidate,
        near=wp.zeros_like(candidate),
        pairs=pairs,
        system=system,
        body_wrench=wp.zeros(max(model.body_count, 1), dtype=WRENCH, device=device),
        instance_force=wp.zeros(count, dtype=wp.vec3d, device=device),
        parameter_flags=wp.zeros(count, dtype=int, device=device),
        every_world=wp.full(layout.world_count + 1, True, dtype=bool, device=device),
        team=sizes["team"],
        lanes=WARP if few else 1,
        block=LARGE_BLOCK if few else 256,
        one_launch=one_launch,
        fused_kernel=fused.newton_kernel(
            system.unit.dtype, *(size if shared else ()), team=world_team, joined=joined and device.is_cpu
        ),
        world_team=world_team,
        round_team=round_team,
        shared=shared,
        rounds=rounds,
        held=fused.held_at_a_time(world_team, device),
        beside=Beside(device),
        room=BESIDE * device.sm_count if device.is_cuda else 0,
        tiled=tiled,
    )


def newton_notes(size: int, *, one_launch: bool, shared: bool, by_panels: bool = False) -> tuple[str, ...]:
    """Return why systems of ``size`` unknowns are not solved in shared memory, all iterations in one launch."""
    if not one_launch:
        most = LANES * ONE_LAUNCH_BLOCKS
        note = (
            f"systems of {size} unknowns take a launch per phase of each Newton iteration: "
            f"one launch takes worlds whose bodies do not touch each other and have at most {most} functions"
        )
        if by_panels:
            note += "; the whole device shares a system, panel by panel"
        return (note,)
    if not shared:
        return (
            f"systems of {size} unknowns are solved in global memory: shared memory takes one body per world, "
            "without pins and driven regions",
        )
    return ()


def fits_in_shared_memory(room: int, size: int, width: int) -> bool:
    """Return whether a block with ``room`` bytes can hold a system of ``size`` unknowns and ``width`` columns."""
    return shared_bytes(size, width) + RESERVED_BYTES <= room


def _newton_options(
    options: SolverReducedOptions, rigid: RigidDofs, system: BlockCholesky, *, slabs: int
) -> NewtonOptions:
    """Return the options of Newton's iteration that do not depend on the length of a step."""
    given = NewtonOptions()
    for name in ("iteration_max", "force_tolerance", "step_length_min"):
        setattr(given, name, getattr(options, name))
    given.refresh_interval, given.refresh_distance = options.stiffness_renewal, options.renewal_distance
    given.rigid_max, given.factor_width = rigid.count_max, system.width
    given.stiffness_slabs = slabs
    return given
