"""Sound files of every format for `tests.fuzz`, made by our own writers, and the readers of each."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import io
import json
import tempfile
import zipfile
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

Seeds = dict[str, tuple[str, str, list[bytes]]]
"""Suffix, mutator and contents by format."""
DEAR = ("stage", "stage packed", "stage splats", "stage body", "animation", "dataset")
"""Formats of which fewer are tried, since each takes a process or many files."""


@contextlib.contextmanager
def _unpacked(path: Path) -> Iterator[Path]:
    """Yield a folder with the members of an archive; what is no archive is a folder with that one file."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            with zipfile.ZipFile(path) as archive:
                archive.extractall(folder)
        except Exception:  # our own packing, which is no part of what is tried
            (Path(folder) / "config.json").write_bytes(path.read_bytes())
        yield Path(folder)


def _splats(path: Path) -> None:
    from softmode.splats import read_splats

    splats = read_splats(path)
    assert all(np.isfinite(getattr(splats, name)).all() for name in ("means", "quats", "scales", "opacities", "sh"))
    assert splats.count >= 1 and (splats.scales > 0.0).all()


def _object(path: Path) -> Any:
    from softmode.deformables.reduction.sources import unpack_sources
    from softmode.objects.object_file import file_kind, read_object

    file_kind(path)
    body = read_object(path).body
    if body.sources:
        unpack_sources(body)
    return body


def _points(path: Path) -> None:
    from softmode.objects.object_file import file_kind
    from softmode.splats.point_cloud import read_points

    file_kind(path)
    splats = read_points(path)
    assert np.isfinite(splats.means).all() and np.isfinite(splats.quats).all()


def _paint(path: Path) -> None:
    from softmode.objects.paint import read_field

    assert np.isfinite(read_field(path)(np.zeros((3, 3)))).all()


def _radiance(path: Path) -> None:
    from softmode.radiance.formats import is_radiance, read_radiance

    is_radiance(path)
    field = read_radiance(path)
    assert np.isfinite(field.density).all() and np.isfinite(field.sh).all()


def _morph(path: Path) -> None:
    from softmode.mpm.run import MorphRun, is_morph

    is_morph(path)
    MorphRun.load(path)


def _recording(path: Path) -> None:
    from softmode.view.live_recording import LiveRecording

    assert np.isfinite(LiveRecording.load(path).q).all()


def _state(path: Path) -> None:
    from softmode.envs.env_state import EnvState, generator_of

    for state in EnvState.load(path).random:
        generator_of(state)


def _checkpoint(path: Path) -> None:
    from softmode.learning.checkpoints import read_checkpoint
    from softmode.learning.config_values import with_config
    from softmode.learning.policy import load_policy

    if importlib.util.find_spec("torch") is None:
        read_checkpoint(path)
        return
    policy = load_policy(path)
    with_config(policy.env, policy.env_options)


def _config(path: Path) -> None:
    from softmode.cli.train import parse_env_options
    from softmode.errors import ConfigError
    from softmode.learning.config_values import joined_config, located_options, pinned_options, split_config

    try:
        text = path.read_text()
    except ValueError as error:
        raise ConfigError("no text", hint="the shell gives none but texts") from error
    options = located_options(parse_env_options(text), path.parent)
    joined_config("softmode/PushSoft-v0", *split_config("softmode/PushSoft-v0", options))
    pinned_options("softmode/PushSoft-v0", options)


def _run(path: Path) -> None:
    from softmode.learning.run_folder import RunFolder

    with _unpacked(path) as folder:
        run = RunFolder(folder, resume=True)
        run.read_config()
        run.forget_after(3)


def _mesh(path: Path) -> None:
    from softmode.objects.mesh_file import read_mesh
    from softmode.objects.object_file import file_kind

    file_kind(path)
    assert np.isfinite(read_mesh(path).corners).all()


def _robot(path: Path) -> None:
    from softmode import robots

    found = robots.load(path)
    assert np.isfinite(found.home).all() and not np.isnan([*found.joint_lower, *found.joint_upper]).any()


