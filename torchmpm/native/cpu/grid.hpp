// The middle of a substep: from sums on the nodes to velocities, with gravity, damping and the velocity rules.
#pragma once
#include "transfer.hpp"

// The rules that apply to each node: one byte per slot, 0 for none, else the index of the rule plus one.
struct RuleCodes {
    uint32_t* code;

    void build(const Scene& scene, const int64_t* shift) {
        const int width = scene.width;
        std::fill_n(code, width * width, 0u);
        for (size_t r = 0; r < scene.rules.size(); ++r) {
            const Rule& rule = scene.rules[r];
            int range[2][2];
            for (int axis = 0; axis < 2; ++axis) {
                const double offset = PAD - (rule.world ? double(shift[axis]) : 0.0);
                range[axis][0] = int(std::min(std::max(rule.range[axis][0] + offset, 0.0), double(width)));
                range[axis][1] = int(std::min(std::max(rule.range[axis][1] + offset, -1.0), double(width - 1)));
            }
            const int bit = 8 * rule.slot;
            for (int i = range[0][0]; i <= range[0][1]; ++i)
                for (int j = range[1][0]; j <= range[1][1]; ++j) {
                    uint32_t& c = code[i * width + j];
                    if (!(c >> bit & 255)) c |= uint32_t(r + 1) << bit;
                }
        }
    }
};

// One thread's share of the rows of a box.
struct Rows {
    int begin, end;

    Rows(const Box& box, int rank, int team) {
        const int count = box.empty() ? 0 : box.i1 - box.i0 + 1;
        begin = box.i0 + count * rank / team, end = box.i0 + count * (rank + 1) / team;
    }
};

// The nodes of one row whose velocity may be read, and those of them that exist.
struct Span {
    int begin, end, inner_begin, inner_end;  // end is one past the last

    Span(const Scene& scene, const Box& box, int i) : begin(box.j0), end(box.j1 + 1) {
        const bool exists = i >= PAD && i < PAD + scene.resolution;
        inner_begin = exists ? std::min(std::max(begin, PAD), end) : end;
        inner_end = exists ? std::max(std::min(end, PAD + scene.resolution), inner_begin) : end;
    }
};

// Add up the parts of row i into `total` (four numbers a node, from node box.j0), and clear them for the next substep.
INLINE void collect(Sums* sums, int parts, const Box& box, int i, int width, Real* total) {
    static constexpr Real none[Sums::TRIPLES] = {};
    const auto four = [](const Real* from) INLINE_LAMBDA { return Real4(*reinterpret_cast<const Row4*>(from)); };
    std::fill_n(total, 4 * (box.j1 - box.j0 + 1), Real(0));
    for (int part = 0; part < parts; ++part) {
        const Box& own = sums[part].box;
        if (i < own.i0 || i > own.i1) continue;
        const int row = sums[part].row, rows = own.j1 - own.j0 - 1;
        Real* begin = sums[part].at(i, own.j0, width);
        // Rows that begin at node j and at the two nodes before it.
        const Real *first = none, *second = none, *third;
        for (int n = 0; n < rows + 2; ++n) {
            third = second, second = first, first = n < rows ? begin + row * n : none;
            const Real4 pair = four(first) + four(second + 2) + four(third + 4);
            const Real4 mass = {row == Sums::PAIRS ? 0 : first[8] + second[9] + third[10]};
            *reinterpret_cast<Row4*>(total + 4 * (own.j0 - box.j0 + n)) += SHUFFLE(pair, mass, 0, 1, 4, 5);
        }
        std::fill_n(begin, row * rows, Real(0));
    }
}

// What the adjoint needs of a row of nodes, from the first node of the box: velocity before gravity, and 1 / mass.
struct Record {
    Real *velocity = nullptr, *inverse_mass = nullptr;
};

// Velocities of row i from the collected mass and momentum.
INLINE void node_velocities(const Scene& scene, const Real* gravity, const RuleCodes& rules, const Box& box, int i,
                            const Real* total, Real* velocity, Record record) {
    const Span span(scene, box, i);
    const Real gx = scene.dt * gravity[0], gy = scene.dt * gravity[1], damping = scene.damping;
    const Real epsilon = scene.mass_epsilon;
    Real* out = velocity + 2 * i * scene.width;
    for (int j = span.begin; j < span.inner_begin; ++j) out[2 * j] = out[2 * j + 1] = 0;
    for (int j = span.inner_end; j < span.end; ++j) out[2 * j] = out[2 * j + 1] = 0;
    const Real* in = total - 4 * span.begin;
#pragma omp simd
    for (int j = span.inner_begin; j < span.inner_end; ++j) {
        const Real inverse = inverse_mass(in[4 * j + 2], epsilon);
        out[2 * j] = node_velocity(in[4 * j], inverse, gx, damping);
        out[2 * j + 1] = node_velocity(in[4 * j + 1], inverse, gy, damping);
    }
    if (record.velocity) {
        Real *raw = record.velocity - 2 * span.begin, *inverses = record.inverse_mass - span.begin;
#pragma omp simd
        for (int j = span.inner_begin; j < span.inner_end; ++j) {
            const Real inverse = inverse_mass(in[4 * j + 2], epsilon);
            inverses[j] = inverse;
            raw[2 * j] = in[4 * j] * inverse, raw[2 * j + 1] = in[4 * j + 1] * inverse;
        }
    }
    const uint32_t* code = rules.code + i * scene.width;
    for (int j = span.inner_begin; j < span.inner_end; ++j)
        if (code[j]) {
            Real v[2] = {out[2 * j], out[2 * j + 1]};
            constrain(scene.rules, code[j], v);
            out[2 * j] = v[0], out[2 * j + 1] = v[1];
        }
}
