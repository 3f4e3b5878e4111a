"""Soft fingertips: domes of rubber glued to the fingers of a gripper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.quadrature.quadrature import quadrature_from_capsule
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.solver.attachments import Attachment, attach
from softmode.robots.arm import ArmIndices

GLUE_STIFFNESS = 680.0
"""Stiffness kappa / E of the glued half over the square of the radius, as its build knows it: about that of the
attachment. The dome of a fingertip of 6 modes then yields 0.47 mm to a newton on 3 mm, of 12 modes without it 0.34 mm,
with about as many functions (49 and 51); 120 functions yield 0.53 mm."""


@dataclass(frozen=True, kw_only=True)
class SoftFingertips:
    """Where the soft fingertips stand in the builder they were added to."""

    body: ReducedBody
    """The fingertip, a capsule; pass it to the solver."""
    instances: tuple[int, ...]
    """Index of each among the soft bodies, in the order of the mounts."""
    attachments: tuple[Attachment, ...]
    """What holds each."""


def fingertip_mounts(arm: ArmIndices) -> tuple[tuple[int, wp.transform], ...]:
    """Return, for both fingers of the arm, the body and the pose of a fingertip in its frame: the middle of the pad."""
    gripper = arm.description.gripper
    height = gripper.finger_length - 0.5 * gripper.pad_size[2]
    middle, half_turn = wp.vec3(0.0, 0.0, height), wp.quat(0.0, 0.0, 1.0, 0.0)
    left, right = arm.finger_bodies
    return (left, wp.transform(middle, half_turn)), (right, wp.transform(middle, wp.quat_identity()))


def add_soft_fingertips(
    builder: newton.ModelBuilder,
    mounts: ArmIndices | Sequence[tuple[int, Any]],
    *,
    radius: float = 0.010,
    half_height: float = 0.012,
    material: Material | None = None,
    mode_count: int = 6,
) -> SoftFingertips:
    """Glue a soft capsule to each finger: half of it stands out of the finger's face.

    The links are taken where the joint coordinates of the builder put them. The fingertips take away ``2 * radius`` of
    the opening.

    Args:
        builder: Builder of the world that holds the gripper.
        mounts: What :func:`softmode.robots.add_arm` returned; or for any gripper, per finger, its body and the pose of
            the fingertip in the frame of that body: a ``wp.transform`` with z along the finger and y out of its face.
        radius: Radius of the capsule [m].
        half_height: Half the distance between the centres of its caps [m].
        material: Its material; default a soft rubber of 0.3 MPa.
        mode_count: Skinning eigenmodes of a fingertip: more conform better and cost more, see ``docs/sensing.md``.

    Returns:
        The body, and where its instances and attachments stand.

    Raises:
        ConfigError: If a link does not exist.
        AssetError: If a length is not positive.
    """
    mounts = fingertip_mounts(mounts) if isinstance(mounts, ArmIndices) else tuple(mounts)
    material = material or Material(youngs_modulus=3.0e5, poissons_ratio=0.45, density=1100.0, friction=1.0)
    quadrature = quadrature_from_capsule(radius, half_height, point_count=2000, surface_count=400)
    options = BuildOptions(mode_count=mode_count, kernel_count=300, cubature_count=256)
    options = options.for_ratio(material.poissons_ratio)
    back = ((-np.inf, -np.inf, -np.inf), (np.inf, 0.0, np.inf))
    glued = Region(name="back", box=np.array(back), stiffness=GLUE_STIFFNESS / radius**2)
    body = build_body(quadrature, options, name="fingertip", regions=(glued,))
    poses = _link_poses(builder)
    instances, attachments = [], []
    for link, mount in mounts:
        pose = poses[link] * mount
        rotation = np.array(wp.quat_to_matrix(wp.transform_get_rotation(pose)), float).reshape(3, 3)
        position = np.array(wp.transform_get_translation(pose), float).tolist()
        instances.append(add_reduced_body(builder, body, material=material, position=position, rotation=rotation))
        attachments.append(attach(builder, instances[-1], body, link=link, box=back, link_pose=poses[link]))
    return SoftFingertips(body=body, instances=tuple(instances), attachments=tuple(attachments))


def _link_poses(builder: newton.ModelBuilder) -> list[wp.transform]:
    """Return where the joint coordinates of a builder put its bodies."""
    model: Any = builder.finalize(device="cpu")
    state = model.state()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    return [wp.transform(*pose) for pose in state.body_q.numpy()]
