"""Device functions of one point, written as C++ for eight points, one in each lane of vector registers.

A law of a point stands once, in Warp. CUDA runs it as it is; a CPU runs what `lanes_code` writes from its source, in
which a float64 is eight. What decides and differs between lanes becomes a choice per lane; what is the same for all of
them, as which material, stays a branch. Results agree up to rounding.

What can be read: numbers (float64 and bool differ between lanes, an int does not unless it comes from what does),
vectors and matrices with constant indices, structs, several results; arithmetic, comparisons, ``and``, ``or``, ``not``;
``if`` with early returns, ``while``, ``for`` over a constant range; calls of such functions, and of the built-in ones
in `expressions`. Both sides of an ``if`` may run in every lane: a side may divide by zero, since its lane is then not
taken. What is rounded to float32 stays in float64. Anything else is an error: which line, and what to write instead.

Eight float64 are one register with AVX-512, two with AVX2, and four with SSE2 or NEON.
"""

from softmode.lanes.functions import lanes_code
from softmode.lanes.native import LANES

__all__ = ["LANES", "lanes_code"]
