// The threads that advance one robot: those of a block, or of several blocks that wait for each other.
#pragma once
#include "arguments.cuh"
#include "fixed.cuh"

// What all particles, or all nodes, of a substep have in common: the largest number of each kind.
enum Summary : int {
    LEFT,  // minus the least first node of a particle's stencil
    BOTTOM,
    RIGHT,  // the largest
    TOP,
    FASTEST,   // rank of the largest speed, see fixed.cuh
    HEAVIEST,  // rank of the largest mass, of a particle before the first substep and then of a node
    FAILURE,   // 0, or why the robot is given up
    SPILL,     // the same of the nodes, which begin while particles' failures are still being read
    SUMMARY
};
enum Failure : int { NONE, LEFT_WINDOW, LEFT_RANGE };
constexpr int NOWHERE = -(1 << 28);

struct Team {
    int rank, size;       // of this thread among all
    int block, blocks;    // of the robot
    int (*own)[SUMMARY];  // [3] of this block, in shared memory
    int (*all)[SUMMARY];  // [3] of the team, in global memory
    uint32_t* counter;

    // Three substeps at a time: while one is being read, the next is being written, and the one after is cleared.
    INLINE int* of(int substep) const { return own[(substep + 3) % 3]; }

    // One thread of each block empties the summary of a substep to come.
    INLINE void clear(int substep) const {
        if (THREAD != 0) return;
        for (int k = 0; k < SUMMARY; ++k) {
            const int least = k < FASTEST ? NOWHERE : 0;
            of(substep)[k] = least;
            if (blocks > 1 && block == 0) all[(substep + 3) % 3][k] = least;
        }
    }

    // The compiler lets one thread of a warp do it for all, because they have the same address.
    INLINE void include(int substep, Summary kind, int value) const { raise<SUMMARISE>(of(substep) + kind, value); }

    // Wait for all threads of the team.
    template <Barrier barrier> INLINE void wait() const {
        BARRIER(barrier);
        if (blocks == 1) return;
        if (THREAD == 0) meet();
        BARRIER(JOINED);
    }

    // Also makes the summary of a substep that of all blocks.
    template <Barrier barrier> INLINE void wait_and_summarise(int substep) const {
        BARRIER(barrier);
        if (blocks == 1) return;
        if (THREAD == 0) {
            int* total = all[(substep + 3) % 3];
            for (int k = 0; k < SUMMARY; ++k) raise<SUMMARISE_TEAM>(total + k, of(substep)[k]);
            meet();
            for (int k = 0; k < SUMMARY; ++k) of(substep)[k] = look(total + k);
        }
        BARRIER(SUMMARISED);
    }

private:
    // The counter only grows, and every block passes when it has reached the next multiple of their number.
    INLINE void meet() const {
        fence();
        const uint32_t goal = (count<ARRIVE>(counter) / blocks + 1) * blocks;
        while (int32_t(look(counter) - goal) < 0) {
        }
        fence();
    }
};
