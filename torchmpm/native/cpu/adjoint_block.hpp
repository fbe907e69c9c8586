// Adjoint of what a block of particles does in a substep.
#pragma once
#include "../common/particle_adjoint.hpp"
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
            const Moments m = gather(
                at.fx[k], at.fy[k], [&](int p) INLINE_LAMBDA { return at.wx[p][k]; },
                [&](int q) INLINE_LAMBDA { return at.wy[q][k]; },
                [&](int p, int q, int c) INLINE_LAMBDA { return p_bar.v[3 * p + q][c][k]; });
            v_bar[0][k] = m.value[0], v_bar[1][k] = m.value[1];
            affine_bar[0][k] = h * m.slope_x[0], affine_bar[1][k] = h * m.slope_y[0];
            affine_bar[2][k] = h * m.slope_x[1], affine_bar[3][k] = h * m.slope_y[1];
        }
    }
};

// Adjoint of deform_one. Turns the derivatives in F and Jp after the substep into those before it; keeps in `momentum`
// what the derivatives in the other components need.
template <Kind kind, bool wants_values>
INLINE void deform_adjoint_one(Real dt, Values m, Bounds bounds, bool on, Real act_x, Real act_y, int k,
                               const Block& state, Momentum& momentum, Block& bar, Real* values_bar) {
    const Mat2 C = matrix(state, C0, k), old_F_bar = matrix(bar, F0, k);
    const Mat2 P_bar{momentum.affine_bar[0][k], momentum.affine_bar[1][k], momentum.affine_bar[2][k],
                     momentum.affine_bar[3][k]};
    const Real old_Jp_bar = bar.v[JP][k];
    const DeformedBar out = deform_adjoint<kind>(dt, m, bounds, C, matrix(state, F0, k), state.v[JP][k], act_x, act_y,
                                                 P_bar, old_F_bar, old_Jp_bar);
    momentum.mass[k] = m.mass;
    momentum.affine[0][k] = out.affine.a, momentum.affine[1][k] = out.affine.b;
    momentum.affine[2][k] = out.affine.c, momentum.affine[3][k] = out.affine.d;
    momentum.C_bar[0][k] = out.C.a, momentum.C_bar[1][k] = out.C.b;
    momentum.C_bar[2][k] = out.C.c, momentum.C_bar[3][k] = out.C.d;
    momentum.act_bar[0][k] = on ? out.material.act_x : 0, momentum.act_bar[1][k] = on ? out.material.act_y : 0;
    bar.v[F0][k] = on ? out.F.a : old_F_bar.a, bar.v[F1][k] = on ? out.F.b : old_F_bar.b;
    bar.v[F2][k] = on ? out.F.c : old_F_bar.c, bar.v[F3][k] = on ? out.F.d : old_F_bar.d;
    if (kind == Kind::snow) bar.v[JP][k] = on ? out.Jp : old_Jp_bar;
    if (!wants_values) return;
    const Real mass_bar = state.v[VX][k] * momentum.v_bar[0][k] + state.v[VY][k] * momentum.v_bar[1][k] +
                          P_bar.a * C.a + P_bar.b * C.b + P_bar.c * C.c + P_bar.d * C.d;
    const Values& of = out.material.values;
    values_bar[k] += on ? mass_bar : 0;
    values_bar[LANES + k] += on ? of.factor : 0;
    values_bar[2 * LANES + k] += on ? of.mu2 : 0;
    values_bar[3 * LANES + k] += on ? of.lam : 0;
    values_bar[4 * LANES + k] += on ? of.tanh2 : 0;
    values_bar[5 * LANES + k] += on ? of.exp : 0;
    values_bar[6 * LANES + k] += on ? of.cosh2 : 0;
    values_bar[7 * LANES + k] += on ? of.sinh2 : 0;
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
        const Real mass = momentum.mass[k], scale = 4 * inverse_h;
        const PositionFactors factors{
            mass,
            mass * state.v[VX][k],
            mass * state.v[VY][k],
            bar.v[VX][k] + dt * bar.v[X][k],
            bar.v[VY][k] + dt * bar.v[Y][k],
            {scale * bar.v[C0][k], scale * bar.v[C1][k], scale * bar.v[C2][k], scale * bar.v[C3][k]},
            {h * momentum.affine[0][k], h * momentum.affine[1][k], h * momentum.affine[2][k], h * momentum.affine[3][k]},
            momentum.act_bar[0][k],
            momentum.act_bar[1][k]};
        const PositionBar sum = ::position_adjoint<muscles>(
            at.fx[k], at.fy[k], [&](int p) INLINE_LAMBDA { return at.wx[p][k]; },
            [&](int q) INLINE_LAMBDA { return at.wy[q][k]; }, factors,
            [&](int p, int q, int c) INLINE_LAMBDA { return velocity.v[3 * p + q][c][k]; },
            [&](int p, int q, int c) INLINE_LAMBDA { return p_bar.v[3 * p + q][c][k]; },
            [&](int p, int q) INLINE_LAMBDA { return mass_bar.v[3 * p + q][k]; },
            [&](int p, int q, int c) INLINE_LAMBDA { return field.v[3 * p + q][c][k]; });
        const bool on = at.on[k] != 0;
        const Real x_bar = on ? sum.fx * inverse_h : 0, y_bar = on ? sum.fy * inverse_h : 0;
        bar.v[X][k] += x_bar, bar.v[Y][k] += y_bar;
        origin_bar[k] -= x_bar, origin_bar[LANES + k] -= y_bar;
        bar.v[VX][k] = on ? mass * momentum.v_bar[0][k] : bar.v[VX][k];
        bar.v[VY][k] = on ? mass * momentum.v_bar[1][k] : bar.v[VY][k];
        for (int c = 0; c < 4; ++c) bar.v[C0 + c][k] = on ? momentum.C_bar[c][k] : bar.v[C0 + c][k];
        if (mass_values_bar) mass_values_bar[k] += on ? sum.mass : 0;
    }
}

PASS void drop_unresolved(Bounds bounds, const Block& state, Block& bar) {
#pragma omp simd
    for (int k = 0; k < LANES; ++k) {
        const bool drop = unresolved(bounds, matrix(state, C0, k));
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
