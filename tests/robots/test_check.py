"""The command ``softmode robots check``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.needs import needs
from tests.robots.files import write_arm5

pytestmark = needs("tyro", "matplotlib")


def test_check_prints_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The table has what was found and what was guessed; the picture shows arm, hand and fingers in their colours."""
    from softmode.cli.main import main

    out = tmp_path / "arm.png"
    assert main(["robots", "check", str(write_arm5(tmp_path)), "-o", str(out)]) == 0
    said = capsys.readouterr().out
    for words in (
        "end effector     roll, moved by 5 joints",
        "reach            0.940 m",
        "jaw_a 0..0.045, jaw_b 0..0.045",
        "opening          90.0 mm",
        "home: key frame 'home'",
        "found by closing it",
    ):
        assert words in said
    pixels = np.asarray(Image.open(out).convert("RGB"), float)
    red, green, blue = pixels[..., 0], pixels[..., 1], pixels[..., 2]
    assert ((red > 1.3 * blue) & (red > green) & (green > blue)).mean() > 0.01  # orange fingers
    assert ((blue > 1.3 * red) & (blue > green)).mean() > 0.01  # the blue hand


def test_check_names_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No name, a picture that is none, and two robots for one picture end with a line that says so."""
    from softmode.cli.main import main

    path = str(write_arm5(tmp_path))
    for arguments, words in (
        (["check"], "names no robot"),
        (["check", path, "-o", str(tmp_path / "arm.jpg")], "no .png"),
        (["check", path, path, "-o", str(tmp_path / "arm.png")], "one picture for 2 robots"),
    ):
        assert main(["robots", *arguments]) == 2
        assert words in capsys.readouterr().err
