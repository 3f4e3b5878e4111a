"""Systems that the whole device shares, panel by panel: against float64, and against one team of threads.

On a CPU the same code runs with one thread; the marker ``gpu`` runs it on CUDA.
"""

import numpy as np
import pytest
import warp as wp

from softmode.deformables.model.lane_kernels import LANES, pad
from softmode.deformables.system.factor import PANEL_UNKNOWNS, BlockCholesky
from tests.deformables.test_factor import FLOAT32, eliminated, in_parts, placed, positive_definite, related_parts

CUDA = pytest.param("cuda:0", marks=[pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="no GPU")])
DEVICES = ["cpu", CUDA]


def system_of(A, B, device, by_panels, world=None, part_count=1):
    """Return a BlockCholesky that holds [A | B], with rubbish below the diagonal, which must not be read."""
    count, size, columns = len(A), A.shape[1], B.shape[2]
    world = wp.array(np.arange(count) if world is None else world, dtype=int, device=device)
    system = BlockCholesky(world, size, columns, wp.get_device(device), part_count, by_panels=by_panels)
    host = np.zeros((count, size, size + pad(columns)), np.float32)
    rows, cols = np.arange(size)[:, None] // LANES, np.arange(size)[None] // LANES
    host[:, :, :size] = np.where(cols >= rows, A, np.nan)
    host[:, :, size : size + columns] = B
    system.matrix.assign(host.reshape(count, size, -1, LANES))
    return system


def flags(values, device):
    """Return a device array of int flags."""
    return wp.array(np.asarray(values), dtype=int, device=device)


def outcome(system, device, column=0, tail=None):
    """Factor and solve; return U above the diagonal blocks, what the columns became, the flags and the solution."""
    count = system.system_count
    on = flags(np.ones(count), device)
    known = wp.array(np.zeros((count, 1)) if tail is None else tail, dtype=wp.float64, device=device)
    system.factor(on)
    x = system.solve(on, column, known, 0 if tail is None else tail.shape[1]).numpy().reshape(count, -1)
    M = system.matrix.numpy().reshape(count, system.size, -1)
    rows, cols = np.arange(system.size)[:, None] // LANES, np.arange(M.shape[2])[None] // LANES
    diagonal = np.triu(system.table.diagonal.numpy().reshape(count, -1, LANES, LANES))
    return np.where(cols > rows, M, 0.0), diagonal, system.indefinite.numpy(), x


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("size", [8, 24, 56, 64, 72, 128, 192, 200, 256, 328, 600])
def test_panels_equal_one_team(size, device):
    """Each entry is reduced by the same products in the same order: to a few roundings, columns and flags included."""
    rng = np.random.default_rng(size)
    condition, columns, tails = 100.0, 11, 5
    A, B = positive_definite(rng, 3, size, condition), rng.normal(size=(3, size, columns))
    tail = rng.normal(size=(3, tails))
    found = [outcome(system_of(A, B, device, panels), device, 7, tail) for panels in (False, True)]
    scales = (np.sqrt(condition), np.abs(found[0][1]).max(), 1.0, np.abs(found[0][3]).max())
    for apart, shared, scale in zip(*found, scales, strict=True):
        np.testing.assert_allclose(shared, apart, atol=8 * FLOAT32 * condition * scale)
    expected = np.linalg.solve(A, (B[:, :, 7] - np.einsum("irj,ij->ir", B[:, :, :tails], tail))[:, :, None])[:, :, 0]
    assert np.linalg.norm(found[1][3] - expected) <= 4 * FLOAT32 * condition * np.linalg.norm(expected)
    U = np.swapaxes(np.linalg.cholesky(A), 1, 2)
    Y = np.linalg.solve(np.swapaxes(U, 1, 2), B)
    assert np.abs(found[1][0][:, :, size : size + columns] - Y).max() <= 4 * FLOAT32 * condition * np.abs(Y).max()
    assert not found[1][2].any()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("size", [24, 200, 328])
