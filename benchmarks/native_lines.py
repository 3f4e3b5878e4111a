"""How much of the package is C++ in Python's strings: non-empty lines, file by file.

Run: ``python -m benchmarks.native_lines [--root softmode]``. Counted are the strings of modules of device code and of
`softmode.lanes` that have a statement of C++, a line that ends with a semicolon, also as parts of f-strings; docstrings
are not. What `softmode.lanes` writes from Warp functions is nobody's to read or change, and not counted.
"""

from __future__ import annotations

import argparse
import ast
import re
from pathlib import Path

_STATEMENT = re.compile(r";\s*(//.*|\\)?$", re.MULTILINE)
_PLACES = "*_kernels.py", "lane_ops.py", "lanes/*.py"


def native_lines(source: str) -> int:
    """Return the non-empty lines of C++ in a module."""
    tree = ast.parse(source)
    strings = [node for node in ast.walk(tree) if isinstance(node, ast.Constant | ast.JoinedStr)]
    apart = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for string in strings:
        apart |= {id(part) for part in ast.walk(string) if part is not string}
    texts = [ast.get_source_segment(source, string) or "" for string in strings if id(string) not in apart]
    codes = [text.strip("rbf\"'") for text in texts]
    return sum(bool(line.strip()) for code in codes if _STATEMENT.search(code) for line in code.splitlines())


def main() -> None:
    """Print a line for each file that has some, and the sum."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, default=Path("softmode"))
    root = parser.parse_args().root
    paths = sorted({path for place in _PLACES for path in root.rglob(place)})
    found = {path: lines for path in paths if (lines := native_lines(path.read_text()))}
    for path, lines in found.items():
        print(f"{lines:5d}  {path}")
    print(f"{sum(found.values()):5d}  in {len(found)} files")


if __name__ == "__main__":
    main()
