"""Device side of `handling`: peaks of force and deformation over the substeps, and how often an object was lost."""

from enum import IntEnum

import warp as wp

from softmode.deformables.materials.material_kernels import energy
from softmode.deformables.model.deformation_kernels import elastic_gradient
from softmode.deformables.model.lane_kernels import vec8d
from softmode.deformables.model.struct_kernels import Basis, Instances
from softmode.deformables.potential.evaluate_kernels import material_of
from softmode.envs.reward_kernels import EndReason, StepResult, WorldState, grasped, is_there, tool_position

wp.set_module_options({"enable_backward": False})

Handled = IntEnum("Handled", "peak_force peak_strain peak_energy_density drops slips", start=0)
SLIP = wp.constant(0.02)
"""How far a held object moves in the grip for a slip [m]."""
DROP = wp.constant(0.05)
"""How far an object falls that no longer is held for a drop, beside its goal [m]."""
LEAST_FORCE = wp.constant(15.0)
"""Least force limit where none is given [N]."""
MARGIN = wp.constant(3.0)
"""How many times the force that holds the object's weight it is, where that is more."""
GENTLE = wp.constant(0.5)
"""Share of a limit up to which handling costs nothing."""
ROUGHEST = wp.constant(8.0)
"""Most that counts beyond it, in limits."""


@wp.struct
class Handling:
    """How the objects of every world are handled in this episode."""

    handled: wp.array2d[float]  # (world_count, figures), see `Handled`
    safe: wp.array[wp.bool]  # success within the limits
    step_force: wp.array[float]  # largest of the last control step [N]
    step_strain: wp.array[float]  # likewise
    force_limit: wp.array[float]  # [N]
    held_slot: wp.array[int]  # which object is held, -1 for none
    falling_slot: wp.array[int]  # which is no longer, until it has dropped
    grip: wp.array[wp.vec3]  # where in the frame of the tool it was grasped [m]
    height: wp.array[float]  # where it was last held [m]


@wp.func
def roughness(handling: Handling, world: int, strain_limit: float):
    """Return how far force or strain of the last control step, whichever is more of its limit, are beyond gentle."""
    force = handling.step_force[world] / wp.max(handling.force_limit[world], 1.0e-6)
    used = wp.max(force, handling.step_strain[world] / strain_limit)
    return wp.clamp(used - GENTLE, 0.0, ROUGHEST)


@wp.func
def principal_strain(G: wp.mat33):
    """Return the largest |s - 1| of the principal stretches s of F = I + G.

    The eigenvalues of E = (F^T F - I) / 2 are (s^2 - 1) / 2; those of a symmetric matrix follow from its invariants
    (Smith 1961).
    """
    E = 0.5 * (G + wp.transpose(G) + wp.transpose(G) * G)
    mean = wp.trace(E) / 3.0
    D = E - wp.diag(wp.vec3(mean, mean, mean))
    size = wp.sqrt(wp.ddot(D, D) / 6.0)
    angle = wp.acos(wp.clamp(wp.determinant(D) / wp.max(2.0 * size * size * size, 1.0e-30), -1.0, 1.0)) / 3.0
    most = mean + 2.0 * size * wp.cos(angle)
    least = mean + 2.0 * size * wp.cos(angle + 2.0943951)
    return wp.max(wp.sqrt(wp.max(1.0 + 2.0 * most, 0.0)) - 1.0, 1.0 - wp.sqrt(wp.max(1.0 + 2.0 * least, 0.0)))


@wp.kernel
def watch_forces(
    first: int,  # whether the control step begins
    body_start: wp.array[int],  # of rigid bodies, (world_count + 1,)
    body_wrench: wp.array[wp.spatial_vector],
    finger_body: wp.array3d[int],  # (world_count, 2, links of a finger), -1 for none
    # In, out:
    step_force: wp.array[float],
    step_strain: wp.array[float],
):
    """Raise the force of the control step to the largest of a link, or of a finger, on soft bodies."""
    w = wp.tid()
    force = wp.where(first != 0, 0.0, step_force[w])
    step_strain[w] = wp.where(first != 0, 0.0, step_strain[w])
    for b in range(body_start[w], body_start[w + 1]):
        force = wp.max(force, wp.length(wp.spatial_top(body_wrench[b])))
    for f in range(finger_body.shape[1]):
        total = wp.vec3()
        for k in range(finger_body.shape[2]):
            if finger_body[w, f, k] >= 0:
                total += wp.spatial_top(body_wrench[finger_body[w, f, k]])
        force = wp.max(force, wp.length(total))
    step_force[w] = force


