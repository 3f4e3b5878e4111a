"""ReducedBody: orthonormal functions, affine closure, files, fingerprints, the cache.

Builds small capsules and default bodies: the build is what it tests.
"""

from __future__ import annotations

import dataclasses
import fcntl
import json
import multiprocessing
import os
import shutil
import threading
import time
from pathlib import Path

import newton
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from softmode.deformables.body.records import BodyCubature
from softmode.deformables.body.reduced_body import FORMAT_VERSION, ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.quadrature.quadrature import (
    quadrature_from_box,
    quadrature_from_capsule,
    quadrature_from_sphere,
)
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.reduction import cache
from softmode.deformables.reduction.build_body import body_fingerprint, build_body
from softmode.deformables.reduction.cache import cache_directory, cached_body, fingerprint_of
from softmode.deformables.reduction.functions import RANK_TOLERANCE
from softmode.deformables.reduction.options import BuildOptions
from softmode.errors import AssetError, BasisError, ConfigError, MaterialError, StorageError
from tests.bodies import RECIPES, assert_same, default_box, quadratic_box, smooth_ball

SMALL = BuildOptions(mode_count=4, kernel_count=80, cubature_count=48)


def small_quadrature() -> Quadrature:
    """Return a capsule coarse enough to build in a tenth of a second."""
    return quadrature_from_capsule(0.02, 0.02, point_count=600, surface_count=60)


@pytest.fixture(scope="module")
def quadrature() -> Quadrature:
    """Return the capsule once for the module."""
    return small_quadrature()


@pytest.fixture(scope="module")
def body(quadrature: Quadrature) -> ReducedBody:
    """Return the capsule's body once for the module."""
    return build_body(quadrature, SMALL, name="capsule")


@pytest.fixture(scope="module", params=["box", pytest.param("sphere", marks=pytest.mark.rest)])
def default(request) -> tuple[Quadrature, ReducedBody]:
    """Bodies built with the default options."""
    if request.param == "box":
        return RECIPES["default_box"]().integrate(), default_box()
    found = quadrature_from_sphere(0.03)
    return found, build_body(found)


FIELDS = {
    "stiffness_scale": lambda X: 2.0 + X[:, 0],
    "density_scale": lambda X: 1.0 + 1e3 * X[:, 2] ** 2 + X[:, 2],
    "poissons_ratio": lambda X: np.clip(0.3 + 3.0 * X[:, 2], 0.0, 0.49),
}


@pytest.fixture(scope="module")
def uneven(quadrature: Quadrature) -> ReducedBody:
    """Return the capsule with a modulus, a density and a Poisson's ratio that vary."""
    return build_body(quadrature, SMALL, **FIELDS)


def test_functions_are_mass_orthonormal(default) -> None:
    """(1/V) sum V_p b_k b_l = delta_kl; the mean of b is (1, 0, 0, ...); the origin is the centre of mass."""
    quadrature, body = default
    value, _ = body.evaluate(quadrature.points - body.offset)
    share = quadrature.weights / quadrature.volume
    assert np.abs((value * share[:, None]).T @ value - np.eye(body.function_count)).max() < 1e-10
    np.testing.assert_allclose(share @ value, body.mean_basis, atol=1e-10)
    assert np.abs(share @ (quadrature.points - body.offset)).max() < 1e-12


def test_affine_closure(default) -> None:
    """x(X) = A X + t to 1e-10 of the size for 100 random maps, inside, on the surface, and far outside; F = A."""
    quadrature, body = default
    rng = np.random.default_rng(1)
    far = 10.0 * body.surface.points
    points = np.concatenate([quadrature.points - body.offset, body.surface.points, far])
    value, gradient = body.evaluate(points)
    for _ in range(100):
        matrix, shift = rng.normal(size=(3, 3)), rng.normal(size=3)
        q = body.affine(matrix, shift)
        size = np.abs(points @ matrix.T).max() + np.abs(shift).max()
        assert np.abs(points + value @ q - (points @ matrix.T + shift)).max() < 1e-10 * size
        deformation = np.eye(3) + np.einsum("ki,pkj->pij", q, gradient)
        assert np.abs(deformation - matrix).max() < 1e-10
    stored = np.eye(3) + np.einsum("ki,pkj->pij", body.affine(matrix, shift), body.cubature.grad_basis)
    assert np.abs(stored - matrix).max() < 1e-5, "float32 storage"
    surface = body.surface.points + body.surface.basis @ body.affine(matrix, shift)
    assert np.abs(surface - (body.surface.points @ matrix.T + shift)).max() < 1e-6 * size


