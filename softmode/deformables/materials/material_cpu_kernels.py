"""Device side of the materials on CPU: energy, stress and Hessian of eight points at a time, in vector registers.

The formulas are those of ``material_kernels`` and ``hessian_kernels``, which say why they are written as they are and
which this code is tested against. A point's numbers do not depend on the other seven: where a point would branch, the
lanes select. Loops that end by a criterion go on until every lane has ended, and a lane that has ended is left alone.

Newton's own Hessian of an energy in the invariants of F is polynomial in F and cof F and is formed from these; singular
values are found for the projected one and for the energies with the term |F - R|^2.
"""

from typing import Any

import warp as wp

from softmode.deformables.materials.material_kernels import MaterialModel

wp.set_module_options({"enable_backward": False})

LANES = 8
"""Points that are evaluated at a time."""

vec8d: Any = wp.types.vector(length=LANES, dtype=wp.float64)
"""A number at eight points."""
mat98d: Any = wp.types.matrix(shape=(9, LANES), dtype=wp.float64)
"""A matrix (3, 3) row by row, at eight points."""
PointLanes: Any = wp.types.matrix(shape=(11, LANES), dtype=wp.float64)
"""Energy density, stress and J at eight points."""
HessianLanes: Any = wp.types.matrix(shape=(54, LANES), dtype=float)
"""The entries of ``hessian_kernels.HessianBlocks`` at eight points."""

FUSED = "#pragma clang fp contract(fast)\n"

_TYPES = f"""
    typedef double lanes __attribute__((ext_vector_type({LANES})));
    typedef __typeof__((lanes)0.0 < (lanes)0.0) words;  // 64-bit integers
"""

_MATRICES = """
        static lanes dot(const lanes* a, const lanes* b) {
            FUSED
            return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        }
        static lanes trace(const lanes* A) { return A[0] + A[4] + A[8]; }
        static lanes ddot(const lanes* A, const lanes* B) {
            FUSED
            return dot(A, B) + dot(A + 3, B + 3) + dot(A + 6, B + 6);
        }
        static lanes second_invariant(const lanes* A) {
            FUSED
            return A[0] * A[4] - A[1] * A[3] + A[4] * A[8] - A[5] * A[7] + A[0] * A[8] - A[2] * A[6];
        }
        static void cofactor(const lanes* F, lanes* C) {
            FUSED
            for (int a = 0; a < 3; ++a)
                for (int b = 0; b < 3; ++b) {
                    const int c = (a + 1) % 3, d = (a + 2) % 3, e = (b + 1) % 3, f = (b + 2) % 3;
                    C[3 * a + b] = F[3 * c + e] * F[3 * d + f] - F[3 * c + f] * F[3 * d + e];
                }
        }
        static lanes determinant(const lanes* A) {
            FUSED
            lanes d = A[0] * (A[4] * A[8] - A[5] * A[7]);
            d += A[1] * (A[5] * A[6] - A[3] * A[8]);
            return d + A[2] * (A[3] * A[7] - A[4] * A[6]);
        }
        static void product(const lanes* A, const lanes* B, lanes* C) {
            FUSED
            for (int a = 0; a < 3; ++a)
                for (int b = 0; b < 3; ++b)
                    C[3 * a + b] = A[3 * a] * B[b] + A[3 * a + 1] * B[3 + b] + A[3 * a + 2] * B[6 + b];
        }
        static void transpose(const lanes* A, lanes* T) {
            for (int a = 0; a < 3; ++a)
                for (int b = 0; b < 3; ++b) T[3 * b + a] = A[3 * a + b];
        }
        static void conjugate(const lanes* V, const lanes* M, lanes* C) {  // V M V^T
            lanes T[9], half[9];
            transpose(V, T);
            product(V, M, half);
            product(half, T, C);
        }
        static void green_strain(const lanes* G, lanes* E) {
            FUSED
            for (int a = 0; a < 3; ++a)
                for (int b = a; b < 3; ++b) {
                    lanes square = G[a] * G[b] + G[3 + a] * G[3 + b] + G[6 + a] * G[6 + b];
                    E[3 * a + b] = 0.5 * (G[3 * a + b] + G[3 * b + a] + square);
                    E[3 * b + a] = E[3 * a + b];
                }
        }
        static lanes most(lanes a, lanes b) { return a < b ? b : a; }
        static lanes root(lanes a) { return __builtin_elementwise_sqrt(a); }
        static lanes absolute(lanes a) { return __builtin_elementwise_abs(a); }
        static bool any(words mask) { return __builtin_reduce_or(mask) != 0; }
"""

