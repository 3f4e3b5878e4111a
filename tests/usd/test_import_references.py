"""What a stage refers to stays inside the asset root; chains and cycles of references, text that is nested too deep."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pxr", reason="needs the extra [usd]")

from softmode.errors import AssetError
from softmode.foreign.child.layers import MAX_LAYERS
from softmode.splats import read_splats
from softmode.usd import read_usd_scene
from tests.usd.stages import Author, Sdf, UsdUtils, UsdVol, shell


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Return the folder `root` beside a file outside it; `root/parts/toy.usda` holds a body."""
    for folder in (tmp_path / "root" / "parts", tmp_path / "secret"):
        folder.mkdir(parents=True)
        author = Author.create(folder / "toy.usda")
        author.body("/World/Toy")
        author.save()
    return tmp_path / "root"


def write(path: Path, text: str) -> Path:
    """Write a text layer whose prim /World holds what the text says."""
    path.write_text(f'#usda 1.0\n(\n upAxis = "Z"\n metersPerUnit = 1\n)\n{text}\n')
    return path


ARCS = {
    "reference": 'def Xform "World" (prepend references = @{}@)\n{{\n}}',
    "payload": 'def Xform "World" (prepend payload = @{}@)\n{{\n}}',
    "variant": (
        'def Xform "World" (\n prepend variantSets = "v"\n variants = {{ string v = "a" }}\n)\n{{\n'
        ' variantSet "v" = {{ "a" {{\n}} "b" (prepend references = @{}@) {{\n}} }}\n}}'
    ),
    "texture": 'def Shader "World"\n{{\n asset inputs:file = @{}@\n}}',
    "textures": 'def Shader "World"\n{{\n asset[] inputs:files = [@./a.png@, @{}@]\n}}',
    "sampled texture": 'def Shader "World"\n{{\n asset inputs:file.timeSamples = {{ 1: @{}@ }}\n}}',
}


TARGETS = {
    "../secret/toy.usda": "outside",
    "./parts/../../secret/toy.usda": "outside",
    "parts/link/toy.usda": "outside",
    "{secret}/toy.usda": "absolute",
    "file:///etc/toy.usda": "address",
    "https://example.com/toy.usda": "address",
    "`'${X}.usda'`": "expression",
    "./parts/toy.usda:SDF_FORMAT_ARGS:a=b": "arguments",
}


@pytest.mark.parametrize(
    ("arc", "target"),
    [*((arc, "../secret/toy.usda") for arc in ARCS), *(("reference", target) for target in list(TARGETS)[1:])],
)
def test_paths_out_of_the_root_are_refused(tree: Path, arc: str, target: str) -> None:
    """References, payloads, unused variants and textures: the path that leads out is named, the file is not opened."""
    (tree / "parts" / "link").symlink_to(tree.parent / "secret")
    path = write(tree / "a.usda", ARCS[arc].format(target.replace("{secret}", str(tree.parent / "secret"))))
    with pytest.raises(AssetError, match=TARGETS[target]) as caught:
        read_usd_scene(path)
    assert "toy.usda" in str(caught.value) or "${X}" in str(caught.value)
    assert caught.value.hint


def test_sublayers_and_clips(tree: Path) -> None:
    """Sublayers obey the rule too; value clips are refused."""
    path = tree / "a.usda"
    path.write_text("#usda 1.0\n(\n subLayers = [ @../secret/toy.usda@ ]\n)\n")
    with pytest.raises(AssetError, match="outside"):
        read_usd_scene(path)
    write(path, 'def "World" (clips = { dictionary default = { asset[] assetPaths = [@/etc/a.usd@] } })\n{\n}')
    with pytest.raises(AssetError, match="value clips"):
        read_usd_scene(path)
    inner = '"a" (clips = { dictionary default = { asset[] assetPaths = [@/etc/a.usd@] } }) {\n}'
    write(path, ARCS["variant"].format("parts/toy.usda").replace('"a" {\n}', inner))
    with pytest.raises(AssetError, match="value clips"):
        read_usd_scene(path)