@wp.kernel
def watch_deformation(
    stride: int,  # soft objects per world
    instances: Instances,
    basis: Basis,
    q: wp.array2d[vec8d],
    # In, out:
    handled: wp.array2d[float],
    step_strain: wp.array[float],
):
    """Raise the peaks of principal strain and energy density to those of a cubature point."""
    w, slot, p = wp.tid()
    i = w * stride + slot
    if p >= instances.point_count[i]:
        return
    point = instances.point_start[i] + p
    scale = wp.float64(instances.scale[i])
    G = elastic_gradient(basis.gradient, q, i, point, instances.function_count[i], scale)
    strain = principal_strain(wp.mat33(G))
    if strain > step_strain[w]:
        wp.atomic_max(step_strain, w, strain)
    material = material_of(instances, basis, i, point)
    material.viscosity = wp.float64(0.0)
    density = float(energy(material, G, G, wp.float64(1.0)))
    if density > handled[w, Handled.peak_energy_density]:
        wp.atomic_max(handled, w, int(Handled.peak_energy_density), density)


@wp.kernel
def judge(
    fresh: wp.array[wp.bool],  # worlds whose step was a reset
    strain_limit: float,
    force_limit: float,  # [N], negative for that of the object's weight
    pad_friction: float,
    friction: int,  # column of the parameters
    care: float,  # what the reward loses for roughness
    gentle: int,  # column of that term, -1 for none
    terminates: int,  # whether a peak beyond its limit ends the episode
    state: WorldState,
    result: StepResult,
    instances: Instances,
    gravity: wp.array[wp.vec3],
    # In, out:
    handling: Handling,
):
    """Raise peaks, count slips and drops, and say whether a success is within the limits; once per control step."""
    w = wp.tid()
    tool = state.tool_pose[w]
    near = int(0)
    nearest = float(1.0e9)
    heaviest = float(0.0)
    for o in range(state.slots):
        if is_there(state, w, o):
            heaviest = wp.max(heaviest, float(instances.mass[w * state.stride + o]))
            distance = wp.length(state.object_position[w, o] - tool_position(state, w))
            if distance < nearest:
                nearest = distance
                near = o
    pads = wp.sqrt(wp.max(state.parameters[w, friction] * pad_friction, 1.0e-6))
    holds = 0.5 * heaviest * wp.length(gravity[w]) / pads
    handling.force_limit[w] = wp.where(force_limit > 0.0, force_limit, wp.max(LEAST_FORCE, MARGIN * holds))
    if not fresh[w]:
        handled = handling.handled
        handled[w, Handled.peak_force] = wp.max(handled[w, Handled.peak_force], handling.step_force[w])
        handled[w, Handled.peak_strain] = wp.max(handled[w, Handled.peak_strain], handling.step_strain[w])
    if gentle >= 0:
        result.terms[w, gentle] = -care * roughness(handling, w, strain_limit)
    if grasped(state, w):
        x = state.object_position[w, near]
        offset = wp.transform_point(wp.transform_inverse(tool), x)
        if handling.held_slot[w] != near:
            handling.grip[w] = offset
        elif wp.length(offset - handling.grip[w]) > SLIP:
            handling.handled[w, Handled.slips] += 1.0
            handling.grip[w] = offset
        handling.height[w] = x[2]
        handling.held_slot[w] = near
        handling.falling_slot[w] = near
    else:
        handling.held_slot[w] = -1
        o = handling.falling_slot[w]
        if o >= 0:
            fallen = state.object_position[w, o][2] < handling.height[w] - DROP
            if fallen and (result.at_goal[w] & (1 << o)) == 0:
                handling.handled[w, Handled.drops] += 1.0
                handling.falling_slot[w] = -1
    gently = handling.handled[w, Handled.peak_force] <= handling.force_limit[w]
    gently = gently and handling.handled[w, Handled.peak_strain] <= strain_limit
    handling.safe[w] = result.success[w] and gently
    if terminates != 0 and not gently:
        result.failure[w] = EndReason.ROUGH
        result.success[w] = False


@wp.kernel
def forget_handling(world_mask: wp.array[wp.bool], handling: Handling):
    """Begin the episode of the masked worlds."""
    w = wp.tid()
    if world_mask[w]:
        for k in range(handling.handled.shape[1]):
            handling.handled[w, k] = 0.0
        handling.safe[w] = False
        handling.step_force[w] = 0.0
        handling.step_strain[w] = 0.0
        handling.held_slot[w] = -1
        handling.falling_slot[w] = -1