def test_linear_coordinates(default) -> None:
    """sum_k b_k c_kj = (X, Y, Z, 1)_j."""
    quadrature, body = default
    points = quadrature.points - body.offset
    value, _ = body.evaluate(points)
    expected = np.column_stack([points, np.ones(len(points))])
    assert np.abs(value @ body.linear_coordinates - expected).max() < 1e-12


def test_gradients_match_finite_differences(body: ReducedBody) -> None:
    """Grad b_k by central differences of step 1e-6 L, to 1e-6 of the largest gradient."""
    points = body.cubature.points[::5]
    _, gradient = body.evaluate(points)
    step = 1e-6 * body.length
    for d in range(3):
        shift = step * np.eye(3)[d]
        difference = (body.evaluate(points + shift)[0] - body.evaluate(points - shift)[0]) / (2.0 * step)
        assert np.abs(difference - gradient[:, :, d]).max() < 1e-6 * np.abs(gradient).max()


def test_gradients_of_quadratic_handles() -> None:
    """Handles of degree two have six more monomials, whose gradients match central differences to 1e-6 as well."""
    body = quadratic_box()
    assert body.function_count > 4 * 3
    test_gradients_match_finite_differences(body)


def test_volume_counts_and_shapes(default) -> None:
    """Cubature weights are positive and sum to the volume; counts agree.

    The force error is under 1.5 %, that of the lowest eigenvalues under 0.5 %.
    """
    quadrature, body = default
    body.check()
    assert body.cubature.weights.sum() == pytest.approx(quadrature.volume, rel=1e-12)
    assert (body.cubature.weights > 0.0).all()
    assert body.point_count == BuildOptions().cubature_count
    assert body.surface_count == len(quadrature.surface_points)
    assert body.mode_count == 48  # of the space, out of whose quadratic handles the functions are chosen
    assert body.function_count == 48
    error = body.provenance["cubature_force_error"]
    assert isinstance(error, float) and error < 0.015
    error = body.provenance["soft_mode_error"]
    assert isinstance(error, float) and 0.0 < error < 5e-3
    np.testing.assert_allclose(body.bounds + body.offset, quadrature.bounds, atol=1e-15)


@pytest.mark.rest
def test_symmetric_object_drops_repeated_functions() -> None:
    """On a sphere x W_y = y W_x: the rank check removes the repeats, on a box with three unequal edges nothing."""
    sphere = build_body(quadrature_from_sphere(0.03), BuildOptions(mode_count=8))
    box = build_body(quadrature_from_box((0.06, 0.05, 0.04)), BuildOptions(mode_count=8))
    assert sphere.function_count < 32
    assert box.function_count == 36


def test_rest_stiffness_is_ordered(body: ReducedBody, quadrature: Quadrature) -> None:
    """Beyond the affine ones, sum V grad b_k . grad b_l is diagonal and ascending."""
    _, gradient = body.evaluate(quadrature.points - body.offset)
    energy = np.einsum("p,pkj,plj->kl", quadrature.weights / quadrature.volume, gradient, gradient)[4:, 4:]
    assert np.abs(energy - np.diag(np.diag(energy))).max() < 1e-8 * energy.max()
    assert (np.diff(np.diag(energy)) > -1e-8 * energy.max()).all()


def test_density_moves_the_frame(uneven: ReducedBody, quadrature: Quadrature) -> None:
    """The origin is the centre of mass, and orthonormality holds with the density."""
    body, density = uneven, FIELDS["density_scale"](quadrature.points)
    mass = quadrature.weights * density / (quadrature.weights @ density)
    assert abs(body.offset[2] - quadrature.weights @ quadrature.points[:, 2] / quadrature.volume) > 1e-5
    np.testing.assert_allclose(body.offset, mass @ quadrature.points, atol=1e-15)
    value, _ = body.evaluate(quadrature.points - body.offset)
    assert np.abs((value * mass[:, None]).T @ value - np.eye(body.function_count)).max() < 1e-10
    np.testing.assert_allclose(mass @ value, body.mean_basis, atol=1e-10)


