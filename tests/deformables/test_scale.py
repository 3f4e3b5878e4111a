"""A body of scale s: equal to the body built at that size, in statics, impact, contact, grasps and gradients.

Builds one body at twice the size, to compare with the enlarged one.
"""

import dataclasses

import numpy as np
import pytest
import warp as wp

from softmode.deformables.gradients.adjoint import AdjointReduced
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_pins, add_reduced_body, drive_regions
from softmode.deformables.model.lane_kernels import from_blocks
from softmode.deformables.quadrature.quadrature import quadrature_from_box
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.skinning.skin_splats import SkinSplats
from softmode.deformables.solver.attachments import attach
from softmode.deformables.solver.evaluate import assemble, gather_gradient
from softmode.deformables.solver.evaluate import evaluate as evaluate_step
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from softmode.deformables.tools.markers import Markers
from softmode.deformables.tools.sensing import ContactSensor, SurfacePressure
from softmode.errors import ConfigError
from tests.bodies import changed, clamped, cube, ring
from tests.deformables.affine_body import affine_cube, mean_gradient
from tests.deformables.test_adjoint import EXACT
from tests.scenes import GRAVITY, GRIPPER, Scene, add_gripper, rotation

FLOAT32 = float(np.finfo(np.float32).eps)
EDGE = 0.1
DOWN = (0.0, 0.0, -GRAVITY)
SCALES = (0.7, 1.3)
FINE = SolverReducedOptions(tolerance=1.0e-10, force_tolerance=1.0e-10)
"""Newton's tolerance out of the comparison: what is left is the rounding of the float32 tables."""
SOFT = Material(youngs_modulus=3.0e4, poissons_ratio=0.4, density=500.0, viscosity=0.004)

BOUNCY = dataclasses.replace(SOFT, youngs_modulus=1.0e5, viscosity=0.0)


def stored(s):
    """Return a scale as the model stores it."""
    return float(np.float32(s))


def enlarged(body, s):
    """Return the body that a build of the same object, s times as large, gives: every array by its dimension."""
    powers = {
        "points": 1, "weights": 3, "grad_basis": -1, "surface_points": 1, "surface_areas": 2, "volume": 3,
        "eigenvalues": -2, "bounds": 1, "offset": 1, "centres": 1, "radii": 1, "length": 1, "region_stiffness": -2,
        "region_radii": 1, "region_cores": 1, "region_points": 1, "region_weights": 3, "material_points": 1,
        "material_frame": -1, "detour_lengths": 1,
    }  # fmt: skip
    changes = {}
    for name, power in powers.items():
        value = body.flat()[name]
        changes[name] = value * s**power if np.isscalar(value) else (value * s**power).astype(value.dtype)
    factors = np.array([s, s, s, 1.0])
    changes |= {name: body.flat()[name] * factors for name in ("linear_coordinates", "drive_affine")}
    return changed(body, **changes, fingerprint=f"{body.fingerprint}, {s} times as large")


ROUNDING = 8 * FLOAT32
"""Difference of positions over the size where nothing amplifies it: both tables are float32, their sums of n terms."""


def both(populate, body, s, **options):
    """Return scenes of a body of scale s and of the body built at that size."""
    s = stored(s)
    scaled = Scene(lambda world: populate(world, body, s), [body], **options)
    large = enlarged(body, s)
    return scaled, Scene(lambda world: populate(world, large, 1.0), [large], **options)


def particles(scene):
    """Return the surface samples [m]."""
    return scene.state.particle_q.numpy().astype(float)


# -- what a build gives ------------------------------------------------------------------------------------------------


