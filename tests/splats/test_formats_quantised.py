"""`.compressed.ply`, `.splat` and SPZ against files built by the published layouts; round trips of all formats."""

from __future__ import annotations

import gzip
import math
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from softmode.errors import AssetError, ConfigError
from softmode.splats import Splats, read_splats, write_splats
from softmode.splats.formats import write_spz
from softmode.splats.splats import SH_DC, rotations_from_quats
from tests.splats.test_splats import random_splats

EPSILON = float(np.finfo(np.float32).eps)


def same_rotations(one: np.ndarray, other: np.ndarray, step: float) -> None:
    """Assert that quaternions xyzw are equal up to sign and a step in each component."""
    sign = np.where((one * other).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    np.testing.assert_allclose(one * sign, other, atol=step)


# -- compressed .ply --------------------------------------------------------------------------------------------------


def compressed_ply(count: int, coefficients: int, colors: bool, seed: int = 0) -> tuple[bytes, dict[str, np.ndarray]]:
    """Return a compressed `.ply` of random bits and its content, decoded one splat at a time as the manual says."""
    rng = np.random.default_rng(seed)
    chunks = -(-count // 256)
    names = [f"{s}_{a}" for s in ("min", "max") for a in "xyz"]
    names += [f"{s}_scale_{a}" for s in ("min", "max") for a in "xyz"]
    names += [f"{s}_{c}" for s in ("min", "max") for c in "rgb"] if colors else []
    low = {name: rng.uniform(-3.0, -1.0, size=chunks).astype(np.float32) for name in names}
    bounds = {name: value + np.float32(name.startswith("max") * 2.5) for name, value in low.items()}
    words = rng.integers(0, 2**32, size=(count, 4), dtype=np.uint32)
    # Three fields of at most 0.57 of their range leave the fourth component the largest.
    for i in range(count):
        a, b, c = rng.integers(220, 800, size=3)
        words[i, 1] = int(rng.integers(4)) << 30 | int(a) << 20 | int(b) << 10 | int(c)
    octets = rng.integers(0, 256, size=(count, coefficients), dtype=np.uint8)
    header = ["ply", "format binary_little_endian 1.0", "comment by hand", f"element chunk {chunks}"]
    header += [f"property float {name}" for name in names]
    header += [f"element vertex {count}"]
    header += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    if coefficients:
        header += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(coefficients))]
    data = "\n".join([*header, "end_header\n"]).encode()
    data += np.stack([bounds[name] for name in names], axis=1).astype("<f4").tobytes()
    data += words.astype("<u4").tobytes() + octets.tobytes()
    truth: dict[str, list[Any]] = {"means": [], "quats": [], "scales": [], "opacities": [], "sh": []}
    for i in range(count):
        position, rotation, scale, color = (int(word) for word in words[i])

        def lerp(name: str, value: int, top: int, i: int = i) -> float:
            t = value / top
            return float(bounds[f"min_{name}"][i // 256]) * (1 - t) + float(bounds[f"max_{name}"][i // 256]) * t

        truth["means"].append(
            [lerp("x", position >> 21, 2047), lerp("y", position >> 11 & 1023, 1023), lerp("z", position & 2047, 2047)]
        )
        truth["scales"].append(
            [
                math.exp(lerp("scale_x", scale >> 21, 2047)),
                math.exp(lerp("scale_y", scale >> 11 & 1023, 1023)),
                math.exp(lerp("scale_z", scale & 2047, 2047)),
            ]
        )
        three = [(field / 1023 - 0.5) * math.sqrt(2) for field in (rotation >> 20 & 1023, rotation >> 10 & 1023)]
        three.append(((rotation & 1023) / 1023 - 0.5) * math.sqrt(2))
        w, x, y, z = (*three[: rotation >> 30], math.sqrt(1 - sum(v * v for v in three)), *three[rotation >> 30 :])
        truth["quats"].append([x, y, z, w])
        rgba = [color >> 24, color >> 16 & 255, color >> 8 & 255, color & 255]
        rgb = [lerp(c, v, 255) if colors else v / 255 for c, v in zip("rgb", rgba[:3], strict=True)]
        truth["opacities"].append(rgba[3] / 255)
        per_channel = coefficients // 3
        bands = [[(value - 0.5) / SH_DC for value in rgb]]
        for k in range(per_channel):
            codes = [int(octets[i, channel * per_channel + k]) for channel in range(3)]
            unit = [0.0 if v == 0 else 1.0 if v == 255 else (v + 0.5) / 256 for v in codes]
            bands.append([(v - 0.5) * 8 for v in unit])
        truth["sh"].append(bands)
    return data, {name: np.array(value) for name, value in truth.items()}


@pytest.mark.parametrize("colors", [True, False])
@pytest.mark.parametrize("coefficients", [0, 9, 24, 45])
def test_compressed_ply_decodes_every_attribute(tmp_path: Path, coefficients: int, colors: bool) -> None:
    """Two chunks, the second partly filled; 12 or 18 bounds a chunk; every degree."""
    data, truth = compressed_ply(300, coefficients, colors)
    (tmp_path / "a.compressed.ply").write_bytes(data)
    splats = read_splats(tmp_path / "a.compressed.ply")
    for name, expected in truth.items():
        np.testing.assert_allclose(getattr(splats, name), expected, rtol=1e-5, atol=1e-6, err_msg=name)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"element chunk 2", b"element chunk 1", "the file holds"),
        (b"element vertex 300", b"element vertex 200", "the file holds"),
        (b"element sh 300", b"element sh 299", "the file holds"),
        (b"element vertex 300", b"element vortex 300", "elements"),
        (b"packed_scale", b"packed_scald", "unexpected properties"),
        (b"property float min_x", b"property uint min_x", "unexpected properties"),
        (b"property uchar f_rest_8", b"property uchar f_rest_9", "unexpected properties"),
        (b"property uchar f_rest_8\n", b"", "the file holds"),
        (b"element vertex 300", b"element vertex 0", "0 splats"),
        (b"min_scale_y", b"min_scale_x", "declared twice"),
    ],
)
def test_compressed_ply_header_damage(tmp_path: Path, old: bytes, new: bytes, message: str) -> None:
    """Tables that do not belong together are refused by name."""
    data, _ = compressed_ply(300, 9, True)
    assert old in data
    (tmp_path / "a.ply").write_bytes(data.replace(old, new, 1))
    with pytest.raises(AssetError, match=message) as caught:
        read_splats(tmp_path / "a.ply")
    assert caught.value.hint