def test_fields_reach_the_points(uneven: ReducedBody, quadrature: Quadrature, tmp_path: Path) -> None:
    """Cubature points have the modulus and the Poisson's ratio of the quadrature point they are, and a file keeps them.

    Where the ratio varies, what is stored is relative to the ratio of the options; a negative one is refused.
    """
    uneven.save(tmp_path / "uneven.npz")
    body, stiff = ReducedBody.load(tmp_path / "uneven.npz"), FIELDS["stiffness_scale"](quadrature.points)
    index = np.array([np.abs(quadrature.points - body.offset - p).sum(axis=1).argmin() for p in body.cubature.points])
    modulus, ratio = body.cubature.moduli(1.0, SMALL.poissons_ratios[0])
    np.testing.assert_allclose(modulus, stiff[index], rtol=1e-14)
    np.testing.assert_allclose(ratio, FIELDS["poissons_ratio"](quadrature.points)[index], rtol=1e-13, atol=1e-15)
    wide = body.cubature.moduli(1.0, 0.49)[1]
    assert wide.max() < 0.5 and (wide >= ratio).all()
    with pytest.raises(MaterialError, match=r"poissons_ratio is -0.1, and that of body .* varies"):
        add_reduced_body(newton.ModelBuilder(), body, material=Material(poissons_ratio=-0.1))


def test_fields_may_be_functions_of_position(uneven: ReducedBody, quadrature: Quadrature) -> None:
    """They give what their values at the quadrature points give; values that are no numbers are refused."""
    given = build_body(quadrature, SMALL, **{name: field(quadrature.points) for name, field in FIELDS.items()})
    assert uneven.fingerprint == given.fingerprint
    np.testing.assert_array_equal(uneven.transform, given.transform)
    for wrong in (lambda X: X[:, 0], lambda X: np.full(len(X), np.nan), lambda X: 1.0):
        with pytest.raises(MaterialError, match="stiffness_scale"):
            build_body(quadrature, SMALL, stiffness_scale=wrong)


BAD = {"stiffness_scale": (0.0, -1.0, np.nan, np.inf), "poissons_ratio": (0.5, -0.1, np.nan)}


@pytest.mark.parametrize(("field", "bad"), [(field, bad) for field, bads in BAD.items() for bad in bads])
def test_bad_fields_are_refused(quadrature: Quadrature, field: str, bad: float) -> None:
    """Zero, negative, NaN and infinite scales, and ratios out of range, raise MaterialError naming field and row."""
    value = np.full(len(quadrature.points), 0.3)
    value[7] = bad
    with pytest.raises(MaterialError, match=f"{field}: .* at row 7"):
        build_body(quadrature, SMALL, **{field: value})
    with pytest.raises(MaterialError, match=field):
        build_body(quadrature, SMALL, **{field: np.ones(3)})


def test_bad_options_are_refused() -> None:
    """Counts and tolerances out of range raise ConfigError."""
    bad = ({"mode_count": 0}, {"kernel_count": 4}, {"cubature_count": 3}, {"handles": "cubic"})
    chosen = ({"function_count": 9}, {"accuracy": 0.0}, {"accuracy": np.nan}, {"poissons_ratio": ()})
    both = ({"function_count": 40, "mode_count": 8}, {"accuracy": 0.02, "function_count": 40})
    rank = ({"rank_tolerance": 0.0}, {"rank_tolerance": 0.02}, {"rank_tolerance": np.nan})
    for options in (*bad, *rank, *chosen, *both, {"poissons_ratio": 0.5}, {"response_derivatives": 19}):
        with pytest.raises(ConfigError, match=next(iter(options))):
            BuildOptions(**options)


def test_rank_tolerance_decides_what_is_dropped() -> None:
    """On a sphere x W_y = y W_x to the error of the eigenmodes: a tiny tolerance keeps what the default drops."""
    default, recipe = smooth_ball(8, 400), RECIPES["smooth_ball"](8, 400)
    fine = dataclasses.replace(recipe, options=dataclasses.replace(recipe.options, rank_tolerance=1e-9)).build()
    assert default.function_count < fine.function_count <= 36
    assert default.fingerprint != fine.fingerprint
    assert fine.provenance["option_rank_tolerance"] == 1e-9
    assert default.provenance["option_rank_tolerance"] == RANK_TOLERANCE == 1e-5