def test_build_at_twice_the_size():
    """Twice the quadrature gives the body that ``enlarged`` gives: powers of two change no rounding, so to the bit."""
    body = cube()
    quadrature = quadrature_from_box((EDGE,) * 3, point_count=1000, surface_count=150)
    powers = {
        "points": 1,
        "weights": 3,
        "spacing": 1,
        "surface_points": 1,
        "surface_areas": 2,
        "volume": 3,
        "bounds": 1,
    }
    large = dataclasses.replace(quadrature, **{name: 2.0**p * getattr(quadrature, name) for name, p in powers.items()})
    built = build_body(large, BuildOptions(mode_count=4, kernel_count=150, cubature_count=128), name="twice")
    twin = enlarged(body, 2.0)
    for name in (
        "points",
        "surface_points",
        "centres",
        "radii",
        "mean_basis",
        "surface_basis",
        "grad_basis",
        "weights",
    ):
        value = twin.flat()[name]
        np.testing.assert_allclose(built.flat()[name], value, rtol=1e-6, atol=1e-6 * np.abs(value).max(), err_msg=name)


# -- identities --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("s", [0.25, 0.7, 1.3, 4.0])
def test_rest_is_rest(s):
    """At x = R s X + p the body is without stress, its samples stand there, and it stays: F/s = R to rounding."""
    R, p = rotation((1, 2, 3), 0.7), np.array([0.3, -0.2, 1.1])
    scene = Scene(lambda world: add_reduced_body(world, cube(), rotation=R, position=p, scale=s), [cube()])
    s = stored(s)
    np.testing.assert_allclose(particles(scene), s * cube().surface.points @ R.T + p, atol=4 * FLOAT32)
    start = scene.q()
    scene.step(5)
    np.testing.assert_allclose(particles(scene), s * cube().surface.points @ R.T + p, atol=ROUNDING * s * EDGE + 2e-7)
    assert np.linalg.norm(scene.q() - start) < ROUNDING * s * EDGE


def test_masses_and_sizes():
    """Volume s^3, area s^2, lengths s; particles have their share of the mass and half their spacing as radius."""
    s = stored(1.3)
    one = Scene(lambda world: add_reduced_body(world, cube()), [cube()])
    two = Scene(lambda world: add_reduced_body(world, cube(), scale=1.3), [cube()])
    powers = {"mass": 3, "area": 2, "size": 1, "tolerance": 1, "margin": 1, "smoothing": 1, "inertia": 2}
    for name, power in powers.items():
        first, second = (getattr(x.reduced.view.instances, name).numpy()[0] for x in (one, two))
        assert second == pytest.approx(s**power * first, rel=4 * FLOAT32), name
    for name, power in (("particle_mass", 3), ("particle_inv_mass", -3), ("particle_radius", 1)):
        first, second = (getattr(x.model, name).numpy() for x in (one, two))
        np.testing.assert_allclose(second, s**power * first, rtol=8 * FLOAT32)
    assert two.model.particle_mass.numpy().sum() == pytest.approx(two.mass(), rel=1e-5)
    assert two.reduced.view.rigid_tolerance.numpy()[0] == pytest.approx(
        s * one.reduced.view.rigid_tolerance.numpy()[0], rel=1e-6
    )


def evaluate(scene, q):
    """Evaluate the elastic energy [J], the forces of points [N] and the stiffness [N/m] at coordinates q (n, 3)."""
    solver, n = scene.reduced, scene.body().function_count
    scene.set(q=q)
    solver.begin(scene.state, scene.control, scene.dt)
    solver.detect(scene.state, scene.control, scene.dt, prescribed=True)
    for flag in (solver.tables.newton.active, solver.tables.newton.refresh):
        flag.fill_(1)
    solver.tables.newton.project.zero_()
    blocks = solver.view.motion.q_start
    wp.copy(solver.tables.arrays.q, blocks)
    evaluate_step(solver.tables, scene.dt, derivatives=True)
    gather_gradient(solver.tables, scene.dt)
    assemble(solver.tables, scene.dt)
    force = from_blocks(solver.tables.arrays.gradient_chunk.numpy()[0].sum(axis=0), n)
    upper = solver.tables.arrays.stiffness.numpy()[0].sum(axis=0)
    size, stride = 3 * solver.view.layout.stride, solver.view.layout.stride
    matrix = np.triu(upper.reshape(size, size).astype(float))
    matrix = matrix + matrix.T - np.diag(np.diag(matrix))
    keep = np.concatenate([axis * stride + np.arange(n) for axis in range(3)])
    return float(solver.view.points.energy.numpy()[0].sum()), force, matrix[np.ix_(keep, keep)]


