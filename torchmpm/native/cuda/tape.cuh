// What a replay leaves for the adjoint, in the scratch memory of a team: the particles at the start of each substep,
// and of each substep the nodes between sums and velocities, which nodes were in use, and where the window was.
#pragma once
#include "substep.cuh"

class Tape {
public:
    static constexpr bool records = true;

    INLINE Tape(const Arguments& given, Arena& scratch) {
        particles = given.particles, nodes = given.rows * given.columns;
        states = scratch.take<Real>(given.substeps * COMPONENTS * particles);
        raw = scratch.take<Real>(given.substeps * 3 * nodes);
        notes = scratch.take<Note>(given.substeps);
    }

    // Component c of a particle at the start of a substep.
    INLINE Real& state(int64_t substep, int c, int particle) const {
        return states[(substep * COMPONENTS + c) * particles + particle];
    }

    INLINE Record record(int64_t substep) const {
        Real* first = raw + (substep < 0 ? 0 : substep) * 3 * nodes;  // the survey is recorded too, and overwritten
        return {first, first + nodes, first + 2 * nodes};
    }

    // Called by all threads while the summary of the substep holds.
    INLINE void note(int substep, const Robot& robot) const {
        if (robot.team.rank != 0) return;
        Note& to = notes[substep];
        to.i = robot.window.i, to.j = robot.window.j;
        for (int k = 0; k < FASTEST; ++k) to.summary[k] = robot.team.of(substep)[k];
    }
    INLINE void rewind(int substep, Window& window) const { window.i = notes[substep].i, window.j = notes[substep].j; }
    INLINE Box box(int substep) const { return Box(notes[substep].summary); }

private:
    struct Note {
        int i, j;  // first node of the window
        int summary[FASTEST];
        int unused[2];
    };
    int64_t particles, nodes;
    Real *states, *raw;
    Note* notes;
};