# The logarithm: u = 2^k m with m in [sqrt(1/2), sqrt(2)), and ln m = ln(1 + f) as in FreeBSD's e_log.c (Sun, 1993), to
# less than a unit in the last place.
_LOGARITHM = """
        static lanes logarithm(lanes u) {  // of normal numbers above 0
            FUSED
            words bits = (words)u;
            words k = (bits - (words)0x3fe6a09e667f3bcd) >> 52;
            lanes n = __builtin_convertvector(k, lanes);
            lanes f = (lanes)(bits - (k << 52)) - 1.0;
            lanes s = f / (2.0 + f), z = s * s;
            lanes R = 1.479819860511658591e-1 * z + 1.531383769920937332e-1;
            R = R * z + 1.818357216161805012e-1;
            R = R * z + 2.222219843214978396e-1;
            R = R * z + 2.857142874366239149e-1;
            R = R * z + 3.999999999940941908e-1;
            R = (R * z + 6.666666666666735130e-1) * z;
            lanes half_square = 0.5 * f * f;
            lanes low = s * (half_square + R) + n * 1.90821492927058770002e-10;
            return n * 6.93147180369123816490e-1 - ((half_square - low) - f);
        }
        static lanes log_of_one_plus(lanes x) {
            FUSED
            lanes u = 1.0 + x;
            return u == 1.0 ? x : logarithm(u) * x / (u - 1.0);
        }
        static lanes excess_over_log(lanes x) {
            FUSED
            lanes s = x / (2.0 + x), q = s * s;
            lanes series = 1.0 / 9.0 + q * (1.0 / 11.0);
            series = 1.0 / 3.0 + q * (1.0 / 5.0 + q * (1.0 / 7.0 + q * series));
            lanes near = x * s - 2.0 * s * q * series;
            words far = absolute(x) > 0.05;
            return any(far) ? (far ? x - log_of_one_plus(x) : near) : near;
        }
"""

SINGULAR_VALUES = """
        static words orthogonal_pair(lanes* x, lanes* y, words moving) {
            FUSED
            lanes alpha = dot(x, x), beta = dot(y, y), gamma = dot(x, y), longer = most(alpha, beta);
            words turn = gamma * gamma > most(1.0e-30 * alpha * beta, 1.0e-33 * longer * longer);
            lanes gap = absolute(alpha - beta), h = root(gap * gap + 4.0 * gamma * gamma);
            lanes scale = 1.0 / root(2.0 * h * (h + gap));
            lanes c = turn ? (h + gap) * scale : (lanes)1.0;
            lanes s = turn ? 2.0 * gamma * scale : (lanes)0.0;
            words first = alpha >= beta;
            for (int k = 0; k < 6; ++k) {
                lanes along = first ? c * x[k] + s * y[k] : s * x[k] + c * y[k];
                lanes across = first ? c * y[k] - s * x[k] : s * y[k] - c * x[k];
                x[k] = moving ? along : x[k];
                y[k] = moving ? across : y[k];
            }
            return ~first | (absolute(s) > 1.0e-7);
        }
        NOINLINE static void orthogonal_columns(const lanes* A, lanes* B, lanes* V) {
            lanes column[3][6];  // of A V, on top of those of V
            for (int c = 0; c < 3; ++c)
                for (int k = 0; k < 3; ++k) {
                    column[c][k] = A[3 * k + c];
                    column[c][3 + k] = (lanes)(k == c ? 1.0 : 0.0);
                }
            words moving = ~(words)0;
            for (int round = 0; round < 12 && any(moving); ++round) {
                words moved = orthogonal_pair(column[0], column[1], moving);
                moved |= orthogonal_pair(column[0], column[2], moving);
                moved |= orthogonal_pair(column[1], column[2], moving);
                moving &= moved;
            }
            for (int c = 0; c < 3; ++c)
                for (int k = 0; k < 3; ++k) {
                    B[3 * k + c] = column[c][k];
                    V[3 * k + c] = column[c][3 + k];
                }
        }
        NOINLINE static void singular_values(const lanes* F, lanes* U, lanes* sigma, lanes* V) {
            FUSED
            lanes B[9], x[3], y[3], z[3], u[3], w[3], n[3];
            orthogonal_columns(F, B, V);
            for (int k = 0; k < 3; ++k) {
                x[k] = B[3 * k];
                y[k] = B[3 * k + 1];
                z[k] = B[3 * k + 2];
            }
            lanes length = root(dot(x, x));
            words none = length == 0.0;
            for (int k = 0; k < 3; ++k) u[k] = none ? (lanes)(k == 0 ? 1.0 : 0.0) : x[k] / length;
            lanes along = dot(u, y);
            for (int k = 0; k < 3; ++k) w[k] = y[k] - along * u[k];
            words lost = dot(w, w) <= 0.25 * dot(y, y), short_x = absolute(u[0]) < 0.6;
            w[0] = lost ? (short_x ? (lanes)0.0 : -u[2]) : w[0];
            w[1] = lost ? (short_x ? u[2] : (lanes)0.0) : w[1];
            w[2] = lost ? (short_x ? -u[1] : u[0]) : w[2];
            length = root(dot(w, w));
            for (int k = 0; k < 3; ++k) w[k] = w[k] / length;
            for (int k = 0; k < 3; ++k) n[k] = u[(k + 1) % 3] * w[(k + 2) % 3] - u[(k + 2) % 3] * w[(k + 1) % 3];
            for (int k = 0; k < 3; ++k) {
                U[3 * k] = u[k];
                U[3 * k + 1] = w[k];
                U[3 * k + 2] = n[k];
            }
            sigma[0] = dot(u, x);
            sigma[1] = dot(w, y);
            sigma[2] = dot(n, z);
        }
        static bool has_rotation(int model) { return model == ARAP || model == COROTATED; }
"""

