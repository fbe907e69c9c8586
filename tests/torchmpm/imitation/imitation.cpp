// The CUDA kernels of torchmpm/native/cuda for one dtype and kind of memory, as a library for
// tests/torchmpm/cuda_imitation.py.
#define TORCHMPM_IMITATION
#include "forward.cu"
#include "adjoint.cu"

extern "C" int bytes_of_arguments() { return sizeof(Arguments); }

extern "C" int launch(const Arguments* given, bool adjoint, int grid, size_t shared_bytes, uint64_t seed,
                      int missing_barrier, int plain_atomic) {
    imitation::Machine machine{missing_barrier, plain_atomic, std::mt19937_64(seed)};
    machine.kernel = [=] { adjoint ? torchmpm_adjoint(*given) : torchmpm_forward(*given); };
    imitation::current = &machine;
    return machine.launch(grid, TORCHMPM_THREADS, shared_bytes);
}