def test_compressed_ply_counts_chunks(tmp_path: Path) -> None:
    """A chunk more or less than one for 256 splats is refused even where the file has the declared size."""
    data, _ = compressed_ply(256, 0, True)
    start = data.index(b"end_header\n") + len(b"end_header\n")
    extra = data[:start].replace(b"element chunk 1", b"element chunk 2") + data[start : start + 72] + data[start:]
    (tmp_path / "a.ply").write_bytes(extra)
    with pytest.raises(AssetError, match="2 chunks for 256 splats"):
        read_splats(tmp_path / "a.ply")


# -- .splat -----------------------------------------------------------------------------------------------------------


def test_splat_decodes_every_attribute(tmp_path: Path) -> None:
    """Two records packed by hand: 3 + 3 floats, r g b a, and w x y z as bytes around 128."""
    first = struct.pack("<6f8B", 1.0, -2.0, 0.5, 0.1, 0.2, 0.3, 255, 0, 128, 51, 255, 128, 128, 128)
    second = struct.pack("<6f8B", 0.0, 0.0, 9.0, 1e-3, 2.0, 1.0, 10, 20, 30, 255, 128, 64, 128, 64)
    (tmp_path / "a.splat").write_bytes(first + second)
    splats = read_splats(tmp_path / "a.splat")
    np.testing.assert_array_equal(splats.means, np.float32([[1, -2, 0.5], [0, 0, 9]]))
    np.testing.assert_array_equal(splats.scales, np.float32([[0.1, 0.2, 0.3], [1e-3, 2.0, 1.0]]))
    np.testing.assert_allclose(splats.opacities, [0.2, 1.0], rtol=EPSILON)
    np.testing.assert_allclose(splats.colors(), [[1, 0, 128 / 255], [10 / 255, 20 / 255, 30 / 255]], atol=4 * EPSILON)
    half = math.sqrt(0.5)
    np.testing.assert_allclose(splats.quats, [[0, 0, 0, 1], [-half, 0, -half, 0]], atol=EPSILON)


