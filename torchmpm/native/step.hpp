// A step of many substeps. One pass over the particles finishes a substep and begins the next: read velocities from the
// nodes, move, deform, add mass and momentum to the nodes.
#pragma once
#include "workspace.hpp"

// What a block's particles give to the nodes: mass, momentum, and the affine momentum -dt V 4/h^2 tau + m C.
struct alignas(64) Impulse {
    Real mass[LANES], vx[LANES], vy[LANES], affine[4][LANES];
};

// Muscle actuation of a block's particles.
struct alignas(64) Pull {
    Real x[LANES], y[LANES];

    void none() { std::fill_n(x, LANES, Real(0)), std::fill_n(y, LANES, Real(0)); }

    void sample(const Nodes<2>& nodes, const Stencil& at) {
#pragma omp simd
        for (int k = 0; k < LANES; ++k) {
            Real sx = 0, sy = 0;
            three([&](int p) {
                Real rx = 0, ry = 0;
                three([&](int q) {
                    rx += at.wy[q][k] * nodes.v[3 * p + q][0][k];
                    ry += at.wy[q][k] * nodes.v[3 * p + q][1][k];
                });
                sx += at.wx[p][k] * rx, sy += at.wx[p][k] * ry;
            });
            x[k] = sx, y[k] = sy;
        }
    }
};

// New velocity and affine matrix from the velocities of the nodes, and the way they carry the particles.
INLINE void advance(const Scene& scene, const Nodes<2>& nodes, const Stencil& at, Block& block) {
    const Real dt = scene.dt, scale = 4 * scene.inverse_h;
#pragma omp simd
    for (int k = 0; k < LANES; ++k) {
        Real v[2] = {0, 0}, slope_x[2] = {0, 0}, slope_y[2] = {0, 0};
        three([&](int p) {
            Real across[2] = {0, 0}, tilt[2] = {0, 0};
            three([&](int q) {
                const Real w = at.wy[q][k], wd = w * (q - at.fy[k]);
                for (int c = 0; c < 2; ++c) {
                    across[c] += w * nodes.v[3 * p + q][c][k];
                    tilt[c] += wd * nodes.v[3 * p + q][c][k];
                }
            });
            const Real w = at.wx[p][k], wd = w * (p - at.fx[k]);
            for (int c = 0; c < 2; ++c) {
                v[c] += w * across[c], slope_x[c] += wd * across[c], slope_y[c] += w * tilt[c];
            }
        });
        const bool on = at.on[k] != 0;
        block.v[X][k] = on ? block.v[X][k] + dt * v[0] : block.v[X][k];
        block.v[Y][k] = on ? block.v[Y][k] + dt * v[1] : block.v[Y][k];
        block.v[VX][k] = on ? v[0] : block.v[VX][k];
        block.v[VY][k] = on ? v[1] : block.v[VY][k];
        block.v[C0][k] = on ? scale * slope_x[0] : block.v[C0][k];
        block.v[C1][k] = on ? scale * slope_y[0] : block.v[C1][k];
        block.v[C2][k] = on ? scale * slope_x[1] : block.v[C2][k];
        block.v[C3][k] = on ? scale * slope_y[1] : block.v[C3][k];
    }
}

INLINE Mat2 matrix(const Block& block, int first, int k) {
    return {block.v[first][k], block.v[first + 1][k], block.v[first + 2][k], block.v[first + 3][k]};
}

// I + dt C
INLINE Mat2 growth(Real dt, Mat2 C) { return {1 + dt * C.a, dt * C.b, dt * C.c, 1 + dt * C.d}; }

// Deform one particle and find what it gives to the nodes. A function of its own, because structures that are declared in
// the body of a vector loop would be kept in memory.
template <Kind kind>
INLINE void deform_one(Real dt, Values m, Bounds bounds, bool on, Real pull_x, Real pull_y, int k, Block& block,
                       Impulse& out) {
    const Mat2 C = matrix(block, C0, k), old = matrix(block, F0, k);
    const Real before = block.v[JP][k], hard = hardened<kind>(m, bounds, before);
    Mat2 F = matmul(growth(dt, C), old);
    Real Jp = before;
    const Direction R = return_map<kind>(m, bounds, F, Jp);
    const Sym2 tau = stress<kind>(m, hard, F, R, pull_x, pull_y);
    out.mass[k] = m.mass;
    out.vx[k] = m.mass * block.v[VX][k], out.vy[k] = m.mass * block.v[VY][k];
    out.affine[0][k] = m.factor * tau.xx + m.mass * C.a, out.affine[1][k] = m.factor * tau.xy + m.mass * C.b;
    out.affine[2][k] = m.factor * tau.xy + m.mass * C.c, out.affine[3][k] = m.factor * tau.yy + m.mass * C.d;
    block.v[F0][k] = on ? F.a : old.a, block.v[F1][k] = on ? F.b : old.b;
    block.v[F2][k] = on ? F.c : old.c, block.v[F3][k] = on ? F.d : old.d;
    if (kind == Kind::soil) block.v[JP][k] = on ? Jp : before;
}

template <Kind kind, bool varying>
void deform(const Scene& scene, const Real* table, Bounds bounds, const Stencil& at, const Pull& pull, Block& block,
            Impulse& out) {
    const Real dt = scene.dt;
    const Values shared = values_at<false>(table, 0);
#pragma omp simd
    for (int k = 0; k < LANES; ++k)
        deform_one<kind>(dt, varying ? values_at<true>(table, k) : shared, bounds, at.on[k] != 0, pull.x[k], pull.y[k],
                         k, block, out);
}

