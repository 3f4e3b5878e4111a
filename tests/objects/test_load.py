"""`load`: whatever describes an object gives the same object; `Placed`: where it is.

Builds objects, which is what it tests.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import newton
import numpy as np
import pytest
import trimesh

from softmode.deformables import BuildOptions, Material
from softmode.deformables.materials.material import warn_of_units
from softmode.envs.task_config import TaskConfig
from softmode.errors import ConfigError
from softmode.objects import PRESETS, ObjectConfig, Placed, SoftObject, StifferColor, build_object, load, surface_cover
from softmode.objects.mesh_file import read_mesh
from softmode.objects.pose import seat_of
from softmode.scenes.table_scene import TableSceneConfig
from softmode.splats import make_plush, write_ply
from softmode.splats.formats import read_splats
from tests.bodies import assert_same

SMALL = {
    "size": 0.06,
    "surface_count": 60,
    "build": BuildOptions(mode_count=1, handles="affine", kernel_count=60, cubature_count=48),
}
RUBBER = Material(youngs_modulus=3.0e4, density=400.0)


@pytest.fixture(scope="module")
def cup(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of a box."""
    file = tmp_path_factory.mktemp("assets") / "cup.obj"
    trimesh.creation.box((0.1, 0.05, 0.04)).export(file)
    return file


def test_a_mesh_in_memory_is_the_mesh_of_the_file(cup: Path) -> None:
    """File, configuration and trimesh give one body and the same splats, bit by bit."""
    options = {"splat_count": 120, **SMALL}
    found = [load(cup, **options), load(ObjectConfig(mesh=cup), **options)]
    found.append(load(trimesh.load_mesh(cup, process=False), **options))
    for thing in found[1:]:
        assert thing.body.fingerprint == found[0].body.fingerprint
        np.testing.assert_array_equal(thing.visible_splats.means, found[0].visible_splats.means)
    assert found[0].config == ObjectConfig(mesh=cup, **options)
    with pytest.raises(TypeError, match="colour"):
        load(cup, colour="red")


def test_splats_in_memory_stand_with_z_up(tmp_path: Path) -> None:
    """Splats that have been read are those of the file with its axis named."""
    write_ply(tmp_path / "toy.ply", make_plush(count=500))
    one = load(tmp_path / "toy.ply", up="+z", **SMALL)
    two = load(read_splats(tmp_path / "toy.ply"), **SMALL)
    assert one.body.fingerprint == two.body.fingerprint
    np.testing.assert_array_equal(one.visible_splats.means, two.visible_splats.means)


def test_a_body_is_covered_and_keeps_its_material(cup: Path) -> None:
    """A body in memory takes splats on its samples; a contact radius lifts it."""
    body = load(cup, **SMALL).body
    thing = load(body, material=RUBBER, contact_radius=0.002)
    assert thing.body is body and thing.material == RUBBER
    np.testing.assert_array_equal(thing.visible_splats.means, surface_cover(body).means)
    assert thing.height == pytest.approx(0.002 - body.surface.points[:, 2].min())


def test_what_is_no_source_is_refused() -> None:
    """A source of another type is named."""
    with pytest.raises(TypeError, match="ndarray"):
        load(np.zeros((3, 3)))


def test_an_object_without_splats_says_so(cup: Path) -> None:
    """Asking for splats that are not there is an error with a remedy; the object itself is fine."""
    bare = replace(load(cup, **SMALL), splats=None)
    assert Placed(object=bare).placed_splats() is None
    with pytest.raises(ConfigError, match="no splats") as caught:
        _ = bare.basis
    assert caught.value.hint


def test_a_placed_object_is_where_it_was_put(cup: Path) -> None:
    """Particles and splats are scale R X + p, the velocity is that of every particle, the mass goes with scale^3."""
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    thing = load(cup, material=RUBBER, contact_radius=0.001, **SMALL)
    placed = Placed(object=thing, position=(0.1, 0.2, 0.3), rotation=turn, scale=2.0, velocity=(0.0, 0.0, -1.0))
    builder = newton.ModelBuilder()
    assert placed.add_to(builder) == 0 and placed.add_to(builder, self_contact=True) == 1
    expected = 2.0 * thing.body.surface.points @ turn.T + placed.position
    model = builder.finalize(device="cpu")
    count = thing.body.surface_count
    particles, velocities, masses = model.particle_q, model.particle_qd, model.particle_mass
    assert particles is not None and velocities is not None and masses is not None
    np.testing.assert_allclose(particles.numpy()[:count], expected, atol=1e-6)
    np.testing.assert_allclose(velocities.numpy(), np.tile((0.0, 0.0, -1.0), (2 * count, 1)))
    assert placed.mass == pytest.approx(RUBBER.density * 8.0 * thing.body.volume)
    assert masses.numpy()[:count].sum() == pytest.approx(placed.mass, rel=1e-5)
    splats = placed.placed_splats()
    assert splats is not None
    centres = 2.0 * thing.visible_splats.means @ turn.T + placed.position
    np.testing.assert_allclose(splats.means, centres, atol=1e-6)


@pytest.mark.parametrize("given", [{"position": (0.0, 0.0, float("inf"))}, {"rotation": -np.eye(3)}, {"scale": 5.0}])
def test_bad_places_are_refused(given: dict, cup: Path) -> None:
    """A place is checked when it is made."""
    with pytest.raises(ConfigError, match=next(iter(given))):
        Placed(object=SoftObject(body=load(cup, **SMALL).body), **given)