def test_a_wider_root_is_the_remedy(tree: Path) -> None:
    """The same stage loads with a root that holds all of it; a root that does not hold the file is refused."""
    path = write(tree / "a.usda", ARCS["reference"].format("../secret/toy.usda"))
    assert [body.path for body in read_usd_scene(path, asset_root=tree.parent).deformables] == ["/World/Toy"]
    with pytest.raises(AssetError, match="outside asset_root"):
        read_usd_scene(path, asset_root=tree / "parts")


def test_inside_the_root_all_arcs_load(tree: Path) -> None:
    """A chain of a sublayer, a reference and a payload inside the root, and a texture that is not there."""
    write(tree / "parts" / "mid.usda", ARCS["payload"].format("./toy.usda"))
    path = tree / "parts" / "mid.usda"
    path.write_text(path.read_text().replace("(\n upAxis", '(\n defaultPrim = "World"\n upAxis'))
    write(tree / "low.usda", ARCS["reference"].format("parts/mid.usda"))
    top = tree / "a.usda"
    top.write_text(
        '#usda 1.0\n(\n upAxis = "Z"\n metersPerUnit = 1\n subLayers = [ @./low.usda@ ]\n)\n'
        + ARCS["texture"].format("OmniPBR.mdl").replace("World", "Shader")
    )
    assert [body.path for body in read_usd_scene(top).deformables] == ["/World/Toy"]


def test_other_units_are_told(tree: Path) -> None:
    """A layer in other units is taken as it is, as OpenUSD does, and the notes say so."""
    path = write(tree / "a.usda", ARCS["reference"].format("parts/toy.usda"))
    assert read_usd_scene(path).notes == ()
    path.write_text(path.read_text().replace("metersPerUnit = 1", "metersPerUnit = 0.01"))
    with pytest.warns(UserWarning, match="scale the prim by 100"):
        (note,) = read_usd_scene(path).notes
    assert "comes from toy.usda, whose metersPerUnit is 1.0; the stage's is 0.01" in note


def test_brackets_in_names(tree: Path) -> None:
    """Brackets belong to the names of files and folders, and of packages in such folders."""
    folder = tree / "toys [new]"
    (tree / "parts").rename(folder)
    UsdUtils.CreateNewUsdzPackage(str(folder / "toy.usda"), str(folder / "toy.usdz"))
    for name in ("toy.usda", "toy.usdz", "toy.usdz[toy.usda]"):
        path = write(tree / "[a].usda", ARCS["reference"].format(f"toys [new]/{name}"))
        assert [body.path for body in read_usd_scene(path).deformables] == ["/World/Toy"], name
    assert len(read_usd_scene(folder / "toy.usdz").deformables) == 1
    path = write(tree / "[a].usda", ARCS["reference"].format("[b]/../../secret/toy.usda"))
    with pytest.raises(AssetError, match="outside"):
        read_usd_scene(path)


def test_packages(tree: Path) -> None:
    """A .usdz package holds all of its stage."""
    package = tree / "toy.usdz"
    assert UsdUtils.CreateNewUsdzPackage(str(tree / "parts" / "toy.usda"), str(package))
    assert [body.path for body in read_usd_scene(package).deformables] == ["/World/Toy"]
    path = write(tree / "a.usda", ARCS["reference"].format("./toy.usdz"))
    assert [body.path for body in read_usd_scene(path).deformables] == ["/World/Toy"]


def test_readers_of_splats_obey_too(tree: Path) -> None:
    """`read_splats` opens files by the same rule."""
    author = Author.create(tree.parent / "secret" / "splats.usda")
    author.splats(UsdVol.ParticleField3DGaussianSplat.Define(author.stage, "/World/Splats"), shell(50))
    author.save()
    path = write(tree / "a.usda", ARCS["reference"].format("../secret/splats.usda"))
    with pytest.raises(AssetError, match="outside"):
        read_splats(path)


