// What a step needs to know, unpacked from the numbers that torchmpm/native/pack.py lays out.
#pragma once
#include <algorithm>
#include <vector>

#include "material.hpp"
#include "team.hpp"

struct Body {
    int count;         // particles
    Kind kind;
    bool muscle;
    bool varying;      // one column of values per particle instead of one for all
    int column;        // first column in the table of values
    Bounds bounds;
    int first;         // first particle
    int first_block;
};

struct Rule {
    int axis;
    Real sign;
    double range[2][2];  // inclusive nodes in x and y
    Real friction;       // infinite: sticks
    bool world;
    int slot;            // rules against one direction share a slot; slots apply in their order
};

// Tensors of one call, all contiguous; a null pointer stands for one that is not there.
struct Call {
    int64_t batch, particles, substeps, threads;
    Pool pool;
    const double* description;
    const Real* planes;      // (13, batch, particles)
    const Real* field;       // (batch, 2, resolution, resolution)
    const Real* origin;      // (batch, 2)
    const int64_t* shift;    // (batch, 2) whole nodes between the world's origin and the window's
    const Real* gravity;     // (batch, 2)
    const Real* values;      // (VALUES, values_batch, columns)
    int64_t values_batch, columns;
    Real* result;            // (13, batch, particles)
    // Backward only: derivative of a loss in the result, and where its derivatives in the inputs go.
    const Real* result_bar;  // (13, batch, particles)
    Real *planes_bar, *field_bar, *origin_bar, *gravity_bar;
    Real* values_bar;        // (VALUES, batch, particles): one column per particle always
};

struct Scene {
    Call call;
    int resolution, width, blocks = 0, parts;
    Real h, inverse_h, dt, margin, extent, damping, mass_epsilon, stretch_floor;
    bool muscles = false, varying = false;
    std::vector<Body> bodies;
    std::vector<Rule> rules;
    std::vector<int> body_of_block;

    explicit Scene(const Call& given) : call(given) {
        const double* d = call.description;
        resolution = int(d[0]), width = resolution + 2 * PAD;
        h = Real(d[1]), inverse_h = Real(1 / d[1]), dt = Real(d[2]), damping = Real(d[4]);
        margin = Real(d[3]), extent = Real(d[0] * d[1] - d[3]);
        mass_epsilon = Real(d[5]), stretch_floor = Real(d[6]);
        const int count = int(d[7]), rule_count = int(d[8]);
        d += 9;
        int first = 0;
        for (int k = 0; k < count; ++k, d += 8) {
            const Bounds bounds{Real(d[5]), Real(d[6]), Real(d[7]), stretch_floor};
            bodies.push_back({int(d[0]), Kind(int(d[1])), d[2] != 0, d[3] > 1, int(d[4]), bounds, first, blocks});
            first += bodies[k].count;
            blocks += (bodies[k].count + LANES - 1) / LANES;
            body_of_block.resize(blocks, k);
            muscles |= bodies[k].muscle && call.field;
            varying |= bodies[k].varying;
        }
        parts = choose_parts();
        for (int k = 0; k < rule_count; ++k, d += 8) {
            Rule rule{int(d[0]), Real(d[1]), {{d[2], d[3]}, {d[4], d[5]}}, Real(d[6]), d[7] != 0, -1};
            int slots = 0;
            for (const Rule& other : rules) {
                slots = std::max(slots, other.slot + 1);
                if (other.axis == rule.axis && other.sign == rule.sign) rule.slot = other.slot;
            }
            if (rule.slot < 0) rule.slot = slots;
            rules.push_back(rule);
        }
    }

    // How many groups of blocks are summed separately depends on nothing but the particles of one simulation, so its
    // result does not depend on threads or on its neighbours in the batch.
    int choose_parts() const { return blocks < 16 ? 1 : blocks < 128 ? 2 : blocks < 512 ? 4 : 8; }

    int part_begin(int part) const { return int(int64_t(blocks) * part / parts); }
    const Body& body(int block) const { return bodies[body_of_block[block]]; }
    // Particles of a block, and where they are among all.
    int first_particle(int block) const { return body(block).first + (block - body(block).first_block) * LANES; }
    int particles_in(int block) const {
        return std::min(LANES, body(block).first + body(block).count - first_particle(block));
    }
};
