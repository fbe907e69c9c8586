// Stencils, and transfers between particles and nodes.
#pragma once
#include "scene.hpp"

struct alignas(64) Block {
    Real v[COMPONENTS][LANES];
};

// Inclusive range of nodes on the padded grid.
struct Box {
    int i0 = 1 << 28, i1 = -1, j0 = 1 << 28, j1 = -1;

    bool empty() const { return i1 < i0; }
    size_t nodes() const { return empty() ? 0 : size_t(i1 - i0 + 1) * (j1 - j0 + 1); }
    bool holds(const Box& o) const { return o.empty() || (i0 <= o.i0 && o.i1 <= i1 && j0 <= o.j0 && o.j1 <= j1); }
    void include(const Box& o) {
        i0 = std::min(i0, o.i0), i1 = std::max(i1, o.i1), j0 = std::min(j0, o.j0), j1 = std::max(j1, o.j1);
    }
};

// Weights and distances are zero for particles that do not take part.
struct alignas(64) Stencil {
    Real wx[3][LANES], wy[3][LANES];  // weights
    Real fx[LANES], fy[LANES];        // distance from the first node in cells
    Real on[LANES];                   // 1 for particles that take part, 0 for others
    int32_t node[LANES];              // first node
    Box box;                          // all nodes of particles that take part

    PASS_MEMBER void locate(const Scene& scene, const Real* origin, const Block& block) {
        const Domain domain = scene.domain(origin);
        const int width = scene.width, none = 1 << 28;
        int i0 = none, i1 = -none, j0 = none, j1 = -none;
#pragma omp simd reduction(min : i0, j0) reduction(max : i1, j1)
        for (int k = 0; k < LANES; ++k) {
            const Place place = ::locate(domain, block.v[X][k], block.v[Y][k]);
            fx[k] = place.fx, fy[k] = place.fy, on[k] = place.on ? Real(1) : Real(0);
            three([&](int p) INLINE_LAMBDA {
                wx[p][k] = place.on ? weight(place.fx, p) : 0;
                wy[p][k] = place.on ? weight(place.fy, p) : 0;
            });
            const int i = place.i, j = place.j;
            node[k] = i * width + j;
            const int ilow = place.on ? i : none, ihigh = place.on ? i : -none;
            const int jlow = place.on ? j : none, jhigh = place.on ? j : -none;
            i0 = ilow < i0 ? ilow : i0, i1 = ihigh > i1 ? ihigh : i1;
            j0 = jlow < j0 ? jlow : j0, j1 = jhigh > j1 ? jhigh : j1;
        }
        box = i1 < 0 ? Box{} : Box{i0, i1 + 2, j0, j1 + 2};
    }
};

INLINE Real8 eight(const Real* from) { return *reinterpret_cast<const Real8*>(from); }

INLINE void put(Real8 value, Real* to) { *reinterpret_cast<Real8*>(to) = value; }

// Row p of the nodes of particle k, two numbers each: six, and two more to ignore. The address is also valid for particles
// that take no part, but the values read there are meaningless.
INLINE Real8 load_row(const Scene& scene, const Stencil& at, int k, int p, const Real* grid) {
    return *reinterpret_cast<const Row8*>(grid + 2 * (int64_t(at.node[k]) + p * int64_t(scene.width)));
}

// Read the nodes of particles k to k + 7, two numbers each: `use(p, row)` gets the nodes (p, q) as row[2 q] and
// row[2 q + 1].
template <class Function>
INLINE void read_eight(const Scene& scene, const Stencil& at, int k, const Real* grid, Function use) {
    three([&](int p) INLINE_LAMBDA {
        // Particles 0 to 3 in the lower halves, 4 to 7 in the upper ones; the first four numbers apart from the last.
        Real8 low[4], high[4];
        for (int l = 0; l < 4; ++l) {
            const Real8 a = load_row(scene, at, k + l, p, grid), b = load_row(scene, at, k + l + 4, p, grid);
            low[l] = SHUFFLE(a, b, 0, 1, 2, 3, 8, 9, 10, 11), high[l] = SHUFFLE(a, b, 4, 5, 6, 7, 12, 13, 14, 15);
        }
        transpose(low), transpose(high);
        const Real8 row[8] = {low[0], low[1], low[2], low[3], high[0], high[1]};
        use(p, row);
    });
}

// A grid that collects sums of particles. Each node holds the sums of a row of three nodes, over the particles whose
// stencil has a row that begins there: two numbers of each of the three (six, and two unused), then a third of each where
// there is one (three, and five unused). So a particle adds to three places instead of nine. Two particles add to the
// same place or to separate ones, so a recent store is forwarded to the next load. Only nodes within `cleared` have
// defined values.
struct Sums {
    static constexpr int PAIRS = 8, TRIPLES = 16;  // numbers of a row
    Real* nodes;
    int row = TRIPLES;
    Box box;      // nodes added to since the last reset
    Box cleared;

    void set_row(int numbers) {
        if (row != numbers) row = numbers, cleared = {};
    }

    void reserve(const Box& wanted, int width) {
        if (cleared.holds(wanted)) return;
        Box next = cleared;
        next.include({wanted.i0 - 4, wanted.i1 + 4, wanted.j0 - 4, wanted.j1 + 4});
        next = {std::max(next.i0, 0), std::min(next.i1, width - 1), std::max(next.j0, 0), std::min(next.j1, width - 1)};
        for (int i = next.i0; i <= next.i1; ++i) {
            const bool known = cleared.i0 <= i && i <= cleared.i1;
            clear(i, next.j0, known ? cleared.j0 - 1 : next.j1, width);
            if (known) clear(i, cleared.j1 + 1, next.j1, width);
        }
        cleared = next;
    }

    Real* at(int i, int j, int width) const { return nodes + row * (int64_t(i) * width + j); }

    void clear(int i, int j0, int j1, int width) {
        if (j1 >= j0) std::fill_n(at(i, j0, width), row * (j1 - j0 + 1), Real(0));
    }
};

// Add `numbers`, two of each of the three nodes, times the weight of row p to the sums of particle k.
template <int row>
INLINE void add_pairs(const Scene& scene, const Stencil& at, int k, int p, Real* grid, const Real8& numbers) {
    const Real w = at.wx[p][k];
    Real* to = grid + row * (int64_t(at.node[k]) + p * int64_t(scene.width));
    *reinterpret_cast<Real8*>(to) += Real8{w, w, w, w, w, w, w, w} * numbers;
}

// The third number of each node.
INLINE void add_third(const Scene& scene, const Stencil& at, int k, int p, Real* grid, const Real4& numbers) {
    Real* to = grid + Sums::TRIPLES * (int64_t(at.node[k]) + p * int64_t(scene.width));
    *reinterpret_cast<Real4*>(to + 8) += at.wx[p][k] * numbers;
}
