// A step of many substeps. One pass over the particles finishes a substep and begins the next: read velocities from the
// nodes, move, deform, add mass and momentum to the nodes.
#pragma once
#include "../common/particle.hpp"
#include "workspace.hpp"

// What a block's particles contribute to the nodes: mass, momentum, and the affine momentum -dt V 4/h^2 tau + m C. Zero for
// particles that take no part.
struct alignas(64) Impulse {
    Real mass[LANES], vx[LANES], vy[LANES], affine[4][LANES];
};

// Muscle actuation of a block's particles.
struct alignas(64) Actuation {
    Real x[LANES], y[LANES];

    void none() { std::fill_n(x, LANES, Real(0)), std::fill_n(y, LANES, Real(0)); }

    PASS_MEMBER void sample(const Scene& scene, const Stencil& at, const Real* field) {
        for (int k = 0; k < LANES; k += 8) {
            Real8 sum[8];
            for (int l = 0; l < 8; ++l) {
                const Real8 first = load_row(scene, at, k + l, 0, field), second = load_row(scene, at, k + l, 1, field);
                const Real8 third = load_row(scene, at, k + l, 2, field);
                sum[l] = at.wx[0][k + l] * first + at.wx[1][k + l] * second + at.wx[2][k + l] * third;
            }
            transpose(sum);
            const Real8 w0 = eight(at.wy[0] + k), w1 = eight(at.wy[1] + k), w2 = eight(at.wy[2] + k);
            put(w0 * sum[0] + w1 * sum[2] + w2 * sum[4], x + k);
            put(w0 * sum[1] + w1 * sum[3] + w2 * sum[5], y + k);
        }
    }
};

// New velocity, affine matrix and position from the velocities of the nodes.
PASS void advance(const Scene& scene, const Real* velocity, const Stencil& at, Block& block) {
    const Real dt = scene.dt, scale = 4 * scene.inverse_h;
    for (int k = 0; k < LANES; k += 8) {
        const Real8 fx = eight(at.fx + k), fy = eight(at.fy + k);
        const Real8 w0 = eight(at.wy[0] + k), w1 = eight(at.wy[1] + k), w2 = eight(at.wy[2] + k);
        const Real8 d0 = w0 * -fy, d1 = w1 * (1 - fy), d2 = w2 * (2 - fy);
        Real8 v[2] = {}, slope_x[2] = {}, slope_y[2] = {};
        read_eight(scene, at, k, velocity, [&](int p, const Real8(&row)[8]) {
            const Real8 w = eight(at.wx[p] + k), d = w * (Real(p) - fx);
            for (int c = 0; c < 2; ++c) {
                const Real8 across = w0 * row[c] + w1 * row[2 + c] + w2 * row[4 + c];
                const Real8 tilt = d0 * row[c] + d1 * row[2 + c] + d2 * row[4 + c];
                v[c] += w * across, slope_x[c] += d * across, slope_y[c] += w * tilt;
            }
        });
        const auto on = eight(at.on + k) != 0;
        const auto update = [&](int component, Real8 value) {
            put(on ? value : eight(block.v[component] + k), block.v[component] + k);
        };
        for (int c = 0; c < 2; ++c) {
            update(X + c, eight(block.v[X + c] + k) + dt * v[c]);
            update(VX + c, v[c]);
            update(C0 + 2 * c, scale * slope_x[c]);
            update(C1 + 2 * c, scale * slope_y[c]);
        }
    }
}

INLINE Mat2 matrix(const Block& block, int first, int k) {
    return {block.v[first][k], block.v[first + 1][k], block.v[first + 2][k], block.v[first + 3][k]};
}

// Column k of a block whose particles have their own values, or the only column.
template <bool varying> INLINE Values values_at(const Real* table, int k) {
    const Real* t = table + k;
    const int stride = varying ? LANES : 1;
    return {t[0],          t[stride],     t[2 * stride], t[3 * stride],
            t[4 * stride], t[5 * stride], t[6 * stride], t[7 * stride]};
}

