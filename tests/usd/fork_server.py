"""Answer many requests from one start of OpenUSD: a fork for each, under the limits of the real process.

With a JSON file as argument, which holds a list of requests, each answer's exit code and messages go beside it
(`.code`, `.errors`). Without one a line of JSON on the standard input asks, and one on the standard output is the code.
"""

from __future__ import annotations

import json
import os
import sys
import time
from typing import Any

from softmode.stages.child import answer


def answer_in_fork(request: dict[str, Any], wall: float, errors: str, folder: str = ".") -> int:
    """Return the exit code of a child that answers the request in a folder, or -9 if the wall clock ended it."""
    pid = os.fork()
    if not pid:
        with open(errors, "wb") as file:
            os.dup2(file.fileno(), 2)
        os.chdir(folder)
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
    """Answer all requests of the file that the argument names, or those of the standard input until it ends."""
    os.environ["PXR_WORK_THREAD_LIMIT"] = "1"
    os.environ["USD_SHADE_MATERIAL_BINDING_API_CHECK"] = "allowMissingAPI"
    if len(sys.argv) == 1:
        codes = os.fdopen(os.dup(1), "w")
        os.dup2(2, 1)  # what an import prints is no code
        for line in sys.stdin:
            asked = json.loads(line)
            request = asked.pop("request")
            answer.load(request)
            print(json.dumps(answer_in_fork(request, **asked)), file=codes, flush=True)
        return
    with open(sys.argv[1]) as file:
        requests = json.load(file)
    answer.load(requests[0])
    for request in requests:
        code = answer_in_fork(request, 120.0, request["answer"] + ".errors")
        with open(request["answer"] + ".code", "w") as file:
            file.write(str(code))


if __name__ == "__main__":
    main()
