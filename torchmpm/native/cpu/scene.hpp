// The arguments of a call, as torchmpm/native/kernels.py lays them out, and what the kernels derive from them.
#pragma once
#include <algorithm>
#include <vector>

#include "../common/node.hpp"
#include "../common/stencil.hpp"
#include "../common/tables.hpp"
#include "simd.hpp"
#include "team.hpp"

// Documented in torchmpm/native/tables.py.
struct Tables {
    int64_t resolution, num_bodies, num_rules;
    double h, dt, margin, extent, damping, mass_epsilon, stretch_floor;
    const BodyTable* bodies;
    const RuleTable* rules;
};

// Tensors of one call, all contiguous; a null pointer stands for one that is not there.
struct Call {
    int64_t batch, particles, substeps, threads;
    Pool pool;
    const Tables* tables;
    const Real* components;      // (13, batch, particles)
    const Real* field;       // (batch, 2, resolution, resolution)
    const Real* origin;      // (batch, 2)
    const int64_t* shift;    // (batch, 2) whole nodes between the world's origin and the window's
    const Real* gravity;     // (batch, 2)
    const Real* values;      // (VALUES, values_batch, columns)
    int64_t values_batch, columns;
    Real* result;            // (13, batch, particles)
    // Backward only: derivative of a loss in the result, and room for its derivatives in the inputs.
    const Real* result_bar;  // (13, batch, particles)
    Real *components_bar, *field_bar, *origin_bar, *gravity_bar;
    Real* values_bar;        // (VALUES, batch, particles): always one column per particle
};

struct Body {
    int count;     // particles
    Kind kind;
    bool muscle;
    bool varying;  // one column of values per particle instead of one for all
    int column;    // first column in the table of values
    Bounds bounds;
    int first;     // first particle
    int first_block;
};

struct Rule : Wall {
    double range[2][2];  // inclusive nodes in x and y
    bool world;
    int slot;
};

struct Scene {
    Call call;
    int resolution, width, blocks = 0, parts;
    Real h, inverse_h, dt, margin, extent, damping, mass_epsilon;
    bool muscles = false, varying = false;
    std::vector<Body> bodies;
    std::vector<Rule> rules;
    std::vector<int> body_of_block;

    explicit Scene(const Call& given) : call(given) {
        const Tables& t = *call.tables;
        resolution = int(t.resolution), width = resolution + 2 * PAD;
        h = Real(t.h), inverse_h = Real(1 / t.h), dt = Real(t.dt), damping = Real(t.damping);
        margin = Real(t.margin), extent = Real(t.extent);
        mass_epsilon = Real(t.mass_epsilon);
        for (const BodyTable* b = t.bodies; b != t.bodies + t.num_bodies; ++b) add(*b, Real(t.stretch_floor));
        for (const RuleTable* r = t.rules; r != t.rules + t.num_rules; ++r)
            rules.push_back({{int(r->axis), Real(r->sign), Real(r->friction)},
                             {{r->i_low, r->i_high}, {r->j_low, r->j_high}},
                             r->world != 0,
                             int(r->slot)});
        // The groups of blocks that are summed separately depend only on the particles of one simulation, so results do
        // not depend on threads or on the other simulations of the batch.
        parts = blocks < 16 ? 1 : blocks < 128 ? 2 : blocks < 512 ? 4 : 8;
    }

    void add(const BodyTable& b, Real stretch_floor) {
        bodies.push_back({int(b.count), Kind(int(b.kind)), b.muscle != 0, b.varying != 0, int(b.column),
                          b.bounds(stretch_floor), int(b.first), blocks});
        blocks += (bodies.back().count + LANES - 1) / LANES;
        body_of_block.resize(blocks, int(bodies.size()) - 1);
        muscles |= bodies.back().muscle && call.field;
        varying |= bodies.back().varying;
    }

    int part_begin(int part) const { return int(int64_t(blocks) * part / parts); }
    const Body& body(int block) const { return bodies[body_of_block[block]]; }
    Domain domain(const Real* origin) const { return {origin[0], origin[1], inverse_h, margin, extent, resolution}; }
    // The particles of a block among all particles.
    int first_particle(int block) const { return body(block).first + (block - body(block).first_block) * LANES; }
    int particles_in(int block) const {
        return std::min(LANES, body(block).first + body(block).count - first_particle(block));
    }
};