def test_a_body_is_built_for_the_ratio_of_its_material(cup: Path) -> None:
    """The material's Poisson's ratio is that of the build; 0.4 changes no bit."""
    options = {"size": 0.06, "splat_count": 120, "surface_count": 60}
    small = BuildOptions(function_count=12, kernel_count=60, cubature_count=48)
    rubber = Material(poissons_ratio=0.49)
    plain, default, found = (
        load(cup, material=material, build=small, **options).body for material in (None, Material(), rubber)
    )
    assert default.fingerprint == plain.fingerprint
    np.testing.assert_array_equal(default.cubature.grad_basis, plain.cubature.grad_basis)
    assert found.provenance["option_poissons_ratio"] == 0.49 and found.serves_ratio(0.49)
    assert found.fingerprint != plain.fingerprint
    again = load(cup, material=rubber, build=small, **options)
    assert again.config is not None and again.config.build == small, "the configuration stays as it was given"
    anew, _ = build_object(cup, material=rubber, build=small, **options)
    np.testing.assert_array_equal(anew.body.cubature.grad_basis, found.cubature.grad_basis)
    assert anew.material == rubber


@pytest.mark.rest
def test_a_ratio_that_options_name_goes_before_that_of_the_material(cup: Path) -> None:
    """As `BuildOptions.for_ratio` says."""
    named = BuildOptions(function_count=12, kernel_count=60, cubature_count=48, poissons_ratio=0.3)
    body = load(cup, material=Material(poissons_ratio=0.49), **{**SMALL, "build": named}).body
    assert body.provenance["option_poissons_ratio"] == 0.3


def test_options_for_a_ratio() -> None:
    """0.4 and options that name a ratio stay as they are; a negative ratio is served by functions for 0."""
    given = BuildOptions()
    assert given.for_ratio(0.4) is given
    assert given.for_ratio(0.45).poissons_ratios == (0.45,)
    assert given.for_ratio(-0.3).poissons_ratios == (0.0,)
    named = BuildOptions(poissons_ratio=0.3)
    assert named.for_ratio(0.49) is named
    varied = given.for_varied_ratio()
    assert varied.for_ratio(0.2) is varied


def test_load_and_build_object_make_one_body(tmp_path: Path) -> None:
    """Of a preset they give the same bits and the same provenance, and neither drops an option.

    The foot of the banana is held, its yellow is three times as stiff, its half x > 0 is four times as dense.
    """
    np.savez(tmp_path / "dense.npz", points=[[-0.05, 0.0, 0.0], [0.05, 0.0, 0.0]], factors=[1.0, 4.0])
    painted = {"stiffness_colors": (StifferColor.parse("#e8c43a:3"),), "density_file": tmp_path / "dense.npz"}
    given = {**SMALL, **painted, "size": 0.2}
    config = ObjectConfig(preset="banana", splat_count=400, clamped_height=0.01, **given)
    one = load(config)
    two, quadrature = build_object(config)
    assert_same(one.body, two.body, skip=("provenance", "build_seconds", "sources"))
    told, again = (
        {name: value for name, value in thing.body.provenance.items() if not name.startswith("seconds_")}
        for thing in (one, two)
    )
    assert told == again and told["seat"] == str(seat_of(quadrature.bounds).tolist())
    np.testing.assert_array_equal(one.visible_splats.means, two.visible_splats.means)
    assert one.material == two.material == PRESETS["banana"].material and one.config == two.config == config
    assert one.body.regions.names == ("foot",) and one.body.driven_count > 0
    assert set(one.body.cubature.stiffness_scale) == {1.0, 3.0}
    assert one.body.offset[0] - quadrature.weights @ quadrature.points[:, 0] / quadrature.volume > 0.01


def test_units_that_no_solid_has_are_warned_of() -> None:
    """Young's modulus in MPa and density in g/cm^3 are told from Pa and kg/m^3, with the value that is meant."""
    given = Material(youngs_modulus=0.05, density=1.2)
    with pytest.warns(UserWarning) as caught:
        warn_of_units(given, "toy")
    told = [str(one.message) for one in caught]
    assert "if it is in MPa, give 50000" in told[0] and "if it is in g/cm^3, give 1200" in told[1]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_units(Material(), "toy")


def test_sizes_from_a_millimetre_to_ten_metres() -> None:
    """Objects may be so small or large; a task names the sizes that its table takes."""
    for size in (0.001, 10.0):
        made = ObjectConfig(size=size)
        assert made.longest_edge == size
        with pytest.raises(ConfigError, match="an object's size") as caught:
            TaskConfig(scene=TableSceneConfig(object=made))
        assert "5 mm to 1 m" in caught.value.hint
    with pytest.raises(ConfigError, match="size"):
        ObjectConfig(size=0.0005)


def test_a_far_mesh_keeps_its_volume_and_tells_its_offset(tmp_path: Path) -> None:
    """A mesh in coordinates of a map has the volume that it has at the origin, and its offset in the provenance."""
    mesh = trimesh.creation.box((0.1, 0.08, 0.06))
    mesh.apply_translation((4.0e5, 5.0e6, 100.0))
    mesh.export(tmp_path / "far.obj", digits=9)
    read = read_mesh(tmp_path / "far.obj")
    np.testing.assert_allclose(np.ptp(read.corners, axis=(0, 1)), (0.1, 0.08, 0.06), atol=1e-6)
    assert read.offset == (4.0e5, 5.0e6, 100.0)
