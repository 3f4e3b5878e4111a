"""Time one implicit step of the beam of the accuracy page, its stages, and how it scales; print the floor beside it.

Run: ``python benchmarks/step.py`` (CPU, one core) or ``python benchmarks/step.py --device cuda:0 --worlds 1 64 1024
4096``. Beam 5 x 1 x 1 m, E = 5e6 Pa, nu = 0.45, 1000 kg/m^3, 0.5 m of it clamped by pins, gravity, dt = 0.01 s, no
contact; replicated worlds share the basis. Medians over replays of a captured graph while the beam swings.

The floor is the arithmetic of a Newton iteration, 27 n^2 P flops of assembly and (3n)^3/3 of Cholesky for n functions
and P points, at the rate of a large float32 matrix product measured in the same run. On CUDA the same two pieces are
also timed with torch: six batched products per instance and ``torch.linalg.cholesky``.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from typing import Any

import newton
import numpy as np
import warp as wp

from benchmarks.clock import Clock, held, replayed
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.deformables.model.authoring import add_pins, add_reduced_body, register_custom_attributes
from softmode.deformables.quadrature.quadrature import quadrature_from_box
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.solver.evaluate import assemble, evaluate, evaluate_trial, gather_gradient
from softmode.deformables.solver.minimise import accept_step, check_convergence, start_line_search
from softmode.deformables.solver.solver_reduced import SolverReduced, SolverReducedOptions

SIZE = (5.0, 1.0, 1.0)
CLAMP_LENGTH = 0.5
CLAMP_STIFFNESS = 1.0e9
"""Pin stiffness per volume of the clamp [N/m^4]."""
DT = 0.01


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--modes", type=int, nargs="+", default=[8, 16])
    parser.add_argument("--points", type=int, nargs="+", default=[256])
    parser.add_argument("--bodies", type=int, nargs="+", default=[1])
    parser.add_argument("--stages", action="store_true", help="time every stage of a step too")
    parser.add_argument("--blocks", action="store_true", help="stiffness of large bodies without tiles (CUDA)")
    parser.add_argument("--repeats", type=int, default=50)
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    rate = product_rate(options.device)
    print(f"{options.device}: float32 matrix product {rate / 1e9:.0f} Gflop/s in this run")
    print("modes functions points worlds bodies | ms/step iterations ms/iteration floor ms | kB/world status")
    for modes in options.modes:
        for points in options.points:
            body = beam(modes, points)
            for worlds in options.worlds:
                for count in options.bodies:
                    scene = Beam(body, worlds, count, options.device, blocks=options.blocks)
                    scene.report(options.repeats, rate)
                    if options.stages:
                        scene.report_stages(options.repeats)
                    if scene.device.is_cuda:
                        report_torch(body, worlds * count, options.repeats)
                    del scene


def beam(mode_count: int, point_count: int) -> ReducedBody:
    """Return the reduced beam."""
    quadrature = quadrature_from_box(SIZE, point_count=5000, surface_count=100)
    options = BuildOptions(mode_count=mode_count, kernel_count=1000, cubature_count=point_count)
    return build_body(quadrature, options, name=f"beam {mode_count}", progress=False)


class Beam:
    """Replicated clamped beams and two captured steps."""

    def __init__(
        self, body: ReducedBody, world_count: int, body_count: int, device: str, *, blocks: bool = False
    ) -> None:
        """Build the model, step until the beam moves, and record a pair of steps."""
        self.body, self.device = body, wp.get_device(device)
        self.world_count = world_count
        world = newton.ModelBuilder()
        material = Material(
            youngs_modulus=5.0e6,
            poissons_ratio=0.45,
            density=1000.0,
            viscosity=0.0,
            model=MaterialModel.STABLE_NEO_HOOKEAN,
        )
        clamp = body.cubature.points[:, 0] < body.bounds[0, 0] + CLAMP_LENGTH
        for _ in range(body_count):
            instance = add_reduced_body(world, body, material=material)
            add_pins(
                world, instance, body.cubature.points[clamp], stiffness=CLAMP_STIFFNESS * body.cubature.weights[clamp]
            )
        builder = newton.ModelBuilder()
        register_custom_attributes(builder)
        builder.replicate(world, world_count)
        before = held(self.device)
        model = builder.finalize(device=device)
        model.set_gravity((0.0, 0.0, -9.81))
        self.solver = SolverReduced(model, [body], options=SolverReducedOptions(contact_max=1))
        if blocks:
            self.solver.tables = dataclasses.replace(self.solver.tables, tiled=False)
        self.states = model.state(), model.state()
        self.control = model.control()
        self.memory = held(self.device) - before
        self.play = replayed(self._two_steps, self.device)
        self.play(20)

    def report(self, repeats: int, rate: float) -> None:
        """Print one row."""
        times, iterations, clock = [], [], Clock(self.device, repeats)
        for _ in range(repeats):
            times.append(0.5 * clock.once(lambda: self.play(1)))
            iterations.append(self.solver.iteration.numpy().max())
        n, points = self.body.function_count, self.body.point_count
        flops = 27.0 * n**2 * points + (3 * n) ** 3 / 3.0
        floor = 1e3 * self.solver.instance_count * flops / rate
        step, count = float(np.median(times)), float(np.mean(iterations))
        bodies = self.solver.instance_count // self.world_count
        print(
            f"{self.body.mode_count:5d} {n:9d} {points:6d} {self.world_count:6d} {bodies:6d} | "
            f"{step:7.3f} {count:10.2f} {step / count:12.3f} {floor:8.3f} | "
            f"{self.memory / self.world_count / 1e3:8.0f} {int(self.solver.status.numpy().max()):6d}",
            flush=True,
        )

    def report_stages(self, repeats: int) -> None:
        """Print the time of every stage, each captured on its own."""
        for name, run in stages(self.solver, *self.states, self.control, DT).items():
            print(f"    {name:<32}{Clock(self.device, repeats).replay(run):8.3f} ms")

    def _two_steps(self) -> None:
        first, second = self.states
        self.solver.step(first, second, self.control, None, DT)
        self.solver.step(second, first, self.control, None, DT)


def stages(
    solver: SolverReduced, state: newton.State, other: newton.State, control: newton.Control, dt: float
) -> dict[str, Callable[[], None]]:
    """Return the stages of a step from one state to another; all worlds take part in each."""
    tables, progress = solver.tables, solver.tables.newton
    rigid = tables.rigid.count_max, tables.rigid.table.direction, tables.rigid.count_max

    def stage(run: Callable[[], object], *, renewed: bool = False) -> Callable[[], None]:
        def prepared() -> None:
            progress.active.fill_(1)
            progress.searching.fill_(1)
            progress.refresh.fill_(int(renewed))
            progress.evaluated.zero_()
            run()

        return prepared

    return {
        "four fills (in every row below)": stage(lambda: None),
        "begin": stage(lambda: solver.begin(state, control, dt)),
        "detect": stage(lambda: solver.detect(state, control, dt, prescribed=True)),
        "evaluate with Hessian": stage(lambda: evaluate(tables, dt, derivatives=True), renewed=True),
        "evaluate with gradient": stage(lambda: evaluate(tables, dt, derivatives=True)),
        "evaluate energy": stage(lambda: evaluate(tables, dt, derivatives=False)),
        "gather gradient": stage(lambda: gather_gradient(tables, dt)),
        "check convergence": stage(lambda: check_convergence(tables, dt)),
        "assemble with stiffness": stage(lambda: assemble(tables, dt), renewed=True),
        "assemble": stage(lambda: assemble(tables, dt)),
        "factor": stage(lambda: tables.system.factor(progress.active)),
        "solve": stage(lambda: tables.system.solve(progress.active, *rigid)),
        "start line search": stage(lambda: start_line_search(tables, dt)),
        "evaluate trial": stage(lambda: evaluate_trial(tables, dt)),
        "accept step": stage(lambda: accept_step(tables, dt)),
        "finish": stage(lambda: solver.finish(other, dt)),
    }


def product_rate(device: str) -> float:
    """Return the rate of a large float32 matrix product [flop/s], one core on CPU."""
    size, best = (2048, np.inf)
    if not wp.get_device(device).is_cuda:
        from threadpoolctl import threadpool_limits

        a = np.ones((size, size), np.float32)
        with threadpool_limits(1):
            for _ in range(4):
                start = time.process_time()
                np.matmul(a, a)
                best = min(best, time.process_time() - start)
        return 2.0 * size**3 / best
    import torch

    size = 8192
    a = torch.ones((size, size), device=device)
    for _ in range(4):
        torch.cuda.synchronize()
        start = time.perf_counter()
        torch.matmul(a, a)
        torch.cuda.synchronize()
        best = min(best, time.perf_counter() - start)
    return 2.0 * size**3 / best


def report_torch(body: ReducedBody, system_count: int, repeats: int) -> None:
    """Time assembly and factorisation of as many systems with torch's batched product and Cholesky."""
    import torch

    n, p = body.function_count, body.point_count
    left = torch.rand((system_count, n, 3 * p), device="cuda")
    right = torch.rand((system_count, 3 * p, n), device="cuda")
    block = torch.empty((system_count, n, n), device="cuda")
    matrix = torch.eye(3 * n, device="cuda").repeat(system_count, 1, 1) + 0.01

    def assemble() -> None:
        for _ in range(6):
            torch.bmm(left, right, out=block)

    def timed(run: Callable[[], Any]) -> float:
        return Clock("cuda", max(repeats // 5, 3)).median(lambda: (run(), torch.cuda.synchronize()))

    print(
        f"    torch: six batched products {timed(assemble):.3f} ms, "
        f"cholesky {timed(lambda: torch.linalg.cholesky(matrix)):.3f} ms"
    )


if __name__ == "__main__":
    main()
