// Adjoint of a step. The substeps are replayed onto a tape; then one pass over the particles per substep finishes the
// adjoint of one substep and begins that of the one before.
#pragma once
#include "adjoint_block.hpp"
#include "grid_adjoint.hpp"

struct AdjointWorkspace : Workspace {
    Tape tape;
    Block* bars;             // [blocks] derivatives in the state
    NodeBars nodes;
    Real* gravity_bar;       // two numbers a row of nodes
    Real* origin_bar;        // [parts][2][LANES]
    Real* values_bar;        // [blocks][VALUES][LANES]
    std::vector<Sums> field_bar;  // [parts], two numbers in use

    AdjointWorkspace(const Scene& scene, Arena& arena, int members) : Workspace(scene, arena, members) {
        const size_t cells = size_t(scene.width) * scene.width, slack = 8, substeps = scene.call.substeps;
        tape.states = arena.take<Block>(substeps * scene.blocks);
        tape.velocity = arena.take<Real>(2 * cells * substeps);
        tape.inverse_mass = arena.take<Real>(cells * substeps);
        tape.boxes = arena.take<Box>(substeps);
        tape.offsets = arena.take<size_t>(substeps);
        bars = arena.take<Block>(scene.blocks);
        nodes = {arena.take<Real>(2 * cells + slack), arena.take<Real>(cells + slack)};
        gravity_bar = arena.take<Real>(2 * scene.width);
        origin_bar = arena.take<Real>(size_t(scene.parts) * 2 * LANES);
        values_bar = scene.call.values_bar ? arena.take<Real>(size_t(scene.blocks) * VALUES * LANES) : nullptr;
        if (!scene.muscles || !scene.call.field_bar) return;
        field_bar.resize(scene.parts);
        for (Sums& part : field_bar) part.nodes = arena.take<Real>(Sums::PAIRS * cells);
    }
};

class Adjoint {
public:
    using Work = AdjointWorkspace;

    Adjoint(const Scene& scene, Work& work, Member& member)
        : scene(scene), work(work), member(member), forward(scene, work, member, work.tape) {}

    // All members of the team call this together.
    void run(int64_t which) {
        element = which;
        forward.run(element);
        prepare();
        const int64_t substeps = scene.call.substeps;
        for (int64_t s = substeps; s >= 0; --s) {
            particles(s, s < substeps, s > 0);
            if (s == 0) break;
            nodes(s - 1);
            member.wait();
        }
        finish();
    }

private:
    const Scene& scene;
    Work& work;
    Member& member;
    Forward forward;
    int64_t element = 0;
    Stencil at;
    Nodes velocity, p_bar, field;
    Masses mass_bar;
    Actuation actuation;
    Momentum momentum;
    Impulse impulse;

    Real* origin_bar(int part) { return work.origin_bar + size_t(part) * 2 * LANES; }

    void prepare() {
        actuation.none();
        for (int part = member.rank; part < scene.parts; part += member.size) {
            std::fill_n(origin_bar(part), 2 * LANES, Real(0));
            work.sums[part].set_row(Sums::PAIRS);
            if (!work.field_bar.empty()) work.field_bar[part].cleared = {}, work.field_bar[part].set_row(Sums::PAIRS);
        }
        forward.own_blocks([&](int, int block) {
            load(scene, block, element, scene.call.result_bar, work.bars[block]);
            if (work.values_bar)
                std::fill_n(work.values_bar + size_t(block) * VALUES * LANES, VALUES * LANES, Real(0));
        });
        if (member.rank == 0) std::fill_n(work.gravity_bar, 2 * scene.width, Real(0));
    }

    // Finish the adjoint of substep number `substep`, begin that of the one before it.
    void particles(int64_t substep, bool finishing, bool beginning) {
        const Real* origin = scene.call.origin + 2 * element;
        for (int part = member.rank; part < scene.parts; part += member.size) work.sums[part].box = {};
        forward.own_blocks([&](int part, int index) {
            const Block* state = work.tape.states + substep * scene.blocks + index;
            if (finishing) prefetch(state + 1, sizeof(Block));
            if (beginning) prefetch(state + 1 - scene.blocks, 2 * LANES * sizeof(Real));
            if (finishing) {
                at.locate(scene, origin, *state);
                block_adjoint(index, *state, part);
            }
            if (!beginning) return;
            Sums& sums = work.sums[part];
            at.locate(scene, origin, *(state - scene.blocks));
            velocity_bars(scene, at, work.bars[index], impulse);
            sums.reserve(at.box, scene.width);
            sums.box.include(at.box);
            scatter<false>(scene, impulse, at, sums.nodes);
        });
        member.wait();
    }

