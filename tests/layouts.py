"""Files after the published layouts of other programs, and the tables of docs/ that tell how each is read.

`python -m tests.layouts` reads every file and writes the tables into the pages; a test compares them.
"""

from __future__ import annotations

import gzip
import struct
import tempfile
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import recfunctions

from softmode.errors import AssetError
from softmode.objects.object_file import file_kind
from softmode.objects.stage.scene import read_usd_scene
from softmode.objects.stage_asset import read_usd_mesh
from softmode.splats import read_splats
from softmode.splats.formats.others import OTHERS
from softmode.splats.point_cloud import read_points
from tests.splats.test_formats import sog_members, write_sog
from tests.splats.test_formats_quantised import compressed_ply
from tests.splats.test_layouts import INRIA, SHAPE, ply_of, tables

DOCS = Path(__file__).parents[1] / "docs"
USD = "OpenUSD"
READ, NOTED, REFUSED = "read", "read with a note", "refused"
BEGIN, END = "<!-- made by tests/layouts.py -->", "<!-- end -->"


@dataclass(frozen=True)
class Layout:
    """One file."""

    format: str
    """Row of the table."""
    what: str
    """What is particular about it, as the table says."""
    name: str
    """Its name."""
    write: Callable[[Path], Any]
    """Writes it."""
    right: Callable[[Any], bool] = lambda found: found.count == 24
    """Whether what was read is right."""
    told: str = ""
    """What its note, or the error, says."""


def with_columns(table: np.ndarray, **columns: np.ndarray | float) -> np.ndarray:
    """Return a table with more columns of single precision."""
    added = [np.broadcast_to(np.asarray(value, "f4"), len(table)) for value in columns.values()]
    return recfunctions.append_fields(table, list(columns), added, usemask=False)


def ply(table: np.ndarray, form: str = "<", **options: Any) -> Callable[[Path], Any]:
    """Return what writes a .ply."""
    return lambda path: path.write_bytes(ply_of(table, form, **options))


def text(header: str, *columns: float) -> Callable[[Path], Any]:
    """Return what writes points of a helix as text, with more columns."""
    turns = np.linspace(0.0, 20.0, 24)
    rows = np.column_stack([np.cos(turns), np.sin(turns), 0.1 * turns, *(np.full(24, x) for x in columns)])
    return lambda path: path.write_text(header + "\n".join(" ".join(f"{x:.5f}" for x in row) for row in rows))


def points(**columns: str) -> np.ndarray:
    """Return a table of points of a helix, with columns of other types."""
    table = np.zeros(24, dtype=[*((name, "f8") for name in "xyz"), *columns.items()])
    turns = np.linspace(0.0, 20.0, 24)
    table["x"], table["y"], table["z"] = np.cos(turns), np.sin(turns), 0.1 * turns
    for name in set(columns) & {"red", "diffuse_red"}:
        table[name] = 255
    return table


def changed(count: int, **changes: tuple[Any, Any]) -> np.ndarray:
    """Return a table of splats in doubles with other values in some rows of a column."""
    table = tables(count, kind="f8")
    for name, (rows, values) in changes.items():
        table[name][rows] = values
    return table


def red(found: Any) -> bool:
    """Return whether all is red."""
    return found.count == 24 and bool(np.allclose(found.colors(), [1.0, 0.0, 0.0], atol=1e-6))


def sog(path: Path, **changes: Any) -> None:
    """Write a SOG archive."""
    meta, images, _ = sog_members(24)
    folder = write_sog(path.parent / "members", meta | changes, images)
    with zipfile.ZipFile(path, "w") as archive:
        for member in folder.iterdir():
            archive.write(member, member.name)


def spz(flags: int, degree: int = 0) -> Callable[[Path], Any]:
    """Return what writes an SPZ file of version 2."""
    size = 9 + 1 + 3 + 3 + 3 + 3 * ((degree + 1) ** 2 - 1)
    head = struct.pack("<4sIIBBBB", b"NGSP", 2, 24, degree, 12, flags, 0)
    return lambda path: path.write_bytes(gzip.compress(head + bytes(np.arange(24 * size, dtype=np.uint8))))


def numbers(path: Path) -> None:
    """Write a .npz of points whose colours are floats of 0..255."""
    table = points()
    np.savez(path, points=np.column_stack([table[n] for n in "xyz"]), colors=np.tile([255.0, 0.0, 0.0], (24, 1)))


def stage(body: str) -> Callable[[Path], Any]:
    """Return what writes a stage in metres with Z up."""
    return lambda path: path.write_text('#usda 1.0\n(\n    upAxis = "Z"\n    metersPerUnit = 1\n)\n' + body)


