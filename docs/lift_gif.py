"""Make a moving picture of README.md, such as docs/images/lift.gif, from a film, such as that of ``make demo``.

Run: ``make demo``, then ``python docs/lift_gif.py [out/lift.mp4] [docs/images/lift.gif]``. docs/gallery.md has the
commands of the other films.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from PIL import Image

DELAY = 0.08
"""Time between two frames [s]; GIF counts in hundredths, so this is 12.5 frames per second."""
HOLD = 1.2
"""How long the last frame stays before the loop starts again [s]."""


def write_gif(film: Path, target: Path, *, width: int, seconds: float, colors: int) -> int:
    """Write the beginning of a film as a GIF that loops.

    All frames share one palette, so that still parts of the picture do not flicker. An octree chooses its colours; the
    median cut spends them on large areas and loses those of the toy.

    Args:
        film: The video to read.
        target: The GIF to write.
        width: Width of the GIF [px]; the height follows.
        seconds: How much of the film is used [s].
        colors: Number of colours of the palette.

    Returns:
        Size of the GIF [bytes].

    Raises:
        ValueError: If the film is shorter than that.
    """
    rate = float(iio.immeta(film, plugin="FFMPEG")["fps"])
    pictures = iio.imread(film, plugin="FFMPEG")
    if len(pictures) < round(seconds * rate):
        raise ValueError(f"{film} lasts {len(pictures) / rate:.1f} s, shorter than the {seconds} s asked for")
    chosen = [pictures[round(time * rate)] for time in np.arange(0.0, seconds - 0.5 / rate, DELAY)]
    height = round(width * pictures.shape[1] / pictures.shape[2])
    frames = [Image.fromarray(picture).resize((width, height), Image.Resampling.LANCZOS) for picture in chosen]
    sample = Image.fromarray(np.concatenate([np.asarray(frame) for frame in frames]))
    palette = sample.quantize(colors, method=Image.Quantize.FASTOCTREE)
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    delays = [round(1e3 * DELAY)] * (len(frames) - 1) + [round(1e3 * HOLD)]
    indexed[0].save(target, save_all=True, append_images=indexed[1:], duration=delays, loop=0, optimize=True)
    return target.stat().st_size


def main(arguments: list[str] | None = None) -> None:
    """Write the GIF and say how large it is."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("film", nargs="?", type=Path, default=Path("out/lift.mp4"))
    parser.add_argument("target", nargs="?", type=Path, default=Path("docs/images/lift.gif"))
    parser.add_argument("--width", type=int, default=512, help="width of the GIF [px]")
    parser.add_argument("--seconds", type=float, default=4.0, help="how much of the film is used [s]")
    parser.add_argument("--colors", type=int, default=160, help="number of colours")
    options = parser.parse_args(arguments)
    size = write_gif(options.film, options.target, width=options.width, seconds=options.seconds, colors=options.colors)
    print(f"wrote {options.target}, {size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