@pytest.mark.parametrize("size", [0, 31, 33])
def test_splat_of_odd_size_is_refused(tmp_path: Path, size: int) -> None:
    """A `.splat` file is a whole number of 32-byte records, at least one."""
    (tmp_path / "a.splat").write_bytes(bytes(size))
    with pytest.raises(AssetError, match=r"32|0 splats"):
        read_splats(tmp_path / "a.splat")


# -- SPZ --------------------------------------------------------------------------------------------------------------


def spz_arrays(version: int, degree: int, count: int = 40, bits: int = 11) -> tuple[list[bytes], dict[str, np.ndarray]]:
    """Return the arrays of an SPZ file of random content and that content, decoded as the specification says."""
    rng = np.random.default_rng(version + 10 * degree)
    coefficients = (degree + 1) ** 2 - 1
    if version == 1:
        means = rng.normal(size=(count, 3)).astype(np.float16)
        positions = means.astype("<f2").tobytes()
    else:
        fixed = rng.integers(-(2**23), 2**23, size=(count, 3))
        means = fixed / 2.0**bits
        positions = b"".join(int(v).to_bytes(3, "little", signed=True) for v in fixed.ravel())
    alphas = rng.integers(0, 256, size=count, dtype=np.uint8)
    colors, scales = (rng.integers(0, 256, size=(count, 3), dtype=np.uint8) for _ in range(2))
    sh = rng.integers(0, 256, size=(count, coefficients, 3), dtype=np.uint8)
    quats, rotations = [], b""
    for _ in range(count):
        if version < 3:
            octets = [int(v) for v in rng.integers(60, 196, size=3)]
            xyz = [v / 127.5 - 1.0 for v in octets]
            quats.append([*xyz, math.sqrt(1.0 - sum(v * v for v in xyz))])
            rotations += bytes(octets)
        else:
            magnitudes, signs = [int(v) for v in rng.integers(0, 400, size=3)], rng.integers(0, 2, size=3)
            largest, word = int(rng.integers(4)), 0
            word = largest
            for magnitude, sign in zip(magnitudes, signs, strict=True):
                word = word << 10 | int(sign) << 9 | magnitude
            parts = [(-1) ** int(s) * m / 511 * math.sqrt(0.5) for m, s in zip(magnitudes, signs, strict=True)]
            parts.insert(largest, math.sqrt(1.0 - sum(v * v for v in parts)))
            quats.append(parts)
            rotations += struct.pack("<I", word)
    truth = {
        "means": means.astype(np.float64),
        "quats": np.array(quats),
        "scales": np.exp(scales / 16.0 - 10.0),
        "opacities": alphas / 255.0,
        "sh": np.concatenate([((colors / 255.0 - 0.5) / 0.15)[:, None], (sh / 128.0 - 1.0)], axis=1)[:, :16],
    }
    arrays = [positions, alphas.tobytes(), colors.tobytes(), scales.tobytes(), rotations, sh.tobytes()]
    return arrays, truth


def zstandard() -> Any:
    """Return the Zstandard module, or skip the test."""
    name = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
    return pytest.importorskip(name, reason="SPZ version 4 needs Python 3.14 or the extra [spz]")