def deformed(s, seed=0):
    """Return random coordinates of a scaled cube, strains of about 10 %."""
    rng = np.random.default_rng(seed)
    R = rotation((1, -2, 0.5), 0.6)
    return cube().affine(s * R @ (np.eye(3) + 0.1 * rng.normal(size=(3, 3)))) + s * 5e-4 * rng.normal(
        size=(cube().function_count, 3)
    )


def scaled_cube(s, **material):
    """Return one scaled cube in free space."""
    given = Material(**{"youngs_modulus": 1.0e5, "viscosity": 0.0} | material)
    return Scene(lambda world: add_reduced_body(world, cube(), material=given, scale=s), [cube()])


@pytest.mark.parametrize("s", SCALES)
def test_energy_is_that_of_the_elastic_part(s):
    """E_s(q) = s^3 E_1(q_e), dE_s/dq = s^2 dE_1/dq_e and K_s = s K_1, q_e = (q - (s - 1) c) / s."""
    s = stored(s)
    q = deformed(s)
    mine = evaluate(scaled_cube(s), q)
    one = evaluate(scaled_cube(1.0), (q - (s - 1.0) * cube().linear_coordinates[:, :3]) / s)
    assert mine[0] == pytest.approx(s**3 * one[0], rel=32 * FLOAT32)
    np.testing.assert_allclose(mine[1], s**2 * one[1], atol=64 * FLOAT32 * np.abs(mine[1]).max())
    np.testing.assert_allclose(mine[2], s * one[2], atol=64 * FLOAT32 * np.abs(mine[2]).max())


@pytest.mark.parametrize("s", SCALES)
def test_derivatives(s):
    """Gradient and Hessian are the central differences of energy and gradient at s != 1; error h^2 and float32."""
    scene, q = scaled_cube(stored(s)), deformed(s)
    d = np.random.default_rng(1).normal(size=q.shape)
    h = 1.0e-5 * s * EDGE
    _, force, stiffness = evaluate(scene, q)
    ahead, behind = evaluate(scene, q + h * d), evaluate(scene, q - h * d)
    assert (ahead[0] - behind[0]) / (2 * h) == pytest.approx(float((force * d).sum()), rel=1e-6)
    change = (ahead[1] - behind[1]) / (2 * h)
    product = (stiffness @ d.T.ravel()).reshape(3, -1).T
    np.testing.assert_allclose(product, change, atol=1e-5 * np.abs(change).max())


@pytest.mark.parametrize("s", SCALES)
def test_recovery_from_a_point(s):
    """Squeezed to a hundredth, the body goes back to its own size: det F = s^3."""
    material = Material(youngs_modulus=1.0e5, mass_damping=20.0)
    scene = Scene(lambda world: add_reduced_body(world, cube(), material=material, scale=s), [cube()], dt=0.01)
    scene.set(q=cube().affine(0.01 * np.eye(3)))
    scene.step(150)
    np.testing.assert_allclose(scene.reduced.view.points.volume_ratio.numpy(), 1.0, atol=1e-3)
    x, X = particles(scene), stored(s) * cube().surface.points
    far = np.linalg.norm(x[:, None] - x, axis=2).max()
    assert far == pytest.approx(np.linalg.norm(X[:, None] - X, axis=2).max(), rel=1e-3)


# -- equal to the body built at that size ------------------------------------------------------------------------------


def hang(world, body, s):
    """Hang a body by the top of its surface, glued to the world."""
    index = add_reduced_body(world, body, material=dataclasses.replace(SOFT, mass_damping=10.0), scale=s)
    size = s * float(np.ptp(body.bounds[:, 2]))
    attach(world, index, body, box=((-1.0, -1.0, 0.45 * size), (1.0, 1.0, 1.0)))