// Deform one particle and compute its contribution to the nodes. A separate function, because structures declared in the
// body of a vector loop would be kept in memory.
template <Kind kind>
INLINE void deform_one(Real dt, Values m, Bounds bounds, bool on, Real act_x, Real act_y, int k, Block& block,
                       Impulse& out) {
    const Mat2 C = matrix(block, C0, k), old = matrix(block, F0, k);
    const Real before = block.v[JP][k];
    Mat2 F = old;
    Real Jp = before;
    const Sym2 tau = deform<kind>(dt, m, bounds, C, act_x, act_y, F, Jp);
    out.mass[k] = on ? m.mass : 0;
    out.vx[k] = on ? m.mass * block.v[VX][k] : 0;
    out.vy[k] = on ? m.mass * block.v[VY][k] : 0;
    out.affine[0][k] = on ? affine_momentum(m, tau.xx, C.a) : 0;
    out.affine[1][k] = on ? affine_momentum(m, tau.xy, C.b) : 0;
    out.affine[2][k] = on ? affine_momentum(m, tau.xy, C.c) : 0;
    out.affine[3][k] = on ? affine_momentum(m, tau.yy, C.d) : 0;
    block.v[F0][k] = on ? F.a : old.a, block.v[F1][k] = on ? F.b : old.b;
    block.v[F2][k] = on ? F.c : old.c, block.v[F3][k] = on ? F.d : old.d;
    if (kind == Kind::snow) block.v[JP][k] = on ? Jp : before;
}

template <Kind kind, bool varying>
void deform(const Scene& scene, const Real* table, Bounds bounds, const Stencil& at, const Actuation& act, Block& block,
            Impulse& out) {
    const Real dt = scene.dt;
    const Values shared = values_at<false>(table, 0);
#pragma omp simd
    for (int k = 0; k < LANES; ++k)
        deform_one<kind>(dt, varying ? values_at<true>(table, k) : shared, bounds, at.on[k] != 0, act.x[k], act.y[k],
                         k, block, out);
}

INLINE void deform(const Scene& scene, const Body& body, const Real* table, const Stencil& at, const Actuation& act,
                   Block& block, Impulse& out) {
    using Function = void (*)(const Scene&, const Real*, Bounds, const Stencil&, const Actuation&, Block&, Impulse&);
    static constexpr Function table_of[3][2] = {
        {deform<Kind::elastic, false>, deform<Kind::elastic, true>},
        {deform<Kind::von_mises, false>, deform<Kind::von_mises, true>},
        {deform<Kind::snow, false>, deform<Kind::snow, true>},
    };
    table_of[int(body.kind)][body.varying](scene, table, body.bounds, at, act, block, out);
}

// Add mass and momentum to the nodes, or momentum alone. The row of nodes at x = p - 1 from the middle of the stencil gets
// its weight times middle + (p - 1) tilt.
template <bool with_mass> PASS void scatter(const Scene& scene, const Impulse& in, const Stencil& at, Real* grid) {
    constexpr int row = with_mass ? Sums::TRIPLES : Sums::PAIRS;
    const Real h = scene.h;
    for (int k = 0; k < LANES; k += 8) {
        const Real8 dx = 1 - eight(at.fx + k), dy = 1 - eight(at.fy + k), mass = eight(in.mass + k);
        const Real8 xx = h * eight(in.affine[0] + k), xy = h * eight(in.affine[1] + k);
        const Real8 yx = h * eight(in.affine[2] + k), yy = h * eight(in.affine[3] + k);
        const Real8 x = eight(in.vx + k) + xx * dx + xy * dy, y = eight(in.vy + k) + yx * dx + yy * dy;
        const Real8 w0 = eight(at.wy[0] + k), w1 = eight(at.wy[1] + k), w2 = eight(at.wy[2] + k);
        Real8 middle[8] = {w0 * (x - xy), w0 * (y - yy), w1 * x, w1 * y, w2 * (x + xy), w2 * (y + yy)};
        Real8 tilt[8] = {w0 * xx, w0 * yx, w1 * xx, w1 * yx, w2 * xx, w2 * yx};
        Real8 masses[4] = {w0 * mass, w1 * mass, w2 * mass};
        transpose(middle), transpose(tilt), transpose(masses);
#pragma GCC unroll 8
        for (int l = 0; l < 8; ++l) {
            const Real8 rows[3] = {middle[l] - tilt[l], middle[l], middle[l] + tilt[l]};
            for (int p = 0; p < 3; ++p) {
                add_pairs<row>(scene, at, k + l, p, grid, rows[p]);
                if (with_mass) add_third(scene, at, k + l, p, grid, half(masses[l % 4], l / 4));
            }
        }
    }
}

// What the forward pass records for the adjoint; null pointers record nothing.
struct Tape {
    Block* states = nullptr;        // [substeps][blocks] at the start of each substep
    Real* velocity = nullptr;       // two numbers a node in use, one substep after the other: before gravity
    Real* inverse_mass = nullptr;   // one number a node in use
    Box* boxes = nullptr;           // [substeps] nodes in use
    size_t* offsets = nullptr;      // [substeps] where a substep's nodes begin

