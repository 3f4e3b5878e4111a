"""Damaged files of every format that softmode reads: what damages sound ones, and what came of each.

    python -m tests.fuzz --cases 100000 --seed 0 --budget-s 7200 --processes 2

A case is a finding if its reader crashes, raises what is no error of `softmode.errors` with a remedy, takes more than
two seconds, or more memory than `tests.attack.Outcome.within` allows. The same seed makes the same cases, however many
processes read them; formats whose package is missing are named and left out, which changes the cases.
"""

from __future__ import annotations

import argparse
import collections
import copy
import gzip
import io
import json
import re
import struct
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests import fuzz_seeds
from tests.attack import Outcome, attack
from tests.fuzz_seeds import READERS

Random = np.random.Generator
NUMBERS = (
    b"nan",
    b"inf",
    b"-inf",
    b"-1",
    b"0",
    b"0.5",
    b"1e308",
    b"-1e308",
    b"1e-320",
    b"2147483648",
    b"9" * 20,
    b"9" * 400,
)
WORDS = [struct.pack("<I", n) for n in (0, 1, 2**31 - 1, 2**31, 2**32 - 1)] + [
    struct.pack("<Q", 2**k) for k in (33, 40, 63)
]
WORDS += [np.array(x, kind).tobytes() for x in (np.nan, np.inf, -1e30, 1e38) for kind in ("<f4", "<f8")]
_BATCH = 500
"""Cases that one process reads after it has read the sound files."""
DEEP, LARGE = "@deep@", "@large@"
VALUES: tuple[Any, ...] = (
    None,
    True,
    "",
    "x" * 5000,
    "a\0b",
    "\ud800",
    "../../etc/passwd",
    "/dev/zero",
    "http://x/y",
    -1,
    0,
)
VALUES += (2**31, 2**63, 2**200, 1e308, -1e308, float("nan"), float("inf"), [], {}, [[]], [None], {"": []}, DEEP, LARGE)
"""What a value of a JSON file becomes; two of them are larger than json writes."""


def damaged_bytes(data: bytes, random: Random, other: bytes = b"") -> bytes:
    """Return data with bits or bytes changed, cut out, doubled, put in, or joined to the end of another file."""
    out, kind = bytearray(data), random.integers(9)
    if not out:
        return random.bytes(20)
    at, length = int(random.integers(len(out))), int(random.integers(1, 200))
    if kind == 0:
        for _ in range(int(random.integers(1, 8))):
            out[int(random.integers(len(out)))] ^= 1 << int(random.integers(8))
    elif kind == 1:
        del out[at:]
    elif kind == 2:
        del out[at : at + length]
    elif kind == 3:
        out[at:at] = out[at : at + length]
    elif kind == 4:
        out[at:] = other[int(random.integers(len(other) or 1)) :]
    elif kind == 5:
        out[at:at] = random.bytes(length % 40)
    elif kind == 6:  # headers are small beside the data: aim at them, with values that declare much
        start = int(random.integers(min(len(out), 400)))
        out[start : start + 4] = bytes(random.choice([0, 9, 48, 57, 127, 128, 255], size=4).tolist())
    elif kind == 7:  # tables of contents stand at the end of some formats
        out[-1 - int(random.integers(min(len(out), 600)))] = int(random.integers(256))
    else:  # counts and numbers are aligned
        word = WORDS[random.integers(len(WORDS))]
        start = at // 4 * 4 if random.random() < 0.5 else int(random.integers(min(len(out), 100))) * 4
        out[start : start + len(word)] = word
    return bytes(out)


