"""MorphRun: what a morph did, and its file."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.errors import AssetError
from softmode.files import damage_errors, read_archive, read_arrays, write_archive

Real = NDArray[Any]
"""float32 or float64, as the particles were stepped."""


FORMAT, VERSION = "softmode-morph", 1
ARRAYS = (
    "positions",
    "deformation",
    "control",
    "velocity",
    "affine_velocity",
    "losses",
    "first_losses",
    "kinetic_energy",
    "offsets",
)


def is_morph(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is an archive that says that it is a morph."""
    try:
        return bool(json.loads(read_arrays(path, ("header",))["header"].tobytes())["format"] == FORMAT)
    except Exception:  # what reading any other file leads to
        return False


@dataclass(frozen=True, kw_only=True, eq=False)
class MorphRun:
    """What a morph did, segment by segment."""

    positions: Real
    """Particles at the start and after each segment [m], shape (S + 1, N, 3)."""
    deformation: Real
    """Deformation gradients at the start and after each segment, shape (S + 1, N, 3, 3)."""
    control: Real
    """Controls of each segment, of its L layers one after another, shape (S L, N, 3, 3)."""
    velocity: Real
    """Velocities at the end [m/s], shape (N, 3)."""
    affine_velocity: Real
    """Affine velocities at the end [1/s], shape (N, 3, 3)."""
    losses: Real
    """Loss at the start and after each segment, to the target of that segment, shape (S + 1,)."""
    first_losses: Real
    """Loss to each target when its turn came, shape (K,)."""
    kinetic_energy: Real
    """Kinetic energy after each segment [J], shape (S,)."""
    offsets: Real
    """By how much source and targets were moved before the run [m], shape (targets + 1, 3)."""
    ends: tuple[int, ...]
    """After how many segments each target was done with; shorter than the targets where a run was cut off."""
    gradient_count: int
    """Gradients taken."""
    trial_count: int
    """Trial steps taken."""
    fingerprint: str
    """Of source, targets and options."""
    names: tuple[str, ...] = ()
    """What source and targets were made from, where it has a name."""
    notes: tuple[str, ...] = ()
    """What the planner says of the run."""

    @property
    def segment_count(self) -> int:
        """Number of segments S."""
        return len(self.kinetic_energy)

    @property
    def layer_count(self) -> int:
        """Number of controls L in a segment."""
        return len(self.control) // max(self.segment_count, 1) or 1

    @property
    def target_count(self) -> int:
        """Number of targets."""
        return len(self.offsets) - 1

    @property
    def accuracy(self) -> float:
        """1 - last loss / first loss, to the last target that was aimed at."""
        return float(1.0 - self.losses[-1] / self.first_losses[-1])

    @property
    def legs(self) -> NDArray[np.int64]:
        """Which target each segment aims at, shape (S,)."""
        return np.searchsorted(np.asarray(self.ends, dtype=int), np.arange(self.segment_count), side="right")

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the run as one .npz; the file appears whole or not at all.

        Raises:
            StorageError: If it cannot be written.
        """
        header = {
            "format": FORMAT,
            "version": VERSION,
            "ends": self.ends,
            "gradient_count": self.gradient_count,
            "trial_count": self.trial_count,
            "fingerprint": self.fingerprint,
            "names": self.names,
            "notes": self.notes,
        }
        write_archive(path, header, {name: getattr(self, name) for name in ARRAYS}, "morph")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> MorphRun:
        """Read a run.

        Raises:
            AssetError: If the file is missing, damaged, of another kind or of another version.
        """
        hint = "plan the morph again, or name another file"
        header, arrays = read_archive(path, FORMAT, VERSION, what="morph", hint=hint)
        with damage_errors(f"morph {path}", hint=hint):
            found = cls(
                **{name: arrays[name] for name in ARRAYS},
                ends=tuple(int(end) for end in header["ends"]),
                gradient_count=int(header["gradient_count"]),
                trial_count=int(header["trial_count"]),
                fingerprint=str(header["fingerprint"]),
                names=tuple(map(str, header["names"])),
                notes=tuple(map(str, header["notes"])),
            )
            whole = found._is_whole()
        if not whole:
            raise AssetError(f"morph {path}: its arrays do not belong together", hint=hint)
        return found

    def _is_whole(self) -> bool:
        """Return whether all arrays are finite and belong together."""
        segments, count = self.segment_count, self.positions.shape[1]
        shapes = {
            "positions": (segments + 1, count, 3),
            "deformation": (segments + 1, count, 3, 3),
            "control": (segments * self.layer_count, count, 3, 3),
            "velocity": (count, 3),
            "affine_velocity": (count, 3, 3),
            "losses": (segments + 1,),
            "kinetic_energy": (segments,),
            "first_losses": (min(len(self.ends) + 1, self.target_count),),
            "offsets": (self.target_count + 1, 3),
        }
        same = all(getattr(self, name).shape == shape for name, shape in shapes.items())
        ordered = list(self.ends) == sorted(self.ends) and max(self.ends, default=0) <= segments
        return same and ordered and all(np.isfinite(getattr(self, name)).all() for name in shapes)
