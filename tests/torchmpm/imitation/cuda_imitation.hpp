// The machine of torchmpm/native/cuda/machine.cuh on one CPU thread. Each CUDA thread is a fibre with a stack of its
// own; a fibre runs until it comes to a barrier or waits for another block, and then a random one of those that can go
// on does. So whatever order of threads the kernels rely on without a barrier is broken sooner or later. Compiled with
// TORCHMPM_REAL_THREADS, each CUDA thread is a thread of the system instead, for ThreadSanitizer.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <limits>
#include <random>
#include <vector>

#define KERNEL extern "C"
#define GRID_CONSTANT
#define THREAD (imitation::self().thread)
#define BLOCK (imitation::self().block->index)
#define BLOCKS (imitation::machine().blocks())
#define BARRIER(name) imitation::barrier(name)

namespace imitation {

// What a launch came to.
enum Outcome : int { DONE, DIVERGED, STUCK, OUT_OF_BOUNDS };

struct Block {
    int index;
    std::vector<char> shared;
    int waiting = 0, finished = 0, barrier = -1;
};

struct Fibre;
struct Machine;
Fibre& self();
Machine& machine();

}  // namespace imitation

#ifdef TORCHMPM_REAL_THREADS
#include "real_threads.hpp"
#else
#include "fibres.hpp"
#endif

INLINE char* shared_memory() { return imitation::self().block->shared.data(); }

template <Atomic name, class Number> void add(Number* to, Number value) {
    imitation::update(name, to, [=](Number old) { return Number(old + value); });
}
template <Atomic name> void raise(int* to, int value) {
    imitation::update(name, to, [=](int old) { return old > value ? old : value; });
}
template <Atomic name> uint32_t count(uint32_t* counter) {
    return imitation::update(name, counter, [](uint32_t old) { return old + 1; });
}
template <class Number> Number look(Number* at) { return imitation::look(at); }
template <class Number> void mark(Number* at) { imitation::mark(at); }
inline void fence() {}

// As on a GPU, numbers that are too large become the largest integer, and NaN becomes 0.
template <class Integer> void round_to(Real value, Integer& to) {
    constexpr Real end = Real(std::numeric_limits<Integer>::max());
    to = value >= end     ? std::numeric_limits<Integer>::max()
         : value <= -end  ? std::numeric_limits<Integer>::min()
         : value == value ? Integer(std::llrint(value))
                          : 0;
}