def pack_spz(version: int, degree: int, count: int, bits: int, arrays: list[bytes], flags: int = 0) -> bytes:
    """Return an SPZ file of these arrays."""
    arrays = [array for array in arrays if array]
    if version < 4:
        header = struct.pack("<IIIBBBB", 0x5053474E, version, count, degree, bits, flags, 0)
        return gzip.compress(header + b"".join(arrays))
    frames = [zstandard().compress(array) for array in arrays]
    header = struct.pack("<IIIBBBBI12x", 0x5053474E, 4, count, degree, bits, flags, len(arrays), 32)
    table = b"".join(struct.pack("<QQ", len(frame), len(array)) for frame, array in zip(frames, arrays, strict=True))
    return header + table + b"".join(frames)


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("version", [1, 2, 3, 4])
def test_spz_decodes_every_attribute(tmp_path: Path, version: int, degree: int) -> None:
    """All versions and degrees; degree 4 is cut to 3."""
    arrays, truth = spz_arrays(version, degree)
    (tmp_path / "a.spz").write_bytes(pack_spz(version, degree, 40, 11, arrays))
    splats = read_splats(tmp_path / "a.spz")
    for name, expected in truth.items():
        np.testing.assert_allclose(getattr(splats, name), expected, rtol=2e-6, atol=1e-6, err_msg=name)