def test_object_without_volume_is_refused(quadrature: Quadrature) -> None:
    """A quadrature with too few points or zero weights cannot be made."""
    with pytest.raises(AssetError, match="no volume"):
        dataclasses.replace(quadrature, weights=np.zeros_like(quadrature.weights))
    with pytest.raises(AssetError, match="no volume"):
        dataclasses.replace(quadrature, points=quadrature.points[:2], weights=quadrature.weights[:2])
    with pytest.raises(AssetError, match="points: not all finite"):
        dataclasses.replace(quadrature, points=quadrature.points * np.nan)


def test_evaluate_outside(body: ReducedBody) -> None:
    """Beyond reach the non-affine functions are constant along rays, or refused; NaN is refused."""
    far = np.array([[0.0, 0.0, 0.2], [0.0, 0.0, 0.4]])
    value, gradient = body.evaluate(far)
    assert not body.covers(far).any() and body.covers(body.cubature.points).all()
    # kernels sit inside: at a pole of the capsule a sample may lie just beyond them
    assert body.raw.reach(body.surface.points)[0].max() < 1.02
    inside = np.abs(body.evaluate(body.surface.points)[0]).max()
    assert np.abs(value[:, 4:]).max() < 4.0 * inside
    assert not gradient[:, 4:].any()
    with pytest.raises(BasisError, match="2 of 2 lie outside"):
        body.evaluate(far, outside="raise")
    with pytest.raises(BasisError, match="finite"):
        body.evaluate(np.array([[np.nan, 0.0, 0.0]]))
    assert body.evaluate(np.zeros((0, 3)))[0].shape == (0, body.function_count)


def test_fingerprint_follows_every_input(quadrature: Quadrature, body: ReducedBody) -> None:
    """Name, options, fields, one ulp of a point, and name, place, radius and stiffness of a region change it."""
    points = quadrature.points.copy()
    points[0, 0] = np.nextafter(points[0, 0], 1.0)
    left = Region(name="left", box=((-np.inf,) * 3, (-0.13, np.inf, np.inf)))
    others = [{"name": "other", "box": left.box}, {"name": "left", "box": ((-np.inf,) * 3, (-0.12, np.inf, np.inf))}]
    others += [{"name": "left", "box": left.box, "stiffness": 10.0}, {"name": "left", "box": left.box, "radius": 0.01}]
    field = 1.0 + points[:, 0]
    ones = np.ones(len(points))

    def made(quadrature=quadrature, options=SMALL, name="capsule", regions=(), stiffness=ones, density=ones) -> str:
        return body_fingerprint(quadrature, options, name, regions, stiffness, density)

    found = {
        made(),
        made(name="other"),
        made(options=dataclasses.replace(SMALL, seed=1)),
        made(options=dataclasses.replace(SMALL, mode_count=5)),
        made(dataclasses.replace(quadrature, points=points)),
        made(density=field),
        made(stiffness=field),
        made(regions=(left,)),
        made(regions=(left, left)),
        *(made(regions=(Region(**other),)) for other in others),
    }
    assert body.fingerprint in found and len(found) == 13
    assert all(len(f) == 64 for f in found)


def test_fingerprint_of_tells_values_apart(tmp_path: Path) -> None:
    """Types, shapes, nesting and file contents all count; unknown objects are refused."""
    file = tmp_path / "asset"
    file.write_bytes(b"one")
    keys = [1, 1.0, True, "1", None, b"1", [1], [[1]], (1, 1), {"a": 1}, {"b": 1}, np.ones(1), np.ones((1, 1)), file]
    prints = [fingerprint_of(k) for k in keys] + [fingerprint_of(1, 1), fingerprint_of("a", "b"), fingerprint_of("ab")]
    file.write_bytes(b"two")
    prints.append(fingerprint_of(file))
    assert len(set(prints)) == len(prints)
    assert fingerprint_of({"a": 1, "b": 2}) == fingerprint_of({"b": 2, "a": 1})
    with pytest.raises(ConfigError, match="fingerprint"):
        fingerprint_of(object())