def damaged_text(data: bytes, random: Random, other: bytes = b"") -> bytes:
    """Return a text with numbers made impossible, words or lines swapped, doubled or lost, or bytes damaged."""
    kind = random.integers(6)
    found = [match.span() for match in re.finditer(rb"-?\d[\d.]*(?:e-?\d+)?" if kind < 3 else rb"[\w/.:]+", data)]
    if kind == 5 or not found:
        return damaged_bytes(data, random, other)
    if kind == 4:
        lines = data.splitlines(keepends=True)
        at = int(random.integers(len(lines)))
        lines[at : at + 1] = [] if random.random() < 0.5 else lines[at : at + 1] * int(random.integers(2, 50))
        return b"".join(lines)
    out = bytearray(data)
    for k in sorted(random.choice(len(found), min(len(found), int(random.integers(1, 4))), False), reverse=True):
        start, end = found[k]
        word = slice(*found[random.integers(len(found))])
        out[start:end] = NUMBERS[random.integers(len(NUMBERS))] if kind < 3 else data[word]
    return bytes(out)


def damaged_json(data: bytes, random: Random, other: bytes = b"") -> bytes:
    """Return a JSON text with values that have another type or an impossible size, that are missing or doubled."""
    if random.random() < 0.15:
        return damaged_text(data, random, other)
    tree = json.loads(data)
    for _ in range(int(random.integers(1, 3))):
        places = list(_places(tree))
        if not places:
            break
        owner, key = places[random.integers(len(places))]
        if random.random() < 0.2:
            del owner[key]
        elif random.random() < 0.2:
            source, name = places[random.integers(len(places))]
            owner[key] = json.loads(json.dumps(source[name]))
        else:
            owner[key] = copy.deepcopy(VALUES[random.integers(len(VALUES))])
    text = json.dumps(tree)
    depth = int(random.choice([60, 400, 900, 100_000]))
    text = text.replace(f'"{DEEP}"', "[" * depth + "]" * depth).replace(
        f'"{LARGE}"', "1" + "0" * int(random.choice([400, 5000]))
    )
    return text.encode()


