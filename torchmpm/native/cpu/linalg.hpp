// 2x2 matrices as the sum of a scaled rotation and a scaled reflection, see torchmpm/materials/linalg.py.
#pragma once
#include "simd.hpp"

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

// The larger of the two parts as (m1, m2), the smaller as (n1, n2); `proper` if the larger one is the rotation.
struct Parts {
    Real m1, m2, n1, n2;
    bool proper;
};

INLINE Parts split(Mat2 F, bool proper) {
    const Real p = F.a + F.d, q = F.c - F.b, r = F.a - F.d, s = F.b + F.c;
    return {proper ? p : r, proper ? q : s, proper ? r : p, proper ? s : q, proper};
}

INLINE Parts split(Mat2 F) {
    const Real rotation = square(F.a + F.d) + square(F.c - F.b), reflection = square(F.a - F.d) + square(F.b + F.c);
    return split(F, rotation >= reflection);
}

// Twice the inverse of split, which is also its adjoint.
INLINE Mat2 join(Parts v) {
    const Real p = v.proper ? v.m1 : v.n1, q = v.proper ? v.m2 : v.n2;
    const Real r = v.proper ? v.n1 : v.m1, s = v.proper ? v.n2 : v.m2;
    return {p + r, s - q, q + s, p - r};
}

// Length and direction of the larger part: the sum of the singular values, and the orthogonal factor R of F = R S.
struct Direction {
    Real total, inverse, cos, sin;  // inverse is one over the total, and 1 for F = 0
    bool proper, empty;
};

INLINE Direction direction(Parts v) {
    const Real length2 = square(v.m1) + square(v.m2);
    const bool empty = length2 == 0;
    const Real total = std::sqrt(empty ? Real(1) : length2), inverse = 1 / total;
    return {empty ? Real(0) : total, inverse, empty ? Real(1) : v.m1 * inverse, v.m2 * inverse, v.proper, empty};
}

INLINE Mat2 orthogonal(Direction d) { return join({d.cos, d.sin, 0, 0, d.proper}); }

// Derivatives in a direction, and those in the larger part that follow from them.
struct DirectionBar {
    Real total, cos, sin;
};

INLINE Parts adjoint(Direction d, DirectionBar bar, Real n1, Real n2) {
    const Real turn = (d.sin * bar.cos - d.cos * bar.sin) * d.inverse;
    const Real m1 = d.sin * turn + bar.total * d.cos, m2 = bar.total * d.sin - d.cos * turn;
    return {d.empty ? Real(0) : m1, d.empty ? bar.sin : m2, n1, n2, d.proper};
}
