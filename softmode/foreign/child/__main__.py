"""Start of the process that reads files of others; each line of its standard input is a request, as JSON."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
from pathlib import Path


def main() -> None:
    """Load the package around this file under a name of its own, so that softmode is not imported, and answer.

    On Linux a fork answers, so that libraries are loaded once and what a file does to memory ends with it; elsewhere
    this process answers one request and ends. The exit code goes to the standard output.
    """
    codes = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what a library prints is no code
    folder = Path(__file__).resolve().parent.parent
    spec = importlib.util.spec_from_file_location(
        "softmode_foreign", folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    if spec is None or spec.loader is None:
        raise ImportError(f"{folder} cannot be loaded")
    sys.modules["softmode_foreign"] = package = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(package)
    answer = importlib.import_module("softmode_foreign.child.answer")
    for line in sys.stdin:
        request = json.loads(line)
        with open(request["errors"], "w") as errors:  # a file, which the limits bound, and no pipe
            os.dup2(errors.fileno(), 2)
            os.dup2(errors.fileno(), 1)
        os.chdir(request["folder"])  # empty: OpenUSD looks there for what it does not find beside a layer
        answer.load(request)
        if sys.platform == "linux":
            pid = os.fork()
            if not pid:
                code = 1
                try:
                    code = answer.answer(request)
                finally:
                    os._exit(code)
            code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        else:
            code = answer.answer(request)
        os.chdir(os.path.dirname(sys.executable))  # the folder is removed
        print(code, file=codes, flush=True)


if __name__ == "__main__":
    main()
