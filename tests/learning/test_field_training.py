"""Training a field on pictures with poses; the full recipe runs in examples/train_field.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softmode.deformables import quadrature_from_density
from softmode.deformables.quadrature.quadrature_density import is_doubtful
from softmode.errors import AssetError, ConfigError
from softmode.radiance import RadianceGrid, render_radiance
from softmode.splats import Lens, PinholeCamera, read_transforms, write_transforms

torch = pytest.importorskip("torch")
RADIUS, EDGE = 0.05, 40


def ball(x):
    """Return density and colour of a ball in two colours."""
    density = 4.0e3 * np.clip(0.5 + (RADIUS - np.linalg.norm(x, axis=1)) / 0.003, 0.0, 1.0)
    return density, np.where(x[:, 2:] > 0.0, (0.8, 0.3, 0.2), (0.2, 0.4, 0.7))


def pictures(folder: Path, count: int) -> Path:
    """Write pictures of the ball before white, of a lens and of wrong exposure; return their folder."""
    field = RadianceGrid.from_function(ball, [[-0.06] * 3, [0.06] * 3], resolution=48)
    z = np.linspace(-0.7, 0.9, count)
    a, r = 2.4 * np.arange(count), np.sqrt(1.0 - z * z)
    eyes = 0.25 * np.stack([r * np.cos(a), r * np.sin(a), z], axis=1)
    cameras = [
        PinholeCamera.look_at(f"{i}", position=tuple(eye), target=(0.0, 0.0, 0.0), width=EDGE, height=EDGE, fov_y=0.7)
        for i, eye in enumerate(eyes)
    ]
    poses, c = [camera.world_to_camera for camera in cameras], cameras[0]
    seen = render_radiance(field, poses, (c.fx, c.fy, c.cx, c.cy), width=EDGE, height=EDGE).on((1.0, 1.0, 1.0))
    gains = np.linspace(0.9, 1.0, count)[:, None, None, None]
    write_transforms(folder, cameras, gains * np.asarray(seen), Lens(k1=0.05))
    return folder


def test_a_ball_is_a_ball(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten small pictures and coarse grids leave a solid of walls with the ball's volume to a sixth, and its colours.

    The wall's colour is not told. The solid is not doubted, for its hull is larger by a skin alone.
    """
    from softmode.learning import train_field

    for name, value in {"COARSE": 24, "FINE": 32, "RAYS": 1024, "REGULAR": 1000}.items():
        monkeypatch.setattr(f"softmode.learning.field_training.{name}", value)
    told: list[float] = []
    shown = read_transforms(pictures(tmp_path, 10))
    found = train_field(shown, wall=None, steps=120, metres=1.0, progress=lambda _, error: told.append(error))
    assert np.mean(told[-5:]) < 0.2 * np.mean(told[:5])
    box = found.bounds + np.array([[-1.0], [1.0]]) * found.spacing
    solid = quadrature_from_density(found.densities, box, surface_count=16, point_count=500)
    seen = RADIUS + 0.001  # density rises over 3 mm, and rays along the rim lose half of their light that far out
    assert solid.volume == pytest.approx(4.0 / 3.0 * np.pi * seen**3, rel=1.0 / 6.0)
    assert solid.report["fog"] < 0.8 and found.metres == 1.0
    assert found.allowed is not None and found.contradicted is not None
    assert found.allowed < 1.1 and not is_doubtful(found.contradicted, found.allowed)
    top, bottom = found.colors([[0.0, 0.0, RADIUS], [0.0, 0.0, -RADIUS]], [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    assert top[0] > top[2] and bottom[2] > bottom[0]


def test_contradicted(tmp_path: Path) -> None:
    """A floor in two colours is not contradicted; a lid over it is, where pictures see one colour or the other."""
    from softmode.learning.space_carving import contradicted

    eyes = [(0.25 * np.cos(a), 0.25 * np.sin(a), z) for z in (0.2, 0.3) for a in np.arange(6.0)]
    cameras = [
        PinholeCamera.look_at(f"{i}", position=eye, target=(0.0, 0.0, 0.0), width=EDGE, height=EDGE, fov_y=0.7)
        for i, eye in enumerate(eyes)
    ]
    write_transforms(tmp_path, cameras, np.ones((12, EDGE, EDGE, 3)))
    shown, floor = read_transforms(tmp_path), -0.03
    ways = np.stack([picture.rays() for picture in shown])
    met = np.array(eyes)[:, None, None] + ways * ((floor - np.array(eyes)[:, None, None, 2]) / ways[..., 2])[..., None]
    images = np.where(met[..., :1] > 0.0, (0.9, 0.8, 0.8), (0.5, 0.5, 0.8))
    z = np.meshgrid(*(np.linspace(-0.05, 0.05, 21),) * 3, indexing="ij")[2]
    for top, low, high in ((floor, 0.0, 0.01), (0.0, 0.1, 0.6)):
        wrong, share = contradicted(shown, images, z < top + 1e-3, np.zeros(3), 0.05)
        assert low <= wrong.sum() / wrong[..., 0].size <= high
        assert not wrong[z < top - 0.003].any() and (share > 0.0) == wrong.any()


def test_what_light_reaches_is_empty() -> None:
    """Fog is empty where light of two pictures comes to it, and full in what is closed: a cup is open, a shell full."""
    from softmode.learning.field_training import Walls

    n = 32
    x, y, z = np.meshgrid(*(np.arange(n) - 15.5,) * 3, indexing="ij")
    ring, shell = np.hypot(x, y), np.sqrt(x * x + y * y + z * z)
    cup = (ring < 11.0) & (np.abs(z) < 9.0) & ~((ring < 8.0) & (z > -6.0))
    line = torch.linspace(0.0, n - 1.0, 64)
    places = torch.stack(torch.meshgrid(line, line, indexing="ij"), dim=-1).reshape(-1, 2)
    for dense, inside in ((cup, False), ((shell < 11.0) & (shell > 8.0), True)):
        hull = (ring < 11.0) & (np.abs(z) < 9.0) if not inside else shell < 11.0
        walls = Walls(np.where(hull, -1.0, 5.0), np.zeros((n, n, n, 3)), fog=hull)
        with torch.no_grad():
            walls.s[2:, 0] = torch.tensor(np.where(dense, -1.0, 3.0)[walls.near])
        lit = walls.lit(*torch.zeros(2, 0, 3), *torch.zeros(2, 0)).float()  # a picture that looks aside lights none
        for tilt in (0.0, 0.1):
            eye = torch.cat([places, torch.full((len(places), 1), 60.0)], dim=1)
            way = torch.tensor([tilt, 0.0, -1.0]).expand(len(places), 3)
            lit += walls.lit(eye, way, torch.full((len(eye),), 25.0), torch.full((len(eye),), 65.0))
        s = walls.anew(n, lit.numpy() > 1).dense()[0]
        assert (s[16, 16, 12] < 0.0) == inside and s[16, 16, 30] > 0.0
        assert (s < 0.0).sum() == pytest.approx((hull if inside else dense).sum(), rel=0.1)


def test_silhouettes_without_anything_in_common(tmp_path: Path) -> None:
    """Pictures of a wall alone, of another than is stated, of no plain one, or of several sizes are refused."""
    from softmode.learning import train_field

    cameras = [PinholeCamera.look_at(f"{i}", position=(0.3, 0.1 * i, 0.1), target=(0.0, 0.0, 0.0), width=16, height=16)
               for i in range(3)]  # fmt: skip
    write_transforms(tmp_path, cameras, np.ones((3, 16, 16, 3)))
    with pytest.raises(AssetError, match="nothing in common"):
        train_field(read_transforms(tmp_path), steps=1)
    with pytest.raises(AssetError, match="several sizes"):
        train_field(())
    with pytest.raises(AssetError, match="not the wall"):
        train_field(read_transforms(tmp_path), wall=(0.1, 0.9, 0.1))
    write_transforms(tmp_path, cameras, np.random.default_rng(0).uniform(size=(3, 16, 16, 3)))
    with pytest.raises(AssetError, match="not of one colour"):
        train_field(read_transforms(tmp_path), wall=None)
    with pytest.raises(ConfigError, match="wall is"):
        train_field(read_transforms(tmp_path), wall=(0.0, 0.0, 0.0))
