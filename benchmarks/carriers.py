"""The object of made captures: what is taken of it, of its carrier, and whether the report says what is doubtful.

Run with `python -m benchmarks.carriers [smooth rough bare room held] [--seeds 4800 --count 40] [--fill]`. Shares are of
the splats of each label, volumes are those of the fill over the truth, times are processor time of one core.
"""

from __future__ import annotations

import argparse
import re
import time
from dataclasses import dataclass

import numpy as np

from softmode.deformables.quadrature.quadrature import quadrature_from_splats
from softmode.errors import AssetError
from softmode.objects.carriers import SURE
from softmode.objects.parts import choose_part
from tests.carriers import CARRIER, OBJECT, SETS, Made
from tests.hands import held

MADE = {**SETS, "held": held}
"""Captures by seed."""
SEEDS = {"smooth": (6000, 40), "rough": (6100, 10), "bare": (6200, 20), "room": (6300, 4), "held": (6400, 12)}
"""First seed and number of captures of each set, chosen after the code was done."""


@dataclass(frozen=True)
class Verdict:
    """What became of one capture."""

    object_share: float
    carrier_share: float
    right: bool
    """At least 97 % (rough: 95 %) of the object's splats and at most 1 % (3 %) of the carrier's; a bare thing uncut; a
    room named; what a hand holds refused, and nothing else."""
    doubted: bool
    """Whether a doubt was named."""
    option: str
    """The named option that is right, if the choice was not."""
    seconds: float
    told: dict[str, str | int | float]
    volume: float = float("nan")
    """Volume of the fill over the truth."""

    @property
    def line(self) -> str:
        """What the table says of it."""
        state = "ok" if self.right else f"named, --part {self.option}" if self.option else "doubted"
        state = state if self.right or self.doubted else "SILENT"
        return (
            f"object {self.object_share:.3f} carrier {self.carrier_share:.3f}"
            f" score {self.told.get('carrier_score', 0.0):.2f} volume {self.volume:.3f} {self.seconds:.1f} s"
            f"  {state}{' (a doubt)' if self.right and self.doubted else ''}"
        )


def judge(made: Made, kind: str, *, fill: bool = False) -> Verdict:
    """Take the object of a capture and compare it with the labels."""
    start = time.process_time()
    choice = choose_part(made.splats, "thickest")
    seconds = time.process_time() - start
    least, most = (0.95, 0.03) if kind == "rough" else (0.97, 0.01)

    def shares(taken: tuple[int, ...]) -> tuple[float, float]:
        kept = np.isin(choice.number, taken)
        return tuple(float(kept[made.label == k].mean()) if (made.label == k).any() else 0.0 for k in (OBJECT, CARRIER))  # type: ignore[return-value]

    def good(taken: tuple[int, ...]) -> bool:
        found = shares(taken)
        return found[0] >= least and found[1] <= most

    options = re.findall(r"--part ([0-9 ]+?) takes", str(choice.told.get("doubt_remedy", "")))
    right = good(choice.taken) and (made.carried or "carrier" not in choice.told)
    if kind == "room":
        right = "scene_crop" in choice.told
    arm = float(choice.told.get("arm", 0.0))
    right = arm > SURE if kind == "held" else right and arm <= SURE
    volume = float("nan")
    if fill:
        part = choice.part
        try:
            found = quadrature_from_splats(part.means, part.scales, part.quats, part.opacities, resolution=96)
            volume = found.volume / made.volume
        except AssetError:
            volume = 0.0
    best = next((part for part in options if good(tuple(map(int, part.split())))), "")
    return Verdict(*shares(choice.taken), right, bool(options), best, seconds, choice.told, volume)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", nargs="*", default=list(MADE))
    parser.add_argument("--seeds", type=int, help="first seed")
    parser.add_argument("--count", type=int, help="number of captures")
    parser.add_argument("--fill", action="store_true", help="fill what is taken, for the volume")
    options = parser.parse_args()
    for kind in options.sets:
        first, count = SEEDS[kind]
        first, count = options.seeds or first, options.count or count
        found, splats = [], 0
        for seed in range(first, first + count):
            made = MADE[kind](seed)
            found.append(judge(made, kind, fill=options.fill))
            splats += made.splats.count
            print(f"{kind:7}{seed:6d} {made.name:22}{made.splats.count:7d} {found[-1].line}", flush=True)
        wrong = [one for one in found if not one.right]
        seconds = 1e5 * sum(one.seconds for one in found) / splats
        print(
            f"{kind}: {count - len(wrong)} of {count} right, {seconds:.2f} s for 100,000 splats; of the others", end=" "
        )
        print(f"{sum(bool(one.option) for one in wrong)} named with the right option,", end=" ")
        print(f"{sum(not one.doubted for one in wrong)} silent", flush=True)


if __name__ == "__main__":
    main()
