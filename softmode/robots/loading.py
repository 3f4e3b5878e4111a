"""From a name or a file to a :class:`RobotDescription`: MuJoCo reads and compiles it, Newton imports the result.

MuJoCo's own compiler resolves includes, defaults and classes, so what the description says (drives, limits, home pose)
is what MuJoCo would simulate; see :mod:`softmode.robots.compiled` for how actuators become drives, and
:mod:`softmode.robots.stage_robot` for OpenUSD.
"""

from __future__ import annotations

import copy
import importlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from softmode.checks import require_number
from softmode.deformables.coupling.rigid_solver import mujoco_warnings
from softmode.errors import AssetError, ConfigError
from softmode.files import reader
from softmode.foreign import process
from softmode.foreign.child.model import check_parts, open_spec
from softmode.foreign.tokens import SUFFIXES
from softmode.robots.assets import RobotAsset, find, names_file
from softmode.robots.compiled import CompiledRobot
from softmode.robots.convex_parts import cut_meshes
from softmode.robots.description import JointTie, RobotDescription
from softmode.robots.hand import branch, colliding, find_end_effector
from softmode.robots.joint_split import hold_base, split_links
from softmode.robots.meshes import use_meshes
from softmode.robots.references import check_references, default_root, read_xml
from softmode.robots.stage_robot import read_stage
from softmode.robots.written_mjcf import written_mjcf

_LEAST_MASS, _LEAST_INERTIA = 1.0e-4, 1.0e-7
"""What links that move get that have no mass of their own, [kg] and [kg m^2]."""


