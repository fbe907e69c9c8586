// What a particle does in a substep: it deforms, and gives mass and momentum to the nodes.
#pragma once
#include "material.hpp"

// I + dt C
INLINE Mat2 growth(Real dt, Mat2 C) { return {1 + dt * C.a, dt * C.b, dt * C.c, 1 + dt * C.d}; }

// Turns F and Jp into those after a substep, and returns the Kirchhoff stress.
template <Kind kind>
INLINE Sym2 deform(Real dt, const Values& m, const Bounds& bounds, Mat2 C, Real act_x, Real act_y, Mat2& F, Real& Jp) {
    const Real hard = hardening_factor<kind>(m, bounds, Jp);
    F = matmul(growth(dt, C), F);
    const Direction R = return_map<kind>(m, bounds, F, Jp);
    return stress<kind>(m, hard, F, R, act_x, act_y);
}

// An entry of the affine momentum that a particle gives to the nodes, -dt V 4/h^2 tau + m C.
INLINE Real affine_momentum(const Values& m, Real tau, Real C) { return m.factor * tau + m.mass * C; }
