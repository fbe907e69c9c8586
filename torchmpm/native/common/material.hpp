// Return maps and stresses, see torchmpm/materials/ for the formulas and their sources.
#pragma once
#include "linalg.hpp"

enum class Kind : int { elastic = 0, von_mises = 1, snow = 2 };

// One column of the table of values. `factor` is -dt V 4/h^2. With d the difference of the principal logarithmic strains
// at yield, `tanh2` is tanh(d/2)^2, `exp` e^d, `cosh2` 2 cosh(d/2) and `sinh2` 2 sinh(d/2), see YieldSurface in
// von_mises.py. Snow keeps its own values in three of these.
struct Values {
    Real mass, factor, mu2, lam, tanh2, exp, cosh2, sinh2;

    INLINE Real& low() { return tanh2; }
    INLINE Real& high() { return exp; }
    INLINE Real& hardening() { return cosh2; }
    INLINE Real low() const { return tanh2; }
    INLINE Real high() const { return exp; }
    INLINE Real hardening() const { return cosh2; }
};
constexpr int VALUES = 8;
constexpr Real LARGEST_JP = Real(1e30);      // as in snow.py
constexpr Real LARGEST_STRAIN = Real(0.03);  // as in snow.py

struct Bounds {
    Real hardening_low, hardening_high, shear_cutoff, resolved_rate, stretch_floor;
};

struct Sym2 {
    Real xx, xy, yy;
};

// Each turns the trial deformation gradient into the returned one in place, and returns the direction of R, the same for
// both.
INLINE Direction elastic_return(const Mat2& F) { return direction(polar_parts(F)); }

INLINE Direction von_mises_return(const Values& m, Bounds bounds, Mat2& F) {
    const PolarParts v = polar_parts(F);
    const Direction R = direction(v);
    const Real large = square(v.m1) + square(v.m2), small = square(v.n1) + square(v.n2);
    const bool outside = small > m.tanh2 * large;
    const Real difference = math::sqrt(small);  // may be zero where the particle does not yield
    const Real major = at_least(Real(0.5) * (R.total + difference), bounds.stretch_floor);
    const Real minor = at_least(Real(0.5) * (R.total - difference), bounds.stretch_floor);
    const bool yields = outside & (major > minor * m.exp);
    const Real mean = Real(0.5) * math::sqrt(major * minor);
    const Real grow_total = mean * m.cosh2, grow_difference = mean * (m.sinh2 / difference);
    const Mat2 returned = from_polar_parts(
        {grow_total * R.cos, grow_total * R.sin, grow_difference * v.n1, grow_difference * v.n2, v.sign});
    F = select(yields, returned, F);
    return R;
}

INLINE Direction snow_return(const Values& m, Bounds bounds, Mat2& F, Real& Jp) {
    const Real low = m.low(), high = m.high();
    const PolarParts v = polar_parts(F);
    const Direction R = direction(v);
    const Real along = v.n1 * R.cos + v.n2 * R.sin;
    const bool drop = math::fabs(v.n2 * R.cos - v.n1 * R.sin) < 2 * bounds.shear_cutoff;
    const Real n1 = drop ? along * R.cos : v.n1, n2 = drop ? along * R.sin : v.n2;
    const Real square2 = square(n1) + square(n2);
    const bool isotropic = square2 == 0;
    const Real root = math::sqrt(isotropic ? Real(1) : square2), difference = isotropic ? Real(0) : root;
    const Real first = Real(0.5) * (R.total + difference), second = Real(0.5) * (R.total - difference);
    const Real major = clamp(first, low, high), minor = clamp(second, low, high);
    const bool kept = (first <= high) & (second >= low);
    const Real ratio = Real(0.5) * (kept ? Real(1) : (major - minor) / root), sum = Real(0.5) * (major + minor);
    F = from_polar_parts({sum * R.cos, sum * R.sin, ratio * n1, ratio * n2, v.sign});
    const Real grown = Jp * (first * second / (major * minor));
    Jp = grown > LARGEST_JP ? LARGEST_JP : grown;
    return R;
}

template <Kind kind> INLINE Direction return_map(const Values& m, Bounds bounds, Mat2& F, Real& Jp) {
    if (kind == Kind::von_mises) return von_mises_return(m, bounds, F);
    if (kind == Kind::snow) return snow_return(m, bounds, F, Jp);
    return elastic_return(F);
}

// Factor on the elastic constants; Jp is from before the return map.
template <Kind kind> INLINE Real hardening_factor(const Values& m, Bounds bounds, Real Jp) {
    if (kind != Kind::snow) return 1;
    return clamp(exponential(m.hardening() * (1 - Jp)), bounds.hardening_low, bounds.hardening_high);
}

// Kirchhoff stress of the fixed corotated solid plus the muscles' F diag(actuation) F^T.
template <Kind kind> INLINE Sym2 stress(const Values& m, Real hard, Mat2 F, Direction R, Real act_x, Real act_y) {
    const Mat2 D = F + Real(-1) * orthogonal(R);
    const Real J = kind == Kind::snow ? math::fabs(det(F)) : det(F);
    const Real pressure = hard * m.lam * (J * (J - 1)), mu2 = hard * m.mu2;
    // P F^T with the first Piola-Kirchhoff stress but its pressure
    const Mat2 P{mu2 * D.a + act_x * F.a, mu2 * D.b + act_y * F.b, mu2 * D.c + act_x * F.c, mu2 * D.d + act_y * F.d};
    const Real xx = P.a * F.a + P.b * F.b + pressure;
    const Real xy = P.a * F.c + P.b * F.d;
    const Real yy = P.c * F.c + P.d * F.d + pressure;
    return {xx, xy, yy};
}