@reader("robot file")
def load(
    source: str | Path,
    *,
    end_effector: str | None = None,
    tool_offset: Sequence[float] | None = None,
    gripper: Mapping[str, tuple[float, float]] | None = None,
    home: Sequence[float] | None = None,
    root: str | None = None,
    hand: str | Path | None = None,
    asset_root: str | Path | None = None,
    drive_bandwidth: float = 8.0,
    floating: bool = False,
    download: bool = True,
) -> RobotDescription:
    """Load a robot by name, or from an MJCF, URDF or OpenUSD file.

    A URDF, and another file without any actuator, gets critically damped drives on every joint, scaled by the joint's
    inertia in the home pose and limited by its effort limit. A torque motor becomes such a drive as well.
    ``RobotDescription.notes`` says what was chosen where the file does not say it.

    Args:
        source: A name of :func:`available`, or the path of a file (a `Path`, or a string that ends in .xml, .mjcf,
            .urdf, .usd, .usda, .usdc or .usdz).
        end_effector: Site or body that carries the tool. If omitted, it is found by its usual names, else as the link
            in which two fingers meet, else as the last link of the longest chain.
        tool_offset: Tool point in the frame of that site or body [m], shape (3,).
        gripper: Coordinates (closed, open) of each gripper joint [m or rad]. If omitted, the driven joints with limits
            behind the end effector that move a finger towards the other one.
        home: Joint coordinates of the home pose [m or rad]; by default the key frame "home", else the first one, else
            zero, brought into the joint limits.
        root: Body whose subtree is the robot, moved to the origin; needed if the file holds several robots.
        hand: A gripper that the robot's file has not: a name, or a file that holds nothing else. Its first link is put
            upon `end_effector`, the flange; its own end effector becomes that of the robot, and its names begin with
            ``hand_``.
        asset_root: Folder outside which the file may refer to nothing. If omitted: its own folder, the one above a
            folder called `urdf`, `mjcf` or the like, or that of its `package.xml`; and of a URDF the packages that it
            names, found above it.
        drive_bandwidth: Natural frequency of the drives of joints without a servo [Hz].
        floating: Whether a base on a free joint may move, by three slides and three hinges without drives;
            otherwise it is held where the home pose has it.
        download: Whether a model that is not in the cache may be downloaded.

    Returns:
        The description.

    Raises:
        AssetError: If the model cannot be fetched, or the file is missing, broken, refers outside the asset root, or
            holds what is not supported: a ball joint, a free joint behind the first link.
        ConfigError: If a name is unknown, or a number out of range.
        MissingExtraError: If the name needs the extra ``[robots]``, or a stage ``[usd]``, and it is not installed.
    """
    asset = _locate(source, asset_root, download)
    end_effector = asset.end_effector if end_effector is None else end_effector
    offset = asset.tool_offset if tool_offset is None else tuple(float(value) for value in tool_offset)
    if len(offset) != 3 or not all(math.isfinite(value) for value in offset):
        raise ConfigError(f"tool_offset = {offset} is not a point", hint="give three coordinates in metres")
    require_number("drive_bandwidth", drive_bandwidth, at_least=0.1, at_most=100.0, unit="Hz")
    spec, notes = _read(asset)
    full = _compile(spec, asset, notes)
    keys = {full.key(k).name: full.key_qpos[k] for k in range(full.nkey)}
    key = keys.get("home", next(iter(keys.values()), full.qpos0))
    free = [j for j in range(full.njnt) if full.jnt_type[j] == 0 and full.body_parentid[full.jnt_bodyid[j]] == 0]
    at_home = {full.joint(j).name: float(key[full.jnt_qposadr[j]]) for j in range(full.njnt)}
    root = asset.root if root is None else root
    notes += _keep_robot(spec, root, asset)
    if hand is not None:
        end_effector, more = _attach(spec, asset, end_effector, _locate(hand, None, download))
        notes += more
    pose = [float(x) for x in key[full.jnt_qposadr[free[0]] :][:7]] if len(free) == 1 and root is None else None
    loose, more = hold_base(spec, pose, floating=floating)
    notes += more
    spec, split = _split(spec, asset)
    notes += [f"split into links of one joint each: {', '.join(map(repr, split))}"] if split else []
    robot = CompiledRobot(_compile(spec, asset), asset, at_home, drive_bandwidth, loose)
    drives = robot.drives()
    start = robot.home(home)
    robot.notes += notes
    if home is None:
        found = "home" if "home" in keys else next(iter(keys), None)
        robot.notes.append("home: zero, no key frame" if found is None else f"home: key frame {found!r}")
    link, tool = robot.tool(end_effector, np.array(offset), drives)
    jaws, palm = robot.gripper(gripper, drives, start, link)
    behind = sorted({*robot.behind(palm), *robot.behind(link)})
    changed = _let_touch(spec, robot, behind)
    if (
        jaws is not None
        and len({branch(robot.model, palm, robot.joint_names.index(name)) for name in jaws.joints}) == 1
    ):
        rigid = np.flatnonzero(robot.model.body_weldid == robot.model.body_weldid[palm]).tolist()
        changed += cut_meshes(spec, robot.model, colliding(robot.model, sorted({*behind, *rigid} - {0})))
    for equality in list(spec.equalities):
        if equality.name in robot.dropped:
            spec.delete(equality)
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    robot.notes += changed
    final = _compile(spec, asset) if changed else robot.model
    return RobotDescription(
        name=asset.name,
        path=asset.path,
        mjcf=written_mjcf(spec, final),
        link_names=tuple(robot.link(b) for b in range(1, robot.model.nbody)),
        joint_names=robot.joint_names,
        joint_links=tuple(robot.link(b) for b in robot.model.jnt_bodyid),
        joint_lower=tuple(robot.lower.tolist()),
        joint_upper=tuple(robot.upper.tolist()),
        drives=drives,
        home=tuple(start.tolist()),
        end_effector=robot.link(link),
        tool=tool,
        hand_links=tuple(robot.link(b) for b in behind),
        gripper=jaws,
        ties=tuple(
            JointTie(joint=robot.joint_names[j], leader=robot.joint_names[owner], ratio=ratio, offset=offset)
            for j, (owner, ratio, offset) in enumerate(zip(*robot.bound, strict=True))
            if owner != j
        ),
        notes=tuple(robot.notes),
    )


