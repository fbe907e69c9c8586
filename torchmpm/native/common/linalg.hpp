// 2x2 matrices as the sum of a scaled rotation and a scaled reflection, see torchmpm/materials/linalg.py.
#pragma once
#include "scalar.hpp"

struct Mat2 {
    Real a, b, c, d;  // row by row
};

INLINE Mat2 operator+(Mat2 m, Mat2 n) { return {m.a + n.a, m.b + n.b, m.c + n.c, m.d + n.d}; }
INLINE Mat2 operator*(Real s, Mat2 m) { return {s * m.a, s * m.b, s * m.c, s * m.d}; }
INLINE Mat2 select(bool condition, Mat2 m, Mat2 n) {
    return {condition ? m.a : n.a, condition ? m.b : n.b, condition ? m.c : n.c, condition ? m.d : n.d};
}
INLINE Mat2 matmul(Mat2 m, Mat2 n) {
    return {m.a * n.a + m.b * n.c, m.a * n.b + m.b * n.d, m.c * n.a + m.d * n.c, m.c * n.b + m.d * n.d};
}
INLINE Mat2 transposed(Mat2 m) { return {m.a, m.c, m.b, m.d}; }
INLINE Real det(Mat2 m) { return m.a * m.d - m.b * m.c; }

// The larger of the two parts as (m1, m2), the smaller as (n1, n2); `sign` is 1 if the larger one is the rotation, else
// -1. A factor costs less than choosing each number.
struct PolarParts {
    Real m1, m2, n1, n2, sign;
};

INLINE PolarParts polar_parts(Mat2 F, Real sign) {
    return {F.a + sign * F.d, F.c - sign * F.b, F.a - sign * F.d, F.c + sign * F.b, sign};
}

INLINE PolarParts polar_parts(Mat2 F) {
    const Real rotation = square(F.a + F.d) + square(F.c - F.b), reflection = square(F.a - F.d) + square(F.b + F.c);
    return polar_parts(F, rotation >= reflection ? Real(1) : Real(-1));
}

// Twice the inverse of polar_parts, which is also its adjoint.
INLINE Mat2 from_polar_parts(PolarParts v) { return {v.m1 + v.n1, v.sign * (v.n2 - v.m2), v.m2 + v.n2, v.sign * (v.m1 - v.n1)}; }

// Length and direction of the larger part: the sum of the singular values, and the orthogonal factor R of F = R S.
struct Direction {
    Real total, inverse, cos, sin;  // inverse is one over the total, and 1 for F = 0
    Real sign;
    bool empty;
};

INLINE Direction direction(PolarParts v) {
    const Real length2 = square(v.m1) + square(v.m2);
    const bool empty = length2 == 0;
    const Real total = math::sqrt(empty ? Real(1) : length2), inverse = 1 / total;
    return {empty ? Real(0) : total, inverse, empty ? Real(1) : v.m1 * inverse, v.m2 * inverse, v.sign, empty};
}

INLINE Mat2 orthogonal(Direction d) { return from_polar_parts({d.cos, d.sin, 0, 0, d.sign}); }

// Derivatives in a direction, and those in the larger part that follow from them.
struct DirectionBar {
    Real total, cos, sin;
};

INLINE PolarParts adjoint(Direction d, DirectionBar bar, Real n1, Real n2) {
    const Real turn = (d.sin * bar.cos - d.cos * bar.sin) * d.inverse;
    const Real m1 = d.sin * turn + bar.total * d.cos, m2 = bar.total * d.sin - d.cos * turn;
    return {d.empty ? Real(0) : m1, d.empty ? bar.sin : m2, n1, n2, d.sign};
}
