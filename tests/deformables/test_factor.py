"""Block Cholesky: against dense float64 solves, for several sizes, with columns carried along and worlds left alone."""

import numpy as np
import pytest
import warp as wp

from softmode.deformables.model.lane_kernels import LANES, pad
from softmode.deformables.system.factor import BlockCholesky

FLOAT32 = float(np.finfo(np.float32).eps)


def positive_definite(rng, count, size, condition):
    """Return symmetric matrices (count, size, size) with eigenvalues from 1 to the condition number."""
    Q = np.linalg.qr(rng.normal(size=(count, size, size)))[0]
    return (Q * np.geomspace(1.0, condition, size)) @ np.swapaxes(Q, 1, 2)


def build(A, B, world=None):
    """Return a BlockCholesky that holds [A | B], with rubbish below the diagonal, which must not be read."""
    count, size, columns = len(A), A.shape[1], B.shape[2]
    with wp.ScopedDevice("cpu"):
        world = wp.array(np.arange(count) if world is None else world, dtype=int)
        system = BlockCholesky(world, size, columns, "cpu")
        host = np.zeros((count, size, (size + pad(columns)) // LANES * LANES), np.float32)
        rows, cols = np.arange(size)[:, None] // LANES, np.arange(size)[None] // LANES
        host[:, :, :size] = np.where(cols >= rows, A, 1.0e6)
        host[:, :, size : size + columns] = B
        system.matrix.assign(host.reshape(count, size, -1, LANES))
    return system


def flags(values):
    """Return a device array of int flags."""
    return wp.array(np.asarray(values), dtype=int, device="cpu")


def no_tail(count):
    """Return an empty Schur correction."""
    return wp.zeros((count, 1), dtype=wp.float64, device="cpu")


@pytest.mark.parametrize("count", [0, 1, 8, 9, 100])
def test_pad(count):
    """pad(n) is the least multiple of 8 that is >= n."""
    assert pad(count) % LANES == 0
    assert 0 <= pad(count) - count < LANES


@pytest.mark.parametrize("size", [8, 24, 72, 120])
@pytest.mark.parametrize("condition", [10.0, 1.0e4])
def test_solve(size, condition):
    """A x = b to float32: |x - A^-1 b| <= c eps cond(A) |x|."""
    rng = np.random.default_rng(size)
    A, b = positive_definite(rng, 3, size, condition), rng.normal(size=(3, size, 1))
    system = build(A, b)
    system.factor(flags([1, 1, 1]))
    x = system.solve(flags([1, 1, 1]), 0, no_tail(3), 0).numpy().reshape(3, size)
    expected = np.linalg.solve(A, b)[:, :, 0]
    assert np.linalg.norm(x - expected) <= 4 * FLOAT32 * condition * np.linalg.norm(expected)


def test_factor_carries_the_columns():
    """[A | B] ends as [U | U^-T B] with A = U^T U."""
    rng = np.random.default_rng(0)
    size, columns = 48, 11
    A, B = positive_definite(rng, 2, size, 100.0), rng.normal(size=(2, size, columns))
    system = build(A, B)
    system.factor(flags([1, 1]))
    Y = system.matrix.numpy().reshape(2, size, -1)[:, :, size : size + columns]
    U = np.swapaxes(np.linalg.cholesky(A), 1, 2)
    expected = np.linalg.solve(np.swapaxes(U, 1, 2), B)
    assert np.abs(Y - expected).max() <= 4 * FLOAT32 * 100.0 * np.abs(expected).max()


@pytest.mark.parametrize("tail_count", [1, 7, 8, 13])
def test_back_substitution_with_known_unknowns(tail_count):
    """[A C; C^T R] [x; t] = [b; ...]: with t known, x = A^-1 (b - C t), b in the column behind C."""
    rng = np.random.default_rng(tail_count)
    size = 40
    A, C = positive_definite(rng, 1, size, 100.0), rng.normal(size=(1, size, tail_count))
    b, t = rng.normal(size=(1, size, 1)), rng.normal(size=(1, tail_count))
    system = build(A, np.concatenate([C, b], axis=2))
    system.factor(flags([1]))
    tail = wp.array(t, dtype=wp.float64, device="cpu")
    x = system.solve(flags([1]), tail_count, tail, tail_count).numpy().reshape(size)
    expected = np.linalg.solve(A[0], b[0, :, 0] - C[0] @ t[0])
    assert np.linalg.norm(x - expected) <= 4 * FLOAT32 * 100.0 * np.linalg.norm(expected)


def test_worlds_that_are_done_are_left_alone():
    """Systems of an inactive world keep their bits; the others equal a run of their own."""
    rng = np.random.default_rng(5)
    A, b = positive_definite(rng, 3, 24, 10.0), rng.normal(size=(3, 24, 1))
    system = build(A, b, world=[0, 0, 1])
    before = system.matrix.numpy().copy()
    system.factor(flags([0, 1]))
    x = system.solve(flags([0, 1]), 0, no_tail(2), 0).numpy()
    np.testing.assert_array_equal(system.matrix.numpy()[:2], before[:2])
    np.testing.assert_array_equal(x[:2], 0.0)
    alone = build(A[2:], b[2:])
    alone.factor(flags([1]))
    np.testing.assert_array_equal(x[2], alone.solve(flags([1]), 0, no_tail(1), 0).numpy()[0])


def test_singular_matrix_stays_finite():
    """A semidefinite matrix (a mode without stiffness) is solved with a floored pivot: finite, no NaN."""
    A = np.zeros((1, 16, 16))
    A[0, :8, :8] = np.ones((8, 8))
    system = build(A, np.ones((1, 16, 1)))
    system.factor(flags([1]))
    assert np.isfinite(system.solve(flags([1]), 0, no_tail(1), 0).numpy()).all()


# -- systems made of parts ---------------------------------------------------------------------------------------------


def related_parts(rng, count, part_count, share):
    """Return random symmetric relations (count, part_count, part_count) of which about a ``share`` is there."""
    upper = np.triu(rng.random((count, part_count, part_count)) < share, 1)
    return upper | np.swapaxes(upper, 1, 2) | np.eye(part_count, dtype=bool)


def in_parts(rng, relations, part):
    """Return positive definite matrices whose blocks of unrelated parts are zero, of condition about 10."""
    count, part_count = relations.shape[:2]
    size = part_count * part
    A = rng.normal(size=(count, size, size))
    A = (A + np.swapaxes(A, 1, 2)) * np.kron(relations, np.ones((part, part)))
    low = np.linalg.eigvalsh(A)[:, 0]
    spread = np.linalg.eigvalsh(A)[:, -1] - low
    return A + (0.1 * spread - low)[:, None, None] * np.eye(size)


def eliminated(relations):
    """Return where least-degree elimination places each part (count, n), and the relations of the factor, by place."""
    place, pattern = np.zeros(relations.shape[:2], int), np.zeros(relations.shape, bool)
    for relation, places, out in zip(relations.copy(), place, pattern, strict=True):
        left = list(range(len(relation)))
        for step in range(len(relation)):
            best = min(left, key=lambda part: relation[part, left].sum())
            left.remove(best)
            near = [part for part in left if relation[best, part]]
            relation[np.ix_(near, near)] = True
            places[best] = step
        order = np.argsort(places)
        out[:] = np.triu(relation[np.ix_(order, order)], 1)
    return place, pattern


def placed(values, place, part, axes):
    """Return matrices with the rows (and columns) of part p moved to place[p]."""
    rows = [np.concatenate([np.arange(part) + part * p for p in np.argsort(one)]) for one in place]
    return np.stack([a[np.ix_(r, r)] if axes == 2 else a[r] for a, r in zip(values, rows, strict=True)])


@pytest.mark.parametrize("part", [8, 24])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_parts(part, share):
    """A x = b where most parts have nothing to do with each other: the pattern fills in as the Cholesky factor does.

    What it leaves out is neither read nor written.
    """
    rng = np.random.default_rng(part)
    count, part_count, columns = 3, 6, 3
    relations = related_parts(rng, count, part_count, share)
    place, pattern = eliminated(relations)
    A, B = in_parts(rng, relations, part), rng.normal(size=(count, part_count * part, columns))
    A, B = placed(A, place, part, 2), placed(B, place, part, 1)
    left_out = np.kron(~pattern & ~np.eye(part_count, dtype=bool), np.ones((part, part), bool))
    poisoned = np.where(left_out, np.nan, A)
    world = wp.array(np.arange(count), dtype=int, device="cpu")
    system = BlockCholesky(world, part_count * part, columns, "cpu", part_count)
    rows = np.concatenate([poisoned, np.pad(B, ((0, 0), (0, 0), (0, pad(columns) - columns)))], axis=2)
    system.matrix.assign(rows.astype(np.float32).reshape(count, part_count * part, -1, LANES))
    system.relation.assign(relations.astype(np.int32))
    system.order_parts()
    np.testing.assert_array_equal(system.place.numpy(), place)
    np.testing.assert_array_equal(np.triu(system.pattern.numpy(), 1) != 0, pattern)
    system.factor(flags([1] * count))
    assert not system.indefinite.numpy().any()
    expected = np.linalg.solve(A, B)
    U = np.swapaxes(np.linalg.cholesky(A), 1, 2)
    Y = system.matrix.numpy().reshape(count, part_count * part, -1)[:, :, part_count * part :][:, :, :columns]
    np.testing.assert_allclose(Y, np.linalg.solve(np.swapaxes(U, 1, 2), B), atol=100 * FLOAT32 * np.abs(B).max())
    for column in range(columns):
        x = system.solve(flags([1] * count), column, no_tail(count), 0).numpy().reshape(count, -1)
        error = np.linalg.norm(x - expected[:, :, column])
        assert error <= 100 * FLOAT32 * np.linalg.norm(expected[:, :, column])


def test_parts_with_known_unknowns():
    """The Schur correction reaches every part, whatever the pattern."""
    rng = np.random.default_rng(0)
    relations = related_parts(rng, 1, 4, 0.4)
    place, _ = eliminated(relations)
    A, C = placed(in_parts(rng, relations, 16), place, 16, 2), rng.normal(size=(1, 64, 5))
    b, t = rng.normal(size=(1, 64, 1)), rng.normal(size=(1, 5))
    world = wp.array([0], dtype=int, device="cpu")
    system = BlockCholesky(world, 64, 6, "cpu", 4)
    rows = np.concatenate([A, C, b, np.zeros((1, 64, 2))], axis=2)
    system.matrix.assign(rows.astype(np.float32).reshape(1, 64, -1, LANES))
    system.relation.assign(relations.astype(np.int32))
    system.order_parts()
    system.factor(flags([1]))
    x = system.solve(flags([1]), 5, wp.array(t, dtype=wp.float64, device="cpu"), 5).numpy().reshape(64)
    expected = np.linalg.solve(A[0], b[0, :, 0] - C[0] @ t[0])
    assert np.linalg.norm(x - expected) <= 100 * FLOAT32 * np.linalg.norm(expected)


def test_order_of_parts():
    """A star is eliminated without fill, its centre last but one; parts that do not exist keep their places."""
    relations = np.zeros((1, 6, 6), bool)
    relations[0, 0, 1:4] = relations[0, 1:4, 0] = True
    relations[0, range(4), range(4)] = True
    system = BlockCholesky(wp.array([0], dtype=int, device="cpu"), 48, 1, "cpu", 6)
    system.relation.assign(relations.astype(np.int32))
    system.order_parts()
    np.testing.assert_array_equal(system.place.numpy()[0], [2, 0, 1, 3, 4, 5])
    assert np.triu(system.pattern.numpy()[0], 1).sum() == 3
