"""Answer many requests from one start of OpenUSD: a fork for each, under the limits of the real process.

Arguments: a JSON file with a list of requests; each answer's exit code and messages go beside it (`.code`, `.errors`).
"""

from __future__ import annotations

import json
import os
import sys
import time
from typing import Any

from softmode.stages.child import answer


def answer_in_fork(request: dict[str, Any], wall: float) -> int:
    """Return the exit code of a child that answers the request, or -9 if the wall clock ended it."""
    pid = os.fork()
    if not pid:
        with open(request["answer"] + ".errors", "wb") as errors:
            os.dup2(errors.fileno(), 2)
        os._exit(answer.answer(request))
    end = time.monotonic() + wall
    while time.monotonic() < end:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.001)
    os.kill(pid, 9)
    os.waitpid(pid, 0)
    return -9


def main() -> None:
    """Answer all requests of the file that the argument names."""
    with open(sys.argv[1]) as file:
        requests = json.load(file)
    os.environ["PXR_WORK_THREAD_LIMIT"] = "1"
    os.environ["USD_SHADE_MATERIAL_BINDING_API_CHECK"] = "allowMissingAPI"
    answer.load(requests[0])
    for request in requests:
        code = answer_in_fork(request, 120.0)
        with open(request["answer"] + ".code", "w") as file:
            file.write(str(code))


if __name__ == "__main__":
    main()
