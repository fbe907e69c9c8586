// What the kernels ask of the machine. Tests define TORCHMPM_IMITATION and bring their own: each thread of a block as a
// fibre of one CPU thread. Barriers and atomic operations have names, so that tests can take any one of them away.
#pragma once

// Each is passed by all threads of a block.
enum Barrier : int {
    FREE,        // the last robot's memory is not in use any more
    PREPARED,    // tables are ready, and sums are zero
    SURVEYED,    // all particles have been located
    PLACED,      // the actuation of the nodes in the window has been read
    GIVEN,       // P2G: all particles have given mass and momentum to the nodes
    MOVED,       // all nodes have their velocities
    FOLLOWED,    // the window has moved, and the actuation in it has been read again
    JOINED,      // the blocks of a team have waited for each other
    SUMMARISED,  // and the summary is that of all of them
    REVERSED,    // adjoint: all particles have passed on their derivatives
    RETURNED,    // adjoint: all nodes have passed on theirs
    SHARED_OUT,  // adjoint: the threads' shares of a sum are there
    BARRIERS
};

enum Atomic : int {
    ADD_MASS,
    ADD_MOMENTUM_X,
    ADD_MOMENTUM_Y,
    SUMMARISE,       // threads of a block
    SUMMARISE_TEAM,  // blocks of a team
    ARRIVE,
    ADD_VELOCITY_BAR_X,
    ADD_VELOCITY_BAR_Y,
    ADD_FIELD_BAR_X,
    ADD_FIELD_BAR_Y,
    ADD_SHARE,  // threads of a block
    ADD_SUM,    // blocks of a team
    ATOMICS
};

#ifdef TORCHMPM_IMITATION
#include "cuda_imitation.hpp"
#else

#define KERNEL extern "C" __global__ __launch_bounds__(TORCHMPM_THREADS, 1)
#define GRID_CONSTANT __grid_constant__
#define THREAD int(threadIdx.x)
#define BLOCK int(blockIdx.x)
#define BLOCKS int(gridDim.x)
#define BARRIER(name) __syncthreads()

INLINE char* shared_memory() {
    extern __shared__ __align__(16) char memory[];
    return memory;
}

template <Atomic> INLINE void add(int32_t* to, int32_t value) { atomicAdd(to, value); }
template <Atomic> INLINE void add(int64_t* to, int64_t value) {
    atomicAdd(reinterpret_cast<uint64_t*>(to), static_cast<uint64_t>(value));
}
template <Atomic> INLINE void add(Real* to, Real value) { atomicAdd(to, value); }
template <Atomic> INLINE void raise(int* to, int value) { atomicMax(to, value); }
template <Atomic> INLINE uint32_t count(uint32_t* counter) { return atomicAdd(counter, 1u); }
// Numbers that other threads may be writing.
template <class Number> INLINE Number look(Number* at) { return *static_cast<volatile Number*>(at); }
template <class Number> INLINE void mark(Number* at) { *at = 1; }
// Orders what a thread wrote before an atomic operation with what others read after they saw it.
INLINE void fence() { __threadfence(); }

// The nearest integer.
INLINE void round_to(Real value, int32_t& to) {
    to = sizeof(Real) == 4 ? __float2int_rn(float(value)) : __double2int_rn(value);
}
INLINE void round_to(Real value, int64_t& to) {
    to = sizeof(Real) == 4 ? __float2ll_rn(float(value)) : __double2ll_rn(value);
}

#endif