@pytest.mark.parametrize("s", SCALES)
def test_static_deflection(s):
    """Hanging by an attachment, the sag equals that of the body built at that size."""
    scenes = both(hang, cube(), s, gravity=DOWN, options=FINE, dt=0.02)
    start = particles(scenes[0])
    for scene in scenes:
        scene.step(80)
    x, twin = (particles(scene) for scene in scenes)
    sag = np.abs(twin - start).max()
    assert sag > 1e-3 * s * EDGE
    np.testing.assert_allclose(x, twin, atol=ROUNDING * s * EDGE)
    assert not any(scene.reduced.status.numpy().any() for scene in scenes)


@pytest.mark.parametrize("s", SCALES)
def test_drop_and_bounce(s):
    """A turning body falls, hits the ground and rises: all along the path agrees to rounding."""

    def populate(world, body, scale):
        add_reduced_body(
            world, body, material=BOUNCY, position=(0.0, 0.0, 0.1 * s), rotation=rotation((1, 1, 0), 0.1),
            angular_velocity=(1.0, 2.0, 0.0), velocity=(0.2, 0.0, -1.0), scale=scale,
        )  # fmt: skip

    scenes = both(populate, cube(), s, gravity=DOWN, ground=0.6, options=FINE)
    heights, error = [], []
    for _ in range(50):
        for scene in scenes:
            scene.step(2)
        x, twin = (particles(scene) for scene in scenes)
        heights.append(x[:, 2].mean())
        error.append(np.abs(x - twin).max() / (s * EDGE))
    assert np.diff(heights).max() > 1e-2 * s * EDGE  # it rises again
    assert max(error) < ROUNDING


@pytest.mark.parametrize("s", SCALES)
def test_force_on_a_plate(s):
    """Pressed by its weight and spin on the ground: force, pressure and patch of every step equal the built body's."""

    def populate(world, body, scale):
        position = (0.0, 0.0, 0.5 * s * EDGE + 1e-4)
        add_reduced_body(world, body, material=SOFT, position=position, velocity=(0.0, 0.0, -0.3), scale=scale)

    scenes = both(populate, cube(), s, gravity=DOWN, ground=0.6, options=FINE)
    sensors = [(ContactSensor(scene.solver, [-1]), SurfacePressure(scene.solver)) for scene in scenes]
    for _ in range(20):
        for scene, pair in zip(scenes, sensors, strict=True):
            scene.step()
            for sensor in pair:
                sensor.update()
        (plate, skin), (plate_twin, skin_twin) = sensors
        weight = scenes[0].mass() * GRAVITY
        force, twin = (scene.reduced.instance_force.numpy()[0] for scene in scenes)
        np.testing.assert_allclose(force, twin, atol=1e-5 * (weight + np.abs(twin).max()))
        assert plate.total_area.numpy()[0, 0] == pytest.approx(plate_twin.total_area.numpy()[0, 0], rel=1e-5)
        pressure, other = skin.pressure.numpy(), skin_twin.pressure.numpy()
        np.testing.assert_allclose(pressure, other, atol=1e-4 * max(other.max(), 1.0))
    assert force[2] > 0.0


def test_a_grasp():
    """Two fingers close on a body and lift it: joints and surface equal the built body's to 1e-5 of the size."""
    s = 1.3

    def populate(world, body, scale):
        add_gripper(world, 0.03 * s)
        material = Material(youngs_modulus=5.0e4, friction=0.8)
        add_reduced_body(world, body, material=material, position=(0.0, 0.0, 0.03 * s + 1e-4), scale=scale)

    scenes = both(populate, cube(0.06), s, coupled=True, gravity=DOWN, ground=0.8, dt=0.01)
    for scene in scenes:
        replay = scene.capture()
        for k in range(50):
            lift = GRIPPER["lift"] * min(max(0.02 * k - 0.5, 0.0) / 0.4, 1.0)
            squeeze = GRIPPER["squeeze"] * min(k / 20, 1.0)
            scene.control.joint_target_q.assign(np.array([lift, squeeze, squeeze], np.float32))
            replay()
    x, twin = (particles(scene) for scene in scenes)
    assert x[:, 2].min() > 0.05  # it hangs in the air
    np.testing.assert_allclose(x, twin, atol=1e-5 * s * 0.06)
    joints, other = (scene.state.joint_q.numpy() for scene in scenes)
    np.testing.assert_allclose(joints, other, atol=1e-6)


