// Adjoint of what a block of particles does in a substep.
#pragma once
#include "material_adjoint.hpp"
#include "step.hpp"

// Two numbers of each of the nine nodes around a block's particles; node (p, q) is number 3 p + q.
struct alignas(64) Nodes {
    Real v[9][2][LANES];

    PASS_MEMBER void read(const Scene& scene, const Stencil& at, const Real* grid) {
        for (int k = 0; k < LANES; k += 8)
            read_eight(scene, at, k, grid, [&](int p, const Real8(&row)[8]) {
                for (int n = 0; n < 6; ++n) put(row[n], &v[3 * p + n / 2][n % 2][k]);
            });
    }
};

// Muscle actuation from the nodes that were read.
PASS void actuation_from_nodes(const Nodes& field, const Stencil& at, Actuation& out) {
#pragma omp simd
    for (int k = 0; k < LANES; ++k) {
        Real sum[2] = {0, 0};
        three([&](int p) {
            for (int c = 0; c < 2; ++c)
                sum[c] += at.wx[p][k] * (at.wy[0][k] * field.v[3 * p][c][k] + at.wy[1][k] * field.v[3 * p + 1][c][k] +
                                         at.wy[2][k] * field.v[3 * p + 2][c][k]);
        });
        out.x[k] = sum[0], out.y[k] = sum[1];
    }
}

// One number of each of the nine nodes.
struct alignas(64) Masses {
    Real v[9][LANES];

    PASS_MEMBER void read(const Scene& scene, const Stencil& at, const Real* grid) {
        for (int k = 0; k < LANES; k += 4)
            three([&](int p) {
                Real4 row[4];
                for (int l = 0; l < 4; ++l)
                    row[l] = *reinterpret_cast<const Row4*>(grid + at.node[k + l] + p * scene.width);
                transpose(row);
                for (int q = 0; q < 3; ++q) *reinterpret_cast<Real4*>(&v[3 * p + q][k]) = row[q];
            });
    }
};

// Derivatives in the momentum that a block's particles gave to the nodes, and what follows from them.
struct alignas(64) Momentum {
    Real mass[LANES];
    Real v_bar[2][LANES];       // sum w p_bar: derivative in m v
    Real affine_bar[4][LANES];  // derivative in the affine momentum
    Real affine[4][LANES];      // the affine momentum itself
    Real C_bar[4][LANES];       // derivative in the affine matrix before the substep
    Real act_bar[2][LANES];    // derivative in the muscle actuation, zero for particles that take no part

    PASS_MEMBER void collect(const Scene& scene, const Nodes& p_bar, const Stencil& at) {
        const Real h = scene.h;
#pragma omp simd
        for (int k = 0; k < LANES; ++k) {
            Real v[2] = {0, 0}, slope_x[2] = {0, 0}, slope_y[2] = {0, 0};
            three([&](int p) {
                Real across[2] = {0, 0}, tilt[2] = {0, 0};
                three([&](int q) {
                    const Real w = at.wy[q][k], d = w * (q - at.fy[k]);
                    for (int c = 0; c < 2; ++c) {
                        across[c] += w * p_bar.v[3 * p + q][c][k];
                        tilt[c] += d * p_bar.v[3 * p + q][c][k];
                    }
                });
                const Real w = at.wx[p][k], d = w * (p - at.fx[k]);
                for (int c = 0; c < 2; ++c) {
                    v[c] += w * across[c], slope_x[c] += d * across[c], slope_y[c] += w * tilt[c];
                }
            });
            v_bar[0][k] = v[0], v_bar[1][k] = v[1];
            affine_bar[0][k] = h * slope_x[0], affine_bar[1][k] = h * slope_y[0];
            affine_bar[2][k] = h * slope_x[1], affine_bar[3][k] = h * slope_y[1];
        }
    }
};

