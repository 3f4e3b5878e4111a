"""Damaged stages: whatever is in a file, the process that called survives, with a valid load or a typed error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr", reason="needs the extra [usd]")

import newton

from softmode.deformables.reduction.options import BuildOptions
from softmode.errors import AssetError
from softmode.foreign import process
from softmode.objects.stage.scene import open_scene
from softmode.usd import add_usd, read_usd_scene
from tests.usd.stages import KINDS, Author, Sdf

SMALL = BuildOptions(mode_count=2, kernel_count=60, cubature_count=48)
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
    paths = []
    for k, start in enumerate(range(88, len(data) - 8, max(8, len(data) // 48))):
        path = tmp_path / f"{k}.usdc"
        path.write_bytes(data[:start] + (2**40).to_bytes(8, "little") + data[start + 8 :])
        paths.append(path)
    refused = 0
    for path in paths:
        try:
            for body in open_scene(path, None, str(tmp_path), copy=True).deformables:
                assert np.isfinite(body.points).all()
        except AssetError:
            refused += 1
    assert refused, "some of them matter"


@pytest.mark.parametrize("kind", KINDS)
def test_points_that_are_no_numbers(tmp_path: Path, kind: str) -> None:
    """NaN among the positions is refused, with the prim that has it; a splat is dropped, and the notes say so."""
    author = Author.create(tmp_path / "a.usda")
    author.body("/World/Toy", kind)
    author.stage.GetPrimAtPath("/World/Toy/Geometry")
    prim = author.stage.GetPrimAtPath("/World/Toy/Geometry")
    attribute = prim.GetAttribute("positions" if kind == "ParticleField3DGaussianSplat" else "points")
    values = np.array(attribute.Get())
    values[1] = np.nan
    attribute.Set(values)
    author.save()
    if kind == "ParticleField3DGaussianSplat":
        (body,) = read_usd_scene(tmp_path / "a.usda").deformables
        assert body.splats is not None and body.splats.count == len(values) - 1
        assert body.notes[0].startswith(f"/World/Toy/Geometry: 1 of {len(values)} splats dropped")
        return
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
