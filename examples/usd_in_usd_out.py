"""A stage with a soft cushion and a rigid block goes in, is simulated, and comes out as an animation in OpenUSD.

The stage below is text as other tools write it: a closed mesh with the deformable schemas of the AOUSD proposal, a
material bound for physics, a rigid body, and ground. Out come two files: the cushion as softmode reduced it, which
comes back to the bit, and an animation that holds handle matrices and the dents of contact, some kilobytes per frame.

Needs the extra usd. Run: ``python examples/usd_in_usd_out.py [FILE] [--short]``; writes ``out/usd_in_usd_out.*``
"""

import argparse
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp

from softmode.deformables import SolverCoupledReduced
from softmode.objects import Placed
from softmode.usd import UsdAnimation, UsdImport, add_usd, read_animation, write_usd

DT, STEPS, GRAVITY, BLOCK = 1.0 / 240.0, 8, 9.81, 0.3  # [s], per frame, [m/s^2], [kg]
CORNERS = [(x, y, z) for z in (-0.03, 0.03) for y in (-0.08, 0.08) for x in (-0.08, 0.08)]
FACES = "0, 2, 3, 1, 4, 5, 7, 6, 0, 1, 5, 4, 2, 6, 7, 3, 0, 4, 6, 2, 1, 3, 7, 5"
STAGE = f"""#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "World"
{{
    def Mesh "Cushion" (
        prepend apiSchemas = ["PhysicsDeformableBodyAPI", "PhysicsSurfaceDeformableSimAPI", "MaterialBindingAPI"]
    )
    {{
        int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
        int[] faceVertexIndices = [{FACES}]
        point3f[] points = {CORNERS}
        rel material:binding:physics = </World/Foam>
        color3f[] primvars:displayColor = [(0.2, 0.45, 0.8)]
        double3 xformOp:translate = (0, 0, 0.05)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
    def Material "Foam" (prepend apiSchemas = ["PhysicsVolumeDeformableMaterialAPI", "PhysicsMaterialAPI"])
    {{
        float physics:youngsModulus = 20000
        float physics:poissonsRatio = 0.3
        float physics:density = 100
        float physics:dynamicFriction = 0.7
    }}
    def Cube "Block" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "PhysicsMassAPI"])
    {{
        double size = 0.06
        float physics:mass = {BLOCK}
        double3 xformOp:translate = (0, 0, 0.16)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
}}
"""


def simulate(path: Path, out: Path, frames: int) -> tuple[Any, UsdImport, np.ndarray, float]:
    """Simulate a stage over a ground and record it; return solver, import, last surface and height of the block."""
    world = newton.ModelBuilder()
    world.add_ground_plane()
    found = add_usd(world, path)
    model: Any = world.finalize()
    solver = SolverCoupledReduced(model, found.reduced_bodies)
    state, after = model.state(), model.state()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    with UsdAnimation(out, model, list(found.bodies.values())) as film:
        for _ in range(frames):
            film.record(state)
            for _ in range(STEPS // 2):
                solver.step(state, after, None, None, DT)
                solver.step(after, state, None, None, DT)
        film.record(state)
    return solver, found, state.particle_q.numpy().copy(), float(state.body_q.numpy()[0, 2])


def test_final(solver: Any, found: UsdImport, points: np.ndarray, height: float, film: Path, kept: Path) -> None:
    """The block rests on the cushion, which carries both; the body comes back to the bit, the animation to rounding."""
    (cushion,) = found.bodies.values()
    weight = GRAVITY * cushion.material.density * cushion.body.volume
    pressed = float(solver.body_wrench.numpy()[0, 2])
    print(f"the block weighs {BLOCK * GRAVITY:.3f} N and presses with {pressed:.3f} N, {1e3 * height:.1f} mm high")
    assert abs(pressed / (BLOCK * GRAVITY) - 1.0) < 0.02
    net = solver.instance_force.numpy()[0]  # ground and block on the cushion
    np.testing.assert_allclose(net, (0.0, 0.0, weight), atol=0.02 * weight)
    assert 0.08 < height < 0.09 and abs(points[:, 2].min()) < 5.0e-4
    assert not solver.status.numpy()[0]
    again = add_usd(newton.ModelBuilder(), kept).bodies["/World/Cushion"]
    assert again.body.fingerprint == cushion.body.fingerprint and again.material == cushion.material
    assert again.splats is not None and cushion.splats is not None
    np.testing.assert_array_equal(again.splats.means, cushion.splats.means)
    np.testing.assert_allclose(read_animation(film).bodies[0].points_at(-1), points, atol=1e-6)


def main(arguments: list[str] | None = None) -> None:
    """Write the stage, simulate it, export."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--short", action="store_true", help="1 s instead of 2 s")
    frames = 30 if parser.parse_args(arguments).short else 60
    wp.config.log_level = wp.LOG_WARNING
    stage, film, kept = (Path("out", f"usd_in_usd_out{end}") for end in (".usda", ".film.usdc", ".body.usdc"))
    stage.parent.mkdir(exist_ok=True)
    stage.write_text(STAGE)
    solver, found, points, height = simulate(stage, film, frames)
    (cushion,) = found.bodies.values()
    write_usd(kept, Placed(object=cushion.object, name="Cushion"))
    for file in (stage, film, kept):
        print(f"{file}: {1e-3 * file.stat().st_size:.0f} kB")
    test_final(solver, found, points, height, film, kept)


if __name__ == "__main__":
    main()