INLINE void deform(const Scene& scene, const Body& body, const Real* table, const Stencil& at, const Pull& pull,
                   Block& block, Impulse& out) {
    using Function = void (*)(const Scene&, const Real*, Bounds, const Stencil&, const Pull&, Block&, Impulse&);
    static constexpr Function table_of[3][2] = {
        {deform<Kind::elastic, false>, deform<Kind::elastic, true>},
        {deform<Kind::von_mises, false>, deform<Kind::von_mises, true>},
        {deform<Kind::soil, false>, deform<Kind::soil, true>},
    };
    table_of[int(body.kind)][body.varying](scene, table, body.bounds, at, pull, block, out);
}

// Mass and momentum for each of the nine nodes.
INLINE void spread(const Scene& scene, const Impulse& in, const Stencil& at, Nodes<3>& out) {
    const Real h = scene.h;
#pragma omp simd
    for (int k = 0; k < LANES; ++k) {
        three([&](int p) {
            const Real dx = (p - at.fx[k]) * h;
            const Real x = in.vx[k] + in.affine[0][k] * dx, y = in.vy[k] + in.affine[2][k] * dx;
            three([&](int q) {
                const Real dy = (q - at.fy[k]) * h, w = at.wx[p][k] * at.wy[q][k];
                out.v[3 * p + q][0][k] = w * (x + in.affine[1][k] * dy);
                out.v[3 * p + q][1][k] = w * (y + in.affine[3][k] * dy);
                out.v[3 * p + q][2][k] = w * in.mass[k];
            });
        });
    }
}

// Where the forward pass leaves what the adjoint needs; null pointers keep nothing.
struct Tape {
    Block* states = nullptr;         // [substeps][blocks] at the start of each substep
    Real* velocity = nullptr;        // [substeps][2 cells] of nodes, before gravity
    Real* inverse_mass = nullptr;    // [substeps][cells]
    Box* boxes = nullptr;            // [substeps] of nodes in use

    Record record(const Scene& scene, int64_t substep) const {
        if (!velocity) return {};
        const size_t cells = size_t(scene.width) * scene.width;
        return {velocity + 2 * cells * substep, inverse_mass + cells * substep};
    }
};

class Forward {
public:
    using Work = Workspace;

    Forward(const Scene& scene, Workspace& work, int rank, int team, Tape tape = {})
        : scene(scene), work(work), rank(rank), team(team), tape(tape) {}

    // All members of the team call this together.
    void run(int64_t which) {
        element = which;
        prepare();
        const int64_t substeps = scene.call.substeps;
        for (int64_t s = 0; s < substeps; ++s) {
            particles(s, s > 0, true);
            nodes(s);
        }
        if (tape.states) return;
        particles(substeps, true, false);
        own_blocks([&](int, int block) { store(scene, block, element, work.state[block], scene.call.result); });
    }

private:
    const Scene& scene;
    Workspace& work;
    const int rank, team;
    const Tape tape;
    int64_t element = 0;
    Stencil at;
    Nodes<2> read;
    Nodes<3> written;
    Pull pull;
    Impulse impulse;

    template <class Function> void own_blocks(Function f) {
        for (int part = rank; part < scene.parts; part += team)
            for (int block = scene.part_begin(part); block < scene.part_begin(part + 1); ++block) f(part, block);
    }

    void prepare() {
        own_blocks([&](int, int block) {
            load(scene, block, element, scene.call.planes, work.state[block]);
            load_values(scene, block, element, work.values);
        });
        if (rank == 0) work.rules.build(scene, scene.call.shift + 2 * element);
        if (rank == team - 1 && scene.muscles) load_field(scene, element, work.field);
        pull.none();
        work.barrier.wait();
    }

    void particles(int64_t substep, bool arriving, bool leaving) {
        const Real* origin = scene.call.origin + 2 * element;
        for (int part = rank; part < scene.parts; part += team) work.sums[part].box = {};
        own_blocks([&](int part, int index) {
            Block& block = work.state[index];
            if (arriving) {
                at.locate(scene, origin, block);
                gather(work.velocity, at, scene.width, read);
                advance(scene, read, at, block);
            }
            if (tape.states) tape.states[substep * scene.blocks + index] = block;
            if (!leaving) return;
            at.locate(scene, origin, block);
            give(index, block, work.sums[part]);
        });
        work.barrier.wait();
    }

    void give(int index, Block& block, Sums& sums) {
        const Body& body = scene.body(index);
        const bool pulls = body.muscle && scene.muscles;
        if (pulls) {
            gather(work.field, at, scene.width, read);
            pull.sample(read, at);
        } else if (scene.muscles) {
            pull.none();
        }
        Real uniform[VALUES];
        deform(scene, body, work.values_of(scene, index, element, uniform), at, pull, block, impulse);
        spread(scene, impulse, at, written);
        sums.reserve(at.box, scene.width);
        sums.box.include(at.box);
        scatter(written, at, scene.width, sums.nodes);
    }

    void nodes(int64_t substep) {
        Box box;
        for (const Sums& part : work.sums) box.include(part.box);
        const int rows = box.empty() ? 0 : box.i1 - box.i0 + 1;
        Real* total = work.total + rank * Workspace::row_length(scene);
        for (int i = box.i0 + rows * rank / team; i < box.i0 + rows * (rank + 1) / team; ++i) {
            collect(work.sums.data(), scene.parts, box, i, scene.width, total);
            node_velocities(scene, scene.call.gravity + 2 * element, work.rules, box, i, total, work.velocity,
                            tape.record(scene, substep));
        }
        if (tape.boxes && rank == 0) tape.boxes[substep] = box;
        work.barrier.wait();
    }
};
