"""Answer one request: open the file under limits, read what is asked for, write JSON and raw arrays to a file."""

from __future__ import annotations

import importlib
import json
import os
import sys
from typing import Any

from ..openusd import Stage, Value, pxr
from .layers import inside, open_layers, split_package
from .limits import MAX_DEPTH, Budget, Refused

MAX_PRIMS = 200_000
"""Most prims that a stage may have."""


class Arrays:
    """Arrays to send: what a reader adds is replaced by its number, and written after the JSON in that order."""

    def __init__(self) -> None:
        """Start with none."""
        self.described: list[tuple[str, list[int]]] = []
        self.values: list[Any] = []

    def add(self, value: Value) -> int:
        """Add an array of OpenUSD; return its number."""
        view = memoryview(value)
        self.described.append((view.format, list(view.shape or ())))
        self.values.append(value)
        return len(self.values) - 1


def load(request: dict[str, Any]) -> None:
    """Import what the request needs: loading it shall not count against the limits."""
    if request["place"] not in sys.path:
        sys.path.insert(0, request["place"])
    if request["library"] == "pxr":
        modules = ["Sdf", "Usd", "UsdGeom"]
        if request["what"] in ("scene", "asset", "robot"):
            modules += ["Ar", "UsdPhysics", "UsdShade"]
            for name in ("numpy", "PIL.Image"):
                importlib.import_module(name)
        for module in modules:
            importlib.import_module(f"pxr.{module}")
    for module in ("pyarrow.parquet", "pyarrow.ipc") if request["library"] == "pyarrow" else (request["library"],):
        importlib.import_module(module)
    importlib.import_module(f".{request['what']}", __package__)


def answer(request: dict[str, Any]) -> int:
    """Answer a request; return the exit code: 0, 3 with the reason on the standard error, or 4 for lack of memory."""
    try:
        budget = Budget(**request["limits"])
        path = request["file"]
        budget.add(os.stat(path).st_size + request.get("size", 0))
        stages = request["library"] == "pxr"
        source = open_stage(path, request["root"], budget, request["strict"]) if stages else budget
        arrays = Arrays()
        reader = importlib.import_module(f".{request['what']}", __package__)
        described = reader.read(source, request | {"budget": budget}, arrays)
        described["arrays"] = arrays.described
        with open(request["answer"], "wb") as out:
            out.write(json.dumps(described).encode("ascii") + b"\n")
            for array in arrays.values:
                out.write(memoryview(array).cast("B"))
    except MemoryError:
        return 4
    except Exception as error:  # every failure of a library is an answer about the file
        try:
            said = " ".join(str(error).split())
        except UnicodeDecodeError:  # OpenUSD quotes what it read
            said = ""
        kind = "" if isinstance(error, Refused) or request["library"] == "pxr" else f"{type(error).__name__}: "
        reason = {"reason": kind + said[:600] or type(error).__name__, "hint": getattr(error, "hint", "")}
        sys.stderr.write(f"\nanswer: {json.dumps(reason)}\n")
        sys.stderr.flush()
        return 3
    return 0


def open_stage(path: str, root: str, budget: Budget, strict: bool) -> Any:
    """Open a stage whose files all lie inside the root.

    Args:
        path: The file.
        root: Folder that holds whatever the stage may read.
        budget: Allowed for each file.
        strict: Whether a stage that does not compose (a cycle of references, say) is refused.
    """
    (Usd,) = pxr("Usd")
    layer = open_layers(path, root, budget)
    stage = Usd.Stage.Open(layer, load=Usd.Stage.LoadAll)
    for used in stage.GetUsedLayers():
        real, _ = split_package(used.realPath)
        if real and real != os.path.realpath(path) and real != path and not inside(real, root):
            raise Refused(f"reads {used.realPath[:200]}, outside {root}", "Pass the folder that holds it as asset_root")
    if strict and stage.GetCompositionErrors():
        first = " ".join(str(stage.GetCompositionErrors()[0]).split())[:300]
        raise Refused(f"does not compose ({first})", "Mend its references")
    return stage


def prims_of(stage: Stage) -> Any:
    """Yield all prims, those of instances included; refuse too many or too deep ones."""
    (Usd,) = pxr("Usd")
    for count, prim in enumerate(Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())):
        if count > MAX_PRIMS:
            raise Refused(f"has more than {MAX_PRIMS} prims", "Import a part of it")
        if prim.GetPath().pathElementCount > MAX_DEPTH:
            raise Refused(f"is nested deeper than {MAX_DEPTH} levels", "Flatten its hierarchy")
        yield prim