def _stage(path: Path) -> None:
    import newton

    from softmode.objects.stage.scene import open_scene
    from softmode.usd.importer import _add_rest

    with tempfile.TemporaryDirectory() as folder:
        for body in open_scene(path, None, folder, copy=True).deformables:
            assert np.isfinite(body.translation).all() and abs(np.linalg.det(body.rotation) - 1.0) < 1e-6
            for surface in (*body.meshes, *([body.surface] if body.surface else [])):
                assert np.isfinite(surface.vertices).all()
                assert not surface.faces.size or 0 <= surface.faces.min() <= surface.faces.max() < len(surface.vertices)
            assert np.isfinite(body.points).all()
            body.material(1.0e-3)
        _add_rest(newton.ModelBuilder(), f"{folder}/rest.usdc", path.name, {})


def _animation(path: Path) -> None:
    from softmode.usd import read_animation

    for played in read_animation(path).bodies:
        assert np.isfinite(played.coordinates).all() and np.isfinite(played.times).all()


def _dataset(path: Path) -> None:
    from softmode.demonstrations import read_dataset

    with _unpacked(path) as folder:
        found = read_dataset(folder)
        if found.episode_count and (folder / "meta" / "states").exists():
            found.state(0)


READERS: dict[str, Callable[[Path], Any]] = {
    **dict.fromkeys(("ply", "compressed ply", "splat", "spz 3", "spz 4", "spz packed", "sog", "stage splats"), _splats),
    **dict.fromkeys(("points", "points ply", "xyz"), _points),
    **dict.fromkeys(("mesh ply", "obj", "stl", "off", "glb", "gltf"), _mesh),
    **dict.fromkeys(("radiance", "nanovdb"), _radiance),
    **dict.fromkeys(("body", "stage body"), _object),
    **dict.fromkeys(("mjcf", "urdf"), _robot),
    "paint": _paint,
    "morph": _morph,
    "recording": _recording,
    "state": _state,
    "checkpoint": _checkpoint,
    "options": _config,
    "run": _run,
    "stage": _stage,
    "stage packed": _stage,
    "animation": _animation,
    "dataset": _dataset,
}
"""Readers by format."""
PACKAGES: dict[str, tuple[tuple[str, ...], str]] = {
    **dict.fromkeys(("stage", "stage packed", "stage splats", "stage body", "animation"), (("pxr",), "usd-core")),
    "dataset": (("pyarrow",), "pyarrow"),
    "checkpoint": (("torch",), "torch"),
    "spz 4": (("backports.zstd", "compression"), "backports.zstd"),
}
"""Packages one of which a format needs, and what installs them."""


def absent() -> dict[str, str]:
    """Return what has to be installed for the formats that cannot be tried here."""

    def there(package: str) -> bool:
        try:
            return importlib.util.find_spec(package) is not None
        except ModuleNotFoundError:  # of a package in a package
            return False

    return {name: install for name, (packages, install) in PACKAGES.items() if not any(map(there, packages))}


def _npz(pack: bool = False, **arrays: Any) -> bytes:
    """Return the bytes of an .npz."""
    stream = io.BytesIO()
    (np.savez_compressed if pack else np.savez)(stream, **arrays)
    return stream.getvalue()


