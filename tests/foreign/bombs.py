"""Files of a few bytes that ask for gigabytes or minutes, or that contradict themselves, made by code."""

from __future__ import annotations

import base64
import io
import json
import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

MESH, ROBOT, DATASET, CLOUD = (
    "softmode.objects.mesh_file:read_mesh",
    "softmode.robots:load",
    "softmode.demonstrations:read_dataset",
    "softmode.splats.point_cloud:read_point_cloud",
)
"""Readers."""


# -- meshes -----------------------------------------------------------------------------------------------------------


def flat_png(edge: int) -> bytes:
    """Return a white picture of one bit per pixel."""
    buffer = io.BytesIO()
    Image.new("1", (edge, edge), 1).save(buffer, format="PNG")
    return buffer.getvalue()


def triangle_gltf(**more: Any) -> dict[str, Any]:
    """Return a glTF scene of one triangle, with more entries."""
    data = (
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
        + np.array([[0, 0], [1, 0], [0, 1]], "<f4").tobytes()
    )
    data += np.array([0, 1, 2, 0], "<u2").tobytes()
    views = [{"buffer": 0, "byteOffset": start, "byteLength": size} for start, size in ((0, 36), (36, 24), (60, 6))]
    accessors = [
        {"bufferView": view, "componentType": component, "count": 3, "type": kind}
        for view, component, kind in ((0, 5126, "VEC3"), (1, 5126, "VEC2"), (2, 5123, "SCALAR"))
    ]
    attributes = {"POSITION": 0, "TEXCOORD_0": 1}
    scene = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 2, "material": 0}]}],
        "materials": [{}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data), "uri": "data:;base64," + base64.b64encode(data).decode()}],
    }
    return scene | more


def textured_gltf(count: int, picture: bytes) -> dict[str, Any]:
    """Return a scene of triangles that each have the same picture, as one of their own."""
    uri = "data:image/png;base64," + base64.b64encode(picture).decode()
    attributes = {"POSITION": 0, "TEXCOORD_0": 1}
    return triangle_gltf(
        images=[{"uri": uri}] * count,
        textures=[{"source": k} for k in range(count)],
        materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": k}}} for k in range(count)],
        meshes=[{"primitives": [{"attributes": attributes, "indices": 2, "material": k} for k in range(count)]}],
    )


def gltf(folder: Path, scene: dict[str, Any]) -> Path:
    """Write a scene."""
    path = folder / "a.gltf"
    path.write_text(json.dumps(scene))
    return path


def zipped(folder: Path, megabytes: int) -> Path:
    """Write an archive of an .obj of blanks: each of its megabytes is the same thousand bytes."""
    whole = b" " * 2**20
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    piece = packer.compress(whole) + packer.flush(zlib.Z_FULL_FLUSH)
    data, check = piece * megabytes + packer.flush(), 0
    for _ in range(megabytes):
        check = zlib.crc32(whole, check)
    path = folder / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.obj", data)  # stored; both headers then say that it is deflated
    content = bytearray(path.read_bytes())
    size = megabytes * 2**20
    for start, at in ((0, 8), (content.rindex(b"PK\x01\x02"), 10)):
        content[start + at : start + at + 2] = struct.pack("<H", zipfile.ZIP_DEFLATED)
        content[start + at + 6 : start + at + 18] = struct.pack("<III", check, len(data), size)
    path.write_bytes(bytes(content))
    return path


def text(name: str, content: str | bytes | Callable[[], str]) -> Callable[[Path], Path]:
    """Return what writes a file."""

    def write(folder: Path) -> Path:
        found = content() if callable(content) else content
        (folder / name).write_bytes(found if isinstance(found, bytes) else found.encode())
        return folder / name

    return write