def test_missing_cyclic_and_endless_references(tree: Path) -> None:
    """A missing file, a cycle, and more files than anyone makes are refused."""
    with pytest.raises(AssetError, match="does not exist"):
        read_usd_scene(write(tree / "a.usda", ARCS["reference"].format("./gone.usda")))
    for one, other in (("b", "c"), ("c", "b")):
        file = write(tree / f"{one}.usda", ARCS["reference"].format(f"./{other}.usda"))
        file.write_text(file.read_text().replace("(\n upAxis", '(\n defaultPrim = "World"\n upAxis'))
    with pytest.raises(AssetError, match="compose"):
        read_usd_scene(tree / "b.usda")
    with pytest.raises(AssetError, match="no such file"):
        read_usd_scene(tree / "gone.usda")


def test_deep_references(tree: Path) -> None:
    """A chain of more files than softmode takes is refused; the process that reads it may not come so far."""
    for i in range(MAX_LAYERS + 2):
        (tree / f"{i}.usda").write_text(
            f'#usda 1.0\n(\n defaultPrim = "W"\n)\ndef "W" (references = @./{i + 1}.usda@)\n{{\n}}\n'
        )
    with pytest.raises(AssetError):
        read_usd_scene(tree / "0.usda")


@pytest.mark.parametrize("opening", ['def "a" {\n', "(\n", "[", 'def "a" ( customData = {'])
def test_nesting(tmp_path: Path, opening: str) -> None:
    """20,000 levels of anything, which make OpenUSD's parser overflow the stack, are refused before it sees them."""
    path = tmp_path / "a.usda"
    path.write_text("#usda 1.0\n" + opening * 20_000)
    with pytest.raises(AssetError, match="nested deeper"):
        read_usd_scene(path)
    with pytest.raises(AssetError, match="nested deeper"):
        read_splats(path)


def test_nesting_in_strings_does_not_count(tmp_path: Path) -> None:
    """Brackets in strings, comments and asset paths are no nesting."""
    author = Author.create(tmp_path / "a.usda")
    author.body("/World/Toy")
    prim = author.stage.GetPrimAtPath("/World")
    prim.SetDocumentation("{" * 5000 + '" ' + "'" * 3)
    prim.CreateAttribute("note", Sdf.ValueTypeNames.String).Set("((((" * 500)
    author.save()
    text = (tmp_path / "a.usda").read_text()
    (tmp_path / "a.usda").write_text(text + "\n# " + "{" * 5000 + "\n")
    assert len(read_usd_scene(tmp_path / "a.usda").deformables) == 1


@pytest.mark.parametrize("depth", [200, 2000])
def test_deep_crates(tmp_path: Path, depth: int) -> None:
    """The depth of prims of a binary layer counts as well."""
    layer: Any = Sdf.Layer.CreateNew(str(tmp_path / "a.usdc"))
    path = "".join(f"/p{i}" for i in range(depth))
    Sdf.CreatePrimInLayer(layer, path).specifier = Sdf.SpecifierDef
    spec = layer.GetPrimAtPath("/p0")
    while spec:
        spec.specifier = Sdf.SpecifierDef
        spec = next(iter(spec.nameChildren), None)
    layer.Save()
    if depth < 256:
        assert read_usd_scene(tmp_path / "a.usdc").deformables == ()
    else:
        with pytest.raises(AssetError):
            read_usd_scene(tmp_path / "a.usdc")


def test_environment_does_not_leak(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Search paths of the resolver and the working folder do not widen what a stage may read."""
    monkeypatch.setenv("PXR_AR_DEFAULT_SEARCH_PATH", str(tree.parent / "secret"))
    monkeypatch.chdir(tree.parent / "secret")
    with pytest.raises(AssetError, match="does not exist"):
        read_usd_scene(write(tree / "a.usda", ARCS["reference"].format("toy.usda")))
    assert os.environ["PXR_AR_DEFAULT_SEARCH_PATH"]
