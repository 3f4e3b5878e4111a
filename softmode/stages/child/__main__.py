"""Start of the process that opens OpenUSD files; its argument is a request of `softmode.stages.process`, as JSON."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path


def main() -> int:
    """Load the package around this file under a name of its own, so that softmode is not imported, and answer."""
    request = json.loads(sys.argv[1])
    folder = Path(__file__).resolve().parent.parent
    spec = importlib.util.spec_from_file_location(
        "softmode_usd", folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    if spec is None or spec.loader is None:
        raise ImportError(f"{folder} cannot be loaded")
    sys.modules["softmode_usd"] = package = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(package)
    sys.path.insert(0, request["pxr"])
    answer = importlib.import_module("softmode_usd.child.answer")
    answer.load(request)
    return answer.answer(request)


if __name__ == "__main__":
    sys.exit(main())
