"""The command ``softmode fit``: what a real object is made of, from a film, markers or forces."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from softmode.cli.common import bar_interval, own_group, quiet_warp, short_name, warp_device
from softmode.cli.object_options import ObjectOptions
from softmode.errors import ConfigError, FitError
from softmode.files import PendingFile, check_place

if TYPE_CHECKING:
    from softmode.cli.fit_scene import FitScene
    from softmode.fitting.estimates import Fitted
    from softmode.objects.soft_object import SoftObject


def _refuse(options: object, names: Sequence[str], what: str) -> None:
    """Refuse options that are given and say nothing about what is fitted to."""
    for name in names:
        if getattr(options, name) is not None:
            raise ConfigError(f"--{name.replace('_', '-')} says nothing about {what}", hint="leave it out")


def _shown(error: FitError, path: Path) -> FitError:
    """Return an error that names the picture of what was refused, which is written, if it has one."""
    if error.picture is None:
        return error
    from PIL import Image

    picture = Image.fromarray(error.picture)
    with PendingFile(path, "picture") as file:
        picture.resize((2 * picture.width, 2 * picture.height)).save(file.temporary, "PNG")
    return FitError(f"{error.message} (see {path})", hint=error.hint)


def _argument() -> object:
    """Return what makes a field an argument; evaluated when tyro reads it."""
    import tyro

    return tyro.conf.Positional


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fit:
    """Find what a real object is made of, and write its twin.

    Example: softmode fit press.csv --object sponge --between y
    """

    file: Annotated[Path, _argument()]
    """A film of the object, held by one end and let go; or a .csv: time [s] and markers [m], or depth and force with
    their units."""
    held: str | None = None
    """End that is held and how much of it [m], in the file's axes: top:0.03, bottom:0.02, --held=-x:0.01."""
    mass: float | None = None
    """Mass of the object [kg]; without it or --density only E over density is known."""
    poissons_ratio: float | None = None
    """Poisson's ratio; that of the preset or body, else 0.35, if omitted."""
    camera: tuple[float, float, float] | None = None
    """About where the camera was, in the axes of the object's file [m]; it looks at the object's middle."""
    fov: float | None = None
    """Vertical angle that it sees [rad]; 0.8 if omitted."""
    plate: Path | None = None
    """Picture of the background without the object; the median of the film if omitted."""
    fps_true: float | None = None
    """Frames per second at which a film was taken that plays slower."""
    exposure: float | None = None
    """For how long a frame of a film sees [s]; 0 if omitted."""
    free: tuple[Literal["poissons_ratio", "mass_damping", "density", "friction"], ...] = ()
    """What is fitted besides, of a film or markers; what they do not say is told."""
    scene: Path | None = None
    """JSON file: kind, held, fps, exposure, free, mass, density, poissons_ratio, camera, markers, axes, load."""
    press: tuple[float, float, float] | None = None
    """Of a force log: where a ball presses the object on a table, in the axes of its file [m]."""
    radius: float | None = None
    """Radius of the ball [m]; 0.006 if omitted."""
    between: Literal["x", "y", "z"] | None = None
    """Of a force log: the axis along which two jaws close on the object."""
    out: Annotated[Path | None, short_name("-o")] = None
    """Twin to write, with fit.json and the film of the fit (.mp4) beside it; out/OBJECT.npz if omitted."""
    device: str | None = None
    """Warp device, for example cpu or cuda:0."""
    toy: Annotated[ObjectOptions, own_group()] = dataclasses.field(default_factory=ObjectOptions)
    """The object: its splats, mesh or preset."""

    @property
    def twin(self) -> Path:
        """The file of the twin."""
        return self.out or Path("out", f"{(self.toy.file or self.file).stem}.npz")

    def run(self) -> int:
        """Fit, print, write; return the exit code."""
        toy = self.toy.file
        if toy is None:
            raise ConfigError("no object is given", hint="name its splats or mesh, like --splat toy.ply --size 0.16")
        out = self.twin
        if out.suffix.lower() != ".npz":
            raise ConfigError(f"out {out} is no .npz file", hint="name it like out/toy.npz")
        check_place(out, "twin")
        _refuse(self.toy, ("youngs_modulus", "friction"), "a fit")
        if self.toy.density is not None and self.mass is not None:
            raise ConfigError("--mass and --density are given", hint="give one of them")
        from softmode.cli.fit_scene import FitScene

        scene = FitScene.read(
            self.scene,
            held=self.held,
            mass=self.mass,
            density=self.toy.density,
            poissons_ratio=self.poissons_ratio,
            fps=self.fps_true,
            exposure=self.exposure,
            free=self.free or None,
        )
        with quiet_warp():
            refused = out.with_suffix(".refused.png")
            try:
                found, free, film = self._fitted(scene)
            except FitError as error:
                raise _shown(error, refused) from error
            refused.unlink(missing_ok=True)  # that of an earlier run
            found.write(out.with_name("fit.json"))
            for line in found.lines():
                print(line)
            twin = found.save(out, free)
            print(f"wrote {out} ({twin.body.function_count} functions) and {out.with_name('fit.json')}")
            if film is not None:
                self._film(out.with_suffix(".mp4"), *film)
        return 0

    def _fitted(self, scene: FitScene) -> tuple[Fitted, SoftObject, Any]:
        """Return what was found, the object, free, and what the film of the fit shows."""
        from softmode.deformables.materials.material import Material
        from softmode.fitting.film import Clip
        from softmode.fitting.film_fit import fit_film
        from softmode.fitting.force_fit import Press, fit_force
        from softmode.fitting.holding import Held, held_object
        from softmode.fitting.marker_fit import fit_markers
        from softmode.fitting.tables import holds_forces, read_forces, read_markers
        from softmode.objects.config import ObjectConfig
        from softmode.objects.frame import laid_down
        from softmode.objects.loader import load

        device = warp_device(self.device)
        table = self.file.suffix.lower() == ".csv"
        forces = table and holds_forces(self.file)
        film, pressed = ("camera", "fov", "plate", "fps_true", "exposure"), ("press", "radius", "between")
        if forces:
            what, silent = "a force log", ("held", *film)
        elif table:
            what, silent = "markers", (*pressed, *film)
        else:
            what, silent = "a film", pressed
        _refuse(self, silent, what)
        if self.camera is None:
            _refuse(self, ("fov",), "a film without --camera")
        if self.press is None:
            _refuse(self, ("radius",), "jaws")
        if (forces or table) and scene.exposure:
            raise ConfigError(f"exposure says nothing about {what}", hint="leave it out of the scene")
        if forces and scene.free:
            raise ConfigError("free says nothing about a force log", hint="leave it out: forces show one number, E")
        scene.check_kind(what, "between" if forces and self.between else "press" if forces else "held")
        base = ObjectConfig(surface_count=3000) if forces else ObjectConfig()
        config = self.toy.object_of(base)
        told = config.material if config.body is None else load(config).material
        made = told or Material(poissons_ratio=0.35)
        if scene.poissons_ratio is not None:
            made = dataclasses.replace(made, poissons_ratio=scene.poissons_ratio)
        free = load(config, material=made)
        density, known = scene.density_of(free.body.volume, made.density)
        material = dataclasses.replace(made, density=density)
        if forces:
            between = None if self.between is None else "xyz".index(self.between)
            ball = {} if self.radius is None else {"radius": self.radius}
            press = Press(point=self.press, between=between, **ball)
            found = fit_force(free, read_forces(self.file), press, material=material, device=device)
            note = f"the twin has {density:g} kg/m^3, which was not measured: give --mass"
            return found if known else dataclasses.replace(found, notes=(*found.notes, note)), free, None
        if scene.held is None:
            raise ConfigError("held is not told", hint="say which end is held, like --held top:0.03")
        held = Held.parse(scene.held)
        captured = load(config.changed(pose="captured"), material=made) if laid_down(free.body) else free
        thing = held_object(captured, held)
        if table:
            markers, places = read_markers(self.file), scene.places()
            found = fit_markers(thing, markers, places, material=material, free=scene.free, device=device)
            return found if known else found.unweighed(), free, None
        clip = Clip.read(self.file, fps_true=scene.fps)
        height, width = clip.frames.shape[1:3]
        if self.camera is not None:
            middle = (thing.body.bounds + thing.body.offset).mean(axis=0)
            view = {"position": self.camera, "target": middle.tolist(), "fov_y": 0.8 if self.fov is None else self.fov}
            scene = dataclasses.replace(scene, camera=view)
        camera = scene.pinhole(width, height, clip.shrink)
        from tqdm import tqdm

        with tqdm(total=100, desc="fitting", unit="%", mininterval=bar_interval()) as bar:

            def tell(stage: str, fraction: float) -> None:
                bar.set_postfix_str(stage, refresh=False)
                bar.update(max(round(100.0 * fraction) - bar.n, 0))

            found, residuals, x = fit_film(
                thing,
                clip,
                camera,
                material=material,
                plate=None if self.plate is None else clip.like(self.plate),
                exposure=scene.exposure,
                free=scene.free,
                keep=self.twin.with_suffix(".fit.part.json"),
                device=device,
                progress=tell,
            )
        return found if known else found.unweighed(), free, (residuals, x)

    def _film(self, path: Path, residuals: Any, x: Any) -> None:
        """Write the film beside the twin."""
        from softmode.fitting.comparison import side_by_side
        from softmode.viz.film import Film

        with Film(path) as film:
            for picture in side_by_side(residuals, x):
                film.add(picture, max(round(1.0 / residuals.clip.interval), 1))
            film.publish()
        print(f"wrote {path}: the film, the twin, and where they differ")