ENERGY = """
        static lanes invariant_energy(int model, lanes mu, lanes lam, const lanes* E, lanes j1) {
            FUSED
            lanes volume = 0.5 * j1 * j1;
            if (model == COROTATED) return lam * volume;
            lanes distortion = volume - 2.0 * second_invariant(E) - 4.0 * determinant(E);
            if (model == STABLE_NEO_HOOKEAN_LOG) {
                lanes origin = 2.0 / 3.0 * excess_over_log(0.5 * trace(E));
                return mu * (distortion + origin) + (lam + 5.0 / 6.0 * mu) * volume;
            }
            if (model == STABLE_NEO_HOOKEAN) return mu * distortion + (lam + mu) * volume;
            if (model == NEO_HOOKEAN) {
                lanes log = log_of_one_plus(j1);
                lanes psi = mu * (distortion + excess_over_log(j1)) + 0.5 * lam * log * log;
                return j1 <= -1.0 ? (lanes)__builtin_inf() : psi;
            }
            return (lanes)0.0;
        }
"""

DERIVATIVES = """
        struct Derivatives { lanes rest, s, b, p, l; };
        static Derivatives invariant_derivatives(int model, lanes mu, lanes lam, lanes strain, lanes j1) {
            FUSED
            const lanes zero = (lanes)0.0;
            if (model == STABLE_NEO_HOOKEAN_LOG) {
                lanes m = 4.0 / 3.0 * mu, l = lam + 5.0 / 6.0 * mu, c = strain + 4.0;
                lanes rest = l * j1 + mu / 3.0 * strain / c;
                return {rest, m * (1.0 - 1.0 / c), 2.0 * m / (c * c), l * j1 - mu, l};
            }
            if (model == STABLE_NEO_HOOKEAN) {
                lanes l = lam + mu;
                return {l * j1, mu, zero, l * j1 - mu, l};
            }
            if (model == COROTATED) return {lam * j1, zero, zero, lam * j1, lam};
            if (model == NEO_HOOKEAN) {
                lanes d = most(j1, (lanes)(1.0e-9 - 1.0));
                lanes j = 1.0 + d, log = lam * log_of_one_plus(d);
                return {(log + mu * d) / j, mu, zero, (log - mu) / j, (mu + lam - log) / (j * j)};
            }
            return {zero, zero, zero, zero, zero};
        }
        static lanes hooke_lambda(int model, lanes lam) { return model == ARAP ? (lanes)0.0 : lam; }
        static lanes hooke_energy(int model, lanes mu, lanes lam, const lanes* E) {
            FUSED
            lanes t = trace(E);
            return mu * ddot(E, E) + 0.5 * hooke_lambda(model, lam) * t * t;
        }
        static void hooke_stress(int model, lanes mu, lanes lam, const lanes* E, lanes* S) {
            FUSED
            lanes p = hooke_lambda(model, lam) * trace(E);
            for (int k = 0; k < 9; ++k) S[k] = 2.0 * mu * E[k];
            for (int k = 0; k < 9; k += 4) S[k] += p;
        }
        static void stretch_minus_one(const lanes* E, const lanes* sigma, const lanes* V, lanes* X) {
            FUSED
            lanes T[9], strain[9];
            transpose(V, T);
            conjugate(T, E, strain);
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) {
                    if (i != j) X[3 * i + j] = 2.0 * strain[3 * i + j] / most(sigma[i] + sigma[j], (lanes)0.5);
                    else X[4 * i] = sigma[i] > -0.5 ? 2.0 * strain[4 * i] / (sigma[i] + 1.0) : sigma[i] - 1.0;
                }
        }
"""

