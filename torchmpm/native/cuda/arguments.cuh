// What the launcher hands to a kernel by value, as torchmpm/native/cuda/arguments.py lays it out: eight bytes a member.
#pragma once
#include "tables.hpp"

// Tensors are contiguous; a null pointer stands for one that is not there.
struct Arguments {
    int64_t batch, particles, substeps;
    int64_t resolution, num_bodies, num_rules;
    int64_t rows, columns;  // nodes of a window in x and y: at most resolution + 2 PAD
    int64_t team;           // blocks that share a robot
    int64_t values_batch, value_columns;
    int64_t scratch_bytes;  // of a team
    double h, dt, margin, extent, damping, mass_epsilon, stretch_floor;
    const BodyTable* bodies;
    const RuleTable* rules;
    const Real* components;  // (13, batch, particles)
    const Real* field;       // (batch, 2, resolution, resolution)
    const Real* origin;      // (batch, 2)
    const int64_t* shift;    // (batch, 2) whole nodes between the world's origin and the window's
    const Real* gravity;     // (batch, 2)
    const Real* values;      // (VALUES, values_batch, value_columns)
    Real* result;            // (13, batch, particles), forward only
    // Adjoint only: derivative of a loss in the result, and room for its derivatives in the inputs.
    const Real* result_bar;  // (13, batch, particles)
    Real *components_bar, *field_bar, *origin_bar, *gravity_bar;
    Real* values_bar;  // (VALUES, batch, particles): always one column per particle
    // A kernel with nodes in shared memory writes for each robot whether it managed it, 0, or why not. A kernel with
    // nodes in global memory takes the robots whose status is not 0, and all of them where there is none.
    int32_t* status;     // (batch)
    uint32_t* counters;  // (teams, COUNTERS), zero, where several blocks share a robot
    char* scratch;       // (teams, scratch_bytes)
};

constexpr int COUNTERS = 64;  // of a team, so that no two teams share a cache line
