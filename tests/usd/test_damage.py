"""Damaged stages: whatever is in a file, the process that called survives, with a valid load or a typed error."""

from __future__ import annotations

import collections
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pxr", reason="needs the extra [usd]")

import newton

from softmode.deformables.build.options import BuildOptions
from softmode.errors import AssetError, MaterialError, SoftmodeError
from softmode.foreign import process
from softmode.objects.stage_scene import UsdScene, scene_from_answer, scene_request
from softmode.usd import add_usd, read_usd_scene
from softmode.usd.importer import _add_rest
from tests.usd.stages import KINDS, Author, Sdf, UsdUtils, UsdVol, shell, transform

SMALL = BuildOptions(mode_count=2, kernel_count=60, cubature_count=48)
NUMBERS = (b"nan", b"inf", b"-inf", b"-1", b"0", b"1e308", b"-1e308", b"2147483647", b"99999999999999999999", b"0.5")


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """Return damaged data: numbers of a text made impossible, or bytes changed, cut out, doubled or lost."""
    found = bytearray(data)
    text = data.startswith(b"#usda")
    if text and rng.random() < 0.6:
        spans = [match.span() for match in re.finditer(rb"(?<=[ (\[])-?[0-9.]+(e-?\d+)?(?=[,)\]\n ])", data)][1:]
        for start, end in sorted(
            (spans[i] for i in rng.choice(len(spans), int(rng.integers(1, 4)), False)), reverse=True
        ):
            found[start:end] = NUMBERS[rng.integers(len(NUMBERS))]
        return bytes(found)
    at = sorted(int(i) for i in rng.integers(0, len(found), 2))
    kind = rng.integers(8)
    if kind == 0:
        del found[at[0] :]
    elif kind == 1:
        del found[at[0] : at[0] + int(rng.integers(1, 200))]
    elif kind == 2:
        found[at[1] : at[1]] = found[at[0] : at[0] + int(rng.integers(1, 200))]
    else:
        for i in rng.integers(0, len(found), int(rng.integers(1, 4))):
            found[i] = int(rng.integers(256))
    return bytes(found)


def valid_files(folder: Path) -> dict[str, bytes]:
    """Return valid files by suffix and content."""
    found = {}
    for kind in KINDS:
        author = Author.create(folder / f"{kind}.usda", "Y", 0.01)
        root = author.body("/World/Toy", kind, matrix=transform((0.0, 0.0, 0.3), turn=0.2))
        root.CreateAttribute("physics:mass", Sdf.ValueTypeNames.Float).Set(0.2)
        if kind == "Mesh":
            author.prop("/World/Prop", (0.5, 0.0, 0.05))
            author.robot("/World/Robot", (1.0, 0.0, 0.0))
            author.splats(UsdVol.ParticleField3DGaussianSplat.Define(author.stage, "/World/Toy/Splats"), shell(20))
        author.save()
        found[f"{kind}.usda"] = (folder / f"{kind}.usda").read_bytes()
        crate = folder / f"{kind}.usdc"
        Sdf.Layer.FindOrOpen(str(folder / f"{kind}.usda")).Export(str(crate))
        found[f"{kind}.usdc"] = crate.read_bytes()
    UsdUtils.CreateNewUsdzPackage(str(folder / "Mesh.usda"), str(folder / "Mesh.usdz"))
    found["Mesh.usdz"] = (folder / "Mesh.usdz").read_bytes()
    return found


def check_scene(scene: UsdScene) -> None:
    """Check that what was loaded is what a build may be given."""
    for body in scene.deformables:
        assert np.isfinite(body.translation).all() and np.linalg.det(body.rotation) == pytest.approx(1.0)
        for surface in (*body.meshes, *([body.surface] if body.surface else [])):
            assert np.isfinite(surface.vertices).all()
            assert surface.faces.size == 0 or 0 <= surface.faces.min() <= surface.faces.max() < len(surface.vertices)
        assert np.isfinite(body.points).all()
        try:
            body.material(1.0e-3)
        except MaterialError as error:
            assert body.path in error.message


def damage(folder: Path, trials: range) -> dict[str, list[int]]:
    """Read damaged files; return how many were refused, loaded, and imported."""
    valid = valid_files(folder)
    requests: list[dict[str, Any]] = []
    for trial in trials:
        name = list(valid)[trial % len(valid)]
        path = folder / f"{trial}-{name}"
        path.write_bytes(mutate(valid[name], np.random.default_rng(trial)))
        place = folder / f"{trial}"
        place.mkdir()
        requests.append(scene_request(path, None, str(place), copy=True))
    outcomes: dict[str, list[int]] = collections.defaultdict(lambda: [0, 0, 0])
    for request in requests:
        name = Path(request["file"]).name.partition("-")[2]
        try:
            check_scene(scene_from_answer(process.ask(request, name=name), name))
            outcomes[name][1] += 1
            _add_rest(newton.ModelBuilder(), request["copy"], name, {})
            outcomes[name][2] += 1
        except SoftmodeError as error:
            assert isinstance(error, AssetError | MaterialError) and error.message and error.hint
            outcomes[name][0] += 1
    return outcomes


def test_damaged_files(tmp_path: Path) -> None:
    """200 damaged text, binary and packaged stages: a typed error or a valid load, and Newton takes the rest of it."""
    outcomes = damage(tmp_path, range(200))
    refused, loaded, imported = np.sum(list(outcomes.values()), axis=0)
    assert refused > 50 and loaded > 20 and imported > 15


@pytest.mark.slow
def test_damaged_files_at_length(tmp_path: Path) -> None:
    """2,000 damaged stages."""
    outcomes = damage(tmp_path, range(200, 2200))
    for name, (refused, loaded, _) in outcomes.items():
        assert refused and (loaded or name.endswith(".usdz")), name  # packages have checksums


