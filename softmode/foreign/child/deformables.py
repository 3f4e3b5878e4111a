"""Which prims of a stage are deformable bodies, and which prims belong to each."""

from __future__ import annotations

import importlib
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

from .. import tokens
from ..openusd import Prim, Stage, Value, pxr
from .limits import Refused

_GEOMETRY = (tokens.TET_MESH, tokens.MESH, tokens.POINTS, tokens.SPLATS)
_FOREIGN = ("PhysicsRigidBodyAPI", "PhysicsArticulationRootAPI")
_BETWEEN = (
    "PhysicsAttachment",
    "PhysicsElementCollisionFilter",
    "OmniPhysicsVtxXformAttachment",
    "PhysxPhysicsAttachment",
)


@dataclass
class Body:
    """A deformable body of a stage."""

    prim: Prim
    """What carries the body's schema."""
    geometry: Prim
    """Its simulation geometry; of one that is only splats the first of them."""
    splats: list[Prim] = field(default_factory=list)
    """Its visible splat prims."""
    meshes: list[Prim] = field(default_factory=list)
    """Its other visible meshes."""
    notes: list[str] = field(default_factory=list)
    """What was read in another way than it was meant."""
    kinematic: str = ""
    """The note that says that the stage moves it; empty where it does not."""


def applied(prim: Prim) -> list[str]:
    """Return the applied schemas, those that are not registered included."""
    return list(prim.GetPrimTypeInfo().GetAppliedAPISchemas())


@dataclass(frozen=True)
class Left:
    """A deformable that is left as it is, for Newton's importer."""

    path: Value
    """Path of its prim."""
    reason: str
    """Why."""


def wanted(path: str, only: list[str] | None, skip: list[str]) -> bool:
    """Return whether a path is asked for: patterns match it, or something above it, as `fnmatch` has it."""
    return (only is None or any(matches(path, p) for p in only)) and not any(matches(path, p) for p in skip)


def matches(path: str, pattern: str) -> bool:
    """Return whether a path, or something above it, matches a pattern."""
    return fnmatchcase(path, pattern) or fnmatchcase(path, f"{pattern.rstrip('/')}/*")


def _is_body(prim: Prim) -> bool:
    """Return whether a prim is an enabled deformable body."""
    if not any(name in tokens.BODY_APIS for name in applied(prim)):
        return False
    for namespace in ("physics:bodyEnabled", "omniphysics:deformableBodyEnabled", "omniphysics:bodyEnabled"):
        attribute = prim.GetAttribute(namespace)
        if attribute and attribute.Get() is False:
            return False
    return True


def uninstance(stage: Stage, *, every: bool = False) -> None:
    """Make the instances that hold deformables, or all, ordinary prims, in the session.

    Parts of a deformable must be told apart, and what is converted to other units is edited prim by prim, which
    instances of one prototype do not allow.
    """
    from .answer import prims_of

    for _ in range(64):
        found = set()
        for prim in prims_of(stage):
            if every and prim.IsInstance():
                found.add(str(prim.GetPath()))
            elif prim.IsInstanceProxy() and (_is_body(prim) or any(a in tokens.SIM_APIS for a in applied(prim))):
                owner = prim
                while owner.IsInstanceProxy():
                    owner = owner.GetParent()
                found.add(str(owner.GetPath()))
        if not found:
            return
        stage.SetEditTarget(stage.GetSessionLayer())
        for path in found:
            stage.GetPrimAtPath(path).SetInstanceable(False)
    raise Refused("nests instances too deeply", "Flatten the stage")