def _places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Yield owner and key of every value of a tree."""
    for key in list(tree) if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ():
        yield tree, key
        yield from _places(tree[key])


def damaged_array(data: bytes, random: Random, other: bytes = b"") -> bytes:
    """Return a .npy file whose values, shape, type or bytes are others."""
    array, kind = np.load(io.BytesIO(data)), random.integers(8)
    if kind == 0 or not array.size:
        return damaged_bytes(data, random, other)
    if kind == 1:  # a shape that the bytes do not have
        shape = str(array.shape).encode()
        return data.replace(shape, (b"(%d,)" % 2 ** int(random.integers(20, 60))).ljust(len(shape)), 1)
    if kind == 2 and array.dtype == np.uint8:
        try:  # a header, or another JSON document
            array = np.frombuffer(damaged_json(array.tobytes(), random), np.uint8)
        except ValueError:
            array = np.frombuffer(damaged_bytes(array.tobytes(), random), np.uint8)
    elif kind < 5:
        flat = array.ravel().copy()
        if flat.dtype.kind in "fiu":
            with np.errstate(all="ignore"):
                values = np.array([np.nan, np.inf, -1.0, 0.0, 1e308, -1e30, 2.0**31, 1e-320][int(random.integers(8))])
                flat[random.integers(len(flat), size=int(random.integers(1, 4)))] = values.astype(flat.dtype)
        array = flat.reshape(array.shape)
    elif kind == 5:
        array = (
            [array[:0], array[:-1], array.ravel(), array[None], array.T, np.concatenate([array, array])][
                int(random.integers(6))
            ]
            if array.ndim
            else array[None]
        )
    elif kind == 6:
        with np.errstate(all="ignore"):
            kinds = (
                ["<f2", "<f4", "<f8", "<i4", "<u1", "<c8", "<U3", "<i8", "?"] if array.dtype.kind != "U" else ["<U1"]
            )
            array = array.astype(kinds[random.integers(len(kinds))])
    else:
        array = np.zeros((0, 2**40) if random.random() < 0.5 else array.shape, array.dtype)
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=False)
    return stream.getvalue()


def damaged_zip(data: bytes, random: Random, other: bytes = b"") -> bytes:
    """Return an archive one member of which is damaged and has the right checksum, is missing, or has another name."""
    if random.random() < 0.25:
        return damaged_bytes(data, random, other)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {info.filename: (archive.read(info), info.compress_type) for info in archive.infolist()}
    names = list(members)
    name = names[random.integers(len(names))]
    if "header.npy" in members and random.random() < 0.3:
        name = "header.npy"
    content, packed = members[name]
    if random.random() < 0.1:
        del members[name]
        if random.random() < 0.5:
            members[names[random.integers(len(names))] + "x"] = content, packed
    else:
        of = {".npy": damaged_array, ".json": damaged_json}.get(Path(name).suffix, damaged_bytes)
        members[name] = of(content, random, members[names[random.integers(len(names))]][0]), packed
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, (content, packed) in members.items():
            archive.writestr(name, content, packed)
    return stream.getvalue()


def damaged_glb(data: bytes, random: Random, other: bytes = b"") -> bytes:
    """Return a binary glTF whose JSON is damaged and whose lengths are right, or whose bytes are damaged."""
    if random.random() < 0.4:
        return damaged_bytes(data, random, other)
    length = struct.unpack_from("<I", data, 12)[0]
    text = damaged_json(data[20 : 20 + length], random)
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def damaged_gzip(data: bytes, random: Random, other: bytes = b"") -> bytes:
    """Return a gzip file whose content is damaged and whose checksum is right."""
    return gzip.compress(damaged_bytes(gzip.decompress(data), random), mtime=0)


def damaged_nanovdb(data: bytes, random: Random, other: bytes = b"") -> bytes:
    """Return a NanoVDB file half of whose changes hit its headers; some are packed afterwards, so as to pass zlib."""
    from tests.radiance.test_nanovdb import GRID, TREE, packed_again, start_of_grid

    out, start = bytearray(data), start_of_grid(data)
    for _ in range(int(random.integers(1, 9))):
        at = int(random.integers(start + GRID + TREE + 128 if random.random() < 0.5 else len(out) - 8))
        value = random.bytes(int(random.integers(1, 9)))
        out[at : at + len(value)] = value
    if start_of_grid(bytes(out)) == start and random.random() < 0.3:
        out = bytearray(packed_again(bytes(out)))
    return bytes(out[: int(random.integers(len(out)))] if random.random() < 0.2 else out)


def damaged_header(data: bytes, random: Random, other: bytes = b"") -> bytes:
    """Return a .ply with a damaged header, or damaged bytes."""
    head, end, rest = data.partition(b"end_header\n")
    return damaged_text(head, random) + end + rest if random.random() < 0.4 else damaged_bytes(data, random, other)


MUTATORS: dict[str, Callable[..., bytes]] = {
    "bytes": damaged_bytes, "text": damaged_text, "json": damaged_json, "zip": damaged_zip, "glb": damaged_glb,
    "gzip": damaged_gzip, "ply": damaged_header, "nvdb": damaged_nanovdb,
}  # fmt: skip


def read(path: str) -> None:
    """Read a case, whose name says its format, or all sound files of a folder."""
    file = Path(path)
    for one in sorted(file.iterdir()) if file.is_dir() else [file]:
        READERS[one.name.split("@")[1]](one)


@dataclass
class Tally:
    """What the cases of a format came to."""

    loaded: int = 0
    refused: int = 0
    seconds: float = 0.0
    findings: int = 0


def run(
    cases: int,
    *,
    seed: int = 0,
    budget: float = 1e9,
    formats: list[str] | None = None,
    keep: Path | None = None,
    processes: int = 1,
) -> tuple[dict[str, Tally], list[str]]:
    """Read damaged files; return what each format came to, and a line for each finding.

    Args:
        cases: Number of cases over all formats.
        seed: What the cases are made from.
        budget: Seconds after which no more are begun.
        formats: Formats; all if None.
        keep: Folder for the files of findings.
        processes: Number of processes that read at a time.
    """
    tallies: dict[str, Tally] = collections.defaultdict(Tally)
    findings: list[str] = []
    end = time.monotonic() + budget
    with tempfile.TemporaryDirectory() as scratch:
        sound = Path(scratch) / "sound"
        sound.mkdir()
        found = fuzz_seeds.seeds(Path(scratch), formats)
        for name, (suffix, _, contents) in found.items():
            for k, content in enumerate(contents[:1] if name in fuzz_seeds.DEAR else contents):
                (sound / f"{k}@{name}@{suffix}").write_bytes(content)
        order = [name for name in found for _ in range(1 if name in fuzz_seeds.DEAR else 5)]

        def batch(first: int) -> list[tuple[str, Path, Outcome]]:
            if time.monotonic() > end:
                return []
            paths, names = [], []
            for trial in range(first, min(first + _BATCH, cases)):
                random = np.random.default_rng([seed, trial])
                name = order[random.integers(len(order))]
                suffix, mutator, contents = found[name]
                content, other = (contents[random.integers(len(contents))] for _ in range(2))
                names.append(name)
                paths.append(Path(scratch) / f"{trial}@{name}@{suffix}")
                paths[-1].write_bytes(MUTATORS[mutator](content, random, other))
            return list(zip(names, paths, attack("tests.fuzz:read", paths, warm=sound), strict=True))

        with ThreadPoolExecutor(processes) as pool:
            for done in pool.map(batch, range(0, cases, _BATCH)):
                for name, path, outcome in done:
                    tally, size = tallies[name], path.stat().st_size
                    tally.loaded += not outcome.error
                    tally.refused += bool(outcome.error)
                    tally.seconds += outcome.seconds
                    plain = outcome.error in ("ConfigError", "MaterialError")  # their message says what was expected
                    if not (outcome.typed or plain) or not outcome.within(size, 2.0 + size / 5e5):
                        tally.findings += 1
                        findings.append(
                            f"{path.name}: {outcome.error} {outcome.message[:300]!r}, {size} bytes, "
                            f"{outcome.memory / 1e6:.0f} MB, {outcome.seconds:.2f} s"
                        )
                        if keep is not None:
                            keep.mkdir(parents=True, exist_ok=True)
                            (keep / path.name).write_bytes(path.read_bytes())
                    path.unlink()
    return dict(tallies), findings


def main() -> None:
    """Run what the command line asks for, print what came of it, and exit with 1 if there are findings."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--budget-s", type=float, default=7200.0)
    parser.add_argument("--processes", type=int, default=1, help="that read at a time; each is best given a core")
    parser.add_argument("--formats", nargs="*", choices=sorted(READERS))
    parser.add_argument("--keep", type=Path, help="folder for the files of findings")
    given = parser.parse_args()
    for name, package in sorted(fuzz_seeds.absent().items()):
        print(f"{name:20} not tried: pip install {package}", flush=True)
    start = time.monotonic()
    tallies, findings = run(
        given.cases,
        seed=given.seed,
        budget=given.budget_s,
        formats=given.formats,
        keep=given.keep,
        processes=given.processes,
    )
    print(f"{'format':20} {'loaded':>7} {'refused':>7} {'findings':>8} {'ms each':>8}")
    for name, tally in sorted(tallies.items()):
        count = tally.loaded + tally.refused
        print(f"{name:20} {tally.loaded:7} {tally.refused:7} {tally.findings:8} {1e3 * tally.seconds / count:8.1f}")
    count, spent = sum(t.loaded + t.refused for t in tallies.values()), time.monotonic() - start
    print(f"{count} cases in {spent:.0f} s, {count / spent:.1f} a second, {len(findings)} findings")
    print("\n".join(findings))
    sys.exit(bool(findings))


if __name__ == "__main__":
    main()