HESSIAN = """
        static void positive_part(lanes* S) {
            FUSED
            words sound = (S[0] > 0.0) & (S[0] * S[4] - S[1] * S[3] > 0.0) & (determinant(S) > 0.0);
            if (!any(~sound)) return;
            lanes shift = root(ddot(S, S)), A[9], B[9], V[9], D[9], R[9];
            for (int k = 0; k < 9; ++k) {
                A[k] = k % 4 == 0 ? S[k] + shift : S[k];
                D[k] = (lanes)0.0;
            }
            orthogonal_columns(A, B, V);
            for (int k = 0; k < 3; ++k) {
                lanes value = B[k] * V[k] + B[3 + k] * V[3 + k] + B[6 + k] * V[6 + k] - shift;
                D[4 * k] = most(value, (lanes)0.0);
            }
            conjugate(V, D, R);
            for (int k = 0; k < 9; ++k) S[k] = sound ? S[k] : R[k];
        }
        static void principal_hessian(int model, lanes mu, lanes lam, const lanes* G, const lanes* sigma,
                                      lanes* twist, lanes* flip, lanes* S) {
            FUSED
            lanes strain = 2.0 * trace(G) + ddot(G, G), square[3], minor[3];
            for (int k = 0; k < 3; ++k) {
                const int i = (k + 1) % 3, j = (k + 2) % 3;
                square[k] = sigma[i] * sigma[i] + sigma[j] * sigma[j] - 1.0;
                minor[k] = sigma[i] * sigma[j];
            }
            if (model == STVK) {
                lanes mean = 0.5 * lam * strain;
                for (int k = 0; k < 3; ++k) {
                    twist[k] = mu * (square[k] - minor[k]) + mean;
                    flip[k] = mu * (square[k] + minor[k]) + mean;
                    for (int j = 0; j < 3; ++j) S[3 * k + j] = lam * sigma[k] * sigma[j];
                    S[4 * k] += mean + mu * (3.0 * sigma[k] * sigma[k] - 1.0);
                }
                return;
            }
            lanes j1 = trace(G) + second_invariant(G) + determinant(G);
            Derivatives d = invariant_derivatives(model, mu, lam, strain, j1);
            for (int k = 0; k < 3; ++k) {
                const int i = (k + 1) % 3, j = (k + 2) % 3;
                twist[k] = d.s + d.p * sigma[k];
                flip[k] = d.s - d.p * sigma[k];
                for (int m = 0; m < 3; ++m) {
                    S[3 * k + m] = d.b * sigma[k] * sigma[m] + d.l * minor[k] * minor[m];
                    if (m != k) S[3 * k + m] += d.p * sigma[3 - k - m];
                }
                S[4 * k] += d.s;
                if (has_rotation(model)) {
                    twist[k] += mu * (2.0 - 4.0 / most(sigma[i] + sigma[j], (lanes)1.0e-6));
                    flip[k] += 2.0 * mu;
                    S[4 * k] += 2.0 * mu;
                }
            }
        }
        NOINLINE
        static void hessian_of_singular_values(int model, lanes mu, lanes lam, double rate, const lanes* G,
                                               const lanes* F, const lanes* viscous, int project, float* out) {
            FUSED
            lanes U[9], sigma[3], V[9], twist[3], flip[3], S[9], direct[9], exchange[9];
            singular_values(F, U, sigma, V);
            principal_hessian(model, mu, lam, G, sigma, twist, flip, S);
            if (project) {
                positive_part(S);
                for (int k = 0; k < 3; ++k) {
                    twist[k] = most(twist[k], (lanes)0.0);
                    flip[k] = most(flip[k], (lanes)0.0);
                }
            }
            const lanes m = rate * mu, n = rate * hooke_lambda(model, lam);
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) {
                    const int k = 3 - i - j;
                    direct[3 * i + j] = m * sigma[i] * sigma[i];
                    exchange[3 * i + j] = m * sigma[i] * sigma[j];
                    S[3 * i + j] += n * sigma[i] * sigma[j];
                    if (i == j) continue;
                    direct[3 * i + j] += 0.5 * (flip[k] + twist[k]);
                    exchange[3 * i + j] += 0.5 * (flip[k] - twist[k]);
                }
            int row = 0;
            for (int c = 0; c < 3; ++c)
                for (int d = c; d < 3; ++d, ++row) {
                    const lanes *u = U + 3 * c, *w = U + 3 * d;
                    lanes M[9], block[9];
                    for (int a = 0; a < 3; ++a)
                        for (int b = 0; b < 3; ++b)
                            M[3 * a + b] = S[3 * a + b] * u[a] * w[b] + exchange[3 * a + b] * w[a] * u[b];
                    for (int a = 0; a < 3; ++a)
                        for (int k = 0; k < 3; ++k) M[4 * a] += direct[3 * k + a] * u[k] * w[k];
                    conjugate(V, M, block);
                    for (int k = 0; k < 9 && c == d; ++k) block[k] += viscous[k];
                    store(block, out + 9 * 8 * row);
                }
        }
        static void hessian_of_invariants(int model, lanes mu, lanes lam, double rate, const lanes* G, const lanes* F,
                                          const lanes* hooke, float* out) {
            FUSED
            lanes cof[9], B[9], T[9];
            cofactor(F, cof);
            transpose(F, T);
            product(F, T, B);
            lanes strain = 2.0 * trace(G) + ddot(G, G), j1 = trace(G) + second_invariant(G) + determinant(G);
            Derivatives t = invariant_derivatives(model, mu, lam, strain, j1);
            const lanes m = rate * mu, b = t.b + rate * hooke_lambda(model, lam);
            int row = 0;
            for (int c = 0; c < 3; ++c)
                for (int d = c; d < 3; ++d, ++row) {
                    lanes block[9];
                    for (int i = 0; i < 3; ++i)
                        for (int j = 0; j < 3; ++j)
                            block[3 * i + j] = b * F[3 * c + i] * F[3 * d + j] + t.l * cof[3 * c + i] * cof[3 * d + j]
                                + m * F[3 * c + j] * F[3 * d + i];
                    for (int i = 0; i < 3; ++i) block[4 * i] += m * B[3 * c + d] + (c == d ? t.s : (lanes)0.0);
                    for (int k = 0; k < 9 && c == d; ++k) block[k] += hooke[k];
                    if (c != d) {  // p dcof/dF: for the pair (0, 2) the permutation (c, d, e) is odd
                        const lanes p = d - c == 1 ? t.p : -t.p;
                        const lanes* f = F + 3 * (3 - c - d);
                        block[1] += p * f[2];
                        block[2] -= p * f[1];
                        block[3] -= p * f[2];
                        block[5] += p * f[0];
                        block[6] += p * f[1];
                        block[7] -= p * f[0];
                    }
                    store(block, out + 9 * 8 * row);
                }
        }
        static void store(const lanes* block, float* out) {
            typedef float floats __attribute__((ext_vector_type(8)));
            for (int k = 0; k < 9; ++k) {
                floats entry = __builtin_convertvector(block[k], floats);
                __builtin_memcpy(out + 8 * k, &entry, sizeof(entry));
            }
        }
"""