    void block_adjoint(int index, const Block& state, int part) {
        const Body& body = scene.body(index);
        Block& bar = work.bars[index];
        const bool actuated = body.muscle && scene.muscles;
        if (actuated) {
            field.read(scene, at, work.field);
            actuation_from_nodes(field, at, actuation);
        } else if (scene.muscles) {
            actuation.none();
        }
        velocity.read(scene, at, work.velocity);
        p_bar.read(scene, at, work.nodes.momentum);
        mass_bar.read(scene, at, work.nodes.mass);
        momentum.collect(scene, p_bar, at);
        Real uniform[VALUES];
        Real* values_bar = work.values_bar ? work.values_bar + size_t(index) * VALUES * LANES : nullptr;
        deform_adjoint(scene, body, work.values_of(scene, index, element, uniform), at, actuation, state, momentum, bar,
                       values_bar);
        const auto positions = actuated ? position_adjoint<true> : position_adjoint<false>;
        positions(scene, at, velocity, p_bar, mass_bar, field, state, momentum, bar, origin_bar(part), values_bar);
        if (body.kind == Kind::snow) drop_unresolved(body.bounds, state, bar);
        if (actuated && !work.field_bar.empty()) {
            work.field_bar[part].reserve(at.box, scene.width);
            scatter_actuation(scene, momentum, at, work.field_bar[part].nodes);
        }
    }

    void nodes(int64_t substep) {
        const Box& box = work.tape.boxes[substep];
        Real* total = work.total + member.rank * Workspace::row_length(scene);
        const Rows rows(box, member.rank, member.size);
        for (int i = rows.begin; i < rows.end; ++i) {
            collect(work.sums.data(), scene.parts, box, i, scene.width, total);
            node_adjoint(scene, scene.call.gravity + 2 * element, work.rules, box, i, total,
                         work.tape.record(substep, i), work.velocity, work.nodes, work.gravity_bar + 2 * i);
        }
    }

    // Write the derivatives to the tensors of the call.
    void finish() {
        const Call& call = scene.call;
        forward.own_blocks([&](int, int block) {
            store(scene, block, element, work.bars[block], call.components_bar);
            if (work.values_bar) store_values(block);
        });
        if (call.field_bar) store_field();
        if (member.rank != 0) return;
        for (int c = 0; c < 2; ++c) {
            Real sum = 0, total = 0;
            for (int i = 0; i < scene.width; ++i) sum += work.gravity_bar[2 * i + c];
            for (int part = 0; part < scene.parts; ++part)
                for (int k = 0; k < LANES; ++k) total += origin_bar(part)[c * LANES + k];
            call.gravity_bar[2 * element + c] = scene.dt * sum;
            call.origin_bar[2 * element + c] = total;
        }
    }

    void store_values(int block) {
        const int64_t n = scene.call.particles, stride = scene.call.batch * n;
        const Real* from = work.values_bar + size_t(block) * VALUES * LANES;
        Real* to = scene.call.values_bar + element * n + scene.first_particle(block);
        for (int r = 0; r < VALUES; ++r) std::copy_n(from + r * LANES, scene.particles_in(block), to + r * stride);
    }

    void store_field() {
        const int n = scene.resolution, width = scene.width;
        Real* out = scene.call.field_bar + 2 * element * n * n;
        for (int i = n * member.rank / member.size; i < n * (member.rank + 1) / member.size; ++i)
            for (int c = 0; c < 2; ++c) {
                Real* row = out + (c * n + i) * n;
                std::fill_n(row, n, Real(0));
                for (const Sums& part : work.field_bar) {
                    const Box& box = part.cleared;
                    if (i + PAD < box.i0 || i + PAD > box.i1) continue;
                    for (int first = box.j0 - PAD; first <= box.j1 - PAD; ++first)
                        for (int j = std::max(first, 0); j < std::min(first + 3, n); ++j)
                            row[j] += part.at(i + PAD, first + PAD, width)[2 * (j - first) + c];
                }
            }
    }
};
