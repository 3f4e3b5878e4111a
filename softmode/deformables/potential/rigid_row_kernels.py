"""MuJoCo's constraint rows (rigid contacts, joint limits, equalities, friction loss) inside the joint solve.

MuJoCo finds the acceleration a that minimises 1/2 (a - a0)^T M (a - a0) + s(x), x = J a - a_ref, with one convex cost
per row or elliptic cone (Todorov 2014, doi:10.1109/ICRA.2014.6907751). The rows of the prediction, with x* its x, enter
the potential over r = dt * joint velocity as what s adds to its own tangent,

    dt^2 [ s(x) - s(x*) - s'(x*) (x - x*) ],   x = x* + J (r - r*) / dt^2,

whose gradient is zero in the prediction: without soft forces nothing moves, a small force meets J^T s'' J, a force
that opens a contact meets nothing once it is open, and one that closes a row which the prediction left open meets it.

MuJoCo's integrator damps after the constraints are solved: the rows see the acceleration that M leaves of a force, the
dofs move by what M_eff = M + dt C leaves of it. A row along which M_eff is c times M is therefore c times as stiff
against r as D says, and x* counts 1/c of what it is (see ``damp_rows``).
"""

import warp as wp

from softmode.deformables.model.declare import kernel_over, struct
from softmode.deformables.model.lane_kernels import barrier, rolled
from softmode.deformables.model.newton_step_kernels import ALL, NewtonStep
from softmode.deformables.model.struct_kernels import Rigid
from softmode.deformables.system.assembly_kernels import factor_rigid

wp.set_module_options({"enable_backward": False})

EQUALITY = wp.constant(0)
FRICTION_DOF = wp.constant(1)
FRICTION_TENDON = wp.constant(2)
ELLIPTIC = wp.constant(7)
"""``mujoco.mjtConstraint``; the types between, limits and contacts of one row, are unilateral."""

MEMBER = wp.constant(-1)
"""Kind of the rows of an elliptic cone behind its first."""


@struct
class MujocoRows:
    """Constraint rows of mujoco_warp after a step, its ``Data.efc`` and what it refers to."""

    count: wp.array[int]  # (world_count,)
    type: wp.array2d[int]
    id: wp.array2d[int]
    J: wp.array3d[float]  # dense (world_count, rows, nv), or sparse (world_count, 1, non-zeros)
    J_rownnz: wp.array2d[int]  # (world_count, 0) where dense
    J_rowadr: wp.array2d[int]
    J_colind: wp.array3d[int]
    D: wp.array2d[float]
    aref: wp.array2d[float]
    frictionloss: wp.array2d[float]
    qacc: wp.array2d[float]  # (world_count, nv)
    contact_friction: wp.array[wp.types.vector(length=5, dtype=float)]
    contact_dim: wp.array[int]
    contact_address: wp.array2d[int]  # (contact, dim), row of each
    impratio_invsqrt: wp.array[float]
    dof: wp.array2d[int]  # (world_count, nv), Newton's dof of each of MuJoCo's, -1 for none


@struct
class TurnedJoints:
    """Free and ball joints, whose velocities MuJoCo keeps in other frames than Newton."""

    joint: wp.array2d[int]  # (world_count, turned_max), -1 pads
    free: wp.array[int]  # (joint_count,), 1 free, 0 ball
    qd_start: wp.array[int]
    q_start: wp.array[int]
    child: wp.array[int]
    parent_frame: wp.array[wp.transform]
    child_frame: wp.array[wp.transform]
    body_com: wp.array[wp.vec3]


