"""The half of the OpenUSD reader that runs in a process of its own; a script, not imported by softmode.

Damaged crate files make OpenUSD allocate without end or run for minutes, so the file is opened where memory and
processor time are limited: this script caps both for itself, opens the stage, and writes to its standard output one
line of JSON (what the stage and each splat prim say) followed by the raw little-endian arrays in the order of the JSON.
It needs nothing but usd-core.

Arguments: the folder that holds `pxr`, the file, the time code ("" for the earliest), and the largest number of splats.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import signal
import sys
from typing import Any

_ARRAYS = ("positions", "orientations", "scales", "opacities", "radiance:sphericalHarmonicsCoefficients")


def _limit(size: int) -> None:
    """Cap what the process may take from here on, generously beside what a file of this size needs."""
    with open("/proc/self/statm") as file:
        used = int(file.read().split()[5]) * os.sysconf("SC_PAGE_SIZE")
    memory = used + 128 * 2**20 + 16 * size
    resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.setitimer(signal.ITIMER_PROF, 1.0 + size / 1e6)


def _read(path: str, time_code: str, most: int) -> tuple[dict[str, Any], list[Any]]:
    """Return the description of the stage and the arrays of its splat prims."""
    Usd, UsdGeom = (importlib.import_module(name) for name in ("pxr.Usd", "pxr.UsdGeom"))
    stage = Usd.Stage.Open(path)
    time = Usd.TimeCode(float(time_code)) if time_code else Usd.TimeCode.EarliestTime()
    transforms = UsdGeom.XformCache(time)
    prims: list[dict[str, Any]] = []
    arrays: list[Any] = []
    total = 0
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
        if prim.GetTypeName() != "ParticleField3DGaussianSplat":
            continue
        if UsdGeom.Imageable(prim).ComputeVisibility(time) == UsdGeom.Tokens.invisible:
            continue
        found: dict[str, list[Any]] = {}
        spaces: list[str] = []
        for name in _ARRAYS:
            for candidate in (name, name + "h"):  # the half variant counts where the float one has no value
                attribute = prim.GetAttribute(candidate)
                value = attribute.Get(time) if attribute else None
                if value is not None and len(value):
                    view = memoryview(value)
                    found[name] = [view.format, list(view.shape or ())]
                    arrays.append(value)
                    spaces += [attribute.GetColorSpace()] if name.startswith("radiance") else []
                    break
        total += found["positions"][1][0] if "positions" in found else 0
        if total > most:
            raise ValueError(f"more than {most} splats")
        prims.append(
            {
                "path": str(prim.GetPath()),
                "matrix": [x for row in transforms.GetLocalToWorldTransform(prim) for x in row],
                "degree": prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get(),
                "color_space": "".join(spaces),
                "arrays": found,
            }
        )
    return {
        "up": str(UsdGeom.GetStageUpAxis(stage)),
        "meters": UsdGeom.GetStageMetersPerUnit(stage),
        "prims": prims,
    }, arrays


def main() -> int:
    """Read the file that the arguments name; return the exit code."""
    folder, path, time_code, most = sys.argv[1:]
    sys.path.insert(0, folder)
    os.environ["PXR_WORK_THREAD_LIMIT"] = "1"
    for module in ("pxr.Usd", "pxr.UsdGeom"):  # loading them shall not count against the limits
        importlib.import_module(module)
    _limit(os.stat(path).st_size)
    out = sys.stdout.buffer
    try:
        description, arrays = _read(path, time_code, int(most))
        out.write(json.dumps(description).encode("ascii") + b"\n")
        for array in arrays:
            out.write(memoryview(array).cast("B"))
        out.flush()
    except Exception as error:  # every failure of OpenUSD is an answer about the file
        sys.stderr.write(f"\nreason: {' '.join(str(error).split())[:300]}\n")
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main())