def test_file_round_trip_is_exact(body: ReducedBody, tmp_path: Path) -> None:
    """Save and load give every field back, bit by bit, and leave no other file behind."""
    path = tmp_path / "deep" / "body.npz"
    body.save(path)
    body.save(path)
    assert_same(body, ReducedBody.load(path))
    assert [p.name for p in path.parent.iterdir()] == ["body.npz"]
    with np.load(path, allow_pickle=False) as file:
        assert all(file[k].dtype.kind in "fui" for k in file.files)


def test_failed_save_leaves_the_old_file(body: ReducedBody, tmp_path: Path, monkeypatch) -> None:
    """An interrupted write neither harms the target nor leaves rubbish."""
    path = tmp_path / "body.npz"
    body.save(path)

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("os.replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        body.save(path)
    assert [p.name for p in tmp_path.iterdir()] == ["body.npz"]
    assert_same(body, ReducedBody.load(path))


def test_foreign_and_old_files_are_refused(body: ReducedBody, tmp_path: Path) -> None:
    """Missing, foreign, old and inconsistent files raise AssetError that names the file."""
    path = tmp_path / "body.npz"

    def rejects(match: str) -> None:
        with pytest.raises(AssetError, match=match) as caught:
            ReducedBody.load(path)
        assert "body.npz" in str(caught.value) and caught.value.hint

    rejects("does not exist")
    path.write_bytes(b"")
    rejects("damaged")
    path.write_text("not an archive")
    rejects("damaged")
    np.savez(path, x=np.ones(3))
    rejects("not a softmode.ReducedBody")
    np.savez(path, x=np.array([object()], dtype=object), allow_pickle=True)
    rejects("damaged|not a softmode.ReducedBody")
    body.save(path)
    with np.load(path) as file:
        stored = {k: file[k] for k in file.files}

    def rewrite(header_change: dict, **arrays) -> None:
        header = {**json.loads(stored["header"].tobytes()), **header_change}
        np.savez(path, **{**stored, **arrays, "header": np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)})

    for version in (1, 999):
        rewrite({"version": version})
        rejects(f"version {version}")
    rewrite({"format": "other"})
    rejects("not a softmode.ReducedBody")
    rewrite({}, points=stored["points"][:-1])
    rejects("points|weights")
    rewrite({}, weights=stored["weights"] * 2.0)
    rejects("weights")
    rewrite({}, radii=stored["radii"] * np.nan)
    rejects("radii: not all finite")
    rewrite({"volume": "large"})
    rejects("volume")
    np.savez(path, **{k: v for k, v in stored.items() if k != "points"})
    rejects("points")


@given(position=st.floats(0.0, 1.0), change=st.integers(1, 255), cut=st.booleans())
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_bytes_never_pass_silently(body: ReducedBody, tmp_path: Path, position, change, cut) -> None:
    """A flipped byte or a truncation raises AssetError, or hits a byte that carries no data; nothing else."""
    path = tmp_path / "body.npz"
    body.save(path)
    data = bytearray(path.read_bytes())
    at = min(int(position * len(data)), len(data) - 1)
    if cut:
        data = data[:at]
    else:
        data[at] ^= change
    path.write_bytes(bytes(data))
    try:
        found = ReducedBody.load(path)
    except AssetError:
        return
    assert_same(body, found)


def test_cache_builds_once(body: ReducedBody, tmp_path: Path, monkeypatch) -> None:
    """A second call loads; another key builds; SOFTMODE_CACHE moves the folder."""
    monkeypatch.setenv("SOFTMODE_CACHE", str(tmp_path))
    calls = []

    def build() -> ReducedBody:
        calls.append(1)
        return body

    assert_same(cached_body(("a", 1), build), body)
    assert_same(cached_body(("a", 1), build), body)
    assert len(calls) == 1
    cached_body(("a", 2), build)
    assert len(calls) == 2
    assert cache_directory() == tmp_path
    assert len(list((tmp_path / "bodies").glob("*.npz"))) == 2


