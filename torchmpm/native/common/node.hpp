// One node: from its mass and momentum to its velocity, with gravity, damping and velocity rules.
#pragma once
#include "scalar.hpp"

struct Rule {
    int axis;
    Real sign;
    double range[2][2];  // inclusive nodes in x and y
    Real friction;       // infinite: sticks
    bool world;
    int slot;
};

// A node remembers its rules in one byte per slot, 0 for none, else the index of the rule plus one.
constexpr int SLOTS = 4;

INLINE int rule_in(uint32_t code, int slot) { return int(code >> 8 * slot & 255) - 1; }

INLINE Real inverse_mass(Real mass, Real epsilon) { return 1 / (mass + epsilon); }

// One component; `gain` is what gravity adds in a substep.
INLINE Real node_velocity(Real momentum, Real inverse, Real gain, Real damping) {
    return (momentum * inverse + gain) * damping;
}

INLINE bool acts(const Rule& rule, Real normal) { return rule.sign > 0 ? normal > 0 : normal < 0; }

INLINE void constrain(const Rule& rule, Real& normal, Real& tangent) {
    if (!acts(rule, normal)) return;
    if (math::isinf(rule.friction))
        tangent = 0;
    else if (rule.friction != 0)
        tangent = math::copysign(at_least(math::fabs(tangent) - rule.friction * math::fabs(normal), 0), tangent);
    normal = 0;
}

// Velocity of a node under one rule, without an address that depends on the axis.
INLINE void constrain(const Rule& rule, Real (&v)[2]) {
    if (rule.axis == 0)
        constrain(rule, v[0], v[1]);
    else
        constrain(rule, v[1], v[0]);
}

// And under all of its rules.
template <class Rules> INLINE void constrain(const Rules& rules, uint32_t code, Real (&v)[2]) {
    for (; code; code >>= 8)
        if (code & 255) constrain(rules[(code & 255) - 1], v);
}