@pytest.mark.parametrize("bounded", [False, True])
def test_indefinite_systems(size, device, bounded):
    """Pivots are raised as far as before, and only the systems with such pivots are flagged."""
    rng = np.random.default_rng(size)
    A, b = positive_definite(rng, 3, size, 10.0), rng.normal(size=(3, size, 1))
    A[1, -1, -1] -= 12.0
    A[2, -6, -6] -= 12.0  # all that follows grows with the pivot that is raised
    found = []
    for panels in (False, True):
        system = system_of(A, b, device, panels)
        if bounded:
            bounds = np.zeros((3, size // LANES, 2), np.float32)
            bounds[:] = (0.5, 1.0e-3)
            system.table.bounds.assign(bounds)
        found.append(outcome(system, device))
    np.testing.assert_array_equal(found[0][2], [0, 1, 1])
    np.testing.assert_array_equal(found[1][2], found[0][2])
    # without bounds the floor is 1e-6 of the pivot before its block: what follows overflows
    which = slice(None) if bounded else slice(1)
    for apart, shared in zip(*found, strict=True):
        assert np.isfinite(shared[which]).all()
        np.testing.assert_allclose(shared[which], apart[which], atol=1.0e-3 * np.abs(apart[which]).max())


@pytest.mark.parametrize("device", DEVICES)
def test_worlds_that_are_done_are_left_alone(device):
    """Systems of an inactive world keep their bits; the others equal a run of their own, to the bit."""
    rng = np.random.default_rng(5)
    A, b = positive_definite(rng, 3, 136, 10.0), rng.normal(size=(3, 136, 1))
    system = system_of(A, b, device, True, world=[0, 0, 1])
    before = system.matrix.numpy().copy()
    on, known = flags([0, 1], device), wp.zeros((2, 1), dtype=wp.float64, device=device)
    system.factor(on)
    x = system.solve(on, 0, known, 0).numpy()
    np.testing.assert_array_equal(system.matrix.numpy()[:2], before[:2])
    np.testing.assert_array_equal(x[:2], 0.0)
    alone = outcome(system_of(A[2:], b[2:], device, True), device)
    np.testing.assert_array_equal(x[2].reshape(-1), alone[3][0])


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("part", [24, 72])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_parts(part, share, device):
    """Blocks of unrelated parts are neither read nor written, parts that do not exist cost nothing."""
    rng = np.random.default_rng(part)
    count, part_count, columns = 3, 6, 3
    relations = related_parts(rng, count, part_count, share)
    relations[2, -1] = relations[2, :, -1] = False  # the last system has a part less
    place, pattern = eliminated(relations)
    exists = relations[:, range(part_count), range(part_count)]
    relations[2, -1, -1] = True
    A, B = in_parts(rng, relations, part), rng.normal(size=(count, part_count * part, columns))
    A, B = placed(A, place, part, 2), placed(B, place, part, 1)
    left_out = np.kron(~pattern & ~np.eye(part_count, dtype=bool), np.ones((part, part), bool))
    size = part_count * part
    used = size - part * (~exists).sum(axis=1)
    poisoned, columns_in = np.where(left_out, np.nan, A), B.copy()
    poisoned[2, used[2] :], columns_in[2, used[2] :] = np.nan, np.nan
    found = []
    for panels in (False, True):
        system = system_of(poisoned, columns_in, device, panels, part_count=part_count)
        there = np.eye(part_count, dtype=bool) & (np.arange(part_count) < used[:, None, None] / part)
        system.pattern.assign((pattern | there).astype(np.int32))
        found.append(outcome(system, device, 1))
    for k in range(count):
        end = used[k]
        assert not found[1][2].any()
        expected = np.linalg.solve(A[k, :end, :end], B[k, :end, 1])
        assert np.linalg.norm(found[1][3][k, :end] - expected) <= 100 * FLOAT32 * np.linalg.norm(expected)
        for apart, shared in zip(found[0], found[1], strict=True):
            if apart.ndim == 3 and apart.shape[1] == size:
                np.testing.assert_array_equal(np.isnan(shared[k]), np.isnan(apart[k]))
                np.testing.assert_allclose(shared[k], apart[k], atol=1.0e-4)


@pytest.mark.parametrize("device", DEVICES)
def test_singular_matrix_stays_finite(device):
    """A semidefinite matrix is solved with floored pivots, across panels too."""
    A = np.zeros((1, 144, 144))
    A[0, :100, :100] = 1.0
    assert np.isfinite(outcome(system_of(A, np.ones((1, 144, 1)), device, True), device)[3]).all()


@pytest.mark.parametrize("device", DEVICES)
def test_captured_equals_eager(device):
    """A replayed graph gives the bits of the launches."""
    rng = np.random.default_rng(1)
    A, b = positive_definite(rng, 2, 264, 100.0), rng.normal(size=(2, 264, 1))
    system = system_of(A, b, device, True)
    before = wp.clone(system.matrix)
    eager = outcome(system, device)[3]
    on, known = flags([1, 1], device), wp.zeros((2, 1), dtype=wp.float64, device=device)
    with wp.ScopedCapture(device=device) as capture:
        wp.copy(system.matrix, before)
        system.factor(on)
        system.solve(on, 0, known, 0)
    system.table.solution.zero_()
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(system.table.solution.numpy().reshape(2, -1), eager)


def test_path_is_chosen_by_size():
    """On CUDA systems of 256 unknowns and more go by panels; on a CPU one thread takes a system."""
    world = wp.array([0], dtype=int, device="cpu")
    assert not BlockCholesky(world, 264, 1, wp.get_device("cpu")).by_panels
    assert PANEL_UNKNOWNS % LANES == 0
