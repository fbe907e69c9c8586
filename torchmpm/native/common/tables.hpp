// What is constant about a solver, as torchmpm/native/tables.py lays it out and documents it.
#pragma once
#include "material.hpp"

// Components of a particle's state.
enum Component : int { X = 0, Y, VX, VY, C0, C1, C2, C3, F0, F1, F2, F3, JP, COMPONENTS };

struct BodyTable {
    int64_t first, count, kind, muscle, varying, column;
    double hardening_low, hardening_high, shear_cutoff, resolved_rate;

    INLINE Bounds bounds(Real stretch_floor) const {
        return {Real(hardening_low), Real(hardening_high), Real(shear_cutoff), Real(resolved_rate), stretch_floor};
    }
};

struct RuleTable {
    int64_t axis, world, slot;
    double sign, i_low, i_high, j_low, j_high, friction;
};