def test_the_real_process_survives_too(tmp_path: Path) -> None:
    """A handful of damaged files through the whole of `add_usd`, each in a process of its own."""
    valid = valid_files(tmp_path)
    refused = 0
    for trial in range(6):
        name = list(valid)[trial % len(valid)]
        (tmp_path / f"damaged-{name}").write_bytes(mutate(valid[name], np.random.default_rng(10_000 + trial)))
        builder = newton.ModelBuilder()
        try:
            add_usd(builder, tmp_path / f"damaged-{name}", build_options=SMALL, surface_count=60)
        except SoftmodeError:
            refused += 1
    assert refused >= 1


HUGE = {
    "points": ('def Mesh "M" {\n point3f[] points = [' + ", ".join(["(0, 0, 0)"] * 200_000) + "]\n}\n", True),
    "prims": ("\n".join(f'def "p{i}" {{\n}}' for i in range(20_000)), True),
    "references to itself": ('def "A" {\n def "B" (\n references = [</A>, </A>]\n) {\n}\n}\n', False),
    "doubling": (
        'def "p0" {\n}\n'
        + "".join(
            f'def "p{i + 1}" {{\n def "a" (\n references = </p{i}>\n) {{\n}}\n def "b" (\n references = </p{i}>\n)'
            " {\n}\n}\n"
            for i in range(40)
        ),
        False,
    ),
    "nested variants": ('def "A" (\n variantSets = "v"\n) {\n variantSet "v" = {\n "a" {\n' * 90, False),
}
"""Text of a stage, and whether it is sound: 40 lines of doubling stand for 10^12 prims."""


@pytest.mark.parametrize("name", HUGE)
def test_huge_declarations(tmp_path: Path, name: str) -> None:
    """What is large loads; what refers to itself or multiplies beyond measure ends in a typed error."""
    path = tmp_path / "a.usda"
    text, sound = HUGE[name]
    path.write_text("#usda 1.0\n" + text)
    if sound:
        assert read_usd_scene(path).deformables == ()
    else:
        with pytest.raises(AssetError) as caught:
            read_usd_scene(path)
        assert caught.value.hint


def test_crates_that_declare_huge_arrays(tmp_path: Path) -> None:
    """Every eight bytes of a crate in turn as a count of 2^40: OpenUSD would allocate it, the process may not."""
    author = Author.create(tmp_path / "a.usda")
    author.body("/World/Toy")
    author.save()
    Sdf.Layer.FindOrOpen(str(tmp_path / "a.usda")).Export(str(tmp_path / "a.usdc"))
    data = (tmp_path / "a.usdc").read_bytes()
    requests = []
    for k, start in enumerate(range(88, len(data) - 8, max(8, len(data) // 48))):
        path = tmp_path / f"{k}.usdc"
        path.write_bytes(data[:start] + (2**40).to_bytes(8, "little") + data[start + 8 :])
        (tmp_path / f"{k}").mkdir()
        requests.append(scene_request(path, None, str(tmp_path / f"{k}"), copy=True))
    refused = 0
    for request in requests:
        try:
            check_scene(scene_from_answer(process.ask(request, name="a"), "a"))
        except AssetError:
            refused += 1
    assert refused, "some of them matter"


@pytest.mark.parametrize("kind", KINDS)
def test_points_that_are_no_numbers(tmp_path: Path, kind: str) -> None:
    """NaN among the positions is refused, with the prim that has it."""
    author = Author.create(tmp_path / "a.usda")
    author.body("/World/Toy", kind)
    author.stage.GetPrimAtPath("/World/Toy/Geometry")
    prim = author.stage.GetPrimAtPath("/World/Toy/Geometry")
    attribute = prim.GetAttribute("positions" if kind == "ParticleField3DGaussianSplat" else "points")
    values = np.array(attribute.Get())
    values[1] = np.nan
    attribute.Set(values)
    author.save()
    with pytest.raises(AssetError, match="/World/Toy/Geometry"):
        read_usd_scene(tmp_path / "a.usda")


def test_indices_that_point_nowhere(tmp_path: Path) -> None:
    """In a deformable they are refused by the reader, in a prop before Newton sees them."""
    author = Author.create(tmp_path / "a.usda")
    author.body("/World/Toy")
    prim = author.stage.GetPrimAtPath("/World/Toy/Geometry")
    prim.GetAttribute("faceVertexIndices").Set([0, 1, 99] * 12)
    author.save()
    with pytest.raises(AssetError, match="indices"):
        read_usd_scene(tmp_path / "a.usda")
    author.stage.RemovePrim("/World/Toy")
    prop = author.geometry("/World/Prop", "Mesh")
    prop.AddAppliedSchema("PhysicsCollisionAPI")
    prop.GetAttribute("faceVertexIndices").Set([0, 1, 99] * 12)
    author.save()
    builder = newton.ModelBuilder()
    with pytest.raises(AssetError, match="vertices that are not there"):
        add_usd(builder, tmp_path / "a.usda")
    assert not builder.shape_count


@pytest.mark.parametrize(
    "limits",
    [process.Limits(memory=2**20, memory_per_byte=0.0), process.Limits(seconds=0.05, seconds_per_byte=0.0)],
    ids=["memory", "time"],
)
def test_limits_hold(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limits: process.Limits) -> None:
    """A sound file that needs more memory or processor time than it may have is refused; the caller goes on."""
    path = tmp_path / "a.usda"
    path.write_text("#usda 1.0\n" + HUGE["points"][0])
    read_usd_scene(path)
    monkeypatch.setattr(process, "Limits", lambda: limits)  # what the reader of scenes asks for
    with pytest.raises(AssetError) as caught:
        read_usd_scene(path)
    assert caught.value.hint