    Record record(int64_t substep, int i) const {
        if (!velocity) return {};
        const Box& box = boxes[substep];
        const size_t node = offsets[substep] + size_t(i - box.i0) * (box.j1 - box.j0 + 1);
        return {velocity + 2 * node, inverse_mass + node};
    }
};

// The tape of a large scene does not fit into the caches, and its blocks are too far apart for hardware prefetching.
// Blocks that will be written are prefetched too, or the stores would wait for them.
INLINE void prefetch(const Block* block, size_t size) {
    const char* start = reinterpret_cast<const char*>(block);
    for (size_t line = 0; line < size; line += 64) __builtin_prefetch(start + line, 0, 2);
}

class Forward {
public:
    using Work = Workspace;

    Forward(const Scene& scene, Workspace& work, Member& member, Tape tape = {})
        : scene(scene), work(work), member(member), tape(tape) {}

    // All members of the team call this together.
    void run(int64_t which) {
        element = which;
        prepare();
        const int64_t substeps = scene.call.substeps;
        for (int64_t s = 0; s < substeps; ++s) {
            particles(s, s > 0, true);
            nodes(s);
            member.wait();
        }
        if (tape.states) return;
        particles(substeps, true, false);
        own_blocks([&](int, int block) { store(scene, block, element, work.state[block], scene.call.result); });
    }

    // The blocks that this thread advances.
    template <class Function> void own_blocks(Function f) const {
        for (int part = member.rank; part < scene.parts; part += member.size)
            for (int block = scene.part_begin(part); block < scene.part_begin(part + 1); ++block) f(part, block);
    }

private:
    const Scene& scene;
    Workspace& work;
    Member& member;
    const Tape tape;
    int64_t element = 0;
    Stencil at;
    Actuation actuation;
    Impulse impulse;

    void prepare() {
        own_blocks([&](int, int block) {
            load(scene, block, element, scene.call.components, work.state[block]);
            load_values(scene, block, element, work.values);
        });
        for (int part = member.rank; part < scene.parts; part += member.size) work.sums[part].set_row(Sums::TRIPLES);
        if (member.rank == 0) work.rules.build(scene, scene.call.shift + 2 * element);
        if (member.rank == member.size - 1 && scene.muscles) load_field(scene, element, work.field);
        actuation.none();
        member.wait();
    }

    void particles(int64_t substep, bool finishing, bool beginning) {
        const Real* origin = scene.call.origin + 2 * element;
        for (int part = member.rank; part < scene.parts; part += member.size) work.sums[part].box = {};
        own_blocks([&](int part, int index) {
            Block& block = work.state[index];
            Block* record = tape.states ? tape.states + substep * scene.blocks + index : nullptr;
            if (record) prefetch(record, sizeof(Block));
            if (finishing) {
                at.locate(scene, origin, block);
                advance(scene, work.velocity, at, block);
            }
            if (record) record_state(block, scene.body(index), *record);
            if (!beginning) return;
            at.locate(scene, origin, block);
            scatter_block(index, block, work.sums[part]);
        });
        member.wait();
    }

    // Jp is only needed for snow.
    static void record_state(const Block& block, const Body& body, Block& to) {
        const int components = body.kind == Kind::snow ? COMPONENTS : JP;
        std::copy_n(block.v[0], components * LANES, to.v[0]);
    }

    void scatter_block(int index, Block& block, Sums& sums) {
        const Body& body = scene.body(index);
        const bool actuated = body.muscle && scene.muscles;
        if (actuated) {
            actuation.sample(scene, at, work.field);
        } else if (scene.muscles) {
            actuation.none();
        }
        Real uniform[VALUES];
        deform(scene, body, work.values_of(scene, index, element, uniform), at, actuation, block, impulse);
        sums.reserve(at.box, scene.width);
        sums.box.include(at.box);
        scatter<true>(scene, impulse, at, sums.nodes);
    }

    void nodes(int64_t substep) {
        Box box;
        for (const Sums& part : work.sums) box.include(part.box);
        if (tape.boxes) record_box(substep, box);
        Real* total = work.total + member.rank * Workspace::row_length(scene);
        const Rows rows(box, member.rank, member.size);
        for (int i = rows.begin; i < rows.end; ++i) {
            collect(work.sums.data(), scene.parts, box, i, scene.width, total);
            node_velocities(scene, scene.call.gravity + 2 * element, work.rules, box, i, total, work.velocity,
                            tape.record(substep, i));
        }
    }

    void record_box(int64_t substep, const Box& box) {
        if (member.rank == 0) {
            tape.boxes[substep] = box;
            tape.offsets[substep] = substep ? tape.offsets[substep - 1] + tape.boxes[substep - 1].nodes() : 0;
        }
        member.wait();
    }
};