@wp.func
def turn_row(turned: TurnedJoints, joint: int, dof: int, joint_q: wp.array[float], rigid: Rigid, w: int, k: int):
    """Rewrite the columns of a joint, the first of them ``dof``, for Newton's velocities.

    Free: MuJoCo has the velocity of the body's origin in the world and the angular velocity in the body, Newton that of
    the centre of mass and the angular velocity, both in the parent's frame. Ball: MuJoCo has it in the body, Newton in
    the parent's frame.
    """
    J = rigid.row_jacobian
    at = turned.q_start[joint]
    child = wp.transform_get_rotation(turned.child_frame[joint])
    if turned.free[joint] != 0:
        parent = wp.transform_get_rotation(turned.parent_frame[joint])
        turn = wp.quat(joint_q[at + 3], joint_q[at + 4], joint_q[at + 5], joint_q[at + 6])
        turn = parent * turn * wp.quat_inverse(child)
        linear = wp.vec3(J[w, k, dof], J[w, k, dof + 1], J[w, k, dof + 2])
        angular = wp.vec3(J[w, k, dof + 3], J[w, k, dof + 4], J[w, k, dof + 5])
        com = wp.quat_rotate(turn, turned.body_com[turned.child[joint]])
        angular = wp.quat_rotate(turn, angular) - wp.cross(com, linear)
        linear = wp.quat_rotate_inv(parent, linear)
        angular = wp.quat_rotate_inv(parent, angular)
        for c in range(3):
            J[w, k, dof + c] = linear[c]
            J[w, k, dof + 3 + c] = angular[c]
    else:
        turn = wp.quat(joint_q[at], joint_q[at + 1], joint_q[at + 2], joint_q[at + 3]) * wp.quat_inverse(child)
        angular = wp.quat_rotate(turn, wp.vec3(J[w, k, dof], J[w, k, dof + 1], J[w, k, dof + 2]))
        for c in range(3):
            J[w, k, dof + c] = angular[c]


@wp.kernel
def gather_rows(
    mujoco: MujocoRows,
    turned: TurnedJoints,
    joint_q: wp.array[float],
    # In and out:
    rigid: Rigid,
):
    """Copy the rows of the predictor, their Jacobians for Newton's joint velocities."""
    w, k = wp.tid()
    count = wp.where(rigid.count[w] > 0, wp.min(mujoco.count[w], rigid.row_kind.shape[1]), 0)
    if k == 0:
        rigid.row_count[w] = count
    if k >= count:
        return
    for j in range(rigid.count[w]):
        rigid.row_jacobian[w, k, j] = 0.0
    value = -wp.float64(mujoco.aref[w, k])
    first = rigid.dof_start[w]
    sparse = mujoco.J_rownnz.shape[1] > 0
    terms = mujoco.qacc.shape[1]
    if sparse:
        terms = mujoco.J_rownnz[w, k]
    for s in range(terms):
        i = int(s)
        entry = float(0.0)
        if sparse:
            address = mujoco.J_rowadr[w, k] + s
            i = mujoco.J_colind[w, 0, address]
            entry = mujoco.J[w, 0, address]
        else:
            entry = mujoco.J[w, k, s]
        value += wp.float64(entry) * wp.float64(mujoco.qacc[w, i])
        dof = mujoco.dof[w, i] - first
        if dof >= 0 and dof < rigid.count[w]:
            rigid.row_jacobian[w, k, dof] = entry
    for s in range(turned.joint.shape[1]):
        joint = turned.joint[w, s]
        if joint >= 0:
            turn_row(turned, joint, turned.qd_start[joint] - first, joint_q, rigid, w, k)
    kind = mujoco.type[w, k]
    limit = mujoco.frictionloss[w, k]
    if kind == ELLIPTIC:
        contact = mujoco.id[w, k]
        head = mujoco.contact_address[contact, 0]
        friction = mujoco.contact_friction[contact]
        if head == k:
            limit = friction[0] * mujoco.impratio_invsqrt[w % mujoco.impratio_invsqrt.shape[0]]
            rigid.row_size[w, k] = mujoco.contact_dim[contact]
        else:
            limit = friction[k - head - 1]
            kind = MEMBER
    rigid.row_kind[w, k] = kind
    rigid.row_limit[w, k] = wp.float64(limit)
    rigid.row_stiffness[w, k] = wp.float64(mujoco.D[w, k])
    rigid.row_start[w, k] = value


@wp.func
def mobility(rigid: Rigid, w: int, k: int):
    """Return J X^-1 J^T of a row, the lower Cholesky factor of X being in ``matrix``; overwrites the row's coupling."""
    total = wp.float64(0.0)
    for a in range(rigid.count[w]):
        value = wp.float64(rigid.row_jacobian[w, k, a])
        for s in range(a):
            value -= rigid.matrix[w, a, s] * rigid.row_coupling[w, k, s]
        value /= rigid.matrix[w, a, a]
        rigid.row_coupling[w, k, a] = value
        total += value * value
    return total


