// Adjoint of grid.hpp.
#pragma once
#include "../common/node_adjoint.hpp"
#include "grid.hpp"

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
        if (code[j]) constrain_adjoint(scene.rules, code[j], v, bar);
        for (int c = 0; c < 2; ++c) {
            v_row[2 * j + c] = v[c];
            bar[c] *= damping;
            gravity_bar[c] += bar[c];
        }
        const NodeBar node = ::node_adjoint(bar, {raw[2 * j], raw[2 * j + 1]}, inverse[j]);
        p_row[2 * j] = node.momentum[0], p_row[2 * j + 1] = node.momentum[1], m_row[j] = node.mass;
    }
}
