// Adjoints of material.hpp. Names with `bar` are derivatives of a loss. At kinks the derivative is that of the side which
// automatic differentiation of torchmpm/materials takes.
#pragma once
#include "material.hpp"

// Derivatives in the material values, the muscles, the hardening factor, and the direction R.
struct MaterialBar {
    Values values;
    Real act_x, act_y, hard;
    DirectionBar R;
};

// The hardening factor in the derivative of the stress with respect to F, see Snow in torchmpm/materials/snow.py.
template <Kind kind> INLINE Real tangent_hardening(const Values& m, Bounds bounds, Real hard) {
    if (kind != Kind::snow) return hard;
    const Real limit = 4 * bounds.resolved_rate * m.mass / (-m.factor * (m.mu2 + 2 * at_least(m.lam, 0)));
    return limit < hard ? limit : hard;
}

// From the derivative in the Kirchhoff stress to those in the returned F (added to F_bar), with the hardening factor
// `tangent`, and in all else.
template <Kind kind>
INLINE void stress_adjoint(const Values& m, Real hard, Real tangent, Mat2 F, Direction R, Real act_x, Real act_y,
                           Sym2 bar, Mat2& F_bar, MaterialBar& out) {
    const Mat2 D = F + Real(-1) * orthogonal(R);
    const Real mu2 = tangent * m.mu2, xx = bar.xx, xy = bar.xy, yy = bar.yy;
    const Mat2 D_bar{mu2 * (xx * F.a + xy * F.c), mu2 * (xx * F.b + xy * F.d), mu2 * yy * F.c, mu2 * yy * F.d};
    const PolarParts R_bar = polar_parts(D_bar, R.sign);
    out.R = {0, -R_bar.m1, -R_bar.m2};

    const Real signed_J = det(F), J = kind == Kind::snow ? math::fabs(signed_J) : signed_J;
    const Real J_bar = (xx + yy) * tangent * m.lam * (2 * J - 1);
    const Real side = kind != Kind::snow ? Real(1) : signed_J > 0 ? Real(1) : signed_J < 0 ? Real(-1) : Real(0);
    const Real area = side * J_bar;

    const Real act_xa = act_x * F.a, act_xc = act_x * F.c, act_yb = act_y * F.b, act_yd = act_y * F.d;
    F_bar.a += D_bar.a + mu2 * xx * D.a + area * F.d + 2 * xx * act_xa + xy * act_xc;
    F_bar.b += D_bar.b + mu2 * xx * D.b - area * F.c + 2 * xx * act_yb + xy * act_yd;
    F_bar.c += D_bar.c + mu2 * (xy * D.a + yy * D.c) - area * F.b + xy * act_xa + 2 * yy * act_xc;
    F_bar.d += D_bar.d + mu2 * (xy * D.b + yy * D.d) + area * F.a + xy * act_yb + 2 * yy * act_yd;
    out.act_x = xx * F.a * F.a + xy * F.a * F.c + yy * F.c * F.c;
    out.act_y = xx * F.b * F.b + xy * F.b * F.d + yy * F.d * F.d;

    const Real of_mu2 = xx * (D.a * F.a + D.b * F.b) + xy * (D.a * F.c + D.b * F.d) + yy * (D.c * F.c + D.d * F.d);
    const Real of_lam = (xx + yy) * (J * (J - 1));
    out.values.mu2 = hard * of_mu2, out.values.lam = hard * of_lam;
    out.hard = m.mu2 * of_mu2 + m.lam * of_lam;
}

// Derivative in Jp through the hardening factor; that in the exponent goes to the values.
template <Kind kind> INLINE Real hardening_adjoint(const Values& m, Bounds bounds, Real Jp, MaterialBar& bar) {
    if (kind != Kind::snow) return 0;
    const Real power = exponential(m.hardening() * (1 - Jp));
    const bool free = (power >= bounds.hardening_low) & (power <= bounds.hardening_high) &
                      (bounds.hardening_low < bounds.hardening_high);
    const Real exponent = free ? bar.hard * power : 0;
    bar.values.hardening() = exponent * (1 - Jp);
    return -exponent * m.hardening();
}

// Each turns the derivative in the returned F, and that in R which the stress left in `bar`, into that in the trial F.
INLINE void elastic_adjoint(Mat2 F, MaterialBar& bar, Mat2& F_bar) {
    F_bar = F_bar + from_polar_parts(adjoint(direction(polar_parts(F)), bar.R, 0, 0));
}

INLINE void von_mises_adjoint(const Values& m, Bounds bounds, Mat2 F, MaterialBar& bar, Mat2& F_bar) {
    const PolarParts v = polar_parts(F);
    const Direction R = direction(v);
    const Real large = square(v.m1) + square(v.m2), small = square(v.n1) + square(v.n2);
    const bool outside = small > m.tanh2 * large;
    const Real total = outside ? R.total : Real(1), inverse = 1 / math::sqrt(outside ? small : Real(0.25));
    const Real difference = outside ? small * inverse : Real(0.5);
    const Real first = Real(0.5) * (total + difference), second = Real(0.5) * (total - difference);
    const Real major = at_least(first, bounds.stretch_floor), minor = at_least(second, bounds.stretch_floor);
    const bool yields = outside & (major > minor * m.exp);
    const Real mean = Real(0.5) * math::sqrt(major * minor);
    const Real grow_total = mean * m.cosh2, grow_difference = mean * (m.sinh2 * inverse);

    const PolarParts v_bar = polar_parts(F_bar, v.sign);
    const Real of_total = v_bar.m1 * R.cos + v_bar.m2 * R.sin, of_difference = v_bar.n1 * v.n1 + v_bar.n2 * v.n2;
    const Real mean_bar = of_total * m.cosh2 + of_difference * m.sinh2 * inverse;
    const Real major_bar = first >= bounds.stretch_floor ? mean_bar * mean / (2 * major) : 0;
    const Real minor_bar = second >= bounds.stretch_floor ? mean_bar * mean / (2 * minor) : 0;
    const Real difference_bar = Real(0.5) * (major_bar - minor_bar) - of_difference * grow_difference * inverse;
    const Real along = difference_bar * inverse;
    bar.values.cosh2 = yields ? of_total * mean : 0;
    bar.values.sinh2 = yields ? of_difference * mean * inverse : 0;
    bar.R.total = yields ? Real(0.5) * (major_bar + minor_bar) : 0;
    bar.R.cos += yields ? grow_total * v_bar.m1 : 0;
    bar.R.sin += yields ? grow_total * v_bar.m2 : 0;
    const Real n1 = yields ? grow_difference * v_bar.n1 + along * v.n1 : 0;
    const Real n2 = yields ? grow_difference * v_bar.n2 + along * v.n2 : 0;
    F_bar = select(yields, Mat2{}, F_bar) + from_polar_parts(adjoint(R, bar.R, n1, n2));
}