@wp.kernel
def damp_rows(
    damping: wp.array[float],  # (joint_dof_count,), D + K_d
    dt: wp.float64,
    team: int,
    # In and out: its ``matrix`` holds the Cholesky factor of M_eff / dt^2 and is overwritten
    rigid: Rigid,
):
    """Let rows answer forces as MuJoCo's do, whose integrator damps after the constraints are solved.

    With a = J M^-1 J^T and b = J M_eff^-1 J^T, dt^2 C = dt^2 (M_eff - M) the damping of the step, one row answers a
    force along it in MuJoCo by (M + dt C)^-1 M (M + J^T D J)^-1, which is (M_eff + J^T D' J)^-1 for D' b = D a. The
    rows of a cone share what its first row has, since their stiffnesses go together.
    """
    w, member = wp.tid()
    n = rigid.count[w]
    count = rigid.row_count[w]
    if n == 0 or count == 0:
        return
    for k in range(member, count, team):
        rigid.row_change[w, k] = mobility(rigid, w, k)
    barrier()
    for a in range(member, n, team):
        for b in range(a + 1):
            rigid.matrix[w, a, b] = rigid.inertia[w, a, b]
        undamped = rigid.inertia[w, a, a] - wp.float64(damping[rigid.dof_start[w] + a]) / dt
        rigid.matrix[w, a, a] = undamped
        rigid.pivot_min[w, a] = wp.float64(1.0e-12) * undamped
    barrier()
    factor_rigid(rigid.matrix, rigid.pivot_min, w, n, member, team)
    for k in range(member, count, team):
        damped = rigid.row_change[w, k]
        if rigid.row_kind[w, k] != MEMBER and damped > wp.float64(0.0):
            ratio = wp.max(mobility(rigid, w, k) / damped, wp.float64(1.0))
            size = int(1)
            if rigid.row_kind[w, k] == ELLIPTIC:
                size = wp.min(rigid.row_size[w, k], count - k)
            for row in range(k, k + size):
                rigid.row_stiffness[w, row] = rigid.row_stiffness[w, row] * ratio
                rigid.row_start[w, row] = rigid.row_start[w, row] / ratio


@wp.func
def row_cost(kind: int, x: wp.float64, D: wp.float64, loss: wp.float64):
    """Return the cost of a row and its first two derivatives: quadratic, one-sided, or Huber's for friction loss."""
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    if kind == FRICTION_DOF or kind == FRICTION_TENDON:
        if wp.abs(x) * D >= loss:
            return loss * (wp.abs(x) - half * loss / D), wp.sign(x) * loss, zero
    elif kind != EQUALITY and x >= zero:
        return zero, zero, zero
    return half * D * x * x, D * x, D


@wp.func
def displaced(rigid: Rigid, w: int, k: int, r: wp.array2d[wp.float64], dt: wp.float64):
    """Return J (r - r*) / dt^2 of a row."""
    change = wp.float64(0.0)
    for j in range(rigid.count[w]):
        rolled()
        change += wp.float64(rigid.row_jacobian[w, k, j]) * (r[w, j] - rigid.predicted[w, j])
    return change / (dt * dt)


@wp.func
def cone_zone(normal: wp.float64, tangent: wp.float64, mu: wp.float64):
    """Return where u = (mu x_0, friction_j x_j) stands: 0 above the cone, 1 below its polar, 2 between."""
    if normal >= mu * tangent:
        return 0
    if mu * normal + tangent <= wp.float64(0.0):
        return 1
    return 2


@wp.func
def cone_row(
    zone: int,
    first: int,  # whether it is the cone's first row, on which the costs of the middle zone are booked
    x: wp.float64,
    normal: wp.float64,
    tangent: wp.float64,
    mu: wp.float64,
    scale: wp.float64,
    D: wp.float64,
    Dm: wp.float64,
):
    """Return slope and cost of one row of an elliptic cone."""
    slope = wp.float64(0.0)
    cost = wp.float64(0.0)
    if zone == 1:
        slope = D * x
        cost = wp.float64(0.5) * D * x * x
    elif zone == 2:
        gap = normal - mu * tangent
        if first != 0:
            slope = Dm * gap * mu
            cost = wp.float64(0.5) * Dm * gap * gap
        else:
            slope = -Dm * gap * mu * scale * scale * x / tangent
    return slope, cost


