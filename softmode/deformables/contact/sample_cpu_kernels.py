"""Device side of the surface samples on CPU: where they are, and which shapes they may touch, eight at a time."""

import warp as wp

from softmode.deformables.contact.detection_kernels import CULLED, Shapes
from softmode.deformables.contact.ridge_kernels import FAR
from softmode.deformables.contact.shape_query_kernels import BOX, HEIGHTFIELD, PLANE
from softmode.deformables.model.interpolation_cpu_kernels import interpolate_rows
from softmode.deformables.model.lane_kernels import LANES
from softmode.deformables.model.struct_kernels import Basis, Instances, Motion, Samples

wp.set_module_options({"enable_backward": False})

SLACK = 1.0e-5
"""Rounding of distances in float32, over the larger of 1 m and the coordinates of a shape."""
NAMES = {"CULLED": int(CULLED), "PLANE": PLANE, "HEIGHTFIELD": HEIGHTFIELD, "SLACK": SLACK}
NAMES |= {"BOX": BOX, "FAR": float(FAR)}


@wp.kernel
def place_eights(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    # Out:
    samples: Samples,
):
    """Compute positions and drifts of eight samples; see ``detection_kernels.place_samples``."""
    i, eight = wp.tid()
    s = LANES * eight
    if s >= instances.sample_count[i]:
        return
    count = wp.min(LANES, instances.sample_count[i] - s)
    row = instances.row_start[i] + s
    n = instances.function_count[i]
    x = interpolate_rows(basis.row, row, count, motion.q_start, motion.q_start, 0, i, n)
    drift = interpolate_rows(basis.row, row, count, motion.q_inertial, motion.q_start, 1, i, n)
    for k in range(count):
        samples.position[i, s + k] = basis.row_point[row + k] + wp.vec3d(x[0, k], x[1, k], x[2, k])
        samples.drift[i, s + k] = wp.vec3(wp.vec3d(drift[0, k], drift[1, k], drift[2, k]))