def find_bodies(prims: list[Prim], only: list[str] | None, skip: list[str]) -> tuple[list[Body], list[Left]]:
    """Return the deformable bodies, and those that are left to Newton.

    Left are those that are not asked for, and of the others what is no soft solid unless `only` asks for it: cloth (a
    surface deformable that is not closed) and points that an MPM scene owns.

    Args:
        prims: All prims, parents first.
        only: Patterns of paths of which one has to match; None for all.
        skip: Patterns of paths of which none may match.
    """
    roots = [prim for prim in prims if _is_body(prim)]
    paths = {prim.GetPath() for prim in roots}
    disabled = [
        prim.GetPath()
        for prim in prims
        if prim.GetPath() not in paths and any(a in tokens.BODY_APIS for a in applied(prim))
    ]
    for prim in prims:  # a simulation geometry that no body governs stands for itself
        path = prim.GetPath()
        if any(a in tokens.SIM_APIS for a in applied(prim)) and not any(path.HasPrefix(p) for p in (*paths, *disabled)):
            roots.append(prim)
            paths.add(path)
    _check_patterns([str(path) for path in paths], (only or []) + skip)
    scenes = [prim for prim in prims if prim.GetTypeName() == "PhysicsScene"]
    bodies, left = [], []
    for root in roots:
        if not wanted(str(root.GetPath()), only, skip):
            left.append(Left(root.GetPath(), "is not asked for"))
            continue
        body = _body(root, paths)
        reason = "is a cable" if body is None else "" if only is not None else _no_solid(body, scenes)
        if body is None or reason:
            left.append(Left(root.GetPath(), reason))
        else:
            bodies.append(body)
    by_path = {body.prim.GetPath(): body for body in bodies}
    for prim in prims:  # pictures that lie elsewhere say whose they are
        if prim.GetTypeName() == tokens.SPLATS and prim.GetRelationship(tokens.SPLAT_BODY):
            for target in prim.GetRelationship(tokens.SPLAT_BODY).GetTargets():
                body = by_path.get(target)
                if body is not None and prim.GetPath() not in {p.GetPath() for p in body.splats} and visible(prim):
                    body.splats.append(prim)
    return bodies, left


def find_ties(prims: list[Prim], left: list[Left]) -> list[tuple[str, str]]:
    """Return path and type of what ties deformables to others and is not read: all but what ties those left alone."""
    ties = []
    for prim in prims:
        if prim.GetTypeName() in _BETWEEN:
            targets = [target for relation in prim.GetRelationships() for target in relation.GetTargets()]
            if not any(target.HasPrefix(one.path) for one in left for target in targets):
                ties.append((str(prim.GetPath()), str(prim.GetTypeName())))
    return ties


def _check_patterns(paths: list[str], patterns: list[str]) -> None:
    """Refuse patterns that match no deformable."""
    for pattern in patterns:
        if not any(matches(path, pattern) for path in paths):
            known = ", ".join(paths[:8]) or "none"
            raise Refused(f"{pattern!r} matches no deformable; there are: {known}", "Mend the pattern in only or skip")


def _no_solid(body: Body, scenes: list[Prim]) -> str:
    """Return what a body is if it is no soft solid."""
    geometry = body.geometry
    if body.prim.GetAttribute(tokens.FORMAT):
        return ""
    if any(name in tokens.SURFACE_SIM_APIS for name in applied(geometry)) and not _closed(geometry):
        return "is cloth, a surface that is not closed"
    if geometry.GetTypeName() == tokens.POINTS:
        owner = body.prim.GetRelationship("physics:simulationOwner")
        targets = owner.GetForwardedTargets() if owner else []
        owners = [p for p in scenes if p.GetPath() in targets] if targets else scenes[:1]
        if any(tokens.MPM_SCENE_API in applied(p) for p in owners):
            return "is the material of an MPM scene"
    return ""