QUAD = """point3f[] points = [(0,0,0),(1,0,0),(1,1,0),(0,1,0)]
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0,1,2,3]
"""
RED_QUAD = QUAD + "    color3f[] primvars:displayColor = [(1,0,0)]\n"
SPLAT = """def ParticleField3DGaussianSplat "S" {
    point3f[] positions = [%s]
    float3[] scales = [%s]
    int radiance:sphericalHarmonicsDegree = %d
    float3[] radiance:sphericalHarmonicsCoefficients = [%s]%s
}
"""


def splats_usd(degree: int = 0, *, space: str = "", first: str = "(0,0,0)") -> Callable[[Path], Any]:
    """Return what writes a stage of 24 splats."""
    places = ",".join([first, *(f"({i},{i % 3},0)" for i in range(1, 24))])
    values = (places, ",".join(["(1,1,1)"] * 24), degree, ",".join(["(0,0,0)"] * 24 * (degree + 1) ** 2))
    return stage(SPLAT % (*values, f' (colorSpace = "{space}")' if space else ""))


def preview(surface: str) -> Callable[[Path], Any]:
    """Return what writes a red square with a material whose surface shader is given."""
    bound = "    rel material:binding = </M>\n"
    shader = "token outputs:surface.connect = </M/S.outputs:surface>\n"
    shader += f' def Shader "S" {{ token outputs:surface\n{surface}\n }}'
    apis = '(prepend apiSchemas = ["MaterialBindingAPI"])'
    return stage(f'def Mesh "Q" {apis} {{\n    {RED_QUAD}{bound}}}\ndef Material "M" {{ {shader}\n }}\n')