def test_a_stack_and_self_contact():
    """Two bodies of different scales, one on the other, that may touch themselves: paths agree to 1e-5 sizes."""
    s = stored(0.8)
    large = enlarged(cube(), s)

    def scene_of(small, scale, bodies):
        def populate(world):
            add_reduced_body(world, cube(), material=SOFT, position=(0.0, 0.0, 0.0502), self_contact=True)
            above = {"position": (0.01, 0.005, 0.1004 + 0.5 * s * EDGE), "velocity": (0.1, 0.0, -0.2)}
            add_reduced_body(world, small, material=SOFT, **above, self_contact=True, scale=scale)

        return Scene(populate, bodies, gravity=DOWN, ground=0.6, options=FINE)

    scenes = scene_of(cube(), 0.8, [cube()]), scene_of(large, 1.0, [cube(), large])
    for scene in scenes:
        scene.step(40)
    x, twin = (particles(scene) for scene in scenes)
    assert scenes[0].reduced.view.constraints.pair_count.numpy().min() > 3
    np.testing.assert_allclose(x, twin, atol=1e-5 * EDGE)


def test_ring_squeezed_shut():
    """The tips of an open ring, pulled at each other by pins, touch as those of the built ring do: to 1e-5 sizes."""
    s, body = stored(1.3), ring()
    X = np.array([[0.048, side * 0.014, z] for side in (-1, 1) for z in (-0.01, 0.01)])
    X = np.concatenate([X, [[-0.05, 0.0, -0.01], [-0.05, 0.0, 0.01]]])
    pull = np.array([[0.0, 0.0175, 0.0]]) * -np.sign(X[:, 1:2])

    def populate(world, asset, scale):
        i = add_reduced_body(
            world, asset, material=Material(youngs_modulus=2.0e4), self_contact=True, contact_radius=0.002, scale=scale
        )
        add_pins(world, i, s * X, stiffness=1000.0)

    scenes = both(populate, body, s)
    for scene in scenes:
        for k in range(30):
            scene.control.softmode.pin_target.assign(s * (X + min(k / 20, 1.0) * pull))
            scene.step()
    assert scenes[0].reduced.view.constraints.pair_count.numpy()[0] > 0
    assert (
        scenes[0].reduced.view.constraints.pair_count.numpy()[0]
        == scenes[1].reduced.view.constraints.pair_count.numpy()[0]
    )
    x, twin = (particles(scene) for scene in scenes)
    np.testing.assert_allclose(x, twin, atol=1e-5 * s * EDGE)


def test_driven_region():
    """An exact region driven by x = A X + t, X at the body's scale, takes the built body along the same path."""
    s, A, t = 1.3, rotation((1, 0, 0), 0.3), np.array([0.01, 0.0, 0.02])
    scenes = both(
        lambda world, body, scale: add_reduced_body(world, body, material=SOFT, scale=scale),
        clamped(), s, gravity=DOWN, options=FINE,
    )  # fmt: skip
    for scene in scenes:
        drive_regions(scene.model, scene.control, 0, scene.body(), A[None], t[None])
        scene.step(10)
    x, twin = (particles(scene) for scene in scenes)
    np.testing.assert_allclose(x, twin, atol=ROUNDING * s * 0.2)
    held = clamped().surface.points[:, 0] < -0.08
    np.testing.assert_allclose(x[held], stored(s) * clamped().surface.points[held] @ A.T + t, atol=1e-6)


