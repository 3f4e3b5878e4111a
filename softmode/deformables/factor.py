"""Batched block Cholesky factorisation and solve with right-hand columns, on CPU and CUDA alike.

Each system is a dense symmetric positive definite matrix A (N x N) with M extra columns B appended: [A | B]. The
factorisation A = U^T U runs row block by row block and carries B along, so that it ends as [U | U^-T B]: the forward
substitution of every right-hand side, and the half of a Schur complement, come with it.

Rows are stored as 8-wide vectors. Measured on one CPU core (112 x 256 x 112 product, AVX-512): arithmetic on
``wp.types.vector(length=8)`` or 16 reaches 50-150 Gflop/s where ``wp.tile_matmul`` reaches 9, because Warp's CPU tiles
are scalar loops; on CUDA the same code is a register-blocked product, parallel over systems and column blocks.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

LANES = 8
"""Width of the row vectors; every dimension is padded to a multiple of it."""

vec8 = wp.types.vector(length=LANES, dtype=float)
mat88 = wp.types.matrix(shape=(LANES, LANES), dtype=float)


def pad(count: int) -> int:
    """Return ``count`` rounded up to a multiple of :data:`LANES`."""
    return -(-count // LANES) * LANES


@wp.kernel
def _update_row_block(
    # Selection:
    system_world: wp.array[int],  # (system_count,)
    active: wp.array[int],  # (world_count,)
    block: int,
    # In and out:
    matrix: wp.array3d[vec8],  # (system_count, N, (N + M) / 8)
):
    """Subtract sum_s U_sa U_sl, s above the block, from the rows a of one row block (left-looking)."""
    i, offset = wp.tid()
    if active[system_world[i]] == 0:
        return
    l = block + offset
    first = LANES * block
    r0 = vec8()
    r1 = vec8()
    r2 = vec8()
    r3 = vec8()
    r4 = vec8()
    r5 = vec8()
    r6 = vec8()
    r7 = vec8()
    for s in range(first):
        u = matrix[i, s, block]
        v = matrix[i, s, l]
        r0 += u[0] * v
        r1 += u[1] * v
        r2 += u[2] * v
        r3 += u[3] * v
        r4 += u[4] * v
        r5 += u[5] * v
        r6 += u[6] * v
        r7 += u[7] * v
    matrix[i, first, l] = matrix[i, first, l] - r0
    matrix[i, first + 1, l] = matrix[i, first + 1, l] - r1
    matrix[i, first + 2, l] = matrix[i, first + 2, l] - r2
    matrix[i, first + 3, l] = matrix[i, first + 3, l] - r3
    matrix[i, first + 4, l] = matrix[i, first + 4, l] - r4
    matrix[i, first + 5, l] = matrix[i, first + 5, l] - r5
    matrix[i, first + 6, l] = matrix[i, first + 6, l] - r6
    matrix[i, first + 7, l] = matrix[i, first + 7, l] - r7


@wp.kernel
def _factor_row_block(
    # Selection:
    system_world: wp.array[int],
    active: wp.array[int],
    block: int,
    # In and out:
    matrix: wp.array3d[vec8],  # (system_count, N, (N + M) / 8)
    # Out:
    diagonal_out: wp.array2d[
        vec8
    ],  # (system_count, N): rows of the 8x8 diagonal blocks of U, inverse pivots on the diagonal
):
    """Factor the 8x8 diagonal block (every thread its own copy) and solve U_bb^T X = A_bl for one column block."""
    i, offset = wp.tid()
    if active[system_world[i]] == 0:
        return
    l = block + offset
    first = LANES * block
    U = mat88()
    for a in range(8):
        row = matrix[i, first + a, block]
        pivot = row[a]
        floor = wp.max(1.0e-6 * wp.abs(pivot), 1.0e-30)
        for s in range(a):
            factor = U[s, a]
            for b in range(8):
                row[b] -= factor * U[s, b]
        inverse = 1.0 / wp.sqrt(wp.max(row[a], floor))
        for b in range(8):
            U[a, b] = inverse * row[b]
        diagonal = vec8()
        for b in range(8):
            diagonal[b] = U[a, b]
        diagonal[a] = inverse
        if offset == 0:
            diagonal_out[i, first + a] = diagonal
        else:
            x = matrix[i, first + a, l]
            for s in range(a):
                x -= U[s, a] * matrix[i, first + s, l]
            matrix[i, first + a, l] = inverse * x


@wp.kernel
def _back_substitute(
    # Selection:
    system_world: wp.array[int],
    active: wp.array[int],
    block_count: int,
    column: int,
    # Factor:
    matrix: wp.array3d[vec8],  # (system_count, N, (N + M) / 8)
    diagonal: wp.array2d[vec8],  # (system_count, N)
    # Schur correction:
    tail: wp.array2d[wp.float64],  # (world_count, tail_count): unknowns already known
    tail_count: int,
    # Out:
    solution_out: wp.array2d[vec8],  # (system_count, N / 8)
):
    """Solve U x = y - Y t from the last row up; y is right-hand column ``column``, Y the ``tail_count`` first ones."""
    i = wp.tid()
    world = system_world[i]
    if active[world] == 0:
        return
    for step in range(block_count):
        block = block_count - 1 - step
        x = vec8()
        for reverse in range(8):
            a = 7 - reverse
            row = LANES * block + a
            rest = vec8()
            for l in range(block + 1, block_count):
                rest += wp.cw_mul(matrix[i, row, l], solution_out[i, l])
            value = matrix[i, row, block_count + column / 8][column % 8]
            for j in range(tail_count):
                value -= matrix[i, row, block_count + j / 8][j % 8] * float(tail[world, j])
            d = diagonal[i, row]
            for b in range(8):
                value -= rest[b]
                if b > a:
                    value -= d[b] * x[b]
            x[a] = value * d[a]
        solution_out[i, block] = x


class BlockCholesky:
    """Storage and launches of ``system_count`` equal-sized systems [A | B].

    Args:
        system_world: World of each system, shape (system_count,); systems of inactive worlds are left alone.
        size: N, a multiple of 8.
        column_count: Right-hand columns wanted; padded to a multiple of 8.
        device: Warp device.
    """

    def __init__(self, system_world: wp.array, size: int, column_count: int, device) -> None:
        """Allocate everything once."""
        self.system_world = system_world
        self.system_count = system_world.shape[0]
        self.size = size
        self.block_count = size // LANES
        self.column_block_count = pad(column_count) // LANES
        self.device = device
        total = self.block_count + self.column_block_count
        self.matrix = wp.zeros((self.system_count, size, total), dtype=vec8, device=device)
        self.diagonal = wp.zeros((self.system_count, size), dtype=vec8, device=device)
        self.solution = wp.zeros((self.system_count, self.block_count), dtype=vec8, device=device)

    def factor(self, active: wp.array) -> None:
        """Replace [A | B] by [U | U^-T B] in the active worlds; only the upper triangle of A is read."""
        for block in range(self.block_count):
            shape = (self.system_count, self.block_count - block + self.column_block_count)
            selection = [self.system_world, active, block, self.matrix]
            if block > 0:
                wp.launch(_update_row_block, dim=shape, inputs=selection, device=self.device)
            wp.launch(_factor_row_block, dim=shape, inputs=selection, outputs=[self.diagonal], device=self.device)

    def solve(self, active: wp.array, column: int, tail: wp.array, tail_count: int) -> wp.array:
        """Return x of U x = y - Y tail, shape (system_count, N / 8) of 8-vectors."""
        wp.launch(
            _back_substitute,
            dim=self.system_count,
            inputs=[
                self.system_world,
                active,
                self.block_count,
                column,
                self.matrix,
                self.diagonal,
                tail,
                tail_count,
            ],
            outputs=[self.solution],
            device=self.device,
        )
        return self.solution
