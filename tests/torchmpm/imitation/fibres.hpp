// Fibres, and what a test can break about them.
#pragma once
#include <ucontext.h>

namespace imitation {

struct Fibre {
    int thread;
    Block* block;
    ucontext_t context;
    std::vector<char> stack;
    bool waits = false, ended = false;
};

struct Machine {
    static constexpr size_t STACK = 64 * 1024, MARGIN = 64;
    static constexpr int64_t PATIENCE = 1'000'000;  // turns without an end

    // A barrier that is not there and an atomic operation that is not atomic, or -1.
    int missing_barrier, plain_atomic;
    std::mt19937_64 random;
    std::function<void()> kernel;
    std::vector<Block> all;
    std::vector<Fibre> fibres;
    std::vector<Fibre*> ready;
    Fibre* running = nullptr;
    ucontext_t home;
    Outcome outcome = DONE;

    int blocks() const { return int(all.size()); }

    Outcome launch(int grid, int threads, size_t shared_bytes) {
        all.resize(grid), fibres.resize(size_t(grid) * threads);
        for (int b = 0; b < grid; ++b) all[b].index = b, all[b].shared.assign(shared_bytes + MARGIN, char(0xCB));
        for (size_t f = 0; f < fibres.size(); ++f) begin(fibres[f], int(f % threads), &all[f / threads]);
        for (int64_t turn = 0; !ready.empty() && outcome == DONE; ++turn) {
            if (turn > PATIENCE) outcome = STUCK;
            std::swap(ready[random() % ready.size()], ready.back());
            running = ready.back();
            swapcontext(&home, &running->context);
            if (running->waits || running->ended) ready.pop_back();
            arrive(*running, threads);
        }
        for (const Fibre& fibre : fibres)
            if (outcome == DONE && !fibre.ended) outcome = STUCK;
        for (const Block& block : all)
            for (size_t k = shared_bytes; k < block.shared.size(); ++k)
                if (outcome == DONE && block.shared[k] != char(0xCB)) outcome = OUT_OF_BOUNDS;
        return outcome;
    }

    void begin(Fibre& fibre, int thread, Block* block) {
        fibre.thread = thread, fibre.block = block, fibre.stack.resize(STACK);
        getcontext(&fibre.context);
        fibre.context.uc_stack.ss_sp = fibre.stack.data(), fibre.context.uc_stack.ss_size = STACK;
        fibre.context.uc_link = &home;
        makecontext(&fibre.context, enter, 0);
        ready.push_back(&fibre);
    }

    static void enter();

    void yield() { swapcontext(&running->context, &home); }

    // All threads of a block, but those that have ended, must come to the same barrier.
    void arrive(Fibre& fibre, int threads) {
        Block& block = *fibre.block;
        if (fibre.ended) ++block.finished;
        if (block.waiting == 0 || block.waiting + block.finished < threads) return;
        if (block.finished > 0) outcome = DIVERGED;
        for (Fibre& other : fibres)
            if (other.block == &block && other.waits) other.waits = false, ready.push_back(&other);
        block.waiting = 0;
    }

    void wait(int barrier) {
        if (barrier == missing_barrier) return;
        Block& block = *running->block;
        if (block.waiting > 0 && block.barrier != barrier) outcome = DIVERGED;
        block.barrier = barrier, ++block.waiting, running->waits = true;
        yield();
    }
};

inline Machine* current = nullptr;
inline Machine& machine() { return *current; }
inline Fibre& self() { return *current->running; }
inline void Machine::enter() {
    current->kernel();
    current->running->ended = true;
}
inline void barrier(int name) { current->wait(name); }

template <class Number, class Function> Number update(int name, Number* at, Function f) {
    const Number old = *at;
    if (name == current->plain_atomic) current->yield();
    *at = f(old);
    return old;
}
template <class Number> Number look(Number* at) {
    current->yield();
    return *at;
}
template <class Number> void mark(Number* at) { *at = 1; }

}  // namespace imitation