def test_gradients():
    """A scaled body has the built body's derivatives by material and state, and those of differences."""
    s = stored(1.3)

    def populate(world, body, scale):
        index = add_reduced_body(world, body, material=SOFT, velocity=(0.3, -0.2, 0.5), scale=scale)
        points = s * cube().cubature.points[cube().cubature.points[:, 2] > 0.03]
        add_pins(world, index, points, stiffness=20.0)

    steps, weight = 5, np.random.default_rng(0).normal(size=(6, cube().function_count, 3))

    def loss(scene, adjoint):
        scene.restart()
        adjoint.start(scene.state)
        for _ in range(steps):
            adjoint.step(scene.state, scene.next_state, scene.control, 0.01)
            scene.state, scene.next_state = scene.next_state, scene.state
        return float((weight * adjoint.q.numpy()).sum())

    found = []
    for scene in both(populate, cube(), s, gravity=DOWN, options=EXACT):
        adjoint = AdjointReduced(scene.reduced, steps)
        loss(scene, adjoint)
        gradients = adjoint.backward(loss_q=weight).numpy()
        found.append(gradients)
        for name in ("youngs_modulus", "density", "poissons_ratio", "viscosity"):
            value = float(getattr(scene.model.softmode, name).numpy()[0])
            x, losses = [], []
            step = 2e-4 if name == "poissons_ratio" else 1e-3  # its second derivative is large
            for factor in (-1.0, 1.0):
                scene.set_parameter(name, value * (1.0 + factor * step))
                x.append(float(getattr(scene.model.softmode, name).numpy()[0]))
                losses.append(loss(scene, adjoint))
            scene.set_parameter(name, value)
            slope = (losses[1] - losses[0]) / (x[1] - x[0])
            assert gradients[name][0] == pytest.approx(slope, rel=1e-4), name
    for name in ("youngs_modulus", "density", "poissons_ratio", "viscosity", "q", "qd", "force", "pin_target"):
        mine, twin = (gradients[name] for gradients in found)
        # nu, a float32, changes its own derivative by ten times as much as itself
        bound = 1e-4 if name == "poissons_ratio" else 1e-5
        np.testing.assert_allclose(mine, twin, atol=bound * np.abs(twin).max(), err_msg=name)


# -- closed forms ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("s", SCALES)
def test_uniaxial_stretch(s):
    """Faces of area s^2 A pulled by f: the strain is f / (E s^2 A) up to the square of the strain."""
    modulus, strain = 1.0e6, 1.0e-3
    body = affine_cube(0.1)
    material = Material(youngs_modulus=modulus, mass_damping=200.0, density=1000.0)
    scene = Scene(
        lambda world: add_reduced_body(world, body, material=material, scale=s), [body], dt=0.01, options=FINE
    )
    pull = strain * modulus * (stored(s) * 0.1) ** 2
    # forces on the samples with the sum and the moments of the pull at both faces: that of z is pull * edge, no other
    x = np.column_stack([body.surface.points, np.ones(body.surface_count)])
    share = x @ np.linalg.solve(x.T @ x, [0.0, 0.0, pull * 0.1, 0.0])
    force = np.column_stack([np.zeros((len(x), 2)), share]).astype(np.float32)
    for _ in range(80):
        scene.state.particle_f.assign(force)
        scene.step()
    F = mean_gradient(body, scene.q())
    assert F[2, 2] / stored(s) - 1.0 == pytest.approx(strain, rel=3 * strain)
    assert F[0, 0] / stored(s) - 1.0 == pytest.approx(-0.4 * strain, rel=6 * strain)


