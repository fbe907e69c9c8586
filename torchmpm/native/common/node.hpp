// One node: from its mass and momentum to its velocity, with gravity, damping and velocity rules.
#pragma once
#include "scalar.hpp"

// What a velocity rule does.
struct Wall {
    int axis;
    Real sign;
    Real friction;  // infinite: sticks
};

// A node remembers its rules in one byte per slot, 0 for none, else the index of the rule plus one.
constexpr int SLOTS = 4;

INLINE int rule_in(uint32_t code, int slot) { return int(code >> 8 * slot & 255) - 1; }

INLINE Real inverse_mass(Real mass, Real epsilon) { return 1 / (mass + epsilon); }

// One component; `gain` is what gravity adds in a substep.
INLINE Real node_velocity(Real momentum, Real inverse, Real gain, Real damping) {
    return (momentum * inverse + gain) * damping;
}

INLINE bool acts(const Wall& wall, Real normal) { return wall.sign > 0 ? normal > 0 : normal < 0; }

INLINE void constrain(const Wall& wall, Real& normal, Real& tangent) {
    if (!acts(wall, normal)) return;
    if (math::isinf(wall.friction))
        tangent = 0;
    else if (wall.friction != 0)
        tangent = math::copysign(at_least(math::fabs(tangent) - wall.friction * math::fabs(normal), 0), tangent);
    normal = 0;
}

// Velocity of a node under one rule, without an address that depends on the axis.
INLINE void constrain(const Wall& wall, Real (&v)[2]) {
    if (wall.axis == 0)
        constrain(wall, v[0], v[1]);
    else
        constrain(wall, v[1], v[0]);
}

// And under all of its rules.
template <class Walls> INLINE void constrain(const Walls& walls, uint32_t code, Real (&v)[2]) {
    for (; code; code >>= 8)
        if (code & 255) constrain(walls[(code & 255) - 1], v);
}