def _let_touch(spec: Any, robot: CompiledRobot, hand: list[int]) -> list[str]:
    """Let what is only seen of a hand collide where nothing else does; return notes."""
    model, notes = robot.model, []
    taken = [geom for geom in colliding(model, hand) if not model.geom_contype[geom] | model.geom_conaffinity[geom]]
    for link in sorted({int(model.geom_bodyid[geom]) for geom in taken}):
        for geom in spec.body(robot.link(link)).geoms:
            geom.contype = geom.conaffinity = 1
        notes.append(f"link {robot.link(link)!r} of the hand has no collision geometry: what is seen of it touches")
    solid = set(model.geom_bodyid[colliding(model, hand)].tolist())
    bare = [repr(robot.link(b)) for b in hand if b not in solid and model.body_geomnum[b]]
    return notes + ([f"links of the hand that touch nothing: {', '.join(bare)}"] if bare else [])


def _attach(spec: Any, asset: RobotAsset, flange: str | None, hand: RobotAsset) -> tuple[str, list[str]]:
    """Put a gripper upon a robot's flange; return the name of the site or link that carries the tool, and notes."""
    tool, notes = _read(hand)
    _compile(tool, hand, notes)
    notes += _keep_robot(tool, hand.root, hand)
    compiled = CompiledRobot(_compile(tool, hand), hand, {})
    name = hand.end_effector or find_end_effector(compiled, compiled.drives())[0]
    if flange is None:
        arm = CompiledRobot(_compile(spec, asset), asset, {})
        flange, how = find_end_effector(arm, arm.drives())
        notes.append(f"hand on {flange!r}: {how}")
    site, body = spec.site(flange), spec.body(flange)
    if site is None and body is None:
        raise ConfigError(
            f"robot {asset.name!r} has no site or body {flange!r} for the hand", hint="name the flange: end_effector="
        )
    tool.option.cone, tool.option.impratio = spec.option.cone, spec.option.impratio  # or MuJoCo warns of a conflict
    (body.add_frame() if site is None else site).attach_body(tool.worldbody.first_body(), "hand_", "")
    return f"hand_{name}", notes


def _locate(source: str | Path, asset_root: str | Path | None, download: bool) -> RobotAsset:
    """Return the file that ``source`` means."""
    if not isinstance(source, (str, Path)):
        raise ConfigError(f"source is a {type(source).__name__}", hint="give a robot's name or the path of a file")
    if isinstance(source, str) and not names_file(source):
        return find(source, download=download)
    path = Path(source)
    stage = path.suffix.lower() in SUFFIXES
    folder = Path(asset_root) if asset_root is not None else path.parent if stage else default_root(path)
    if path.exists() and not path.resolve().is_relative_to(folder.resolve()):
        raise AssetError(f"robot file {path} lies outside asset_root = {folder}", hint="name a folder that holds it")
    return RobotAsset(name=path.stem, path=path, asset_root=folder, root_given=asset_root is not None)


@mujoco_warnings()
def _read(asset: RobotAsset) -> tuple[Any, list[str]]:
    """Return the editable MuJoCo specification of a file whose references have been checked, and notes."""
    if asset.path.suffix.lower() in SUFFIXES:
        spec, notes = read_stage(asset)
        check_parts(spec)
        return spec, notes
    tree, notes, text = read_xml(asset.path), [], None
    if tree.tag == "robot":
        text, notes, size = _prepare_urdf(tree, asset)
    elif tree.tag == "mujoco":
        size = check_references(asset.path, asset.asset_root)
    else:
        raise AssetError(
            f"robot file {asset.path} starts with <{tree.tag}>", hint="MJCF starts with <mujoco>, URDF with <robot>"
        )
    if not asset.trusted:
        process.read("model", asset.path, name=f"robot file {asset.path}", text=text, size=2 * size)
    try:
        return open_spec(str(asset.path), text), notes
    except (ValueError, RuntimeError) as error:
        raise AssetError(f"robot file {asset.path}: {_one_line(error)}", hint="mend the file at that line") from error