def _cull_snippet() -> str:
    """Return the native code of :func:`cull_samples_of`."""
    code = """{
    typedef double lanes __attribute__((ext_vector_type(8)));
    typedef __typeof__((lanes)0.0 < (lanes)0.0) words;
    const int candidate_max = candidate.shape[1], sample_count = instances.sample_count.data[i];
    const int checked = candidate_max < CULLED ? candidate_max : CULLED;
    const int* own = (const int*)candidate.data + (size_t)i * candidate_max;
    const int* close = (const int*)near.data + (size_t)i * candidate_max;
    struct Frame {
        double turn[9], origin[3], lower[3], upper[3], linear[3], angular[3], centre[3], thick, slack, edge;
        int shape, bit;
    };
    Frame frames[CULLED];
    int frame_count = 0, passed = 0;
    for (int c = 0; c < checked; ++c) {
        if (close[c] == 0) continue;
        const int shape = own[c];
        if (shapes.kind.data[shape] == PLANE || shapes.kind.data[shape] == HEIGHTFIELD) {
            passed |= 1 << c;
            continue;
        }
        Frame& f = frames[frame_count++];
        wp::transform_t<wp::float32> pose = shapes.transform.data[shape];
        const int body = shapes.body.data[shape];
        for (int k = 0; k < 3; ++k) f.linear[k] = f.angular[k] = f.centre[k] = 0.0;
        if (body >= 0) {
            const auto place = shapes.body_q.data[body];
            const auto twist = shapes.body_qd.data[body];
            pose = wp::transform_multiply(place, pose);
            const auto com = wp::transform_point(place, shapes.body_com.data[body]);
            for (int k = 0; k < 3; ++k) {
                f.linear[k] = dt * twist.c[k];
                f.angular[k] = dt * twist.c[3 + k];
                f.centre[k] = com.c[k];
            }
        }
        const auto turn = wp::quat_to_matrix(wp::transform_get_rotation(pose));
        const auto origin = wp::transform_get_translation(pose);
        double far = 1.0;
        for (int k = 0; k < 3; ++k) {
            for (int l = 0; l < 3; ++l) f.turn[3 * k + l] = turn.data[k][l];
            f.origin[k] = origin.c[k];
            far = far > f.origin[k] ? far : f.origin[k];
            far = far > -f.origin[k] ? far : -f.origin[k];
            f.lower[k] = shapes.lower.data[shape].c[k];
            f.upper[k] = shapes.upper.data[shape].c[k];
        }
        f.thick = shapes.margin.data[shape] + instances.contact_radius.data[i];
        f.slack = SLACK * far;
        f.edge = shapes.kind.data[shape] == BOX ? FAR * instances.scale.data[i] : 0.0;
        f.shape = shape;
        f.bit = 1 << c;
    }
    const size_t first = (size_t)i * samples.position.shape[1];
    const double* position = (const double*)samples.position.data + 3 * first;
    const float* drift = (const float*)samples.drift.data + 3 * first;
    const double* inner = (const double*)basis.inner_point.data + 3 * (size_t)instances.row_start.data[i];
    const double scale = instances.scale.data[i], margin = instances.margin.data[i];
    const float* area = basis.row_area.data + instances.row_start.data[i];
    const int* memory = (const int*)stick_shape.data + 2 * (size_t)instances.particle_start.data[i];
    const bool fresh = dt_before.data[i] == 0.0;
    int* out = (int*)samples.near.data + first;
    for (int s = 0; s < sample_count; s += 8) {
        lanes x[3], move[3], depth = 0.0, wide;
        words stuck[2];
        for (int lane = 0; lane < 8; ++lane) {
            const int sample = s + lane < sample_count ? s + lane : sample_count - 1, at = 3 * sample;
            wide[lane] = area[sample];
            for (int k = 0; k < 2; ++k) stuck[k][lane] = memory[2 * sample + k];
            for (int k = 0; k < 3; ++k) {
                x[k][lane] = position[at + k];
                move[k][lane] = drift[at + k];
                depth[lane] += inner[at + k] * inner[at + k];
            }
        }
        depth = 2.0 * scale * __builtin_elementwise_sqrt(depth);
        wide = __builtin_elementwise_sqrt(wide);
        words bits = (words)(long long)passed;
        for (int n = 0; n < frame_count; ++n) {
            const Frame& f = frames[n];
            lanes gap = 0.0, travel = 0.0, arm[3], from[3];
            for (int k = 0; k < 3; ++k) {
                arm[k] = x[k] - f.centre[k];
                from[k] = x[k] - f.origin[k];
            }
            for (int k = 0; k < 3; ++k) {
                const lanes local = f.turn[k] * from[0] + f.turn[3 + k] * from[1] + f.turn[6 + k] * from[2];
                lanes away = local - f.upper[k] > f.lower[k] - local ? local - f.upper[k] : f.lower[k] - local;
                away = away > 0.0 ? away : (lanes)0.0;
                gap += away * away;
                const int l = (k + 1) % 3, m = (k + 2) % 3;
                const lanes moving = f.linear[k] + f.angular[l] * arm[m] - f.angular[m] * arm[l];
                travel += (move[k] - moving) * (move[k] - moving);
            }
            lanes reach = margin + 2.0 * __builtin_elementwise_sqrt(travel);
            reach = f.edge * wide > reach ? f.edge * wide : reach;
            const words shape = (words)(long long)f.shape, bit = (words)(long long)f.bit;
            const words touched = (stuck[0] == shape) | (stuck[1] == shape) | (fresh ? ~(words)0 : (words)0);
            const lanes within = ((touched & (depth > reach)) ? depth : reach) + f.thick + f.slack;
            // a comparison that is false where something is no number
            bits |= gap > within * within ? (words)0 : bit;
        }
        for (int lane = 0; lane < 8 && s + lane < sample_count; ++lane) out[s + lane] = (int)bits[lane];
    }
}"""
    for name, value in NAMES.items():
        code = code.replace(name, str(value))
    return code


@wp.func_native(snippet=_cull_snippet())
def cull_samples_of(
    instances: Instances,
    basis: Basis,
    candidate: wp.array2d[int],
    near: wp.array2d[int],
    shapes: Shapes,
    samples: Samples,
    stick_shape: wp.array[wp.vec2i],
    dt_before: wp.array[wp.float64],
    dt: float,
    i: int,
) -> None:
    """Write for each sample of an instance a bit per candidate shape whose bounds are within the sample's reach."""


@wp.kernel
def cull_samples(
    instances: Instances,
    basis: Basis,
    candidate: wp.array2d[int],
    near: wp.array2d[int],
    shapes: Shapes,
    dt: float,
    # State in, as for ``find_contacts``:
    stick_shape: wp.array[wp.vec2i],
    dt_before: wp.array[wp.float64],
    # In and out:
    samples: Samples,
):
    """Mark the candidate shapes that a sample may touch: none other can become a contact in ``find_contacts``.

    That looks at a shape where the distance is less than the reach of the sample or, if it has touched the shape, than
    twice its distance to the inside of the body. The distance to the bounds of the shape is a lower one.
    """
    i = wp.tid()
    cull_samples_of(instances, basis, candidate, near, shapes, samples, stick_shape, dt_before, dt, i)
