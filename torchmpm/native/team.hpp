// Threads that live for one call. None waits idle between calls, so nothing spins beside other programs and a forked
// process inherits nothing.
#pragma once
#include <atomic>
#include <chrono>
#include <system_error>
#include <thread>
#include <vector>

#if defined(__x86_64__)
#include <immintrin.h>
#define RELAX() _mm_pause()
#else
#define RELAX() ((void)0)
#endif

// Where the threads of a team wait for each other.
class Barrier {
    using Clock = std::chrono::steady_clock;

public:
    bool disbanded = false;

    explicit Barrier(int members) : size(members) {}

    void wait() {
        if (size == 1) return;
        const int now = phase.load(std::memory_order_relaxed);
        if (waiting.fetch_add(1, std::memory_order_acq_rel) == size - 1) {
            waiting.store(0, std::memory_order_relaxed);
            phase.store(now + 1, std::memory_order_release);
            return;
        }
        // The others are a few microseconds away, unless they lost their core.
        for (int spins = 0; spins < 500; ++spins) {
            if (phase.load(std::memory_order_acquire) != now) return;
            RELAX();
        }
        const Clock::time_point since = Clock::now();
        for (int turns = 0; phase.load(std::memory_order_acquire) == now; ++turns)
            if (turns < 64)
                std::this_thread::yield();
            else
                std::this_thread::sleep_for(std::chrono::microseconds(50));
        lost += (Clock::now() - since).count();
    }

    void begin() { disbanded = false, lost = 0, start = Clock::now(); }

    // Beside other programs, threads that wait for each other many times a millisecond are slower together than one of
    // them alone. Called by the first member while the others are about to wait.
    void judge() {
        const Clock::rep passed = (Clock::now() - start).count();
        disbanded = passed > Clock::duration(std::chrono::microseconds(300)).count() && 4 * lost > passed * (size - 1);
    }

private:
    const int size;
    Clock::time_point start{};
    alignas(64) std::atomic<int> waiting{0};
    alignas(64) std::atomic<int> phase{0};
    std::atomic<Clock::rep> lost{0};
};

// One thread's place in its team.
struct Member {
    int rank, team;
    Barrier& barrier;

    void wait() {
        if (team > 1) barrier.wait();
    }

    // Wait, and say whether this thread goes on: the team may leave the rest to its first member.
    bool goes_on() {
        if (team == 1) return true;
        if (rank == 0) barrier.judge();
        barrier.wait();
        if (!barrier.disbanded) return true;
        team = 1;
        return rank == 0;
    }
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
