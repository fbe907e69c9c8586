// Threads: those of torch's OpenMP runtime if it can be reached. After an operator they spin for some milliseconds waiting
// for the next one, so threads of our own would have to share the cores with them. Otherwise threads live for one call.
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

// Functions of GNU OpenMP, if torch uses it; else null.
struct Pool {
    void (*parallel)(void (*)(void*), void*, unsigned, unsigned);
    int (*rank)();
    int (*team_size)();
};

// Where the threads of a team wait for each other.
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
        // The others arrive within microseconds, unless they were descheduled.
        for (int turns = 0; phase.load(std::memory_order_acquire) == now; ++turns)
            if (turns < 500)
                RELAX();
            else if (turns < 564)
                std::this_thread::yield();
            else
                std::this_thread::sleep_for(std::chrono::microseconds(50));
    }

private:
    const int size;
    alignas(64) std::atomic<int> waiting{0};
    alignas(64) std::atomic<int> phase{0};
};

// One thread of a team.
struct Member {
    int rank, size;
    Barrier& barrier;

    void wait() { barrier.wait(); }
};

template <class Function> bool run_in_pool(const Pool& pool, int threads, Function function) {
    struct Job {
        const Pool& pool;
        int threads;
        Function& function;
        std::atomic<bool> done;
    } job{pool, threads, function, {true}};
    pool.parallel(
        [](void* data) {
            Job& job = *static_cast<Job*>(data);
            if (job.pool.team_size() == job.threads)
                job.function(job.pool.rank());
            else
                job.done = false;
        },
        &job, unsigned(threads), 0);
    return job.done;
}

// Run `function(rank)` for all ranks at once, the first on this thread. Returns false, without having called it, where
// there are not as many threads.
template <class Function> bool run_together(const Pool& pool, int threads, Function function) {
    if (threads > 1 && pool.parallel) return run_in_pool(pool, threads, function);
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
