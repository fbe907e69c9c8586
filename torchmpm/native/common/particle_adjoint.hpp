// Adjoint of what a particle does in a substep.
#pragma once
#include "material_adjoint.hpp"
#include "particle.hpp"
#include "stencil.hpp"

struct DeformedBar {
    Mat2 C, F;  // derivatives in C and F before the substep
    Real Jp;
    Mat2 affine;  // the affine momentum itself
    MaterialBar material;
};

// Adjoint of `deform`, from the derivatives in its results.
template <Kind kind> INLINE DeformedBar deform_adjoint(Real dt, const Values& m, const Bounds& bounds, Mat2 C, Mat2 F,
                                                       Real Jp, Real act_x, Real act_y, Mat2 affine_bar, Mat2 F_bar,
                                                       Real Jp_bar) {
    const Mat2 grown = growth(dt, C), trial = matmul(grown, F);
    Sym2 S;
    const MaterialBar out =
        material_adjoint<kind>(m, bounds, trial, Jp, act_x, act_y,
                               {affine_bar.a, affine_bar.b + affine_bar.c, affine_bar.d}, F_bar, Jp_bar, S);
    return {m.mass * affine_bar + dt * matmul(F_bar, transposed(F)),
            matmul(transposed(grown), F_bar),
            Jp_bar,
            {S.xx + m.mass * C.a, S.xy + m.mass * C.b, S.xy + m.mass * C.c, S.yy + m.mass * C.d},
            out};
}

// Snow that moves faster than a substep resolves passes no derivative on, see Snow in torchmpm/materials/snow.py.
INLINE bool unresolved(const Bounds& bounds, Mat2 C) {
    return square(C.a) + square(C.b) + square(C.c) + square(C.d) > square(LARGEST_STRAIN * bounds.resolved_rate);
}

// Factors of what a particle reads from the nodes and gives to them, for the derivative in its position.
struct PositionFactors {
    Real mass, mvx, mvy;  // mass and momentum
    Real vx_bar, vy_bar;  // derivatives in the velocity that it reads, with that of the position
    Mat2 C_bar, affine;   // derivative in the affine matrix that it reads, affine momentum; both per cell
    Real act_x, act_y;    // derivatives in the actuation
};

struct PositionBar {
    Real fx, fy;  // derivatives in the distances from the first node
    Real mass;    // sum of the weighted derivatives in the masses of the nodes
};

// Through all weights and offsets of a substep. `velocity`, `momentum_bar` and `field` are called with (p, q, c) for
// number c of node (p, q), `mass_bar` with (p, q).
template <bool muscles, class WeightX, class WeightY, class Velocity, class MomentumBar, class MassBar, class Field>
INLINE PositionBar position_adjoint(Real fx, Real fy, WeightX wx, WeightY wy, const PositionFactors& f,
                                    Velocity velocity, MomentumBar momentum_bar, MassBar mass_bar, Field field) {
    PositionBar sum = {0, 0, 0};
    three([&](int p) {
        Real row = 0, row_slope = 0, row_x = 0, row_y = 0, row_mass = 0;
        three([&](int q) {
            const Real vx = velocity(p, q, 0), vy = velocity(p, q, 1);
            const Real px = momentum_bar(p, q, 0), py = momentum_bar(p, q, 1), m = mass_bar(p, q);
            Real value = f.vx_bar * vx + f.vy_bar * vy + f.mass * m + f.mvx * px + f.mvy * py;
            if (muscles) value += f.act_x * field(p, q, 0) + f.act_y * field(p, q, 1);
            const Real along_x = f.C_bar.a * vx + f.C_bar.c * vy + f.affine.a * px + f.affine.c * py;
            const Real along_y = f.C_bar.b * vx + f.C_bar.d * vy + f.affine.b * px + f.affine.d * py;
            value += (p - fx) * along_x + (q - fy) * along_y;
            const Real w = wy(q);
            row += w * value, row_slope += weight_slope(fy, q) * value;
            row_x += w * along_x, row_y += w * along_y, row_mass += w * m;
        });
        const Real w = wx(p);
        sum.fx += weight_slope(fx, p) * row - w * row_x;
        sum.fy += w * (row_slope - row_y);
        sum.mass += w * row_mass;
    });
    return sum;
}
