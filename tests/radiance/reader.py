"""Reads the radiance fields whose paths come in, line by line, and says what came of each: run as a process of its own.

A reader that crashes takes this process with it, and the test that fuzzes it sees that.
"""

import sys

import numpy as np

from softmode.errors import AssetError
from softmode.radiance import read_radiance


def main() -> None:
    """Answer until the input ends."""
    for line in sys.stdin:
        try:
            field = read_radiance(line.strip())
            answer = "field" if np.isfinite(field.density).all() else "not finite"
        except AssetError as error:
            answer = f"refused: {error}".replace("\n", " ")
        print(answer, flush=True)


if __name__ == "__main__":
    main()