def _closed(mesh: Prim) -> bool:
    """Return whether every edge of a mesh, its vertices merged by place, belongs to an even number of faces."""
    numpy = importlib.import_module("numpy")
    first = pxr("Usd")[0].TimeCode.EarliestTime()
    values = [mesh.GetAttribute(name).Get(first) for name in ("points", "faceVertexCounts", "faceVertexIndices")]
    points, counts, index = (numpy.array([] if value is None else value) for value in values)
    bad = not len(index) or index.min() < 0 or index.max() >= len(points) or counts.min(initial=0) < 0
    if bad or counts.sum() != len(index):
        return True  # refused where it is read, by name
    place = numpy.unique(points, axis=0, return_inverse=True)[1].reshape(-1)[index]
    ends = numpy.cumsum(counts)
    following = numpy.arange(1, len(index) + 1)
    following[ends[counts > 0] - 1] = (ends - counts)[counts > 0]
    edges = numpy.sort(numpy.stack([place, place[following]], axis=1), axis=1)
    edges = edges[edges[:, 0] != edges[:, 1]]
    return bool((numpy.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all())


def _body(root: Prim, roots: set[Value]) -> Body | None:
    """Return what belongs to a body: the geometries beneath it up to other bodies; None for cables, left to Newton."""
    owned: list[Prim] = []
    _collect(root, root, roots, owned)
    of_type = {kind: [p for p in owned if p.GetTypeName() == kind] for kind in _GEOMETRY}
    marked = [p for p in owned if any(a in tokens.SIM_APIS for a in applied(p))]
    if not marked and any(a in tokens.CURVES_SIM_APIS for prim in owned for a in applied(prim)):
        return None
    cooked = root.GetRelationship(tokens.COOKING_SOURCE)
    targets = [root.GetStage().GetPrimAtPath(t) for t in cooked.GetTargets()] if cooked else []
    candidates = marked or [p for p in targets if p] or ([root] if root.GetTypeName() in _GEOMETRY else [])
    if not candidates:
        candidates = next((of_type[kind] for kind in _GEOMETRY if of_type[kind]), [])
        if candidates and candidates[0].GetTypeName() == tokens.SPLATS:
            candidates = candidates[:1]
    where = f"{root.GetPath()}:"
    if not candidates:
        raise Refused(f"{where} a deformable body without geometry", f"Give it a child of type {', '.join(_GEOMETRY)}")
    if len(candidates) > 1:
        names = ", ".join(str(p.GetPath()) for p in candidates[:4])
        raise Refused(
            f"{where} a deformable body with {len(candidates)} simulation geometries ({names})",
            f"Apply {tokens.VOLUME_SIM_API} to one of them",
        )
    geometry = candidates[0]
    if geometry.GetTypeName() not in _GEOMETRY:
        raise Refused(
            f"{geometry.GetPath()}: a deformable of type {geometry.GetTypeName() or 'none'}",
            f"Make its simulation geometry a {', '.join(_GEOMETRY)}",
        )
    body = Body(root, geometry)
    body.splats = [p for p in of_type[tokens.SPLATS] if visible(p) or p == geometry]
    body.meshes = [p for p in of_type[tokens.MESH] if p != geometry and visible(p)]
    if any(one.GetName().endswith(":kinematicEnabled") and one.Get() is True for one in root.GetAuthoredAttributes()):
        body.kinematic = "is kinematic in the stage; softmode simulates it: hold it by a region, or make it rigid"
        body.notes.append(body.kinematic)
    for namespace in ("physics", "omniphysics"):
        rest = geometry.GetAttribute(f"{namespace}:restShapePoints")
        if rest and rest.HasAuthoredValue():
            body.notes.append("starts undeformed, in its rest shape")
    return body


def _collect(prim: Prim, root: Prim, roots: set[Value], owned: list[Prim]) -> None:
    """Gather a prim and what lies beneath it, up to other bodies."""
    if prim != root and (prim.GetPath() in roots or any(name in _FOREIGN for name in applied(prim))):
        return
    owned.append(prim)
    for child in prim.GetFilteredChildren(pxr("Usd")[0].TraverseInstanceProxies()):
        _collect(child, root, roots, owned)


def visible(prim: Prim) -> bool:
    """Return whether a prim is visible."""
    (UsdGeom,) = pxr("UsdGeom")
    return UsdGeom.Imageable(prim).ComputeVisibility() != UsdGeom.Tokens.invisible