def _snippet(body: str, more: str = "") -> str:
    """Return native code whose functions stand in a local struct, as a function's body has no other place for them."""
    parts = _MATRICES + _LOGARITHM + SINGULAR_VALUES + ENERGY + DERIVATIVES + more + "    };\n" + LOADS
    models = ", ".join(f"{model.name} = {int(model)}" for model in MaterialModel)
    text = f"{{\n    FUSED\n{_TYPES}    struct Eight {{\n        enum Model {{ {models} }};\n{parts}{body}}}"
    return text.replace("FUSED", FUSED).replace("NOINLINE", "__attribute__((noinline))")


LOADS = """
    lanes mu, lam, G[9], E[9], start[9], F[9], before[9], change[9], hooke[9];
    __builtin_memcpy(&mu, &mu_in, sizeof(mu));
    __builtin_memcpy(&lam, &lam_in, sizeof(lam));
    __builtin_memcpy(G, &G_in, sizeof(G));
    __builtin_memcpy(start, &G_start, sizeof(start));
    for (int k = 0; k < 9; ++k) F[k] = k % 4 == 0 ? 1.0 + G[k] : G[k];
    Eight::green_strain(G, E);
    // Hooke's law acts on the strain of STVK and, times the viscosity's rate, on its change in the step
    if (rate > 0.0) Eight::green_strain(start, before);
    for (int k = 0; k < 9; ++k) {
        change[k] = rate > 0.0 ? E[k] - before[k] : (lanes)0.0;
        hooke[k] = rate > 0.0 ? rate * change[k] : (lanes)0.0;
        if (model == Eight::STVK) hooke[k] += E[k];
    }
"""