def spz_3(**changes: Any) -> bytes:
    """Return an SPZ version 3 file with a changed header or more bytes than it declares."""
    arrays, _ = spz_arrays(3, 1)
    fields = {"magic": 0x5053474E, "version": 3, "count": 40, "degree": 1, "bits": 11, "flags": 0, "reserved": 0}
    tail = changes.pop("tail", b"")
    header = struct.pack("<IIIBBBB", *(fields | changes).values())
    return gzip.compress(header + b"".join(arrays) + tail)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"magic": 1}, "no SPZ header"),
        ({"version": 0}, "SPZ version 0"),
        ({"version": 4}, "SPZ version 4"),
        ({"count": 0}, "0 splats"),
        ({"count": 41}, "the file holds"),
        ({"count": 39}, "the file holds more than"),
        ({"count": 2**32 - 1}, "4294967295 splats"),
        ({"count": 2**26}, "cannot hold the 67108864 splats"),
        ({"degree": 5}, "degree 5"),
        ({"degree": 2}, "the file holds"),
        ({"bits": 31}, "31 fractional bits"),
        ({"tail": b"x"}, "the file holds more than"),
        ({"tail": bytes(2**21), "flags": 2}, "the file holds more than"),
    ],
)
def test_spz_header_damage(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    """Every kind of damage to the header is refused by name."""
    (tmp_path / "a.spz").write_bytes(spz_3(**changes))
    with pytest.raises(AssetError, match=message) as caught:
        read_splats(tmp_path / "a.spz")
    assert caught.value.hint


def test_spz_skips_extensions(tmp_path: Path) -> None:
    """Records behind the arrays are skipped where the header announces them."""
    record = struct.pack("<II3f", 0xADBE0002, 12, 0.1, 0.2, 0.3)
    (tmp_path / "a.spz").write_bytes(spz_3(tail=record, flags=2))
    assert read_splats(tmp_path / "a.spz").count == 40


@pytest.mark.parametrize("cut", [1, 5, 12, 40, -1, -9])
def test_spz_truncated_or_followed(tmp_path: Path, cut: int) -> None:
    """A gzip stream cut anywhere, or followed by anything, is refused."""
    for data in (spz_3()[:cut], spz_3() + b"x"):
        (tmp_path / "a.spz").write_bytes(data)
        with pytest.raises(AssetError):
            read_splats(tmp_path / "a.spz")


def spz_4(change: dict[str, Any]) -> bytes:
    """Return an SPZ version 4 file with a changed header, table or stream."""
    zstd = zstandard()
    arrays = [array for array in spz_arrays(4, 0)[0] if array]
    frames = [zstd.compress(array) for array in arrays]
    if "frame" in change:
        frames[1] = change["frame"](zstd)
    table = [(len(frame), len(array)) for frame, array in zip(frames, arrays, strict=True)]
    table[0] = (table[0][0], change.get("size", 9 * 40))
    header = struct.pack("<IIIBBBBI12x", 0x5053474E, 4, 40, 0, 11, 0, change.get("streams", 5), change.get("table", 32))
    return header + b"".join(struct.pack("<QQ", *entry) for entry in table) + b"".join(frames)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"streams": 6}, "6 streams"),
        ({"table": 31}, "streams listed at byte 31"),
        ({"table": 2**31}, "streams listed at byte"),
        ({"size": 10**15}, "contradict"),
        ({"frame": lambda zstd: zstd.compress(bytes(39))}, "does not hold 40 bytes"),
        ({"frame": lambda zstd: zstd.compress(bytes(41))}, "does not hold 40 bytes"),
        ({"frame": lambda zstd: zstd.compress(bytes(2**28))}, "too much memory"),
        ({"frame": lambda zstd: b"not zstd"}, "is damaged"),
        # A frame header that asks for a window of 2 GB (exponent 21 above 2^10) before one raw block of 40 bytes.
        (
            {"frame": lambda zstd: b"\x28\xb5\x2f\xfd\x00\xa8" + (40 << 3 | 1).to_bytes(3, "little") + bytes(40)},
            "too much",
        ),
    ],
)
def test_spz_4_damage(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    """Streams that unpack to another size, more than they may, or into a window beyond reason are refused."""
    (tmp_path / "a.spz").write_bytes(spz_4(change))
    with pytest.raises(AssetError, match=message):
        read_splats(tmp_path / "a.spz")


def test_spz_writer_refuses(tmp_path: Path) -> None:
    """Coordinates beyond 24 bits and unknown versions have no SPZ file."""
    with pytest.raises(AssetError, match="exceeds"):
        write_splats(tmp_path / "a.spz", random_splats().transformed(translation=[1e7, 0, 0]))
    with pytest.raises(ConfigError, match="version"):
        write_spz(tmp_path / "a.spz", random_splats(), version=2)  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


# -- round trips ------------------------------------------------------------------------------------------------------


@st.composite
def any_splats(draw: st.DrawFn) -> Splats:
    """Return splats of any degree whose values lie within what the quantised formats can hold."""
    count, coefficients = draw(st.integers(1, 300)), draw(st.sampled_from([1, 4, 9, 16]))
    size = 10.0 ** draw(st.integers(-3, 3))

    def array(*shape: int, low: float, high: float) -> np.ndarray:
        elements = st.floats(low, high, width=32)
        return draw(hnp.arrays(np.float32, (count, *shape), elements=elements, fill=elements))

    quats = array(4, low=-1.0, high=1.0)
    quats[np.linalg.norm(quats, axis=1) < 0.1] = [0.0, 0.0, 0.0, 1.0]
    return Splats(
        means=size * array(3, low=-1.0, high=1.0).astype(np.float64),
        quats=quats,
        scales=np.exp(array(3, low=-9.875, high=5.75).astype(np.float64)),
        opacities=array(low=0.0, high=1.0),
        sh=array(coefficients, 3, low=-0.984375, high=0.984375),
    )


@given(splats=any_splats())
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@pytest.mark.parametrize("suffix", [".ply", ".spz", ".4.spz", ".splat", ".compressed.ply"])
def test_round_trip_within_the_steps_of_the_format(tmp_path: Path, suffix: str, splats: Splats) -> None:
    """Reading what was written returns the splats to half a step of the format, or to float32."""
    path = tmp_path / f"a{suffix}"
    if suffix == ".4.spz":
        zstandard()
        write_spz(path, splats, version=4)
    else:
        write_splats(path, splats)
    again = read_splats(path)
    color, logs = splats.sh[:, 0].astype(np.float64), np.log(splats.scales.astype(np.float64))
    reach = np.abs(splats.means).max()
    half_of_255 = 0.5 / 255.0 + 2 * EPSILON
    if suffix == ".ply":
        steps = {
            "means": 2 * EPSILON * np.abs(again.means).max(),
            "quats": 2 * EPSILON,
            "log_scales": 8 * EPSILON,
            "color": 0.0,
            "rest": 0.0,
            "alpha": 2e-6,
        }
    elif suffix.endswith(".spz"):
        steps = {
            "means": max(reach * 2.0**-22, 2.0**-20) / 2.0,
            # Half a step in each of three components; the largest one, computed from them, errs by up to sqrt(3) times.
            "quats": 2.0 * math.sqrt(3.0) * math.sqrt(0.5) / 511.0 / 2.0,
            "log_scales": 1.0 / 32.0 + 16 * EPSILON,
            "color": half_of_255 / 0.15,
            "rest": 0.5 / 128.0 + EPSILON,
            "alpha": half_of_255,
        }
    elif suffix == ".splat":
        steps = {
            "means": 2 * EPSILON * reach,
            "quats": 2.0 / 128.0,
            "log_scales": EPSILON * 10,
            "color": None,
            "alpha": half_of_255,
        }
        np.testing.assert_allclose(again.colors(), splats.colors(), atol=half_of_255)
        assert again.sh_degree == 0
    else:
        span = np.ptp(splats.means.astype(np.float64), axis=0)
        steps = {
            "means": span * [0.5 / 2047, 0.5 / 1023, 0.5 / 2047] + 4 * EPSILON * reach,
            "quats": 2.0 * math.sqrt(3.0) * math.sqrt(2.0) / 1023.0 / 2.0,
            "log_scales": np.ptp(logs, axis=0) * [0.5 / 2047, 0.5 / 1023, 0.5 / 2047] + 32 * EPSILON,
            "color": half_of_255 * np.ptp(color, axis=0) + 32 * EPSILON,
            "rest": 8.0 / 256.0 / 2.0 + EPSILON,
            "alpha": half_of_255,
        }
    found = {
        "means": again.means.astype(np.float64) + again.offset - splats.means,
        "log_scales": np.log(again.scales.astype(np.float64)) - logs,
        "color": again.sh[:, 0] - color,
        "alpha": again.opacities.astype(np.float64) - splats.opacities,
    }
    if steps.get("rest") is not None:
        found["rest"] = again.sh[:, 1:].astype(np.float64) - splats.sh[:, 1:]
    for name, difference in found.items():
        if steps[name] is not None:
            assert (np.abs(difference) <= steps[name]).all(), (name, np.abs(difference).max(), steps[name])
    same_rotations(again.quats, splats.quats, float(steps["quats"]) + 2 * EPSILON)


@pytest.mark.parametrize("up", ["-y", "+y", "+x"])
def test_up_axis_of_a_written_file(tmp_path: Path, up: Any) -> None:
    """What is written with an up axis and set upright again is what it was, colour included."""
    splats = random_splats(coefficients=16)
    write_splats(tmp_path / "a.ply", splats, up=up)
    again = read_splats(tmp_path / "a.ply").oriented(up)
    np.testing.assert_allclose(again.means, splats.means, atol=16 * EPSILON)
    np.testing.assert_allclose(again.sh, splats.sh, atol=32 * EPSILON)
    np.testing.assert_allclose(rotations_from_quats(again.quats), rotations_from_quats(splats.quats), atol=32 * EPSILON)


def test_unwritable_suffix_and_axis(tmp_path: Path) -> None:
    """A suffix without a writer and an axis that is none are refused before anything is written."""
    for name in ("a.sog", "a.obj", "a", "a.usdz"):
        with pytest.raises(AssetError, match="cannot write") as caught:
            write_splats(tmp_path / name, random_splats())
        assert ".ply" in caught.value.hint
    with pytest.raises(ConfigError, match="up must be"):
        write_splats(tmp_path / "a.ply", random_splats(), up="y")  # type: ignore[arg-type]
    for suffix in ("usd", "usda", "usdc"):
        with pytest.raises(ConfigError, match="stage says itself") as refused:
            write_splats(tmp_path / f"a.{suffix}", random_splats(), up="+y")
        assert "+z" in refused.value.hint
    assert not list(tmp_path.iterdir())
