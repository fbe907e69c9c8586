// Mass and momentum of nodes as integers, whose sums do not depend on the order of additions: results are the same bit
// for bit in every run. Shared memory adds integers of 32 bits natively, while floating-point numbers take a loop of
// compare-and-swap there; global memory adds integers of 64 bits as fast as any.
//
// The unit of mass follows the heaviest node, and the unit of momentum the fastest particle, both of the substep
// before. With V at least the speed that a particle lends to any of its nodes, |w q| / unit of momentum <= w m / unit
// of mass: where the mass of a node is rounded to nothing, so is its momentum, and no velocity is larger than V.
// Particles that are faster than this range are not added, see Substep::scatter.
#pragma once
#include "machine.cuh"

constexpr bool WIDE = sizeof(Real) == 8 || !TORCHMPM_SHARED;  // 64 bits
template <bool wide> struct FixedOf {
    using type = int32_t;
};
template <> struct FixedOf<true> {
    using type = int64_t;
};
using Fixed = FixedOf<WIDE>::type;

// A node holds up to 2^RANGE units of mass. Weights of a particle in the outermost half cell are negative for some
// nodes, which takes the remaining bit.
constexpr int RANGE = WIDE ? 62 : 30;
// How much faster the fastest particle and heavier the heaviest node may become within a substep. What leaves the range
// in shared memory starts again in global memory. There, what becomes faster than that counts as not finite: from rest,
// that is more than a cell per substep.
constexpr Real FASTER = TORCHMPM_SHARED ? Real(2) : sizeof(Real) == 8 ? Real(64) : Real(1 << 20);
constexpr Real HEAVIER = TORCHMPM_SHARED ? Real(1.5) : sizeof(Real) == 8 ? Real(2) : Real(16);
// As many particles as a node may have before anything is known about it.
constexpr Real CROWD = WIDE ? Real(1 << 30) : Real(1 << 12);
// The least range of speeds: so many cells per substep.
constexpr Real SLOWEST = Real(1) / 64;

struct Scale {
    Real mass, momentum;            // units in one
    Real mass_unit, momentum_unit;  // their inverses
    Real fastest;                   // largest speed
};

INLINE Scale scale_of(Real fastest, Real heaviest, Real cells_per_substep) {
    constexpr Real range = Real(int64_t(1) << RANGE);
    fastest = FASTER * at_least(fastest, SLOWEST * cells_per_substep);
    heaviest = heaviest > 0 ? HEAVIER * heaviest : Real(1);
    const Real impulse = heaviest * fastest;
    return {range / heaviest, range / impulse, heaviest / range, impulse / range, fastest};
}

// To find the heaviest node and the fastest particle before the first substep; gives no momentum.
INLINE Scale survey_scale(Real heaviest_particle) {
    constexpr Real range = Real(int64_t(1) << RANGE);
    const Real crowd = CROWD * (heaviest_particle > 0 ? heaviest_particle : Real(1));
    return {range / crowd, 0, crowd / range, 0, Bits::largest};
}

INLINE Fixed fixed(Real value) {
    Fixed result;
    round_to(value, result);
    return result;
}

// Numbers that are not negative as integers in the same order, rounded up.
INLINE int rank_of(Real value) {
    const float single = sizeof(Real) == 4 ? float(value) : float(value) * 1.0000002f;
    return __builtin_bit_cast(int, single);
}
INLINE Real value_of(int rank) { return Real(__builtin_bit_cast(float, rank)); }