@wp.func
def evaluate_cone(rigid: Rigid, w: int, head: int, r: wp.array2d[wp.float64], dt: wp.float64, derivatives: int):
    """Evaluate an elliptic cone: 1/2 D_m (N - mu T)^2 between the cone and its polar, N = mu x_0, T = |friction x|."""
    zero = wp.float64(0.0)
    size = wp.min(rigid.row_size[w, head], rigid.row_count[w] - head)
    mu = rigid.row_limit[w, head]
    D0 = rigid.row_stiffness[w, head]
    Dm = D0 / (mu * mu * (wp.float64(1.0) + mu * mu))
    # at the prediction and here
    tangent_start = zero
    tangent = zero
    for k in range(head, head + size):
        rolled()
        change = displaced(rigid, w, k, r, dt)
        rigid.row_change[w, k] = change
        if k > head:
            u = rigid.row_limit[w, k] * rigid.row_start[w, k]
            tangent_start += u * u
            u += rigid.row_limit[w, k] * change
            tangent += u * u
    tangent_start = wp.sqrt(tangent_start)
    tangent = wp.sqrt(tangent)
    normal_start = mu * rigid.row_start[w, head]
    normal = normal_start + mu * rigid.row_change[w, head]
    zone_start = cone_zone(normal_start, tangent_start, mu)
    zone = cone_zone(normal, tangent, mu)
    for k in range(head, head + size):
        rolled()
        x_start = rigid.row_start[w, k]
        x = x_start + rigid.row_change[w, k]
        D = rigid.row_stiffness[w, k]
        scale = rigid.row_limit[w, k]
        first = wp.where(k == head, 1, 0)
        slope_start, cost_start = cone_row(zone_start, first, x_start, normal_start, tangent_start, mu, scale, D, Dm)
        slope, cost = cone_row(zone, first, x, normal, tangent, mu, scale, D, Dm)
        rigid.row_energy[w, k] = dt * dt * (cost - cost_start - slope_start * rigid.row_change[w, k])
        rigid.row_force[w, k] = slope - slope_start
    if derivatives == 0:
        return
    for j in range(rigid.count[w]):
        rolled()
        # z = scaled rows, p = their part along the slip
        z0 = mu * wp.float64(rigid.row_jacobian[w, head, j])
        p = zero
        if zone == 2:
            for k in range(head + 1, head + size):
                rolled()
                scale = rigid.row_limit[w, k]
                x = rigid.row_start[w, k] + rigid.row_change[w, k]
                p += scale * x / tangent * scale * wp.float64(rigid.row_jacobian[w, k, j])
        for k in range(head, head + size):
            rolled()
            J = wp.float64(rigid.row_jacobian[w, k, j])
            value = zero
            if zone == 1:
                value = rigid.row_stiffness[w, k] * J
            elif zone == 2:
                scale = rigid.row_limit[w, k]
                if k == head:
                    value = Dm * mu * (z0 - mu * p)
                else:
                    x = rigid.row_start[w, k] + rigid.row_change[w, k]
                    along = scale * x / tangent
                    value = (
                        Dm
                        * scale
                        * (-mu * along * (z0 - mu * p) + (mu * mu - mu * normal / tangent) * (scale * J - along * p))
                    )
            rigid.row_coupling[w, k, j] = value / (dt * dt)


@wp.func
def evaluate_row(
    step: NewtonStep, selected: wp.array[int], r: wp.array2d[wp.float64], derivatives: int, w: int, k: int
):
    """Evaluate the rows at r: energy, force and, where asked, s'' J; ``derivatives`` as for the points."""
    dt = step.options.dt
    if selected[w] == 0 or k >= step.rigid.row_count[w]:
        return
    if derivatives == ALL and step.state.evaluated[w] != 0:
        return
    kind = step.rigid.row_kind[w, k]
    if kind == ELLIPTIC:
        evaluate_cone(step.rigid, w, k, r, dt, derivatives)
    elif kind != MEMBER:
        start = step.rigid.row_start[w, k]
        D = step.rigid.row_stiffness[w, k]
        loss = step.rigid.row_limit[w, k]
        change = displaced(step.rigid, w, k, r, dt)
        cost_start, slope_start, _curvature_start = row_cost(kind, start, D, loss)
        cost, slope, curvature = row_cost(kind, start + change, D, loss)
        step.rigid.row_energy[w, k] = dt * dt * (cost - cost_start - slope_start * change)
        step.rigid.row_force[w, k] = slope - slope_start
        if derivatives != 0:
            for j in range(step.rigid.count[w]):
                rolled()
                step.rigid.row_coupling[w, k, j] = curvature / (dt * dt) * wp.float64(step.rigid.row_jacobian[w, k, j])


evaluate_rows = kernel_over(evaluate_row, "evaluate_rows", "w", "k")