def _zipped(folder: Path) -> bytes:
    """Return a folder as an archive."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                archive.write(file, file.relative_to(folder))
    return stream.getvalue()


def seeds(folder: Path, formats: Collection[str] | None = None) -> Seeds:
    """Return sound files of some formats, or of all whose packages are installed.

    Args:
        folder: Where files may be written.
        formats: Names in `READERS`; all if None.
    """
    makers = {
        _splat_seeds: ("ply", "compressed ply", "splat", "spz 3", "spz 4", "spz packed", "sog"),
        array_seeds: ("points", "paint", "body", "morph", "recording", "state", "radiance", "nanovdb", "checkpoint"),
        _mesh_seeds: ("mesh ply", "obj", "stl", "off", "glb", "gltf", "points ply", "xyz"),
        _text_seeds: ("mjcf", "urdf", "options", "run"),
    }
    makers[_stage_seeds] = ("stage", "stage packed", "stage splats", "stage body", "animation")
    makers[_dataset_seeds] = ("dataset",)
    wanted = set(READERS if formats is None else formats) - absent().keys()
    found: Seeds = {}
    for make, names in makers.items():
        if wanted & set(names):
            found |= make(folder)
    return {name: seed for name, seed in found.items() if name in wanted}


def _dataset_seeds(folder: Path) -> Seeds:
    from tests.demonstrations import episodes

    for pictures in (None, "image"):
        episodes.write(folder / f"dataset {pictures}", (4, 3), pictures)
    return {"dataset": (".zip", "zip", [_zipped(folder / f"dataset {pictures}") for pictures in (None, "image")])}


def _splat_seeds(folder: Path) -> Seeds:
    from softmode.splats import write_splats
    from tests.splats.test_formats import sog_members, zip_sog
    from tests.splats.test_formats_quantised import compressed_ply, pack_spz, spz_3, spz_arrays
    from tests.splats.test_splats import random_splats

    for suffix in (".ply", ".splat"):
        write_splats(folder / f"a{suffix}", random_splats())
    meta, images, _ = sog_members()
    found: Seeds = {
        "ply": (".ply", "ply", [(folder / "a.ply").read_bytes()]),
        "compressed ply": (
            ".ply",
            "ply",
            [compressed_ply(40, degree, colors)[0] for degree, colors in ((0, True), (9, False))],
        ),
        "splat": (".splat", "bytes", [(folder / "a.splat").read_bytes()]),
        "spz 3": (".spz", "gzip", [spz_3()]),
        "spz packed": (".spz", "bytes", [spz_3()]),
        "sog": (".sog", "zip", [zip_sog(folder / "a.sog", meta, images).read_bytes()]),
    }
    if "spz 4" not in absent():
        found["spz 4"] = ".spz", "bytes", [pack_spz(4, 3, 40, 11, spz_arrays(4, 3)[0])]
    return found


def array_seeds(folder: Path) -> Seeds:
    """Return sound .npz and NanoVDB files of every kind."""
    import warp as wp

    from softmode.envs.env_state import EnvState, generator_state
    from softmode.mpm.run import MorphRun
    from softmode.objects.object_file import write_object
    from softmode.view.live_recording import LiveRecording
    from tests.bodies import cube
    from tests.radiance.test_grid import plenoctree, plenoxels, small
    from tests.radiance.test_nanovdb import with_checksums
    from tests.splats.test_splats import random_splats

    random = np.random.default_rng(0)
    x = random.normal(size=(40, 3))
    body = cube()
    body.save(folder / "body.npz")
    write_object(folder / "object.npz", body, random_splats())
    n, s = 5, 2
    many = {"positions": (s + 1, n, 3), "deformation": (s + 1, n, 3, 3), "control": (s, n, 3, 3), "velocity": (n, 3)}
    many |= {
        "affine_velocity": (n, 3, 3),
        "losses": (s + 1,),
        "first_losses": (1,),
        "kinetic_energy": (s,),
        "offsets": (2, 3),
    }
    told: dict[str, Any] = {"ends": (), "gradient_count": 1, "trial_count": 2, "fingerprint": "f", "names": ("a", "b")}
    MorphRun(**{name: np.ones(shape) for name, shape in many.items()}, **told).save(folder / "morph.npz")
    recording = LiveRecording(
        times=np.arange(4.0), q=random.normal(size=(4, 6, 3)), dent=np.zeros((4, 9, 3), np.float32),
        body_q=np.ones((4, 2, 7), np.float32), fingerprints=("a", "b"),
    )  # fmt: skip
    recording.save(folder / "recording.npz")
    arrays = {"state.joint_q": random.normal(size=(2, 5)), "task.done": np.zeros((2, 1), bool)}
    draws = (generator_state(np.random.default_rng(3)), None)
    EnvState(owner={"task": "t", "robot": "r", "objects": "o"}, arrays=arrays, random=draws).save(folder / "state.npz")
    values = np.zeros((8, 8, 8), np.float32)
    values[2:6, 3:6, 1:7] = 40.0
    volume = wp.Volume.load_from_numpy(values, min_world=(1.0, 2.0, 3.0), voxel_size=0.5, bg_value=0.0, device="cpu")
    volume.save_to_nvdb(str(folder / "none"), codec="none")
    plain = {
        "density": small()["density"],
        "bounds": np.array([[0.0] * 3, [1.0] * 3]),
        "rgb": np.full((4, 5, 6, 3), 99, np.uint8),
    }
    found: Seeds = {
        "points": (
            ".npz",
            "zip",
            [_npz(points=x), _npz(True, points=x, normals=x, colors=np.full((40, 3), 9, np.uint8))],
        ),
        "paint": (".npz", "zip", [_npz(points=x, factors=np.ones(40))]),
        "body": (".npz", "zip", [(folder / name).read_bytes() for name in ("body.npz", "object.npz")]),
        "morph": (".npz", "zip", [(folder / "morph.npz").read_bytes()]),
        "recording": (".npz", "zip", [(folder / "recording.npz").read_bytes()]),
        "state": (".npz", "zip", [(folder / "state.npz").read_bytes()]),
        "radiance": (".npz", "zip", [_npz(True, **small()), _npz(**plenoxels()), _npz(**plenoctree()), _npz(**plain)]),
        "nanovdb": (".nvdb", "nvdb", [(folder / "none").read_bytes(), with_checksums((folder / "none").read_bytes())]),
    }
    if "checkpoint" not in absent():
        from softmode.learning.checkpoints import write_checkpoint
        from tests.learning.test_checkpoints import checkpoint

        options = {"obs_type": "state", "config": json.loads(_OPTIONS)["config"]}
        write_checkpoint(checkpoint(), folder / "a.npz")
        write_checkpoint(checkpoint(env="softmode/PushSoft-v0", env_options=options), folder / "b.npz")
        found["checkpoint"] = ".npz", "zip", [(folder / name).read_bytes() for name in ("a.npz", "b.npz")]
    return found


def _mesh_seeds(folder: Path) -> Seeds:
    import trimesh as package

    trimesh: Any = package
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    box.visual.vertex_colors = np.full((8, 4), 200, np.uint8)
    export: Callable[..., Any] = functools.partial(trimesh.exchange.export.export_mesh, box, None)

    def content(kind: str, **options: Any) -> bytes:
        given = export(kind, **options)
        return given.encode() if isinstance(given, str) else given

    uv = trimesh.visual.TextureVisuals(uv=np.linspace(0.0, 1.0, 16).reshape(8, 2), image=_picture())
    textured = trimesh.Trimesh(box.vertices, box.faces, visual=uv).export(file_type="glb")
    parts: Any = box.export(file_type="gltf", embed_buffers=True)
    cloud = b"ply\nformat ascii 1.0\nelement vertex 8\n" + b"".join(b"property float %c\n" % c for c in b"xyz")
    corners = "\n".join(" ".join(f"{v:g}" for v in row) for row in box.vertices).encode() + b"\n"
    return {
        "mesh ply": (".ply", "ply", [content("ply"), content("ply", encoding="ascii")]),
        "obj": (".obj", "text", [content("obj")]),
        "stl": (".stl", "bytes", [content("stl"), content("stl_ascii")]),
        "off": (".off", "text", [content("off")]),
        "glb": (".glb", "glb", [content("glb"), textured]),
        "gltf": (".gltf", "json", [parts["model.gltf"]]),
        "points ply": (".ply", "text", [cloud + b"end_header\n" + corners]),
        "xyz": (".xyz", "text", [corners]),
    }


def _picture() -> Any:
    from PIL import Image

    return Image.fromarray(np.arange(16 * 16 * 3, dtype=np.uint8).reshape(16, 16, 3))


_OPTIONS = """{"obs_type": "state", "max_episode_steps": 40, "config": {"goal_distance": [0.05, 0.1], "scene": {
"object": {"shape": "box", "extents": [0.06, 0.05, 0.04], "colors": [[1, 0, 0], [0, 1, 0]], "build": {"mode_count": 4},
"stiffness": [{"box": [0, 0, 0, 1, 1, 1], "factor": 2.0}]},
"others": [{"shape": "sphere", "extents": [0.05, 0.05, 0.05]}],
"material": {"youngs_modulus": 20000.0, "poissons_ratio": 0.4}, "substeps": 4, "solver": {"friction_lag": 4}}}}"""


def _text_seeds(folder: Path) -> Seeds:
    from tests.robots.files import ARM5, MJCF, URDF, hand_mjcf

    mjcf = [text.encode() for text in (MJCF.replace('<mesh name="wedge" file="wedge.stl"/>', ""), ARM5, hand_mjcf())]
    mjcf[0] = mjcf[0].replace(b'type="mesh" mesh="wedge"', b'type="sphere" size="0.02"')
    urdf = URDF.replace('<mesh filename="package://lifter/meshes/wedge.stl"/>', '<box size="0.04 0.01 0.02"/>')
    urdf = urdf.replace('<mesh filename="package://lifter/meshes/arm.dae"/>', '<box size="0.1 0.1 0.1"/>')
    run = folder / "run"
    run.mkdir()
    (run / "config.json").write_text(json.dumps({"env": "softmode/PushSoft-v0", "env_options": json.loads(_OPTIONS)}))
    (run / "progress.csv").write_text("iteration,env_steps,loss\n1,100,0.5\n2,200,0.4\n3,300,nan\n")
    (run / "latest.npz").write_bytes(b"")
    return {
        "mjcf": (".xml", "text", mjcf),
        "urdf": (".urdf", "text", [urdf.encode()]),
        "options": (
            ".json",
            "json",
            [_OPTIONS.encode(), json.dumps({"config": {"yaw_range": 1.0, "density_range": [200.0, 300.0]}}).encode()],
        ),
        "run": (".zip", "zip", [_zipped(run)]),
    }


def _stage_seeds(folder: Path) -> Seeds:
    from softmode.splats import write_splats
    from tests.splats.test_splats import random_splats
    from tests.usd.stages import KINDS, Author, Sdf, UsdUtils, UsdVol, shell, transform

    stages = {}
    for kind in KINDS:
        author = Author.create(folder / f"{kind}.usda", "Y", 0.01)
        root = author.body("/World/Toy", kind, matrix=transform((0.0, 0.0, 0.3), turn=0.2))
        root.CreateAttribute("physics:mass", Sdf.ValueTypeNames.Float).Set(0.2)
        if kind == "Mesh":
            author.prop("/World/Prop", (0.5, 0.0, 0.05))
            author.robot("/World/Robot", (1.0, 0.0, 0.0))
            author.splats(UsdVol.ParticleField3DGaussianSplat.Define(author.stage, "/World/Toy/Splats"), shell(20))
        author.save()
        for suffix in ("usda", "usdc"):
            crate = folder / f"{kind}.{suffix}"
            if suffix == "usdc":
                Sdf.Layer.FindOrOpen(str(folder / f"{kind}.usda")).Export(str(crate))
            stages[crate.name] = crate.read_bytes()
    UsdUtils.CreateNewUsdzPackage(str(folder / "Mesh.usda"), str(folder / "Mesh.usdz"))
    for suffix in (".usda", ".usdc"):
        write_splats(folder / f"splats{suffix}", random_splats(30))
    texts = [content for name, content in stages.items() if name.endswith("usda")]
    crates = [content for name, content in stages.items() if name.endswith("usdc")]
    from softmode.objects.placed import Placed
    from softmode.objects.soft_object import SoftObject
    from softmode.usd import write_usd
    from tests.bodies import cube
    from tests.usd.test_export_animation import Scene

    for suffix in (".usda", ".usdc"):
        write_usd(folder / f"body{suffix}", Placed(object=SoftObject(body=cube())))
        Scene("affine").record(folder / f"animation{suffix}")
    return {
        "stage body": (".usd", "text", [(folder / f"body{suffix}").read_bytes() for suffix in (".usda", ".usdc")]),
        "animation": (".usd", "text", [(folder / f"animation{suffix}").read_bytes() for suffix in (".usda", ".usdc")]),
        "stage": (".usd", "text", [*texts, *crates]),
        "stage packed": (".usdz", "bytes", [(folder / "Mesh.usdz").read_bytes()]),
        "stage splats": (".usd", "text", [(folder / f"splats{suffix}").read_bytes() for suffix in (".usda", ".usdc")]),
    }