// Adjoint of deform_one. Turns the derivatives in F and Jp after the substep into those before it; keeps in `momentum`
// what the derivatives in the other components need.
template <Kind kind, bool wants_values>
INLINE void deform_adjoint_one(Real dt, Values m, Bounds bounds, bool on, Real act_x, Real act_y, int k,
                               const Block& state, Momentum& momentum, Block& bar, Real* values_bar) {
    const Mat2 C = matrix(state, C0, k), F = matrix(state, F0, k), grown = growth(dt, C), trial = matmul(grown, F);
    const Mat2 P_bar{momentum.affine_bar[0][k], momentum.affine_bar[1][k], momentum.affine_bar[2][k],
                     momentum.affine_bar[3][k]};
    const Real old_Jp_bar = bar.v[JP][k];
    const Mat2 old_F_bar = matrix(bar, F0, k);
    Mat2 F_bar = old_F_bar;
    Real Jp_bar = old_Jp_bar;
    Sym2 S;
    const MaterialBar out = material_adjoint<kind>(m, bounds, trial, state.v[JP][k], act_x, act_y,
                                                   {P_bar.a, P_bar.b + P_bar.c, P_bar.d}, F_bar, Jp_bar, S);
    const Mat2 C_bar = m.mass * P_bar + dt * matmul(F_bar, transposed(F));
    F_bar = matmul(transposed(grown), F_bar);
    momentum.mass[k] = m.mass;
    momentum.affine[0][k] = S.xx + m.mass * C.a, momentum.affine[1][k] = S.xy + m.mass * C.b;
    momentum.affine[2][k] = S.xy + m.mass * C.c, momentum.affine[3][k] = S.yy + m.mass * C.d;
    momentum.C_bar[0][k] = C_bar.a, momentum.C_bar[1][k] = C_bar.b;
    momentum.C_bar[2][k] = C_bar.c, momentum.C_bar[3][k] = C_bar.d;
    momentum.act_bar[0][k] = on ? out.act_x : 0, momentum.act_bar[1][k] = on ? out.act_y : 0;
    bar.v[F0][k] = on ? F_bar.a : old_F_bar.a, bar.v[F1][k] = on ? F_bar.b : old_F_bar.b;
    bar.v[F2][k] = on ? F_bar.c : old_F_bar.c, bar.v[F3][k] = on ? F_bar.d : old_F_bar.d;
    if (kind == Kind::snow) bar.v[JP][k] = on ? Jp_bar : old_Jp_bar;
    if (!wants_values) return;
    const Real mass_bar = state.v[VX][k] * momentum.v_bar[0][k] + state.v[VY][k] * momentum.v_bar[1][k] +
                          P_bar.a * C.a + P_bar.b * C.b + P_bar.c * C.c + P_bar.d * C.d;
    values_bar[k] += on ? mass_bar : 0;
    values_bar[LANES + k] += on ? out.values.factor : 0;
    values_bar[2 * LANES + k] += on ? out.values.mu2 : 0;
    values_bar[3 * LANES + k] += on ? out.values.lam : 0;
    values_bar[4 * LANES + k] += on ? out.values.tanh2 : 0;
    values_bar[5 * LANES + k] += on ? out.values.exp : 0;
    values_bar[6 * LANES + k] += on ? out.values.cosh2 : 0;
    values_bar[7 * LANES + k] += on ? out.values.sinh2 : 0;
}

template <Kind kind, bool varying, bool wants_values>
void deform_adjoint(const Scene& scene, const Real* table, Bounds bounds, const Stencil& at, const Actuation& act,
                    const Block& state, Momentum& momentum, Block& bar, Real* values_bar) {
    const Real dt = scene.dt;
    const Values shared = values_at<false>(table, 0);
#pragma omp simd
    for (int k = 0; k < LANES; ++k)
        deform_adjoint_one<kind, wants_values>(dt, varying ? values_at<true>(table, k) : shared, bounds, at.on[k] != 0,
                                               act.x[k], act.y[k], k, state, momentum, bar, values_bar);
}

INLINE void deform_adjoint(const Scene& scene, const Body& body, const Real* table, const Stencil& at, const Actuation& act,
                           const Block& state, Momentum& momentum, Block& bar, Real* values_bar) {
    using Function = void (*)(const Scene&, const Real*, Bounds, const Stencil&, const Actuation&, const Block&, Momentum&,
                              Block&, Real*);
#define VARIANTS(kind)                                                                     \
    {                                                                                      \
        {deform_adjoint<kind, false, false>, deform_adjoint<kind, false, true>}, {         \
            deform_adjoint<kind, true, false>, deform_adjoint<kind, true, true>            \
        }                                                                                  \
    }
    static constexpr Function table_of[3][2][2] = {VARIANTS(Kind::elastic), VARIANTS(Kind::von_mises),
                                                   VARIANTS(Kind::snow)};
#undef VARIANTS
    table_of[int(body.kind)][body.varying][values_bar != nullptr](scene, table, body.bounds, at, act, state, momentum,
                                                                  bar, values_bar);
}

