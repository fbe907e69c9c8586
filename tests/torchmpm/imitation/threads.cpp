// The CUDA kernels with real threads, as a program for ThreadSanitizer: reads the arguments of a launch and the memory
// that they point to from its input, see tests/torchmpm/cuda_imitation.py.
#define TORCHMPM_IMITATION
#define TORCHMPM_REAL_THREADS
#include <iostream>

#include "adjoint.cu"
#include "forward.cu"

int main() {
    const auto number = [&] {
        int64_t value;
        std::cin.read(reinterpret_cast<char*>(&value), sizeof value);
        return value;
    };
    const int64_t adjoint = number(), grid = number(), shared_bytes = number();
    Arguments given;
    std::cin.read(reinterpret_cast<char*>(&given), sizeof given);
    // All pointers at the end of the arguments, each with its memory; a size of zero stands for none.
    const int count = (sizeof given - offsetof(Arguments, bodies)) / sizeof(void*);
    std::vector<std::vector<char>> memory(count);
    for (int k = 0; k < count; ++k) {
        memory[k].resize(number());
        std::cin.read(memory[k].data(), memory[k].size());
        const void* address = memory[k].empty() ? nullptr : memory[k].data();
        std::memcpy(reinterpret_cast<char*>(&given) + offsetof(Arguments, bodies) + k * sizeof address, &address,
                    sizeof address);
    }
    imitation::Machine machine{TORCHMPM_THREADS};
    machine.kernel = [=] { adjoint ? torchmpm_adjoint(given) : torchmpm_forward(given); };
    imitation::current = &machine;
    machine.launch(int(grid), shared_bytes);
}