def leaving(folder: Path) -> Path:
    """Write an .obj whose colours lie outside its folder, behind a link."""
    inside = folder / "inside"
    inside.mkdir()
    (folder / "a.mtl").write_text("newmtl m\nKd 1 0 0\n")
    (inside / "a.mtl").symlink_to(folder / "a.mtl")
    (inside / "a.obj").write_text("mtllib a.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    return inside / "a.obj"


INSTANCES = {"scenes": [{"nodes": list(range(300_000))}], "nodes": [{"mesh": 0}] * 300_000}
HUGE_ACCESSOR = [{"componentType": 5126, "count": 10**9, "type": kind} for kind in ("VEC3", "VEC2", "SCALAR")]
MESHES: dict[str, Callable[[Path], Path]] = {
    "textures": lambda folder: gltf(folder, textured_gltf(21, flat_png(8000))),
    "one texture": lambda folder: gltf(folder, textured_gltf(1, flat_png(16384))),
    "zip": lambda folder: zipped(folder, 1500),
    "scene cycle": lambda folder: gltf(folder, triangle_gltf(nodes=[{"mesh": 0, "children": [0]}])),
    "longer cycle": lambda folder: gltf(
        folder, triangle_gltf(nodes=[{"mesh": 0, "children": [1]}, {"children": [2]}, {"children": [1]}])
    ),
    "cycle of the root": lambda folder: gltf(
        folder, triangle_gltf(nodes=[{"mesh": 0, "children": [1]}, {"children": [0]}])
    ),
    "instances": lambda folder: gltf(folder, triangle_gltf(**INSTANCES)),
    "accessor": lambda folder: gltf(folder, triangle_gltf(accessors=HUGE_ACCESSOR)),
    "buffer outside": lambda folder: gltf(folder, triangle_gltf(buffers=[{"byteLength": 66, "uri": "../a.bin"}])),
    "address": lambda folder: gltf(
        folder, triangle_gltf(buffers=[{"byteLength": 66, "uri": "http://127.0.0.1/a.bin"}])
    ),
    "link outside": leaving,
    "ply": text(
        "a.ply",
        "ply\nformat binary_little_endian 1.0\nelement vertex 2000000000\nproperty float x\nproperty float y\n"
        "property float z\nelement face 2000000000\nproperty list uchar int vertex_indices\nend_header\n",
    ),
    "stl": text("a.stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50)),
    "off": text("a.off", "OFF\n2000000000 2000000000 0\n0 0 0\n"),
    "obj": text("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 2000000000\n"),
    "negative faces": text("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 -1\n"),
    "entities": text(
        "a.dae",
        '<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa">'
        + "".join(f'<!ENTITY {chr(98 + k)} "{f"&{chr(97 + k)};" * 10}">' for k in range(10))
        + "]><COLLADA>&k;</COLLADA>",
    ),
}
"""What writes a mesh file into a folder; none of them can be read."""


# -- robots -----------------------------------------------------------------------------------------------------------

LINK = '<geom size="0.1" contype="0" conaffinity="0"/><joint/>'


def mjcf(content: str, body: str = LINK, *, name: str = "a.xml") -> Callable[[Path], Path]:
    """Return what writes an MJCF file of one link, with more in it."""
    return text(name, f'<mujoco>{content}<worldbody><body name="b">{body}</body></worldbody></mujoco>')


def chain(count: int) -> str:
    """Return links behind each other."""
    return f"{LINK}<body>" * count + LINK + "</body>" * count


def included(folder: Path) -> Path:
    """Write a file that includes 900 large ones."""
    (folder / "large.xml").write_text(f"<mujoco>{'<custom/>' * 30_000}</mujoco>")
    return mjcf('<include file="large.xml"/>' * 900)(folder)


def pictured(folder: Path) -> Path:
    """Write a file with a height field of a large picture."""
    (folder / "a.png").write_bytes(flat_png(16384))
    return mjcf('<asset><hfield name="h" file="a.png" size="1 1 1 1"/></asset>')(folder)


def piped(folder: Path) -> Path:
    """Write a URDF with a mesh that is a pipe."""
    os.mkfifo(folder / "a.stl")
    shape = '<collision><geometry><mesh filename="a.stl"/></geometry></collision>'
    return text("a.urdf", f'<robot name="a"><link name="x">{shape}</link></robot>')(folder)


def jointed(limits: str, mass: str = "1") -> Callable[[Path], Path]:
    """Return what writes a URDF with a joint of some limits and a link of some mass."""
    inertial = f'<inertial><mass value="{mass}"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    return text(
        "a.urdf",
        f'<robot name="a"><link name="x"/><link name="y">{inertial}</link><joint name="j" type="revolute">'
        f'<parent link="x"/><child link="y"/><axis xyz="0 0 1"/><limit {limits}/></joint></robot>',
    )


FLEX = '<flexcomp name="f" type="grid" count="200 200 200" spacing="1 1 1" dim="3"/>'
REPLICATE = (
    '<replicate count="1000"><replicate count="1000"><replicate count="1000">{}</replicate></replicate></replicate>'
)
SERVO = '<actuator><position joint="j" {}/></actuator>'
JOINTED = '<geom size="0.1"/><joint name="j" range="-1 1"/>'
ROBOTS: dict[str, Callable[[Path], Path]] = {
    "flexcomp": mjcf("", LINK + FLEX),
    "replicate": mjcf("", LINK + REPLICATE.format('<geom size="0.1"/>')),
    "key frames": mjcf('<size nkey="100000000"/>'),
    "many key frames": mjcf(f"<keyframe>{'<key/>' * 100_000}</keyframe>"),
    "chain": mjcf("", chain(450)),
    "long chain": mjcf("", "".join(f"{LINK}<body>" for _ in range(2000)) + LINK + "</body>" * 2000),
    "joints": mjcf("", '<geom size="0.1"/>' + "<joint/>" * 20_000),
    "cable": mjcf(
        "",
        LINK + '<composite type="cable" count="1000000 1 1" size="1"><joint kind="main"/>'
        '<geom type="capsule" size="0.1"/></composite>',
    ),
    "picture": pictured,
    "pipe": piped,
    "no such path": lambda folder: folder / "a\0.xml",
    "long path": lambda folder: folder / f"{'a' * 5000}.xml",
    "height field": mjcf('<asset><hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/></asset>'),
    "user data": mjcf('<size nuserdata="2000000000"/>'),
    "user numbers": mjcf('<size nuser_body="2000000000"/>'),
    "elements": text("a.urdf", lambda: f"<robot>{'<a/>' * 14_000_000}</robot>"),
    "attributes": text("a.urdf", lambda: "<robot " + " ".join(f'a{k}=""' for k in range(3_000_000)) + "/>"),
    "nested": text("a.urdf", "<robot>" + "<a>" * 200_000 + "</a>" * 200_000 + "</robot>"),
    "includes": included,
    "hidden entities": text(
        "a.urdf",
        '<?xml version="1.0" encoding="UTF-16"?><!DOCTYPE robot [<!ENTITY a "a">]><robot>&a;</robot>'.encode("utf-16"),
    ),
    "gain that is NaN": mjcf(SERVO.format('kp="nan"'), JOINTED),
    "negative gain": mjcf(SERVO.format('kp="-100"'), JOINTED),
    "huge gain": mjcf(SERVO.format('kp="1e300"'), JOINTED),
    "negative damping": mjcf(SERVO.format('kp="100" kv="-1"'), JOINTED),
    "mass that is NaN": mjcf("", '<geom size="0.1" mass="nan"/><joint/>'),
    "range that is NaN": mjcf("", '<geom size="0.1"/><joint range="nan 1"/>'),
    "URDF of mass NaN": jointed('lower="-1" upper="1" effort="1" velocity="1"', "nan"),
    "URDF of range NaN": jointed('lower="nan" upper="1" effort="1" velocity="1"'),
    "URDF of effort NaN": jointed('lower="-1" upper="1" effort="NaN" velocity="1"'),
}
"""What writes a robot file into a folder; "chain" is sound."""


# -- datasets ---------------------------------------------------------------------------------------------------------


def zeros(path: Path, names: list[str], rows: int, groups: int, kind: str = "int64") -> None:
    """Write a table of zeros, which run-length coding makes small."""
    import pyarrow as pa
    from pyarrow import parquet

    table = pa.table({name: pa.array(np.zeros(rows, kind)) for name in names})
    with parquet.ParquetWriter(path, table.schema, compression="gzip", write_page_checksum=True) as writer:
        for _ in range(groups):
            writer.write_table(table)


def dataset(folder: Path) -> Path:
    """Write a sound one of two frames."""
    from tests.demonstrations.episodes import write

    write(folder / "d", (2,))
    return folder / "d"


def swollen(name: str, columns: list[str], rows: int, groups: int, kind: str = "int64") -> Callable[[Path], Path]:
    """Return what writes a dataset of which one table is a long one of zeros."""

    def write(folder: Path) -> Path:
        zeros(dataset(folder) / name, columns, rows, groups, kind)
        return folder / "d"

    return write


def linked(name: str) -> Callable[[Path], Path]:
    """Return what writes a dataset of which one file lies outside, behind a link."""

    def write(folder: Path) -> Path:
        place = dataset(folder) / name
        place.rename(folder / "outside")
        place.symlink_to(folder / "outside")
        return folder / "d"

    return write


def pipe(name: str) -> Callable[[Path], Path]:
    """Return what writes a dataset of which one file is a pipe, which never ends."""

    def write(folder: Path) -> Path:
        place = dataset(folder) / name
        place.unlink()
        os.mkfifo(place)
        return folder / "d"

    return write


DATA, ROWS, TASKS = (
    "data/chunk-000/file-000.parquet",
    "meta/episodes/chunk-000/file-000.parquet",
    "meta/tasks.parquet",
)
DATASETS: dict[str, Callable[[Path], Path]] = {
    "frames": swollen(DATA, ["index"], 5_000_000, 40),
    "episodes": swollen(ROWS, ["episode_index"], 1_000_000, 20, "int8"),
    "flags": swollen(ROWS, [f"f{k}" for k in range(20)], 1_000_000, 10, "bool"),
    "tasks": swollen(TASKS, ["task_index", "task"], 1_000_000, 4),
    **{f"link to {name}": linked(name) for name in (DATA, ROWS, TASKS, "meta/info.json")},
    **{f"pipe at {name}": pipe(name) for name in (DATA, "meta/info.json")},
}
"""What writes a dataset into a folder."""


def shuffled(data: bytes, number: int) -> bytes:
    """Return damaged bytes: some changed, a part missing, twice or moved."""
    random = np.random.default_rng(number)
    array = bytearray(data)
    a, b = sorted(random.integers(0, len(array) + 1, 2).tolist())
    match random.integers(0, 5):
        case 0:
            for k in random.integers(0, len(array), 1 + int(random.integers(0, 8))):
                array[k] = random.integers(0, 256)
        case 1:
            del array[a : min(b, a + 64)]
        case 2:
            array[a:a] = array[a : min(b, a + 64)]
        case 3:
            del array[b:]
        case _:
            k = int(random.integers(0, max(1, len(array) - 8)))
            array[k : k + 4] = random.choice([b"\xff\xff\xff\x7f", b"\xff\xff\xff\xff", b"-1 9", b"nan "])
    return bytes(array)
