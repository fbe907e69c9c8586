// The CUDA kernel of the observation on the imitation of a GPU in tests/torchmpm/imitation, as a library for
// test_cuda_picture.py.
#define TORCHMPM_IMITATION
#include "picture.cu"

extern "C" int launch(const Arguments* given, int grid, size_t shared_bytes, uint64_t seed, int missing_barrier, int plain_atomic) {
    imitation::Machine machine{missing_barrier, plain_atomic, std::mt19937_64(seed)};
    machine.kernel = [=] { dittogym_draw(*given); };
    imitation::current = &machine;
    return machine.launch(grid, TORCHMPM_THREADS, shared_bytes);
}

extern "C" int barriers() { return BARRIERS; }
extern "C" int atomics() { return ATOMICS; }