def _prepare_urdf(tree: ElementTree.Element, asset: RobotAsset) -> tuple[str, list[str], int]:
    """Resolve the meshes of a URDF, and ask MuJoCo to keep links and shapes as they are; with notes and size."""
    tree = copy.deepcopy(tree)
    for old in tree.findall("mujoco"):
        tree.remove(old)
    extension = ElementTree.SubElement(tree, "mujoco")
    ElementTree.SubElement(
        extension,
        "compiler",
        {"strippath": "false", "fusestatic": "false", "discardvisual": "false", "balanceinertia": "true"},
    )
    notes = use_meshes(tree, asset)
    for link in tree.iter("link"):
        for second in link.findall("inertial")[1:]:
            link.remove(second)
            notes.append(f"link {link.get('name')!r} has its first <inertial>, of several")
        inertia = link.find("inertial/inertia")
        if inertia is not None and _mended(inertia):
            notes.append(f"link {link.get('name')!r} had an inertia that is none, only its diagonal is kept")
    notes += _checked_joints(tree, asset)
    for texture in tree.iter("texture"):
        texture.attrib.pop("filename", None)
    files = {mesh.get("filename", "") for mesh in tree.iter("mesh")}
    size = sum(Path(file).stat().st_size for file in files if Path(file).is_file())
    return ElementTree.tostring(tree, encoding="unicode"), notes, size


def _checked_joints(tree: ElementTree.Element, asset: RobotAsset) -> list[str]:
    """Refuse limits and ties of a URDF that MuJoCo would pass over without a word; return notes."""
    notes, names = [], {joint.get("name") for joint in tree.findall("joint")}
    for joint in tree.findall("joint"):
        name, limit, mimic = joint.get("name"), joint.find("limit"), joint.find("mimic")
        if mimic is not None and mimic.get("joint") not in names - {name}:
            raise AssetError(
                f"robot file {asset.path}: joint {name!r} mimics {mimic.get('joint')!r}, which is no other joint of it",
                hint=f"name one of {', '.join(sorted(map(str, names - {name})))}, or remove <mimic>",
            )
        if limit is None or joint.get("type") not in ("revolute", "prismatic"):
            continue
        try:
            low, high, effort = (float(limit.get(key, d)) for key, d in (("lower", 0), ("upper", 0), ("effort", -1)))
        except ValueError:
            continue  # the compiler says where
        if low > high:
            text = f"robot file {asset.path}: joint {name!r} has its lower limit {low:g} above the upper one {high:g}"
            raise AssetError(text, hint="exchange them")
        notes += [f"joint {name!r} has the empty range {low:g} to {high:g}: taken as no limit"] if low == high else []
        notes += [f"joint {name!r} has effort 0: taken as no limit"] if effort == 0.0 else []
    return notes


def _mended(inertia: ElementTree.Element) -> bool:
    """Keep the diagonal alone of an inertia that is not positive; return whether that was so."""
    rows = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
    try:
        tensor = np.array([[float(inertia.get(name, "0")) for name in row] for row in rows])
    except ValueError:
        return False  # the compiler says where
    if not np.all(np.isfinite(tensor)) or not tensor.any() or np.linalg.eigvalsh(tensor)[0] > 0.0:
        return False
    for k, row in enumerate(rows):
        inertia.attrib.update({name: repr(max(float(tensor[k, k]), _LEAST_INERTIA)) for name in row[k : k + 1]})
        inertia.attrib.update({name: "0" for name in row[k + 1 :]})
    return True


