// The C interface that torchmpm/native/kernels.py calls.
#include <exception>
#include <memory>

#include "adjoint.hpp"

namespace {

// Threads that share one simulation, and how many such teams there are.
struct Shape {
    int team, teams;
};

Shape choose_shape(const Scene& scene) {
    const Call& call = scene.call;
    // A thread costs as much to start as some 20,000 particle-substeps to compute.
    const int64_t useful = 1 + call.batch * call.particles * call.substeps / 20000;
    const int64_t threads = std::max<int64_t>(1, std::min(call.threads, useful));
    const int64_t team = std::max<int64_t>(1, std::min<int64_t>(scene.parts, threads / call.batch));
    return {int(team), int(std::min<int64_t>(call.batch, threads / team))};
}

// Each team takes the next simulation when it is done with its last; which one takes which makes no difference to the
// numbers. Returns false where the system gives out no more threads.
template <class Pass> bool run_batch(const Scene& scene, Shape shape, char* scratch) {
    using Work = typename Pass::Work;
    Arena arena(scratch);
    std::vector<std::unique_ptr<Work>> work;
    for (int t = 0; t < shape.teams; ++t) work.push_back(std::make_unique<Work>(scene, arena, shape.team));
    std::atomic<int64_t> next{0};
    return run_together(scene.call.pool, shape.team * shape.teams, [&](int index) {
        Work& own = *work[index / shape.team];
        Member member{index % shape.team, shape.team, own.barrier};
        Pass pass(scene, own, member);
        while (true) {
            if (member.rank == 0) own.element = next.fetch_add(1);
            member.wait();
            const int64_t element = own.element;
            if (element >= scene.call.batch) return;
            pass.run(element);
            member.wait();
        }
    });
}

template <class Pass> size_t measure(const Call* call) {
    const Scene scene(*call);
    const Shape shape = choose_shape(scene);
    Arena arena(nullptr);
    for (int t = 0; t < shape.teams; ++t) typename Pass::Work(scene, arena, shape.team);
    return arena.used;
}

template <class Pass> int run(const Call* call, char* scratch) {
    try {
        const Scene scene(*call);
        if (!run_batch<Pass>(scene, choose_shape(scene), scratch)) run_batch<Pass>(scene, {1, 1}, scratch);
        return 0;
    } catch (const std::bad_alloc&) {
        return 1;
    }
}

}  // namespace

// Bytes of scratch memory a call needs, and the call itself: 0, or 1 where memory ran out.
extern "C" {
size_t torchmpm_forward_bytes(const Call* call) { return measure<Forward>(call); }
int torchmpm_forward(const Call* call, char* scratch) { return run<Forward>(call, scratch); }
size_t torchmpm_backward_bytes(const Call* call) { return measure<Adjoint>(call); }
int torchmpm_backward(const Call* call, char* scratch) { return run<Adjoint>(call, scratch); }
}
