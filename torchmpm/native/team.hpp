// Threads that live for one call. None waits idle between calls, so nothing spins beside other programs and a forked
// process inherits nothing.
#pragma once
#include <atomic>
#include <system_error>
#include <thread>
#include <vector>

#if defined(__x86_64__)
#include <immintrin.h>
#define RELAX() _mm_pause()
#else
#define RELAX() ((void)0)
#endif

class Barrier {
public:
    explicit Barrier(int members) : size(members) {}

    void wait() {
        if (size == 1) return;
        const int now = phase.load(std::memory_order_relaxed);
        if (waiting.fetch_add(1, std::memory_order_acq_rel) == size - 1) {
            waiting.store(0, std::memory_order_relaxed);
            phase.store(now + 1, std::memory_order_release);
            return;
        }
        // The others are a few microseconds away, unless they lost their core: then so do we.
        for (int spins = 0; phase.load(std::memory_order_acquire) == now; ++spins)
            if (spins < 500)
                RELAX();
            else
                std::this_thread::yield();
    }

private:
    const int size;
    alignas(64) std::atomic<int> waiting{0};
    alignas(64) std::atomic<int> phase{0};
};

// Run `function(rank)` for all ranks at once, the first on this thread. Returns false, without having called it, where
// the system gives out no more threads.
template <class Function> bool run_together(int threads, Function function) {
    std::atomic<int> gate{0};  // 1: go, 2: go home
    std::vector<std::thread> others;
    const auto enter = [&](int rank) {
        while (gate.load(std::memory_order_acquire) == 0) std::this_thread::yield();
        if (gate.load(std::memory_order_acquire) == 1) function(rank);
    };
    try {
        for (int rank = 1; rank < threads; ++rank) others.emplace_back(enter, rank);
        gate.store(1, std::memory_order_release);
    } catch (const std::system_error&) {
        gate.store(2, std::memory_order_release);
    }
    const bool go = gate.load() == 1;
    if (go) function(0);
    for (std::thread& other : others) other.join();
    return go;
}