def test_a_cache_that_cannot_be_made_is_temporary(body: ReducedBody, tmp_path: Path, monkeypatch) -> None:
    """A warning names SOFTMODE_CACHE; the body is kept for this process and its children, and built once."""
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("SOFTMODE_CACHE", str(tmp_path / "file" / "cache"))
    calls = []

    def build() -> ReducedBody:
        calls.append(1)
        return body

    with pytest.warns(UserWarning, match="SOFTMODE_CACHE"):
        assert_same(cached_body(("a", 1), build), body)
    assert cache_directory() != tmp_path / "file" / "cache" and list(cache_directory().glob("bodies/*.npz"))
    assert_same(cached_body(("a", 1), build), body)
    assert len(calls) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_damaged_cache_entry_is_rebuilt(body: ReducedBody, tmp_path: Path) -> None:
    """Rubbish under the right name is replaced."""
    cached_body(("k",), lambda: body, directory=tmp_path)
    entry = next(tmp_path.glob("*.npz"))
    entry.write_bytes(entry.read_bytes()[:1000])
    assert_same(cached_body(("k",), lambda: body, directory=tmp_path), body)
    assert_same(ReducedBody.load(entry), body)


def test_an_entry_is_read_only_under_its_own_key(body: ReducedBody, tmp_path: Path, monkeypatch) -> None:
    """A whole body under another key, a link, and another user's file are built anew, in place of what was there."""
    cached_body(("k",), lambda: body, directory=tmp_path)
    (entry,) = tmp_path.glob("*.npz")
    other = tmp_path / f"{fingerprint_of(FORMAT_VERSION, 'other')}.npz"
    calls = []

    def build() -> ReducedBody:
        calls.append(1)
        return body

    shutil.copy(entry, other)
    cached_body(("other",), build, directory=tmp_path)
    assert len(calls) == 1
    kept = tmp_path / "elsewhere.bin"
    other.rename(kept)
    other.symlink_to(kept)
    before = kept.read_bytes()
    cached_body(("other",), build, directory=tmp_path)
    assert len(calls) == 2 and not other.is_symlink() and kept.read_bytes() == before
    if os.getuid() == 0:
        os.chown(other, 12345, -1)
        cached_body(("other",), build, directory=tmp_path)
        assert len(calls) == 3 and other.stat().st_uid == 0
    cached_body(("other",), build, directory=tmp_path)
    assert len(calls) == 2 + (os.getuid() == 0)


def test_a_lock_is_waited_for_aloud(body: ReducedBody, tmp_path: Path, monkeypatch, capfd) -> None:
    """After a while it is said which file another process holds; a link in the lock's place is a typed error."""
    monkeypatch.setattr(cache, "_SILENCE", 0.05)
    path = tmp_path / f"{fingerprint_of(FORMAT_VERSION, 'k')}.lock"
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        threading.Timer(0.5, fcntl.flock, (file, fcntl.LOCK_UN)).start()
        assert_same(cached_body(("k",), lambda: body, directory=tmp_path), body)
    err = capfd.readouterr().err
    assert err.count("waiting for another process") == 1 and str(path) in err
    (tmp_path / f"{fingerprint_of(FORMAT_VERSION, 'l')}.lock").symlink_to(tmp_path / "made by the lock")
    with pytest.raises(StorageError):
        cached_body(("l",), lambda: body, directory=tmp_path)
    assert not (tmp_path / "made by the lock").exists()
    with pytest.raises(StorageError, match="cache folder"):
        cached_body(("m",), lambda: body, directory=path / "below a file")


