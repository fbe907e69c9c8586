// Each CUDA thread as a thread of the system, for ThreadSanitizer.
#pragma once
#include <atomic>
#include <condition_variable>
#include <mutex>
#include <thread>

namespace imitation {

struct Fibre {
    int thread;
    Block* block;
};

struct Machine {
    int threads;
    std::function<void()> kernel;
    std::vector<Block> all;
    std::mutex mutex;
    std::condition_variable changed;

    int blocks() const { return int(all.size()); }

    void launch(int grid, size_t shared_bytes);

    void wait(Block& block, int barrier) {
        std::unique_lock<std::mutex> lock(mutex);
        const int turn = block.finished;  // counts the barriers that have been passed
        if (++block.waiting == threads)
            block.waiting = 0, ++block.finished, changed.notify_all();
        else
            changed.wait(lock, [&] { return block.finished != turn; });
    }
};

inline Machine* current = nullptr;
inline thread_local Fibre own;
inline Machine& machine() { return *current; }
inline Fibre& self() { return own; }
inline void barrier(int name) { current->wait(*own.block, name); }

inline void Machine::launch(int grid, size_t shared_bytes) {
    all.resize(grid);
    std::vector<std::thread> running;
    for (int b = 0; b < grid; ++b) all[b].index = b, all[b].shared.assign(shared_bytes, char(0xCB));
    for (int t = 0; t < grid * threads; ++t)
        running.emplace_back([this, t] {
            own = {t % threads, &all[t / threads]};
            kernel();
        });
    for (std::thread& thread : running) thread.join();
}

template <class Number, class Function> Number update(int, Number* at, Function f) {
    std::atomic_ref<Number> number(*at);
    Number old = number.load();
    while (!number.compare_exchange_weak(old, f(old))) {
    }
    return old;
}
template <class Number> Number look(Number* at) { return std::atomic_ref<Number>(*at).load(); }
template <class Number> void mark(Number* at) { std::atomic_ref<Number>(*at).store(1); }

}  // namespace imitation