_POINT = """
    lanes out[11], cof[9], T[9], S[9], *P = out + 1;
    lanes j1 = Eight::trace(G) + Eight::second_invariant(G) + Eight::determinant(G);
    lanes strain = 2.0 * Eight::trace(G) + Eight::ddot(G, G);
    lanes psi = Eight::invariant_energy(model, mu, lam, E, j1);
    Eight::Derivatives t = Eight::invariant_derivatives(model, mu, lam, strain, j1);
    Eight::cofactor(G, cof);
    Eight::transpose(G, T);
    for (int k = 0; k < 9; ++k) P[k] = t.s * G[k] + t.p * (cof[k] - T[k]);
    for (int k = 0; k < 9; k += 4) P[k] += t.rest + t.p * Eight::trace(G);
    if (Eight::has_rotation(model)) {
        lanes U[9], sigma[3], V[9], X[9], half[9], turned[9];
        Eight::singular_values(F, U, sigma, V);
        Eight::stretch_minus_one(E, sigma, V, X);
        psi += mu * Eight::ddot(X, X);
        Eight::product(U, X, half);
        Eight::transpose(V, X);
        Eight::product(half, X, turned);
        for (int k = 0; k < 9; ++k) P[k] += 2.0 * mu * turned[k];
    }
    if (model == Eight::STVK) psi += Eight::hooke_energy(model, mu, lam, E);
    if (rate > 0.0) psi += rate * Eight::hooke_energy(model, mu, lam, change);
    if (rate > 0.0 || model == Eight::STVK) {
        lanes viscous[9];
        Eight::hooke_stress(model, mu, lam, hooke, S);
        Eight::product(F, S, viscous);
        for (int k = 0; k < 9; ++k) P[k] += viscous[k];
    }
    out[0] = psi;
    out[10] = 1.0 + j1;
    wp::mat_t<11, 8, wp::float64> found;
    __builtin_memcpy(&found, out, sizeof(found));
    return found;
"""

_CURVATURE = """
    wp::mat_t<54, 8, float> C;
    float* out = (float*)&C;
    // the stress F S of a strain's S changes by dF S too
    lanes S[9];
    Eight::hooke_stress(model, mu, lam, hooke, S);
    if (project || Eight::has_rotation(model)) {
        for (int k = 0; k < 9; ++k) S[k] = project ? (lanes)0.0 : S[k];
        Eight::hessian_of_singular_values(model, mu, lam, rate, G, F, S, project, out);
    } else {
        Eight::hessian_of_invariants(model, mu, lam, model == Eight::STVK ? rate + 1.0 : rate, G, F, S, out);
    }
    return C;
"""


@wp.func_native(snippet=_snippet(_POINT))
def energy_and_stress(
    model: int, mu_in: vec8d, lam_in: vec8d, rate: wp.float64, G_in: mat98d, G_start: mat98d
) -> PointLanes:  # pyright: ignore[reportReturnType]
    """Return energy density, stress and J at eight points; see ``material_kernels.energy`` and ``stress``.

    Args:
        model: Energy density of all eight.
        mu_in: Lame's mu [Pa].
        lam_in: Lame's lambda [Pa].
        rate: Viscosity over the duration of the step, tau / dt.
        G_in: Displacement gradients F - I at the end of the step.
        G_start: Those at its start; not read where ``rate`` is 0.
    """
    ...


@wp.func_native(snippet=_snippet(_CURVATURE, HESSIAN))
def hessian_lanes(
    model: int, mu_in: vec8d, lam_in: vec8d, rate: wp.float64, G_in: mat98d, G_start: mat98d, project: int
) -> HessianLanes:  # pyright: ignore[reportReturnType]
    """Return the Hessian at eight points; see ``hessian_kernels.hessian``, and ``energy_and_stress`` for arguments."""
    ...
