// The 3 x 3 nodes around a particle, and their weights.
#pragma once
#include "scalar.hpp"

// Quadratic B-spline: weight of node p of three, counted from the first, at f cells from the first, and its derivative.
INLINE Real weight(Real f, int p) {
    return p == 0   ? Real(0.5) * square(Real(1.5) - f)
           : p == 1 ? Real(0.75) - square(f - 1)
                    : Real(0.5) * square(f - Real(0.5));
}
INLINE Real weight_slope(Real f, int p) { return p == 0 ? f - Real(1.5) : p == 1 ? 2 - 2 * f : f - Real(0.5); }

// Where the particles of a simulation take part: the window's lower left corner and its ends.
struct Domain {
    Real x, y, inverse_h, margin, extent;
    int resolution;
};

// Where a particle is.
struct Place {
    bool on;      // whether it takes part
    int i, j;     // first node, on the padded grid
    Real fx, fy;  // distance from the first node in cells, zero for particles that do not take part
};

INLINE Place locate(const Domain& domain, Real x, Real y) {
    const Real low = -PAD, high = Real(domain.resolution);
    const Real offset = x - domain.x;
    const Real ux = offset * domain.inverse_h, uy = (y - domain.y) * domain.inverse_h;
    const bool on = (offset > domain.margin) & (offset < domain.extent) & (uy >= 0) & (uy <= high);
    Real bx = math::trunc(ux - Real(0.5)), by = math::trunc(uy - Real(0.5));
    const Real fx = on ? ux - bx : 0, fy = on ? uy - by : 0;
    // Clamped before the conversion, which is undefined for large numbers; NaN goes to the low end.
    bx = bx > low ? bx : low, by = by > low ? by : low;
    bx = bx < high ? bx : high, by = by < high ? by : high;
    return {on, int(bx) + PAD, int(by) + PAD, fx, fy};
}

// What a particle reads from two numbers v of each of its nodes: sum w v, and sum w v (offset in cells) in x and in y.
struct Moments {
    Real value[2], slope_x[2], slope_y[2];
};

// `wx(p)` and `wy(q)` are the weights, `read(p, q, c)` is number c of node (p, q).
template <class WeightX, class WeightY, class Read>
INLINE Moments gather(Real fx, Real fy, WeightX wx, WeightY wy, Read read) {
    Moments sum = {{0, 0}, {0, 0}, {0, 0}};
    three([&](int p) {
        Real across[2] = {0, 0}, tilt[2] = {0, 0};
        three([&](int q) {
            const Real w = wy(q), d = w * (q - fy);
            for (int c = 0; c < 2; ++c) {
                const Real value = read(p, q, c);
                across[c] += w * value;
                tilt[c] += d * value;
            }
        });
        const Real w = wx(p), d = w * (p - fx);
        for (int c = 0; c < 2; ++c) {
            sum.value[c] += w * across[c], sum.slope_x[c] += d * across[c], sum.slope_y[c] += w * tilt[c];
        }
    });
    return sum;
}