def faces(count: int, color: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> Callable[[Any], bool]:
    """Return what checks the number and the colour of triangles."""
    return lambda found: len(found.corners) == count and bool(np.allclose(found.corner_colors, color, atol=1e-3))


BRICK = """def Xform "Brick" (prepend apiSchemas = ["PhysicsDeformableBodyAPI"]) {{
    {0}
    def Mesh "Shape" (prepend apiSchemas = ["PhysicsVolumeDeformableSimAPI"]) {{
        point3f[] points = [(0,0,0),(1,0,0),(0,1,0),(0,0,1)]
        int[] faceVertexCounts = [3,3,3,3]
        int[] faceVertexIndices = [0,2,1,0,1,3,0,3,2,1,2,3]
    }}
    {1}
}}
"""


def bricks(count: int) -> Callable[[Any], bool]:
    """Return what checks the number of bodies."""
    return lambda found: len(found.deformables) == count


def copies(prototype: str, indices: str) -> Callable[[Path], Any]:
    """Return what writes two copies of a prototype 3 m apart."""
    return stage(
        f'def PointInstancer "P" {{\n rel prototypes = </P/Brick>\n int[] protoIndices = [{indices}]\n'
        f" point3f[] positions = [(0,0,0),(3,0,0)]\n{prototype} }}\n"
    )


NORMALS = {"nx": 0.0, "ny": 0.0, "nz": 1.0}
SHARP = b"element extrinsic 16\nproperty float extrinsic\nelement version 3\nproperty uchar version\n"
PLY, CLOUD = ".ply of splats", ".ply of points"
LAYOUTS = (
    Layout(
        PLY, "INRIA, degree 0 to 3, normals", "a.ply", ply(with_columns(tables(), **NORMALS)), lambda s: s.count == 24
    ),
    Layout(PLY, "text, either byte order, doubles", "b.ply", ply(tables(kind="f8"), "ascii")),
    Layout(PLY, "gsplat, with lists in its rows", "c.ply", ply(tables(), ">", lists=True)),
    Layout(
        PLY,
        "colours red, green, blue as bytes (nerfstudio)",
        "d.ply",
        ply(
            recfunctions.merge_arrays(
                [
                    tables(columns=("x", "y", "z", "opacity", *SHAPE)),
                    np.array([(255, 0, 0)] * 24, [("red", "u1"), ("green", "u1"), ("blue", "u1")]),
                ],
                flatten=True,
            )
        ),
        red,
    ),
    Layout(PLY, "discs with two scales (2DGS)", "e.ply", ply(tables(columns=INRIA + SHAPE[:2] + SHAPE[3:]))),
    Layout(
        PLY,
        "other elements (SHARP)",
        "f.ply",
        lambda path: path.write_bytes(ply_of(tables(), after=SHARP) + bytes(67)),
        told="16 extrinsic, 3 version",
    ),
    Layout(
        PLY,
        "filter_3D (Mip-Splatting), applied",
        "g.ply",
        ply(with_columns(tables(), filter_3D=0.1)),
        lambda s: bool(np.allclose(s.scales, 0.1 * 2**0.5, rtol=1e-5)),
        "filter_3D",
    ),
    Layout(
        PLY,
        "labels, times, motions",
        "h.ply",
        ply(with_columns(tables(), label=3.0, trbf_center=0.5)),
        told="label, trbf_center",
    ),
    Layout(
        PLY,
        "degree 4, cut to 3",
        "i.ply",
        ply(with_columns(tables(), **{f"f_rest_{i}": 0.0 for i in range(72)})),
        lambda s: s.sh_degree == 3,
        "degree 4",
    ),
    Layout(
        PLY,
        "rows that are not finite or have no rotation or size, dropped",
        "j.ply",
        ply(changed(25, x=(3, np.nan))),
        told="1 of 25",
    ),
    Layout(PLY, "no colours or opacities", "k.ply", ply(tables(columns=("x", "y", "z", *SHAPE))), told="opaque"),
    Layout(
        PLY,
        "coordinates of a map, centred",
        "l.ply",
        ply(changed(24, x=(slice(None), 4.0e5 + 1e-3 * np.arange(24)))),
        lambda s: s.offset[0] == 4e5,
        "offset",
    ),
    Layout(
        PLY,
        "anchors of a network (Scaffold-GS)",
        "m.ply",
        ply(with_columns(tables(), scale_3=0.0, scale_4=0.0, scale_5=0.0)),
        told="6 scale properties",
    ),
    Layout(
        PLY,
        "files shorter or longer than their header says",
        "n.ply",
        lambda path: path.write_bytes(ply_of(tables())[:-4]),
        told="the file holds",
    ),
    Layout(
        ".compressed.ply",
        "12 or 18 bounds a chunk",
        "a.compressed.ply",
        lambda path: path.write_bytes(compressed_ply(24, 9, True)[0]),
    ),
    Layout(".splat", "32 bytes a splat", "a.splat", lambda path: path.write_bytes(bytes(range(1, 97)) * 8)),
    Layout(
        ".splat", "no multiple of 32 bytes", "b.splat", lambda path: path.write_bytes(bytes(33)), told="multiple of 32"
    ),
    Layout(".spz", "versions 1 to 4, degree 0 to 3", "a.spz", spz(0)),
    Layout(".spz", "antialiased", "b.spz", spz(1), told="antialiased"),
    Layout(".spz", "degree 4, cut to 3", "c.spz", spz(0, 4), told="degree 4"),
    Layout("SOG", "archive, folder, archive of a folder", "a.sog", sog),
    Layout("SOG", "antialiased", "b.sog", lambda path: sog(path, antialias=True), told="antialiased"),
    Layout("SOG", "version 1", "c.sog", lambda path: sog(path, version=1), told="not SOG version 2"),
    Layout(
        CLOUD,
        "colours of bytes or floats, normals (COLMAP, Open3D)",
        "a.ply",
        ply(points(nx="f4", ny="f4", nz="f4", red="u1", green="u1", blue="u1")),
        red,
    ),
    Layout(
        CLOUD,
        "diffuse_red, ... (MeshLab)",
        "b.ply",
        ply(points(diffuse_red="u1", diffuse_green="u1", diffuse_blue="u1"), ">"),
        red,
    ),
    Layout(
        CLOUD,
        "scalar fields (CloudCompare), classes (Metashape)",
        "c.ply",
        ply(points(red="u1", green="u1", blue="u1", scalar_Intensity="f4", **{"class": "u1"})),
        red,
        "scalar_Intensity",
    ),
    Layout(".xyz", "x y z, with normals, colours or both", "a.xyz", text("", 255, 0, 0), red),
    Layout(".xyz", "a header line (CloudCompare, PTS)", "b.xyz", text("X Y Z R G B\n", 255, 0, 0), red, "header"),
    Layout(".xyz", "an intensity before the colours", "c.xyz", text("", 7, 255, 0, 0), red, "before the colours"),
    Layout(".npz of points", "colours in floats of 0..255", "a.npz", numbers, red, "0..255"),
    *(
        Layout("others", suffix, f"a{suffix}", lambda path: path.write_bytes(b"x"), told=OTHERS[suffix][0])
        for suffix in OTHERS
    ),
)
STAGES = (
    Layout("splats", "float and half attributes, any unit and axis", "a.usda", splats_usd()),
    Layout("splats", "degree 4, cut to 3", "b.usda", splats_usd(4), told="degree 4"),
    Layout(
        "splats",
        "splats that are not finite, dropped",
        "c.usda",
        splats_usd(first="(nan,0,0)"),
        lambda s: s.count == 23,
        "1 of 24",
    ),
    Layout("splats", "linear radiance", "d.usda", splats_usd(space="lin_rec709_scene"), told="radiance is linear"),
    Layout(
        "meshes",
        "displayColor of every interpolation, indexed or not",
        "a.usda",
        stage(f'def Mesh "Q" {{\n    {RED_QUAD}}}\n'),
        faces(2),
    ),
    Layout(
        "meshes",
        "UsdPreviewSurface: colour, texture, subsets",
        "b.usda",
        preview('uniform token info:id = "UsdPreviewSurface"\n color3f inputs:diffuseColor = (0, 1, 0)'),
        faces(2, (0.0, 1.0, 0.0)),
    ),
    Layout(
        "meshes",
        "materials of other kinds (MDL, MaterialX)",
        "c.usda",
        preview('uniform token info:id = "ND_standard_surface_surfaceshader"'),
        faces(2),
        "no UsdPreviewSurface",
    ),
    Layout(
        "meshes",
        "opacity",
        "d.usda",
        stage(f'def Mesh "Q" {{\n    {RED_QUAD}    float[] primvars:displayOpacity = [0.5]\n}}\n'),
        faces(2),
        "opaque",
    ),
    Layout(
        "meshes",
        "textures that are missing or tiled",
        "e.usda",
        preview(
            'uniform token info:id = "UsdPreviewSurface"\n color3f inputs:diffuseColor.connect = </M/S/T.outputs:rgb>\n'
            ' def Shader "T" { uniform token info:id = "UsdUVTexture"\n asset inputs:file = @./t.<UDIM>.png@\n'
            " float3 outputs:rgb\n }"
        ),
        faces(2),
        "many tiles",
    ),
    Layout(
        "meshes",
        "spheres, curves and other geometry beside them",
        "f.usda",
        stage(f'def Mesh "Q" {{\n    {RED_QUAD}}}\ndef BasisCurves "C" {{ }}\n'),
        faces(2),
        "a BasisCurves",
    ),
    Layout(
        "meshes",
        "indices that point nowhere",
        "g.usda",
        stage(f'def Mesh "Q" {{\n    {QUAD.replace("3]", "9]")}}}\n'),
        told="indices 0..9",
    ),
    Layout("bodies", "the three families of schemas", "a.usda", stage(BRICK.format("", "")), bricks(1)),
    Layout("bodies", "PointInstancers, nested too", "b.usda", copies(BRICK.format("", ""), "0, 0"), bricks(2)),
    Layout(
        "bodies",
        "kinematic ones, simulated",
        "c.usda",
        stage(BRICK.format("bool physics:kinematicEnabled = 1", "")),
        bricks(1),
        "kinematic",
    ),
    Layout(
        "bodies",
        "other geometry beneath them",
        "d.usda",
        stage(BRICK.format("", 'def Sphere "B" { }')),
        bricks(1),
        "a Sphere",
    ),
    Layout(
        "bodies", "protoIndices out of range", "e.usda", copies(BRICK.format("", ""), "0, 1"), told="protoIndices 0..1"
    ),
)


def outcome(layout: Layout, folder: Path) -> str:
    """Write a file, read it, check that it is right, and return the column that it belongs to."""
    path = folder / layout.name
    layout.write(path)
    if layout.format == "bodies":
        reader: Callable[[Path], Any] = read_usd_scene
    elif layout.format == "meshes":
        reader = read_usd_mesh
    else:
        points_of = layout.format != "others" and layout.format != "splats" and file_kind(path) == "points"
        reader = read_points if points_of else read_splats
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            found = reader(path)
    except AssetError as error:
        assert layout.told and layout.told in error.message and error.hint, (layout.what, str(error))
        return REFUSED
    assert layout.right(found), (layout.what, found)
    notes = [*found.notes, *(note for body in getattr(found, "deformables", ()) for note in body.notes)]
    assert any(layout.told in note for note in notes) if layout.told else not notes, (layout.what, notes)
    return NOTED if notes else READ


def rendered(layouts: tuple[Layout, ...], folder: Path) -> str:
    """Read all files and return the table, a row for each format."""
    cells: dict[str, dict[str, list[str]]] = {}
    for number, layout in enumerate(layouts):
        place = folder / str(number)
        place.mkdir()
        row = cells.setdefault(layout.format, {READ: [], NOTED: [], REFUSED: []})
        row[outcome(layout, place)].append(layout.what)
    lines = [f"| | {READ} | {NOTED} | {REFUSED} |", "|---|---|---|---|"]
    lines += [f"| {name} | " + " | ".join("; ".join(row[kind]) for kind in row) + " |" for name, row in cells.items()]
    return "\n".join([BEGIN, *lines, END])


PAGES = {"splat_files.md": LAYOUTS, "usd.md": STAGES}


def main() -> None:
    """Write the tables into the pages."""
    for page, layouts in PAGES.items():
        with tempfile.TemporaryDirectory() as folder:
            table = rendered(layouts, Path(folder))
        before, _, rest = (DOCS / page).read_text().partition(BEGIN)
        (DOCS / page).write_text(before + table + rest.partition(END)[2])


if __name__ == "__main__":
    main()
