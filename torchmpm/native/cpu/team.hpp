// Threads: those of torch's OpenMP runtime if it can be reached. After an operator they spin for some milliseconds waiting
// for the next one, so threads of our own would have to share the cores with them. Otherwise threads live for one call.
//
// A team waits for all its members several times per substep. When other programs occupy a core, one descheduled member
// holds up all others at every barrier, so a step on two threads gets slower than on one: measured with three busy
// processes on two cores, four times (benchmarks/test_solver.py, test_beside_other_programs). Then the first member goes on
// alone and calls the others back after some milliseconds.
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
    using Clock = std::chrono::steady_clock;

    const int size;
    std::atomic<int64_t> stalled{0};  // nanoseconds that members waited in total

    explicit Barrier(int members) : size(members) {}

    // The wait is added to `stalled` if it `counts`.
    void wait(bool counts) {
        if (size == 1) return;
        const int now = phase.load(std::memory_order_relaxed);
        if (waiting.fetch_add(1, std::memory_order_acq_rel) == size - 1) {
            waiting.store(0, std::memory_order_relaxed);
            phase.store(now + 1, std::memory_order_release);
            return;
        }
        // The others arrive within microseconds, unless they were descheduled.
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
        if (counts) stalled += std::chrono::nanoseconds(Clock::now() - since).count();
    }

private:
    alignas(64) std::atomic<int> waiting{0};
    alignas(64) std::atomic<int> phase{0};
};

// State shared by the members of a team.
struct Team {
    using Clock = Barrier::Clock;

    Barrier barrier;
    bool suspended = false;  // whether the first member goes on alone
    int64_t substep = 0;     // at which it called the others back
    bool alone = false;      // this and all below belong to the first member only
    Clock::time_point since{};

    explicit Team(int members) : barrier(members) {}

    void begin(bool by_itself) { alone = by_itself, barrier.stalled = 0, since = Clock::now(); }

    int64_t nanoseconds() const { return std::chrono::nanoseconds(Clock::now() - since).count(); }
    bool is_stalled() const {
        const int64_t passed = nanoseconds();
        return passed > 1000000 && 2 * barrier.stalled > passed * (barrier.size - 1);
    }
};

// One thread of a team.
struct Member {
    int rank, size;
    Team& team;

    void wait(bool counts = true) {
        if (size > 1) team.barrier.wait(counts);
    }

    // Wait for the others at the end of a substep. Members that the first one leaves behind wait until it calls them back,
    // and go on at its substep.
    void finish(int64_t& substep, bool last) {
        if (team.barrier.size == 1) return;
        if (rank > 0) {
            team.barrier.wait(true);
            if (!team.suspended) return;
            team.barrier.wait(false);
            substep = team.substep;
        } else if (team.alone) {
            if (!last && team.nanoseconds() < 5000000) return;
            team.substep = substep, size = team.barrier.size;
            team.barrier.wait(false);
            team.begin(false);
        } else {
            team.suspended = !last && team.is_stalled();
            if (team.suspended) size = 1;
            team.barrier.wait(true);
            if (team.suspended) team.begin(true);
        }
    }
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
