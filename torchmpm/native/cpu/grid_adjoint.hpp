// Adjoint of grid.hpp.
#pragma once
#include "grid.hpp"

// Turns the derivative in the velocity after a rule into that in the velocity before it, `v`, in place.
INLINE void constrain_adjoint(const Rule& rule, const Real (&v)[2], Real (&bar)[2]) {
    const Real normal = v[rule.axis], tangent = v[1 - rule.axis];
    if (!(rule.sign > 0 ? normal > 0 : normal < 0)) return;
    Real &normal_bar = bar[rule.axis], &tangent_bar = bar[1 - rule.axis];
    normal_bar = 0;
    if (std::isinf(rule.friction)) {
        tangent_bar = 0;
    } else if (rule.friction != 0) {
        const bool slides = std::abs(tangent) - rule.friction * std::abs(normal) >= 0;
        const Real drag = (tangent > 0) == (normal > 0) ? -rule.friction * tangent_bar : rule.friction * tangent_bar;
        if (slides) normal_bar = drag;
        if (!slides) tangent_bar = 0;
    }
}

// All rules of a node: `v` becomes the velocity after them, `bar` the derivative in the velocity before them.
INLINE void constrain_adjoint(const Scene& scene, uint32_t code, Real (&v)[2], Real (&bar)[2]) {
    const Rule* rules[4];
    Real before[4][2];
    int count = 0;
    for (; code; code >>= 8)
        if (code & 255) {
            before[count][0] = v[0], before[count][1] = v[1];
            rules[count] = &scene.rules[(code & 255) - 1];
            constrain(*rules[count++], v);
        }
    while (count-- > 0) constrain_adjoint(*rules[count], before[count], bar);
}

// Grids that the adjoint of a particle reads.
struct NodeBars {
    Real* momentum;  // derivative in the momentum, two numbers a node
    Real* mass;      // derivative in the mass
};

// Row i: from the derivatives in the velocities (`total`, four numbers a node from box.j0, two in use) to those in
// momentum and mass. Also recomputes the velocities, and adds to the derivative in the velocity gained from gravity.
INLINE void node_adjoint(const Scene& scene, const Real* gravity, const RuleCodes& rules, const Box& box, int i,
                         const Real* total, Record record, Real* velocity, NodeBars out, Real* gravity_bar) {
    const Span span(scene, box, i);
    const Real gx = scene.dt * gravity[0], gy = scene.dt * gravity[1], damping = scene.damping;
    Real *v_row = velocity + 2 * i * scene.width, *p_row = out.momentum + 2 * i * scene.width;
    Real* m_row = out.mass + i * scene.width;
    const Real* in = total - 4 * span.begin;
    const Real *raw = record.velocity - 2 * span.begin, *inverse = record.inverse_mass - span.begin;
    const uint32_t* code = rules.code + i * scene.width;
    for (int j = span.begin; j < span.end; ++j)
        v_row[2 * j] = v_row[2 * j + 1] = p_row[2 * j] = p_row[2 * j + 1] = m_row[j] = 0;
    for (int j = span.inner_begin; j < span.inner_end; ++j) {
        Real v[2] = {(raw[2 * j] + gx) * damping, (raw[2 * j + 1] + gy) * damping};
        Real bar[2] = {in[4 * j], in[4 * j + 1]};
        if (code[j]) constrain_adjoint(scene, code[j], v, bar);
        for (int c = 0; c < 2; ++c) {
            v_row[2 * j + c] = v[c];
            bar[c] *= damping;
            gravity_bar[c] += bar[c];
            p_row[2 * j + c] = bar[c] * inverse[j];
        }
        m_row[j] = -(raw[2 * j] * p_row[2 * j] + raw[2 * j + 1] * p_row[2 * j + 1]);
    }
}