def test_the_folder_of_the_cache_may_begin_with_a_tilde(tmp_path: Path, monkeypatch) -> None:
    """It is the home folder, not a folder of that name."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("SOFTMODE_CACHE", "~/bodies of mine")
    assert cache_directory() == tmp_path / "bodies of mine"


def test_failed_build_is_not_cached(body: ReducedBody, tmp_path: Path) -> None:
    """An exception of the build passes through, releases the lock and leaves no entry."""

    def fail() -> ReducedBody:
        raise AssetError("no volume")

    with pytest.raises(AssetError, match="no volume"):
        cached_body(("k",), fail, directory=tmp_path)
    assert not list(tmp_path.glob("*.npz"))
    assert_same(cached_body(("k",), lambda: body, directory=tmp_path), body)


def _race(source: Path, folder: Path, log: Path) -> None:
    def build() -> ReducedBody:
        with open(log, "ab") as file:
            file.write(b"x")
        time.sleep(0.3)
        return ReducedBody.load(source)

    cached_body(("race",), build, directory=folder)


def test_ten_processes_build_once(body: ReducedBody, tmp_path: Path) -> None:
    """Ten processes that ask at the same time cause one build, and all succeed."""
    source, folder, log = tmp_path / "source.npz", tmp_path / "cache", tmp_path / "log"
    body.save(source)
    context = multiprocessing.get_context("fork")
    workers = [context.Process(target=_race, args=(source, folder, log)) for _ in range(10)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(60)
    assert [worker.exitcode for worker in workers] == [0] * 10
    assert log.read_bytes() == b"x"
    assert_same(ReducedBody.load(next(folder.glob("*.npz"))), body)


def test_progress_is_reported(quadrature: Quadrature, capsys) -> None:
    """A callable receives ascending fractions that end at 1; False prints nothing; True draws a bar on stderr."""
    seen: list[tuple[str, float]] = []
    build_body(quadrature, SMALL, name="capsule", progress=lambda stage, fraction: seen.append((stage, fraction)))
    fractions = [f for _, f in seen]
    assert fractions == sorted(fractions) and fractions[-1] == 1.0
    build_body(quadrature, SMALL, name="capsule", progress=False)
    assert capsys.readouterr().err == ""
    build_body(quadrature, SMALL, name="capsule", progress=True)
    assert "build capsule" in capsys.readouterr().err


# -- fields ------------------------------------------------------------------------------------------------------------


def test_a_field_of_the_span_is_projected_onto_itself(body: ReducedBody) -> None:
    """An affine field and a sum of functions come back as they are, from values at the cubature points alone."""
    rng = np.random.default_rng(0)
    A, t, q = rng.normal(size=(3, 3)), rng.normal(size=3), rng.normal(size=(body.function_count, 3))
    expected = body.affine(np.eye(3) + A, t)
    np.testing.assert_allclose(body.project(lambda X: X @ A.T + t), expected, atol=1e-11 * np.abs(expected).max())
    np.testing.assert_allclose(body.project(lambda X: body.evaluate(X)[0] @ q), q, atol=1e-11 * np.abs(q).max())


@pytest.mark.rest
def test_the_error_of_a_projected_field_falls_with_the_functions() -> None:
    """With 4, 8 and 16 modes the error of a smooth field falls, at most a tenth above the best there is."""
    quadrature = quadrature_from_box((0.4, 0.1, 0.1), point_count=2000, surface_count=60)
    mass, errors = quadrature.weights / quadrature.volume, []

    def field(X: np.ndarray) -> np.ndarray:
        x, y, z = 10.0 * X.T
        return np.stack([np.sin(2.0 * x) * y, np.cos(1.5 * x), 0.2 * x * x + y * z], axis=1)

    for mode_count in (4, 8, 16):
        options = BuildOptions(mode_count=mode_count, kernel_count=200, cubature_count=200)
        body = build_body(quadrature, options)
        X = quadrature.points - body.offset
        B, v = body.evaluate(X)[0], field(X)
        found, best = (
            np.sqrt(mass @ ((B @ q - v) ** 2).sum(axis=1) / (mass @ (v**2).sum(axis=1)))
            for q in (body.project(field), B.T @ (mass[:, None] * v))
        )
        assert best <= found < 1.1 * best
        errors.append(found)
        momentum = body.mean_basis @ body.project(field)
        np.testing.assert_allclose(momentum, mass @ v, atol=2e-3 * np.abs(mass @ v).max())
    assert errors[1] < 0.75 * errors[0] and errors[2] < 0.5 * errors[1]


@pytest.mark.parametrize("field", [lambda X: X[:, :2], lambda X: np.full_like(X, np.nan)], ids=["shape", "nan"])
def test_fields_that_are_none_are_refused(body: ReducedBody, field) -> None:
    """By name, before anything is solved; too few cubature points are refused too."""
    with pytest.raises(ConfigError, match="field: expected finite vectors"):
        body.project(field)
    first = {f.name: getattr(body.cubature, f.name)[:5] for f in dataclasses.fields(body.cubature)}
    few = dataclasses.replace(body, cubature=BodyCubature(**first))
    with pytest.raises(BasisError, match="5 cubature points tell 5 of"):
        few.project(lambda X: X)