def test_weight_and_spin():
    """At rest the ground carries rho s^3 V g; a spin omega has the angular momentum of s^5."""
    for s in SCALES:
        scene = Scene(
            lambda world, s=s: add_reduced_body(
                world, cube(), material=dataclasses.replace(SOFT, mass_damping=10.0),
                position=(0.0, 0.0, 0.5 * s * EDGE), scale=s,
            ),
            [cube()], gravity=DOWN, ground=0.6, dt=0.02,
        )  # fmt: skip
        scene.step(100)
        weight = SOFT.density * stored(s) ** 3 * cube().volume * GRAVITY
        assert scene.reduced.instance_force.numpy()[0][2] == pytest.approx(weight, rel=1e-3)
        turning = [
            Scene(lambda world, k=k: add_reduced_body(world, cube(), angular_velocity=(0, 0, 5.0), scale=k), [cube()])
            for k in (1.0, s)
        ]
        (_, one), (_, mine) = (scene.momentum() for scene in turning)
        assert mine[2] == pytest.approx(stored(s) ** 5 * one[2], rel=1e-9)


def test_momentum():
    """Bodies of scales 0.7 and 1.3 collide in free space: linear momentum stays to rounding, angular to order dt."""

    def populate(world):
        add_reduced_body(world, cube(), material=SOFT, velocity=(1.0, 0.0, 0.0), scale=0.7)
        position = (0.5 * EDGE * (0.7 + 1.3) + 0.002, 0.01, 0.005)
        add_reduced_body(world, cube(), material=SOFT, position=position, scale=1.3)

    drift = []
    for dt in (0.002, 0.001):
        scene = Scene(populate, [cube()], options=FINE, dt=dt)
        p, L = (sum(pair) for pair in zip(*(scene.momentum(i) for i in range(2)), strict=True))
        scene.step(round(0.06 / dt))
        after, turned = (sum(pair) for pair in zip(*(scene.momentum(i) for i in range(2)), strict=True))
        assert scene.momentum(0)[0][0] < 0.5 * np.max(p)  # they have met
        np.testing.assert_allclose(after, p, atol=1e-6 * np.linalg.norm(p))
        drift.append(np.linalg.norm(turned - L) / (EDGE * np.linalg.norm(p)))
    assert drift[0] < 1.5e-3  # in a contact that dents they stay together for longer
    assert drift[1] < 0.6 * drift[0]


# -- the rest ----------------------------------------------------------------------------------------------------------


def test_splats_follow():
    """Means and covariances of splats are those of x = s X: F Sigma F^T has s^2 in it."""
    s, body = 1.3, cube()
    scene = Scene(lambda world: add_reduced_body(world, body, scale=s), [body])
    means = 0.4 * EDGE * np.random.default_rng(0).uniform(-1, 1, size=(20, 3))
    covariances = np.tile(1e-6 * np.diag([1.0, 4.0, 9.0]), (20, 1, 1))
    skin = SkinSplats(means, covariances, *body.evaluate(means), device="cpu")
    out = wp.zeros((1, 20), dtype=wp.vec3, device="cpu")
    six = wp.zeros((1, 20), dtype=skin.rest_covariances.dtype, device="cpu")
    skin.launch(scene.state.softmode.q, scene.model.softmode.function_start, out, six)
    np.testing.assert_allclose(out.numpy()[0], s * means, atol=1e-7)
    np.testing.assert_allclose(six.numpy()[0][:, [0, 3, 5]], s**2 * 1e-6 * np.tile([1.0, 4.0, 9.0], (20, 1)), rtol=1e-5)
    points = Markers(scene.reduced, means).positions(scene.state.softmode.q.numpy())
    np.testing.assert_allclose(points, stored(s) * means, atol=1e-9)


@pytest.mark.parametrize("scale", [0.0, -1.0, 0.2, 4.1, float("nan"), float("inf")])
def test_scale_out_of_range(scale):
    """A scale outside [0.25, 4] is refused with the remedy."""
    with pytest.raises(ConfigError, match="scale must lie in") as error:
        Scene(lambda world: add_reduced_body(world, cube(), scale=scale), [cube()])
    assert "build the body at that size" in str(error.value.hint)
