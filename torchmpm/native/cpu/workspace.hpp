// Memory of one simulation while it runs. A team of threads reuses one workspace for all its simulations.
#pragma once
#include <limits>

#include "grid.hpp"
#include "team.hpp"

// Hands out aligned pieces of one buffer; without a buffer it only adds up the size.
class Arena {
public:
    explicit Arena(char* base) : base(base) {}

    template <class T> T* take(size_t count) {
        T* piece = base ? reinterpret_cast<T*>(base + used) : nullptr;
        // An odd number of cache lines, so that neighbours of a power of two in size do not share cache sets.
        used += ((count * sizeof(T) + 63) / 64 | 1) * 64;
        return piece;
    }

    size_t used = 0;

private:
    char* base;
};

struct Workspace {
    Block* state;      // [blocks]
    Real* values;      // [blocks][VALUES][LANES], where particles have their own
    Real* field;       // actuation, two numbers a node
    Real* velocity;    // two numbers a node
    Real* total;       // [threads of the team] one row of nodes of four numbers
    RuleCodes rules;
    std::vector<Sums> sums;  // [parts]
    Barrier barrier;
    std::atomic<int64_t> element{0};

    Workspace(const Scene& scene, Arena& arena, int members) : barrier(members) {
        const size_t cells = size_t(scene.width) * scene.width, slack = 8;
        state = arena.take<Block>(scene.blocks);
        values = scene.varying ? arena.take<Real>(size_t(scene.blocks) * VALUES * LANES) : nullptr;
        field = scene.muscles ? arena.take<Real>(2 * cells + slack) : nullptr;
        velocity = arena.take<Real>(2 * cells + slack);
        total = arena.take<Real>(size_t(members) * row_length(scene));
        rules.code = arena.take<uint32_t>(cells);
        sums.resize(scene.parts);
        for (Sums& part : sums) part.nodes = arena.take<Real>(Sums::TRIPLES * cells);
    }

    static size_t row_length(const Scene& scene) { return (4 * scene.width + 31) / 16 * 16; }

    // Values of a block's particles for values_at.
    const Real* values_of(const Scene& scene, int block, int64_t element, Real* uniform) const {
        const Body& body = scene.body(block);
        if (body.varying) return values + size_t(block) * VALUES * LANES;
        const Call& call = scene.call;
        const int64_t row = call.values_batch == 1 ? 0 : element;
        for (int r = 0; r < VALUES; ++r)
            uniform[r] = call.values[(r * call.values_batch + row) * call.columns + body.column];
        return uniform;
    }
};

// Copy the particles of a block from components (13, batch, particles). The lanes beyond the last particle have NaN
// positions, so they take no part.
INLINE void load(const Scene& scene, int block, int64_t element, const Real* components, Block& out) {
    const int count = scene.particles_in(block);
    const int64_t first = scene.first_particle(block), n = scene.call.particles, stride = scene.call.batch * n;
    for (int c = 0; c < COMPONENTS; ++c) {
        const Real* from = components + c * stride + element * n + first;
        std::copy_n(from, count, out.v[c]);
        std::fill(out.v[c] + count, out.v[c] + LANES, c == X ? std::numeric_limits<Real>::quiet_NaN() : Real(1));
    }
}

INLINE void store(const Scene& scene, int block, int64_t element, const Block& in, Real* components) {
    const int64_t first = scene.first_particle(block), n = scene.call.particles, stride = scene.call.batch * n;
    for (int c = 0; c < COMPONENTS; ++c)
        std::copy_n(in.v[c], scene.particles_in(block), components + c * stride + element * n + first);
}

inline void load_values(const Scene& scene, int block, int64_t element, Real* values) {
    const Body& body = scene.body(block);
    if (!body.varying) return;
    const Call& call = scene.call;
    const int64_t row = call.values_batch == 1 ? 0 : element;
    const int count = scene.particles_in(block), offset = scene.first_particle(block) - body.first;
    for (int r = 0; r < VALUES; ++r) {
        const Real* from = call.values + (r * call.values_batch + row) * call.columns + body.column + offset;
        Real* to = values + (size_t(block) * VALUES + r) * LANES;
        std::copy_n(from, count, to);
        std::fill(to + count, to + LANES, Real(1));
    }
}

// Actuation with two numbers a node, zero on nodes that do not exist.
inline void load_field(const Scene& scene, int64_t element, Real* field) {
    const int n = scene.resolution, width = scene.width;
    std::fill_n(field, 2 * size_t(width) * width, Real(0));
    const Real* from = scene.call.field + 2 * element * n * n;
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j)
            for (int c = 0; c < 2; ++c)
                field[2 * ((i + PAD) * width + j + PAD) + c] = from[(c * n + i) * n + j];
}