@mujoco_warnings()
def _compile(spec: Any, asset: RobotAsset, notes: list[str] | None = None) -> Any:
    """Compile a specification; errors of the compiler name the file. Links without mass that move get a little."""
    try:
        return spec.compile()
    except (ValueError, RuntimeError) as error:
        text = _one_line(error)
        if notes is not None and "mjMINVAL" in text:
            spec.compiler.boundmass, spec.compiler.boundinertia = _LEAST_MASS, _LEAST_INERTIA
            notes.append(f"links that move and have no mass got {_LEAST_MASS} kg and {_LEAST_INERTIA} kg m^2")
            return _compile(spec, asset)
        hint = "convert that mesh to .stl or .obj" if "no decoder found" in text else "mend the file"
        raise AssetError(f"robot file {asset.path}: {text}", hint=hint) from error


def _split(spec: Any, asset: RobotAsset) -> tuple[Any, list[str]]:
    """Return the specification with one joint per link and none on the first, and the names of changed links."""
    if not spec.worldbody.first_body().joints and all(len(body.joints) < 2 for body in spec.bodies):
        return spec, []
    _compile(spec, asset)
    text, names = split_links(spec.to_xml())
    return importlib.import_module("mujoco").MjSpec.from_string(text), names


def _one_line(error: Exception) -> str:
    return "; ".join(line.strip() for line in str(error).splitlines() if line.strip())


def _keep_robot(spec: Any, root: str | None, asset: RobotAsset) -> list[str]:
    """Delete all but the robot, name what has no name, make asset paths absolute; return notes."""
    tops = list(spec.worldbody.bodies)
    chosen = [body for body in tops if body.name == root] if root is not None else tops
    if len(chosen) != 1:
        names = ", ".join(repr(body.name) for body in tops)
        what = f"has no body {root!r} at the top" if root is not None else f"holds {len(tops)} bodies at the top"
        raise ConfigError(
            f"robot file {asset.path} {what}", hint=f"pass root= one of {names}" if tops else "give it a <body>"
        )
    for joint in spec.joints:
        if joint.range[0] > joint.range[1]:
            text = f"has its lower limit {joint.range[0]:g} above the upper one {joint.range[1]:g}"
            raise AssetError(f"robot file {asset.path}: joint {joint.name!r} {text}", hint="exchange them")
    left = [body.name or "a body without a name" for body in tops if body is not chosen[0]]
    left += [f"{len(spec.worldbody.geoms)} shapes of the world"] if spec.worldbody.geoms else []
    notes = [f"left out beside the robot: {', '.join(left)}"] if left else []
    for body in spec.bodies:
        if body.mocap:
            body.mocap = False
            notes.append(f"link {body.name!r} is moved from outside (mocap) in the file: here it stands still")
    for group in (spec.keys, spec.cameras, spec.lights, spec.sensors, spec.worldbody.geoms, spec.worldbody.sites):
        for element in list(group):
            spec.delete(element)
    for body in tops:
        if body is not chosen[0]:
            spec.delete(body)
    if root is not None:
        notes += [f"{root!r} moved from {np.round(chosen[0].pos, 4).tolist()} m to the origin"]
        chosen[0].pos, chosen[0].quat = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
    for kind, group in (("link", spec.bodies), ("joint", spec.joints), ("equality", spec.equalities)):
        for k, element in enumerate(group):
            element.name = element.name or f"{kind}{k}"
    used = {geom.meshname for geom in spec.geoms} | {geom.hfieldname for geom in spec.geoms}
    for group in (spec.meshes, spec.hfields):
        for element in list(group):
            if element.name not in used:
                spec.delete(element)
    # What compiled once is found again; only the folder that a path counts from is made explicit.
    base = asset.path.parent.resolve() / spec.meshdir
    for element in (*spec.meshes, *spec.hfields):
        if element.file and not Path(element.file).is_absolute():  # those of a URDF have been found already
            file = (base / element.file).resolve()
            if not file.is_relative_to(asset.asset_root.resolve()):
                raise AssetError(f"robot file {asset.path} refers to {file}", hint="keep assets inside the asset root")
            element.file = str(file)
    spec.meshdir = spec.texturedir = ""
    return notes
