// Adjoint of node.hpp.
#pragma once
#include "node.hpp"

// Turns the derivatives in the velocity after a rule into those in the velocity before it.
INLINE void constrain_adjoint(const Wall& wall, Real normal, Real tangent, Real& normal_bar, Real& tangent_bar) {
    if (!acts(wall, normal)) return;
    normal_bar = 0;
    if (math::isinf(wall.friction)) {
        tangent_bar = 0;
    } else if (wall.friction != 0) {
        const bool slides = math::fabs(tangent) - wall.friction * math::fabs(normal) >= 0;
        const Real drag = (tangent > 0) == (normal > 0) ? -wall.friction * tangent_bar : wall.friction * tangent_bar;
        if (slides) normal_bar = drag;
        if (!slides) tangent_bar = 0;
    }
}

INLINE void constrain_adjoint(const Wall& wall, const Real (&v)[2], Real (&bar)[2]) {
    if (wall.axis == 0)
        constrain_adjoint(wall, v[0], v[1], bar[0], bar[1]);
    else
        constrain_adjoint(wall, v[1], v[0], bar[1], bar[0]);
}

// All rules of a node: `v` becomes the velocity after them, `bar` the derivative in the velocity before them.
template <class Walls> INLINE void constrain_adjoint(const Walls& walls, uint32_t code, Real (&v)[2], Real (&bar)[2]) {
    Real before[SLOTS][2];
    for (int slot = 0; slot < SLOTS; ++slot) {
        before[slot][0] = v[0], before[slot][1] = v[1];
        if (const int rule = rule_in(code, slot); rule >= 0) constrain(walls[rule], v);
    }
    for (int slot = SLOTS - 1; slot >= 0; --slot)
        if (const int rule = rule_in(code, slot); rule >= 0) constrain_adjoint(walls[rule], before[slot], bar);
}

// Derivatives in what a node sums up.
struct NodeBar {
    Real momentum[2], mass;
};

// `velocity_bar` is the derivative in the velocity before the rules, but with damping; `raw` is that before gravity.
INLINE NodeBar node_adjoint(const Real (&velocity_bar)[2], const Real (&raw)[2], Real inverse) {
    const Real x = velocity_bar[0] * inverse, y = velocity_bar[1] * inverse;
    return {{x, y}, -(raw[0] * x + raw[1] * y)};
}
