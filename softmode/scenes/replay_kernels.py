"""Device side of a replayed recording on CPU: its operations one after another, launches as calls of addresses."""

from enum import IntEnum

import warp as wp

wp.set_module_options({"enable_backward": False})


class Operation(IntEnum):
    """What a row of a recording does with the numbers behind its kind; addresses are those of this process."""

    LAUNCH = 0  # call the function at address 1 with the launch bounds at 2 and the arguments at 3
    COPY = 1  # to address 1 from address 2, so many bytes
    FILL = 2  # from address 1 with a byte, so many of them
    REPEAT = 3  # from address 1 with the bytes at address 2: how many they are, times 2^32, plus how often
    UNLESS = 4  # where the integer at address 1 is 0, go on at row 2
    GO_ON = 5  # at row 1


@wp.func_native(
    snippet="""
    const long long* const table = (const long long*)operations.data;
    const int count = operations.shape[0];
    for (int row = 0; row < count;) {
        const long long* const op = table + 4 * (size_t)row;
        ++row;
        switch (op[0]) {
        case 0: ((void (*)(void*, void*))op[1])((void*)op[2], (void*)op[3]); break;
        case 1: memcpy((void*)op[1], (const void*)op[2], (size_t)op[3]); break;
        case 2: memset((void*)op[1], (int)op[2], (size_t)op[3]); break;
        case 3: {
            const size_t size = (size_t)(op[3] >> 32), times = (size_t)(op[3] & 0xffffffff);
            for (size_t k = 0; k < times; ++k) memcpy((char*)op[1] + k * size, (const void*)op[2], size);
            break;
        }
        case 4: if (*(volatile const int*)op[1] == 0) row = (int)op[2]; break;
        default: row = (int)op[1];
        }
    }
"""
)
def run_operations(operations: wp.array2d[wp.int64]) -> None:
    """Run the rows of a recording in their order."""


@wp.kernel
def replay(operations: wp.array2d[wp.int64]):
    """Run a recording, shape (row_count, 4): see :class:`Operation`."""
    run_operations(operations)
