"""Skinning kernels against their NumPy twins, and exact affine motion."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp
from scipy.linalg import polar

from softmode.deformables.skinning import averages
from softmode.deformables.skinning.averages import average_basis
from softmode.deformables.skinning.skin_splats import STRETCH_LIMIT, SkinSplats
from softmode.deformables.skinning.skinning_kernels import vec6
from softmode.errors import BasisError
from softmode.splats.splats import rotations_from_quats

FLOAT32 = np.finfo(np.float32).eps
N, M, WORLDS = 60, 12, 3


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> str:
    """Every device that is there."""
    if request.param != "cpu" and not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    return request.param


class Case:
    """Random splats of a few centimetres under the basis {W_j} x {X, Y, Z, 1}, with q of WORLDS instances."""

    def __init__(self, seed: int = 0, amplitude: float = 0.02) -> None:
        rng = np.random.default_rng(seed)
        self.means = rng.uniform(-0.04, 0.04, size=(N, 3)).astype(np.float32).astype(np.float64)
        root = 2e-3 * rng.normal(size=(N, 3, 3))
        self.covariances = root @ root.transpose(0, 2, 1)
        x = self.means
        wave = np.stack([np.ones(N), np.cos(40 * x[:, 0]), np.sin(30 * x[:, 2])], axis=1)
        slope = np.zeros((N, 3, 3))
        slope[:, 1, 0] = -40 * np.sin(40 * x[:, 0])
        slope[:, 2, 2] = 30 * np.cos(30 * x[:, 2])
        one = np.concatenate([x, np.ones((N, 1))], axis=1)
        unit = np.concatenate([np.eye(3), np.zeros((1, 3))])
        self.basis = np.einsum("nj,nc->njc", wave, one).reshape(N, M)
        self.grad = (
            np.einsum("njd,nc->njcd", slope, one) + np.einsum("nj,cd->njcd", wave, unit)
        ).reshape(N, M, 3)  # fmt: skip
        self.q = amplitude * rng.normal(size=(WORLDS, M, 3))
        self.qd = rng.normal(size=(WORLDS, M, 3))
        self.pad = 2

    def flat(self, values: np.ndarray, device: str) -> wp.array:
        """Return q of all instances in one array with foreign entries before each instance."""
        padded = np.concatenate([np.full((len(values), self.pad, 3), 1e6), values], axis=1)
        return wp.array(padded.reshape(-1, 3), dtype=wp.vec3d, device=device)

    def starts(self, device: str) -> wp.array:
        """Return where each instance begins."""
        return wp.array(self.pad + (M + self.pad) * np.arange(WORLDS), dtype=wp.int32, device=device)

    def skin(self, device: str, **kwargs: Any) -> SkinSplats:
        """Return the object on the device."""
        return SkinSplats(self.means, self.covariances, self.basis, self.grad, device=device, **kwargs)

    def gradients(self) -> np.ndarray:
        """Return F of all worlds and splats."""
        return np.eye(3) + np.einsum("wka,nkb->wnab", self.q, self.grad)


def run(case: Case, device: str, first: int = 0, **kwargs: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return deformed means and covariances, shapes (WORLDS, N, 3) and (WORLDS, N, 3, 3)."""
    means = wp.zeros((WORLDS, first + N), dtype=wp.vec3, device=device)
    covariances = wp.zeros((WORLDS, first + N), dtype=vec6, device=device)
    skin = case.skin(device, **kwargs)
    skin.launch(case.flat(case.q, device), case.starts(device), means, covariances, first_splat=first)
    assert not means.numpy()[:, :first].any()
    six = covariances.numpy()[:, first:]
    return means.numpy()[:, first:], six[..., [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


def test_matches_numpy(device: str) -> None:
    """X + sum b q and F Sigma F^T, in float64 NumPy; rounding of F scales with the sum of |q| |grad b|."""
    case = Case()
    means, covariances = run(case, device, first=5, stretch_limit=1e9)
    np.testing.assert_allclose(means, case.means + np.einsum("nk,wka->wna", case.basis, case.q), atol=4 * FLOAT32 * 0.3)
    f = case.gradients()
    size = 1.0 + np.einsum("wka,nkb->wnab", np.abs(case.q), np.abs(case.grad)).max(axis=(2, 3))
    bound = 40 * FLOAT32 * size**2 * np.abs(case.covariances).max(axis=(1, 2))
    assert (np.abs(covariances - f @ case.covariances @ f.transpose(0, 1, 3, 2)) < bound[..., None, None]).all()


def test_dents_move_splats(device: str) -> None:
    """Each centre moves by sum_k share_k dent[near_k] of its own world; in a world without dents not by a bit."""
    case, rng = Case(), np.random.default_rng(3)
    samples, pad = 7, 2
    near, share = rng.integers(0, samples, (N, 4)), rng.random((N, 4)).astype(np.float32)
    dent = 1e-3 * rng.normal(size=(WORLDS, samples + pad, 3)).astype(np.float32)
    dent[1, pad:] = 0.0
    still, _ = run(case, device)
    flat = wp.array(dent.reshape(-1, 3), dtype=wp.vec3, device=device)
    first = wp.array(pad + (samples + pad) * np.arange(WORLDS), dtype=wp.int32, device=device)
    out = wp.zeros((WORLDS, N), dtype=wp.vec3, device=device)
    skin = case.skin(device, near=near, share=share, sample_count=samples)
    q = (case.flat(case.q, device), case.starts(device))
    skin.launch(*q, out, wp.zeros(out.shape, dtype=vec6, device=device), dent=flat, sample_start=first)
    moved = np.einsum("nk,wnkd->wnd", share, dent[:, pad:][:, near])
    np.testing.assert_allclose(out.numpy(), still + moved, atol=8 * FLOAT32 * 0.3)
    np.testing.assert_array_equal(out.numpy()[1], still[1])
    with pytest.raises(BasisError, match="near"):
        case.skin(device, near=near, share=share, sample_count=5)


def test_affine_motion_is_exact(device: str) -> None:
    """Q of x = A X + t gives means A X + t and covariances A Sigma A^T, a metre away from home too."""
    case = Case()
    a = np.array([[0.9, -0.5, 0.1], [0.4, 1.2, 0.2], [0.0, -0.3, 0.8]])
    t = np.array([1.5, -2.0, 0.7])
    case.q[:] = 0.0
    case.q[:, :3] = (a - np.eye(3)).T
    case.q[:, 3] = t
    means, covariances = run(case, device)
    expected = case.means @ a.T + t
    np.testing.assert_allclose(means, np.broadcast_to(expected, means.shape), atol=FLOAT32 * np.abs(t).max())
    sigma = a @ case.covariances @ a.T
    np.testing.assert_allclose(covariances, np.broadcast_to(sigma, covariances.shape), atol=50 * FLOAT32 * sigma.max())


def test_stretch_is_limited_and_compression_is_not(device: str) -> None:
    """Singular values of F are cut to the limit; below it F is left as it is."""
    case = Case(amplitude=0.0)
    case.covariances[:] = 1e-6 * np.eye(3)
    case.q[:, :3] = np.diag([40.0, 1.0, -0.999])
    _, covariances = run(case, device)
    expected = 1e-6 * np.diag([STRETCH_LIMIT, 2.0, 1e-3]) ** 2
    np.testing.assert_allclose(covariances[0, 0], expected, atol=1e-5 * expected.max())
    case.q[:, :3] = np.diag([0.5, -0.9, 0.0])
    _, covariances = run(case, device)
    expected = 1e-6 * np.diag([1.5, 0.1, 1.0]) ** 2
    np.testing.assert_allclose(covariances[0, 0], expected, atol=1e-6 * expected.max())


def test_worlds_are_independent(device: str) -> None:
    """World i of three is bitwise the single world with the same q."""
    case = Case()
    means, covariances = run(case, device)
    for world in range(WORLDS):
        single = Case()
        single.q[:] = case.q[world]
        alone = run(single, device)
        np.testing.assert_array_equal(means[world], alone[0][0])
        np.testing.assert_array_equal(covariances[world], alone[1][0])


def rotated(f: np.ndarray, device: str) -> np.ndarray:
    """Return the rotations that skinning finds of one F per world, as matrices; every splat of a world has the same."""
    case = Case(amplitude=0.0)
    q = np.zeros((len(f), M, 3))
    q[:, :3] = (f - np.eye(3)).transpose(0, 2, 1)
    start = wp.array((M + case.pad) * np.arange(len(f)) + case.pad, dtype=wp.int32, device=device)
    means, covariances, rotations = (
        wp.zeros((len(f), N + 3), dtype=dtype, device=device) for dtype in (wp.vec3, vec6, wp.quat)
    )
    case.skin(device).launch(case.flat(q, device), start, means, covariances, rotations=rotations, first_splat=3)
    assert not rotations.numpy()[:, :3].any()
    found = rotations.numpy()[:, 3:].astype(np.float64)
    np.testing.assert_array_equal(found, np.broadcast_to(found[:, :1], found.shape))
    np.testing.assert_allclose(np.linalg.norm(found, axis=2), 1.0, atol=4 * FLOAT32)
    return rotations_from_quats(found[:, 0])


def turns(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return rotations about random axes by 0 to 180 degrees, a tenth of them by 180."""
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.where(np.arange(count) % 10 == 0, np.pi, rng.uniform(0.0, np.pi, count))[:, None]
    return rotations_from_quats(np.concatenate([np.sin(angle / 2) * axis, np.cos(angle / 2)], axis=1))


@pytest.mark.parametrize(
    ("third", "tolerance"),
    [((0.2, 3.0), 16), ((1e-6, 1e-2), 16), ((-0.05, -0.01), 32)],
    ids=["stretched", "nearly singular", "inverted"],
)
def test_rotation_of_the_deformation_gradient(device: str, third: tuple[float, float], tolerance: float) -> None:
    """R maximises tr(R^T F) over the proper rotations: with the singular value decomposition U diag(1, 1, d) V^T.

    Where det F > 0 that is the polar factor of scipy. The rounding of F alone turns R by about eps |F| / (s2 + s3).
    """
    rng = np.random.default_rng(1)
    count = 1000
    stretch = rng.uniform(0.2, 3.0, size=(count, 3))
    stretch[:, 2] = rng.uniform(*third, size=count)
    v = turns(rng, count)
    f = turns(rng, count) @ v * stretch[:, None, :] @ v.transpose(0, 2, 1)
    found = rotated(f, device)
    left, s, right = np.linalg.svd(f)
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    expected = left @ right
    if third[0] > 0.0:
        np.testing.assert_allclose(expected, [polar(matrix)[0] for matrix in f], atol=1e-9)
    bound = tolerance * FLOAT32 * s[:, 0] / (s[:, 1] + np.sign(third[0]) * s[:, 2])
    assert (np.abs(found - expected).max(axis=(1, 2)) < bound).all()


def test_rotation_where_none_is_nearest(device: str) -> None:
    """Point, line and mirrored F have no single nearest rotation: any proper one will do, NaN will not."""
    u = np.array([0.6, 0.0, 0.8])
    f = np.stack([np.zeros((3, 3)), np.outer(u, u), -np.eye(3), np.diag([1.0, 1.0, -1.0]), np.full((3, 3), 1e-30)])
    for r in rotated(f, device):
        np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-6)
        assert np.linalg.det(r) > 0.0


def test_rotations_are_left_out_of_degree_zero(device: str) -> None:
    """The placeholder of `SplatArrays` stays as it is; any other shape is refused."""
    case = Case()
    means = wp.zeros((WORLDS, N), dtype=wp.vec3, device=device)
    covariances = wp.zeros((WORLDS, N), dtype=vec6, device=device)
    q, starts, skin = case.flat(case.q, device), case.starts(device), case.skin(device)
    none = wp.zeros((1, 1), dtype=wp.quat, device=device)
    skin.launch(q, starts, means, covariances, rotations=none)
    assert not none.numpy().any()
    with pytest.raises(BasisError, match=r"rotations has shape \(1, 60\)"):
        skin.launch(q, starts, means, covariances, rotations=wp.zeros((1, N), dtype=wp.quat, device=device))


def test_averages_of_quadratic_functions_are_exact() -> None:
    """E[b] = b + tr(H Sigma) / 2 and E[grad b] = grad b for b of degree two, of discs, needles and points too."""
    rng = np.random.default_rng(0)
    case = Case()
    case.covariances[0] = 0.0
    case.covariances[1] = np.diag([1e-6, 0.0, 0.0])
    hessian = rng.normal(size=(M, 3, 3))
    hessian += hessian.transpose(0, 2, 1)
    slope, constant = rng.normal(size=(M, 3)), rng.normal(size=M)

    def values(x: np.ndarray) -> np.ndarray:
        return constant + x @ slope.T + 0.5 * np.einsum("ni,kij,nj->nk", x, hessian, x)

    def evaluate(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return values(x), slope + np.einsum("kij,nj->nki", hessian, x)

    def functions(narrow: float) -> SimpleNamespace:
        return SimpleNamespace(values=values, evaluate=evaluate, narrow=narrow)

    basis, gradient = average_basis(functions(0.0), case.means, case.covariances)
    expected = values(case.means) + 0.5 * np.einsum("kij,nij->nk", hessian, case.covariances)
    # A point is as wide as 1e-5 of the object, at most: its average is off by the square of that.
    np.testing.assert_allclose(basis, expected, atol=1e-10)
    np.testing.assert_allclose(gradient, evaluate(case.means)[1], atol=1e-8)
    # Splats that are narrow take both at their centre: the median of the widths says which.
    width = np.sqrt(3.0 * np.linalg.eigvalsh(case.covariances)[:, 2])
    narrow = width <= np.median(width)
    mixed = average_basis(functions(float(np.median(width))), case.means, case.covariances)
    np.testing.assert_array_equal(mixed[0][narrow], values(case.means)[narrow])
    np.testing.assert_array_equal(mixed[0][~narrow], basis[~narrow])


def test_averages_of_many_splats_are_those_of_each(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a grid a quadratic function keeps its averages to rounding, and at a step the error is bounded."""
    rng = np.random.default_rng(1)
    means = rng.uniform(-0.04, 0.04, (500, 3))
    scales = rng.uniform(2e-4, 3e-3, (500, 3))
    covariances = scales[:, :, None] ** 2 * np.eye(3)
    slope = np.array([[1.0, 0.0, 0.0], [0.0, 0.5, -1.0]])

    def values(x: np.ndarray) -> np.ndarray:
        step = 0.02 * np.tanh(x[:, :1] / 1e-4)
        return np.concatenate([x @ slope.T + 5.0 * (x * x) @ slope.T, step], axis=1)

    def evaluate(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        smooth = slope + 10.0 * slope * x[:, None]
        step = 200.0 / np.cosh(np.clip(x[:, None, :1] / 1e-4, -300.0, 300.0)) ** 2 * np.array([1.0, 0.0, 0.0])
        return values(x), np.concatenate([smooth, step], axis=1)

    functions = SimpleNamespace(values=values, evaluate=evaluate, narrow=2e-3)
    each = average_basis(functions, means, covariances)
    monkeypatch.setattr(averages, "MANY", 500)
    shares: list[float] = []
    grid = average_basis(functions, means, covariances, progress=shares.append)
    assert shares == sorted(shares) and shares[-1] == 1.0
    np.testing.assert_allclose(grid[0][:, :2], each[0][:, :2], atol=1e-7)
    np.testing.assert_allclose(grid[1][:, :2], each[1][:, :2], atol=2e-4)
    beside = np.abs(means[:, 0]) < 1e-3
    bound = averages.TOLERANCE * np.sqrt(np.mean(each[1] ** 2))
    np.testing.assert_allclose(grid[1][beside], each[1][beside], rtol=0.0, atol=bound)


def test_average_of_a_step_is_bounded_by_its_height() -> None:
    """Across a jump of one between the cubature points F is 1 / (2 sqrt(3) sigma), however thin the jump is."""
    sigma = 2e-3
    for width in (1e-4, 1e-6):
        step = SimpleNamespace(values=lambda x, w=width: 0.5 * np.tanh(x[:, :1] / w), narrow=0.0)
        _, gradient = average_basis(step, np.zeros((1, 3)), sigma**2 * np.eye(3)[None])
        np.testing.assert_allclose(gradient[0, 0], [1.0 / (2.0 * np.sqrt(3.0) * sigma), 0.0, 0.0], rtol=1e-9)


def test_refuses_shapes_that_do_not_belong_together() -> None:
    """The message lists the shapes."""
    case = Case()
    with pytest.raises(BasisError, match=r"basis \(60, 11\)"):
        SkinSplats(case.means, case.covariances, case.basis[:, 1:], case.grad, device="cpu")
    for shape, first in (((1, N), 0), ((WORLDS, N - 1), 0), ((WORLDS, N), 1), ((WORLDS, N), -1)):
        outputs = wp.zeros(shape, dtype=wp.vec3, device="cpu"), wp.zeros(shape, dtype=vec6, device="cpu")
        with pytest.raises(BasisError, match="of 3 worlds"):
            case.skin("cpu").launch(case.flat(case.q, "cpu"), case.starts("cpu"), *outputs, first_splat=first)


def test_a_first_launch_is_not_captured(device: str) -> None:
    """Buffers made in a capture would go with its graph; after one launch for as many worlds, it is captured."""
    case = Case()
    q, starts, skin = case.flat(case.q, device), case.starts(device), case.skin(device)
    means = wp.zeros((WORLDS, N), dtype=wp.vec3, device=device)
    covariances = wp.zeros((WORLDS, N), dtype=vec6, device=device)
    case.skin(device).launch(q, starts, means, covariances)  # compiles
    eager = means.numpy()
    with wp.ScopedCapture(device=device), pytest.raises(BasisError, match="first launch for 3 worlds"):
        skin.launch(q, starts, means, covariances)
    skin.launch(q, starts, means, covariances)
    with wp.ScopedCapture(device=device) as capture:
        skin.launch(q, starts, means, covariances)
    means.zero_()
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(means.numpy(), eager)


@pytest.mark.parametrize(("count", "worlds"), [(1, 3), (15, 2), (16, 5), (17, 4), (53, 9)])
def test_any_number_of_splats_and_worlds(device: str, count: int, worlds: int) -> None:
    """Centres X + sum_k b_k q_k and F Sigma F^T are right around the size of the blocks that a thread may take.

    World i of many equals the single world bitwise, and columns beside the object's stay as they were.
    """
    rng = np.random.default_rng(count)
    n, before, after = 5, 2, 4
    means = rng.normal(size=(count, 3)).astype(np.float32).astype(np.float64)
    root = 0.1 * rng.normal(size=(count, 3, 3))
    covariances = (root @ root.transpose(0, 2, 1)).astype(np.float32).astype(np.float64)
    basis, gradients = rng.normal(size=(count, n)), 0.2 * rng.normal(size=(count, n, 3))
    q = 0.3 * rng.normal(size=(worlds, n, 3))
    skin = SkinSplats(means, covariances, basis, gradients, stretch_limit=100.0, device=device)

    def moved(some: np.ndarray) -> list[np.ndarray]:
        shape = (len(some), before + count + after)
        out = [wp.full(shape, -7.0, dtype=wp.vec3, device=device), wp.full(shape, -7.0, dtype=vec6, device=device)]
        start = wp.array(np.arange(len(some)) * n, dtype=wp.int32, device=device)
        skin.launch(wp.array(some.reshape(-1, 3), dtype=wp.vec3d, device=device), start, *out, first_splat=before)
        return [array.numpy() for array in out]

    x, s = moved(q)
    f = np.eye(3) + np.einsum("wka,nkb->wnab", q, gradients)
    expected = f @ covariances @ f.transpose(0, 1, 3, 2)
    six = expected[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    inside = slice(before, before + count)
    np.testing.assert_allclose(x[:, inside], means + np.einsum("wka,nk->wna", q, basis), atol=1e-6 * n)
    np.testing.assert_allclose(s[:, inside], six, atol=1e-5 * np.abs(six).max())
    for array in (x, s):
        assert (array[:, :before] == -7.0).all() and (array[:, before + count :] == -7.0).all()
    for world in range(worlds):
        for many, single in zip((x, s), moved(q[world : world + 1]), strict=True):
            np.testing.assert_array_equal(many[world], single[0])