// Derivative in the positions, through all weights and offsets of a substep; also turns the derivatives in v and C after
// the substep into those before it.
template <bool muscles>
PASS void position_adjoint(const Scene& scene, const Stencil& at, const Nodes& velocity, const Nodes& p_bar,
                           const Masses& mass_bar, const Nodes& field, const Block& state, const Momentum& momentum,
                           Block& bar, Real* origin_bar, Real* mass_values_bar) {
    const Real dt = scene.dt, h = scene.h, inverse_h = scene.inverse_h;
#pragma omp simd
    for (int k = 0; k < LANES; ++k) {
        const Real fx = at.fx[k], fy = at.fy[k], mass = momentum.mass[k];
        const Real vx_bar = bar.v[VX][k] + dt * bar.v[X][k], vy_bar = bar.v[VY][k] + dt * bar.v[Y][k];
        const Real mvx = mass * state.v[VX][k], mvy = mass * state.v[VY][k];
        const Real scale = 4 * inverse_h;
        const Real cxx = scale * bar.v[C0][k], cxy = scale * bar.v[C1][k];
        const Real cyx = scale * bar.v[C2][k], cyy = scale * bar.v[C3][k];
        const Real pxx = h * momentum.affine[0][k], pxy = h * momentum.affine[1][k];
        const Real pyx = h * momentum.affine[2][k], pyy = h * momentum.affine[3][k];
        const Real gx = momentum.act_bar[0][k], gy = momentum.act_bar[1][k];
        Real fx_bar = 0, fy_bar = 0, masses = 0;
        three([&](int p) {
            Real row = 0, row_slope = 0, row_x = 0, row_y = 0, row_mass = 0;
            three([&](int q) {
                const int n = 3 * p + q;
                const Real vx = velocity.v[n][0][k], vy = velocity.v[n][1][k];
                const Real px = p_bar.v[n][0][k], py = p_bar.v[n][1][k], m = mass_bar.v[n][k];
                Real value = vx_bar * vx + vy_bar * vy + mass * m + mvx * px + mvy * py;
                if (muscles) value += gx * field.v[n][0][k] + gy * field.v[n][1][k];
                const Real along_x = cxx * vx + cyx * vy + pxx * px + pyx * py;
                const Real along_y = cxy * vx + cyy * vy + pxy * px + pyy * py;
                value += (p - fx) * along_x + (q - fy) * along_y;
                const Real w = at.wy[q][k];
                row += w * value, row_slope += weight_slope(fy, q) * value;
                row_x += w * along_x, row_y += w * along_y, row_mass += w * m;
            });
            const Real w = at.wx[p][k];
            fx_bar += weight_slope(fx, p) * row - w * row_x;
            fy_bar += w * (row_slope - row_y);
            masses += w * row_mass;
        });
        const bool on = at.on[k] != 0;
        const Real x_bar = on ? fx_bar * inverse_h : 0, y_bar = on ? fy_bar * inverse_h : 0;
        bar.v[X][k] += x_bar, bar.v[Y][k] += y_bar;
        origin_bar[k] -= x_bar, origin_bar[LANES + k] -= y_bar;
        bar.v[VX][k] = on ? mass * momentum.v_bar[0][k] : bar.v[VX][k];
        bar.v[VY][k] = on ? mass * momentum.v_bar[1][k] : bar.v[VY][k];
        for (int c = 0; c < 4; ++c) bar.v[C0 + c][k] = on ? momentum.C_bar[c][k] : bar.v[C0 + c][k];
        if (mass_values_bar) mass_values_bar[k] += on ? masses : 0;
    }
}

// Snow that moves faster than a substep resolves passes no derivative on, see Snow in torchmpm/materials/snow.py.
PASS void drop_unresolved(Bounds bounds, const Block& state, Block& bar) {
    const Real limit = square(LARGEST_STRAIN * bounds.resolved_rate);
#pragma omp simd
    for (int k = 0; k < LANES; ++k) {
        const bool drop = square(state.v[C0][k]) + square(state.v[C1][k]) + square(state.v[C2][k]) +
                              square(state.v[C3][k]) > limit;
        for (int c = 0; c < COMPONENTS; ++c) bar.v[c][k] = drop ? 0 : bar.v[c][k];
    }
}

// Derivatives in the node velocities in the form of an impulse, so that the forward scatter can distribute them.
PASS void velocity_bars(const Scene& scene, const Stencil& at, const Block& bar, Impulse& out) {
    const Real dt = scene.dt, scale = 4 * scene.inverse_h * scene.inverse_h;
#pragma omp simd
    for (int k = 0; k < LANES; ++k) {
        const bool on = at.on[k] != 0;
        out.mass[k] = 0;
        out.vx[k] = on ? bar.v[VX][k] + dt * bar.v[X][k] : 0;
        out.vy[k] = on ? bar.v[VY][k] + dt * bar.v[Y][k] : 0;
        for (int c = 0; c < 4; ++c) out.affine[c][k] = on ? scale * bar.v[C0 + c][k] : 0;
    }
}

// Add the derivatives in the muscle actuation to the nodes of the field.
PASS void scatter_actuation(const Scene& scene, const Momentum& momentum, const Stencil& at, Real* grid) {
    for (int k = 0; k < LANES; k += 8) {
        const Real8 x = eight(momentum.act_bar[0] + k), y = eight(momentum.act_bar[1] + k);
        const Real8 w0 = eight(at.wy[0] + k), w1 = eight(at.wy[1] + k), w2 = eight(at.wy[2] + k);
        Real8 numbers[8] = {w0 * x, w0 * y, w1 * x, w1 * y, w2 * x, w2 * y};
        transpose(numbers);
#pragma GCC unroll 8
        for (int l = 0; l < 8; ++l)
            for (int p = 0; p < 3; ++p) add_pairs<Sums::PAIRS>(scene, at, k + l, p, grid, numbers[l]);
    }
}