// Repeats the lines of snow_return: a struct of intermediate values would keep the compiler from vectorising the return
// map, and a step of snow would take three times as long. Also turns the derivative in Jp after the return map into the
// part of it that reaches Jp before.
INLINE void snow_adjoint(const Values& m, Bounds bounds, Mat2 F, Real Jp, MaterialBar& bar, Mat2& F_bar, Real& Jp_bar) {
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
    const Real reduction = first * second / (major * minor);
    Jp_bar = Jp * reduction > LARGEST_JP ? Real(0) : Jp_bar;
    const Real reduction_bar = Jp_bar * Jp;

    const PolarParts v_bar = polar_parts(F_bar, v.sign);
    const Real sum_bar = v_bar.m1 * R.cos + v_bar.m2 * R.sin;
    const Real ratio_bar = kept | isotropic ? 0 : v_bar.n1 * n1 + v_bar.n2 * n2;
    const Real major_bar = Real(0.5) * (sum_bar + ratio_bar / root) - reduction_bar * reduction / major;
    const Real minor_bar = Real(0.5) * (sum_bar - ratio_bar / root) - reduction_bar * reduction / minor;
    const Real area = reduction_bar / (major * minor);
    const bool low1 = first < low, high1 = first > high, low2 = second < low, high2 = second > high;
    const Real first_bar = area * second + (low1 | high1 ? 0 : major_bar);
    const Real second_bar = area * first + (low2 | high2 ? 0 : minor_bar);
    bar.values.low() = (low1 ? major_bar : 0) + (low2 ? minor_bar : 0);
    bar.values.high() = (high1 ? major_bar : 0) + (high2 ? minor_bar : 0);
    Jp_bar *= reduction;

    const Real difference_bar = isotropic ? 0 : Real(0.5) * (first_bar - second_bar) - ratio_bar * ratio / root;
    Real n1_bar = ratio * v_bar.n1 + difference_bar * n1 / root, n2_bar = ratio * v_bar.n2 + difference_bar * n2 / root;
    const Real along_bar = n1_bar * R.cos + n2_bar * R.sin;
    bar.R.total = Real(0.5) * (first_bar + second_bar);
    bar.R.cos += sum * v_bar.m1 + (drop ? along * n1_bar + along_bar * v.n1 : 0);
    bar.R.sin += sum * v_bar.m2 + (drop ? along * n2_bar + along_bar * v.n2 : 0);
    n1_bar = drop ? along_bar * R.cos : n1_bar, n2_bar = drop ? along_bar * R.sin : n2_bar;
    F_bar = from_polar_parts(adjoint(R, bar.R, n1_bar, n2_bar));
}

// Adjoint of return map and stress together. `F` is the trial deformation, `S_bar` the derivative in S = factor tau, and
// `S` is an output; F_bar and Jp_bar are turned from those of the returned into those of the trial state.
template <Kind kind>
INLINE MaterialBar material_adjoint(const Values& m, Bounds bounds, Mat2 F, Real Jp, Real act_x, Real act_y,
                                    Sym2 S_bar, Mat2& F_bar, Real& Jp_bar, Sym2& S) {
    MaterialBar bar{};
    Mat2 returned = F;
    Real Jp_after = Jp;
    const Direction R = return_map<kind>(m, bounds, returned, Jp_after);
    const Real hard = hardening_factor<kind>(m, bounds, Jp);
    const Sym2 tau = stress<kind>(m, hard, returned, R, act_x, act_y);
    bar.values.factor = S_bar.xx * tau.xx + S_bar.xy * tau.xy + S_bar.yy * tau.yy;
    S = {m.factor * tau.xx, m.factor * tau.xy, m.factor * tau.yy};
    const Sym2 tau_bar{m.factor * S_bar.xx, m.factor * S_bar.xy, m.factor * S_bar.yy};
    const Real tangent = tangent_hardening<kind>(m, bounds, hard);
    stress_adjoint<kind>(m, hard, tangent, returned, R, act_x, act_y, tau_bar, F_bar, bar);
    const Real Jp_hard = hardening_adjoint<kind>(m, bounds, Jp, bar);
    if (kind == Kind::elastic) elastic_adjoint(F, bar, F_bar);
    if (kind == Kind::von_mises) von_mises_adjoint(m, bounds, F, bar, F_bar);
    if (kind == Kind::snow) snow_adjoint(m, bounds, F, Jp, bar, F_bar, Jp_bar);
    Jp_bar += Jp_hard;
    return bar;
}
