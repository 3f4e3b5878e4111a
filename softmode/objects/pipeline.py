"""Stages of :func:`softmode.objects.loader.load`: an object stands, is reduced, and gets its splats."""

from __future__ import annotations

import json
import warnings
import zlib
from base64 import b85decode, b85encode
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.materials.material import Material
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.quadrature.surface_samples import SURFACE_COUNT
from softmode.deformables.reduction.build_body import Progress, build_body
from softmode.errors import AssetError, ConfigError
from softmode.objects.config import FIELD_FILES, FILES, ObjectConfig
from softmode.objects.material_field import PROPERTIES, MaterialField, read_material
from softmode.objects.paint import color_field, read_field
from softmode.objects.pose import seat_of, stable_rotation
from softmode.objects.shapes.presets import find_preset
from softmode.objects.shapes.primitives import scaled, turned
from softmode.objects.soft_object import SoftObject
from softmode.objects.source import ObjectSource, pose_of
from softmode.splats.splats import Splats
from softmode.stages import stage

Array = NDArray[np.float64]

RECIPE = 10
"""Part of the cache key; raise it when the way from a file or shape to a body changes."""
MISSED_LEAST = 1.0e-3
"""Share of an object that a field of material misses from which on that is said."""
SIZE_TOLERANCE = 0.005
"""Relative error of the size of a fill that is left. Splats tell a size less well than their fill does: few of them lie
at a tip, such as the handle of a mug (1.3 % of its size), and floaters lie beyond it."""


def body_key(config: ObjectConfig, source: ObjectSource) -> tuple[object, ...]:
    """Return what the body of an object depends on.

    Raises:
        AssetError: If a file of factors is missing.
    """
    fields = {name: Path(file) for name in FIELD_FILES if (file := getattr(config, name)) is not None}
    for name, file in fields.items():
        if not file.is_file():
            raise AssetError(f"{name} {file}: no such file", hint="check the path")
    colors = (config.stiffness_colors, config.density_colors)
    painted = (colors, source.splats.means, source.splats.sh) if any(colors) else ()  # A mesh's key has no colours.
    held = (config.surface_count, config.build, config.clamped_height, config.stiffness)
    return (RECIPE, *source.key, _may_turn(config), *held, painted, fields)


def standing_quadrature(config: ObjectConfig, source: ObjectSource) -> tuple[Quadrature, Array]:
    """Integrate an object, bring it to its size, and lay it on a stable side if its pose is to be stable.

    Samples say which side is stable: twice as many turned a banana by 3 degrees more. So they and the bounding box are
    those of the default number, whatever number touches.

    Args:
        config: Which object.
        source: What it is made of.

    Returns:
        The quadrature, and the rotation times the factor that was applied, shape (3, 3).

    Raises:
        AssetError: If it encloses no volume.
    """
    try:
        with stage(f"integrating {source.name}"):
            quadrature = source.integrate()
        turns = _may_turn(config) and config.surface_count != SURFACE_COUNT
        like = source.integrate(surface_count=SURFACE_COUNT) if turns else quadrature
    except AssetError as error:
        raise AssetError(f"{source.splats.name}: {error.message}", hint=error.hint) from error
    quadrature = replace(quadrature, bounds=like.bounds, report={**quadrature.report, **source.capture})
    outline, factor, turn = like.surface_points, 1.0, None
    if source.fill_size is not None:
        extent = float(np.ptp(quadrature.bounds, axis=0).max())
        if abs(extent / source.fill_size - 1.0) > SIZE_TOLERANCE:
            factor = source.fill_size / extent
            quadrature, outline = scaled(quadrature, factor), outline * factor
    if _may_turn(config):
        turn = stable_rotation(outline - quadrature.weights @ quadrature.points / quadrature.volume)
    return (quadrature, factor * np.eye(3)) if turn is None else (turned(quadrature, turn, outline), factor * turn)


def relative_scale(
    config: ObjectConfig,
    name: Literal["stiffness", "density"],
    quadrature: Quadrature,
    splats: Splats,
    field: MaterialField | None = None,
) -> Array | None:
    """Return the relative stiffness or density per quadrature point (P,), None if it is the same everywhere.

    Args:
        config: Which object.
        name: Which of the two.
        quadrature: Its solid, as it stands.
        splats: What shows it there.
        field: What its material file says.

    Raises:
        AssetError: If a file cannot be read.
        ConfigError: If a part of another stiffness holds no point, or no splat has the colour of one.
    """
    boxes = config.stiffness if name == "stiffness" else ()
    colors, file = getattr(config, f"{name}_colors"), getattr(config, f"{name}_file")
    points = quadrature.points - seat_of(quadrature.bounds)
    own = "youngs_modulus" if name == "stiffness" else name
    absolute = None if field is None else field.at(own, points)
    if not boxes and not colors and file is None and absolute is None:
        return None
    found = np.ones(len(points))
    for part in boxes:
        inside = (points >= part.box[:3]).all(axis=1) & (points <= part.box[3:]).all(axis=1)
        if not inside.any():
            low, high = np.round([points.min(axis=0), points.max(axis=0)], 4).tolist()
            raise ConfigError(
                f"stiffness: box {part.box} holds no point of the object", hint=f"the object fills {low} to {high} m"
            )
        found[inside] = part.factor
    if colors:
        found *= color_field(splats, colors)(quadrature.points)
    if file is not None:
        found *= read_field(file)(points)
    return found if field is None or absolute is None else found * (absolute / field.means[own])


