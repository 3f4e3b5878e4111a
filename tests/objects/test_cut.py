"""Cut objects: splats go to their side or are split, faces are covered, energy and motion go over."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from softmode.deformables import BuildOptions, Material, Patch
from softmode.objects import ObjectConfig, Placed, SoftObject, cut_object, load, write_object
from softmode.objects.cut import split_splats
from softmode.objects.object_file import read_object
from softmode.scenes import SplatScene, motion_of, set_motion
from softmode.splats import Splats
from tests.marks import rest_but

OPTIONS = BuildOptions(function_count=24, cubature_count=128, kernel_count=150)
BOX = ObjectConfig(shape="box", extents=(0.05, 0.05, 0.1), splat_count=1500, surface_count=150, build=OPTIONS)
MATERIAL = Material(youngs_modulus=3e4, density=300.0)


@pytest.fixture(scope="module")
def box() -> SoftObject:
    """A box that stands."""
    return load(BOX, material=MATERIAL)


def world_splats(parts: tuple[SoftObject, ...]) -> NDArray[np.float64]:
    """Return the centres of the splats of parts in asset coordinates."""
    return np.concatenate([part.visible_splats.means + part.body.offset for part in parts])


def test_a_split_gaussian_keeps_mass_mean_and_covariance() -> None:
    """The two halves of a Gaussian, weighed by its mass on either side, have its mean and its covariance."""
    from scipy.stats import norm

    rng = np.random.default_rng(0)
    factor = rng.normal(size=(50, 3, 3))
    one = Splats(
        means=np.zeros((50, 3)),
        quats=rng.normal(size=(50, 4)),
        scales=np.exp(rng.uniform(-4.0, 0.0, (50, 3))),
        opacities=np.full(50, 0.8),
        sh=np.zeros((50, 1, 3)),
    )
    normal = factor[:, 0] / np.linalg.norm(factor[:, 0], axis=1, keepdims=True)
    C = one.covariances()
    s = np.sqrt(np.einsum("ni,nij,nj->n", normal, C, normal))
    z = rng.uniform(-1.9, 1.9, 50)
    both = split_splats(one, z * s, normal)
    front, mean, cov = norm.cdf(z)[:, None], both.means.astype(np.float64), both.covariances()
    weights = [front, 1.0 - front]
    halves = [slice(0, 50), slice(50, 100)]
    found = sum(w * mean[half] for w, half in zip(weights, halves, strict=True))
    np.testing.assert_allclose(found / s[:, None], 0.0, atol=1e-5)
    second = sum(
        w[:, :, None] * (cov[half] + mean[half][:, :, None] * mean[half][:, None])
        for w, half in zip(weights, halves, strict=True)
    )
    scale = np.trace(C, axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(second / scale, C / scale, atol=2e-5)
    side = ((mean * np.tile(normal, (2, 1))).sum(axis=1) + np.tile(z * s, 2)) * np.repeat([1.0, -1.0], 50)
    assert (side > 0.0).all() and (both.opacities <= 0.8 + 1e-6).all()
    far = split_splats(one, np.full(50, np.inf), normal)
    assert far is one


def test_splats_go_to_their_side(box: SoftObject) -> None:
    """No centre lies on the other side, none is lost, straddling ones are two, and the faces are covered."""
    height = 0.013
    parts, cut = cut_object(box, Patch.plane((0.0, 0.0, height), (0.0, 0.0, 1.0)))
    assert len(parts) == 2 and not cut.missed
    sides = [world_splats((part,))[:, 2] - height for part in parts]
    assert (np.sign(np.median(sides[0])) == -np.sign(np.median(sides[1]))) and all(
        (np.sign(np.median(side)) * side > -1e-6).all() for side in sides
    )
    face = sum((np.abs(side) < 1e-6).sum() for side in sides)
    splats = box.visible_splats
    z = splats.means[:, 2] + box.body.offset[2] - height
    straddling = (np.abs(z) < 2.0 * np.sqrt(splats.covariances()[:, 2, 2])).sum()
    assert straddling > 20 and sum(map(len, sides)) == splats.count + straddling + face
    area = sum((abs(part.body.surface.points[:, 2] + part.body.offset[2] - height) < 1e-6).sum() for part in parts)
    assert face > area > 10
    inside = cut_object(box, Patch.plane((0.0, 0.0, height), (0.0, 0.0, 1.0)), inside=(1.0, 0.0, 0.0))[0][0]
    red = np.abs(inside.visible_splats.means[:, 2] + inside.body.offset[2] - height) < 1e-6
    np.testing.assert_allclose(inside.visible_splats.colors()[red], [[1.0, 0.0, 0.0]] * red.sum(), atol=1e-5)


def test_a_patch_that_misses(box: SoftObject) -> None:
    """The object itself comes back."""
    parts, cut = cut_object(box, Patch.plane((0.0, 0.0, 1.0), (0.0, 0.0, 1.0)))
    assert parts == (box,) and cut.missed


def test_a_part_is_saved_with_its_density(box: SoftObject, tmp_path) -> None:
    """The density in the file of a part is its own."""
    body = dataclasses.replace(box.body, provenance={**box.body.provenance, "material": '{"density": 200.0}'})
    (part, _), _ = cut_object(dataclasses.replace(box, body=body), Patch.plane((0.0, 0.0, 0.01), (0.0, 0.0, 1.0)))
    write_object(tmp_path / "part.npz", part.body, part.splats)
    again = read_object(tmp_path / "part.npz")
    assert again.material is not None and again.material.density == pytest.approx(200.0)
    assert again.visible_splats.count == part.visible_splats.count


def placed(parts: tuple[SoftObject, ...], whole: SoftObject) -> list[Placed]:
    """Return parts where they were in the whole, high up."""
    origin = np.array([0.0, 0.0, 1.0]) - whole.body.offset
    return [Placed(object=part, position=tuple((origin + part.body.offset).tolist())) for part in parts]


@pytest.mark.parametrize("seed", rest_but([2], range(3)))
def test_energy_never_grows(box: SoftObject, seed: int) -> None:
    """A stretched, twisted and moving box, cut: kinetic and elastic energy are not above those before, momentum stays.

    What is left of the elastic energy is most of it.
    """
    scene = SplatScene([], placed((box,), box))
    rng = np.random.default_rng(seed)
    fade = 1.0 / (1.0 + np.arange(box.body.function_count))[:, None] ** 1.5
    q = box.body.affine(np.diag([0.9, 0.9, 1.3]), (0.0, 0.0, 1.0)) + 0.01 * fade * rng.normal(size=fade.shape)
    q = q + 0.02 * fade * rng.normal(size=(len(fade), 3))
    scene.state.softmode.q.assign(q)
    scene.state.softmode.qd.assign(2.0 * fade * rng.normal(size=(len(fade), 3)))
    before, kinetic = motion_of(scene), scene.kinetic_energy()
    centre = box.body.mean_basis @ q
    normal = rng.normal(size=3)
    parts, _ = cut_object(box, Patch.plane(centre + 0.01 * normal / np.linalg.norm(normal), normal), q)
    after = SplatScene([], placed(parts, box))
    set_motion(after, before, [0] * len(parts))
    found = motion_of(after)
    assert after.kinetic_energy() <= kinetic * (1.0 + 1e-12)
    assert 0.8 * before.elastic[0] < found.elastic.sum() <= before.elastic[0]
    momentum = (
        sum(part.body.volume * part.body.mean_basis @ qd for part, qd in zip(parts, found.qd, strict=True))
        / box.body.volume
    )
    np.testing.assert_allclose(momentum, box.body.mean_basis @ before.qd[0], atol=1e-9)
    middle = sum(part.body.volume * part.body.mean_basis @ x for part, x in zip(parts, found.q, strict=True))
    np.testing.assert_allclose(middle / box.body.volume, centre, atol=1e-9)
