// Stencils, and the movement of numbers between particles and nodes.
#pragma once
#include "scene.hpp"

enum Plane : int { X = 0, Y, VX, VY, C0, C1, C2, C3, F0, F1, F2, F3, JP, PLANES };

struct alignas(64) Block {
    Real v[PLANES][LANES];
};

// Inclusive range of nodes on the padded grid.
struct Box {
    int i0 = 1 << 28, i1 = -1, j0 = 1 << 28, j1 = -1;

    bool empty() const { return i1 < i0; }
    bool holds(const Box& o) const { return o.empty() || (i0 <= o.i0 && o.i1 <= i1 && j0 <= o.j0 && o.j1 <= j1); }
    void include(const Box& o) {
        i0 = std::min(i0, o.i0), i1 = std::max(i1, o.i1), j0 = std::min(j0, o.j0), j1 = std::max(j1, o.j1);
    }
};

struct alignas(64) Stencil {
    Real wx[3][LANES], wy[3][LANES];  // weights
    Real fx[LANES], fy[LANES];        // distance from the first node in cells
    Real on[LANES];                   // 1 for particles that take part
    int32_t node[LANES];              // first node
    Box box;                          // all nodes of particles that take part

    void locate(const Scene& scene, const Real* origin, const Block& block) {
        const Real ox = origin[0], oy = origin[1], inverse_h = scene.inverse_h;
        const Real margin = scene.margin, extent = scene.extent;
        const Real low = -PAD, high = Real(scene.resolution);
        const int width = scene.width, none = 1 << 28;
        int i0 = none, i1 = -none, j0 = none, j1 = -none;
#pragma omp simd reduction(min : i0, j0) reduction(max : i1, j1)
        for (int k = 0; k < LANES; ++k) {
            const Real offset = block.v[X][k] - ox;
            const bool inside = (offset > margin) & (offset < extent);
            const Real ux = offset * inverse_h, uy = (block.v[Y][k] - oy) * inverse_h;
            Real bx = std::trunc(ux - Real(0.5)), by = std::trunc(uy - Real(0.5));
            const Real dx = ux - bx, dy = uy - by;
            fx[k] = dx, fy[k] = dy, on[k] = inside ? Real(1) : Real(0);
            wx[0][k] = Real(0.5) * square(Real(1.5) - dx), wy[0][k] = Real(0.5) * square(Real(1.5) - dy);
            wx[1][k] = Real(0.75) - square(dx - 1), wy[1][k] = Real(0.75) - square(dy - 1);
            wx[2][k] = Real(0.5) * square(dx - Real(0.5)), wy[2][k] = Real(0.5) * square(dy - Real(0.5));
            // Clamped before the conversion, which is undefined for large numbers; a NaN ends at the low end.
            bx = bx > low ? bx : low, by = by > low ? by : low;
            bx = bx < high ? bx : high, by = by < high ? by : high;
            const int i = int(bx) + PAD, j = int(by) + PAD;
            node[k] = i * width + j;
            const int ilow = inside ? i : none, ihigh = inside ? i : -none;
            const int jlow = inside ? j : none, jhigh = inside ? j : -none;
            i0 = ilow < i0 ? ilow : i0, i1 = ihigh > i1 ? ihigh : i1;
            j0 = jlow < j0 ? jlow : j0, j1 = jhigh > j1 ? jhigh : j1;
        }
        box = i1 < 0 ? Box{} : Box{i0, i1 + 2, j0, j1 + 2};
    }
};

// Values of a block's nine nodes, node 3 p + q first, with a number of components.
template <int components> struct alignas(64) Nodes {
    Real v[9][components][LANES];
};

// Read nodes of two components: a row of three is six numbers, and two more are loaded and forgotten. Addresses are
// valid also for particles that take no part; what they read is never used.
INLINE void gather(const Real* grid, const Stencil& at, int width, Nodes<2>& out) {
    for (int k = 0; k < LANES; k += 8)
        three([&](int p) {
            Real8 row[8];
            for (int l = 0; l < 8; ++l)
                row[l] = *reinterpret_cast<const Row8*>(grid + 2 * (at.node[k + l] + p * width));
            transpose(row);
            three([&](int q) {
                *reinterpret_cast<Real8*>(&out.v[3 * p + q][0][k]) = row[2 * q];
                *reinterpret_cast<Real8*>(&out.v[3 * p + q][1][k]) = row[2 * q + 1];
            });
        });
}

// The same for nodes of one component.
INLINE void gather(const Real* grid, const Stencil& at, int width, Nodes<1>& out) {
    for (int k = 0; k < LANES; k += 4)
        three([&](int p) {
            Real4 row[4];
            for (int l = 0; l < 4; ++l) row[l] = *reinterpret_cast<const Row4*>(grid + at.node[k + l] + p * width);
            transpose(row);
            three([&](int q) { *reinterpret_cast<Real4*>(&out.v[3 * p + q][0][k]) = row[q]; });
        });
}

// Add to nodes of four numbers, of which the last `4 - components` are padding. Aligned nodes never overlap in part, so
// what was stored a moment ago is forwarded to the next load.
template <int components> INLINE void scatter(const Nodes<components>& in, const Stencil& at, int width, Real* grid) {
    for (int k = 0; k < LANES; k += 4)
        three([&](int p) {
            three([&](int q) {
                Real4 value[4] = {};
                for (int c = 0; c < components; ++c)
                    value[c] = *reinterpret_cast<const Real4*>(&in.v[3 * p + q][c][k]);
                transpose(value);
                for (int l = 0; l < 4; ++l)
                    if (at.on[k + l] != 0)
                        *reinterpret_cast<Real4*>(grid + 4 * (at.node[k + l] + p * width + q)) += value[l];
            });
        });
}

// A grid of nodes of four numbers on which sums build up. Nodes within `cleared` are zero or being added to; others hold
// rubbish.
struct Sums {
    Real* nodes;
    Box box;      // nodes added to since the last reset
    Box cleared;

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

    void clear(int i, int j0, int j1, int width) {
        if (j1 >= j0) std::fill_n(nodes + 4 * (i * width + j0), 4 * (j1 - j0 + 1), Real(0));
    }
};