def build_standing(
    config: ObjectConfig, source: ObjectSource, *, regions: Sequence[Region] = (), progress: bool | Progress | None
) -> tuple[ReducedBody, Quadrature]:
    """Reduce an object as it stands.

    Args:
        config: Which object.
        source: What it is made of.
        regions: Parts that a scene holds, moves or grasps, beside the foot of a clamped object, where it stands.
        progress: Passed to :func:`softmode.deformables.reduction.build_body.build_body`.

    Returns:
        The body, whose `provenance` tells how it was laid down ("turn"), where it stands ("seat") and which splats of a
        capture have solid under them ("shown"), and its solid.
    """
    quadrature, turn = standing_quadrature(config, source)
    seat, splats = seat_of(quadrature.bounds), _laid_down(source.splats, turn)
    held = [region.moved(-seat, quadrature.bounds) for region in regions]
    if config.clamped_height > 0.0:
        wide = float("inf")
        top = float(seat[2]) + config.clamped_height
        held.append(Region(name="foot", box=((-wide,) * 3, (wide, wide, top))))
    field, places, options, missed = None, quadrature.points - seat, config.build, 0.0
    if config.material_file is not None:
        field = read_material(config.material_file)
        missed = field.missed(places, quadrature.weights)
    ratio = None if field is None else field.at("poissons_ratio", places)
    if field is not None and ratio is not None:
        options = replace(options, poissons_ratio=field.means["poissons_ratio"])  # to which the field is relative
    body = build_body(
        quadrature,
        options,
        name=source.name,
        regions=held,
        stiffness_scale=relative_scale(config, "stiffness", quadrature, splats, field),
        density_scale=relative_scale(config, "density", quadrature, splats, field),
        poissons_ratio=ratio,
        progress=progress,
    )
    frame: dict[str, str | float] = {}
    if field is not None and (density := field.at("density", places)) is not None:
        frame["field_density"] = float(quadrature.weights @ density / quadrature.volume)
    if missed > MISSED_LEAST:
        frame["field_missed"] = missed
    frame |= {"turn": json.dumps(turn.tolist()), "seat": json.dumps(seat.tolist())}
    if "part_splats" in source.capture and quadrature.members is not None:
        frame["shown"] = b85encode(zlib.compress(np.packbits(quadrature.members).tobytes())).decode()
    return replace(body, provenance={**body.provenance, **frame}), quadrature


def dressed(body: ReducedBody, config: ObjectConfig, source: ObjectSource, material: Material | None) -> SoftObject:
    """Return a body with the splats and the field of its source in its frame; its provenance tells the asset.

    Splats of a capture without solid under them are left out, as is what lies beyond an eighth of the body's size
    around its bounding box.

    Warns:
        RuntimeWarning: If its material file misses a part of it.
    """
    turn = np.array(json.loads(str(body.provenance["turn"])))
    splats = _laid_down(source.splats, turn)
    low, high = body.bounds + body.offset
    margin = 0.125 * np.linalg.norm(high - low)
    near = ((splats.means >= low - margin) & (splats.means <= high + margin)).all(axis=1)
    bare = 0
    if (shown := body.provenance.get("shown")) is not None:
        bits = np.frombuffer(zlib.decompress(b85decode(str(shown))), dtype=np.uint8)
        near &= np.unpackbits(bits, count=splats.count).astype(bool)
        bare = splats.count - int(near.sum())
    splats = splats.subset(near).transformed(translation=-body.offset)
    told = {
        "asset": source.name,
        "asset_kind": config.kind,
        "asset_splats": source.asset_splats,
        "asset_left_out": source.asset_splats + int(source.capture.get("floor_splats", 0)) - splats.count,
        "asset_bare_splats": bare,
    }
    if any(source.offset):
        told["asset_offset"] = json.dumps(source.offset)
    if source.notes:
        told["asset_notes"] = "; ".join(source.notes)
    if config.preset is not None:
        told["material"] = json.dumps(find_preset(config.preset).properties)
    if config.material_file is not None and (own := config.material) is not None:
        # The mean over the solid, so that its mass is that of the field.
        mean = replace(own, density=float(body.provenance.get("field_density") or own.density))
        if material is not None and material.density == own.density:
            material = replace(material, density=mean.density)
        told["material"] = json.dumps({name: getattr(mean, name) for name in (*PROPERTIES, "friction")})
    notes = source.notes
    if (missed := body.provenance.get("field_missed")) is not None:
        file = Path(str(config.material_file)).name
        text = f"{file} misses {100.0 * float(missed):.1f} % of the object: its nearest points stand for what is there"
        warnings.warn(text, RuntimeWarning, stacklevel=3)
        notes = (*notes, text)
    factor, field = float(np.cbrt(np.linalg.det(turn))), source.radiance
    if source.field_pose is not None:
        laid = pose_of(turn, -body.offset) @ source.field_pose
        told["field_pose"] = json.dumps(laid.tolist())
    return SoftObject(
        body=replace(body, provenance={**body.provenance, **told}),
        splats=splats,
        material=material,
        contact_radius=config.contact_radius,
        config=config,
        radiance=None if field is None else field.transformed(turn / factor, -body.offset, factor),
        notes=notes,
    )


def _may_turn(config: ObjectConfig) -> bool:
    """Return whether an object is laid on a stable side if it has to be."""
    return config.pose == "stable" and config.kind in ("preset", *FILES)


def _laid_down(splats: Splats, turn: Array) -> Splats:
    """Return splats after the rotation times a factor that laid their solid down."""
    if np.array_equal(turn, np.eye(3)):
        return splats
    factor = float(np.cbrt(np.linalg.det(turn)))
    rotation = turn / factor
    return splats.transformed(None if np.allclose(rotation, np.eye(3), atol=1e-12) else rotation, scale=factor)
