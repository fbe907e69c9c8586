// Which simulations can go on, in one pass: the comparisons of dittogym/validity/__init__.py.
#include <cstdint>

// Tensors are contiguous, of Real where nothing else is said. As the arguments of a call in __init__.py.
struct Simulations {
    int64_t batch, particles, robot;  // the robot's particles come first
    double margin, extent;            // particles between these are in the window, m
    const void* planes;               // (13, batch, particles), x and y first
    const void* origin;               // (batch, 2)
    bool* valid;                      // (batch,)
};

namespace {

template <class Real> bool all_finite(const Real* numbers, int64_t count) {
    int wrong = 0;
    // The difference of a number to itself is zero, that of anything else is not a number.
#pragma omp simd reduction(| : wrong)
    for (int64_t k = 0; k < count; ++k) wrong |= !(numbers[k] - numbers[k] == 0);
    return !wrong;
}

template <class Real> void find_valid(const Simulations& given) {
    const Real *planes = static_cast<const Real*>(given.planes), *origin = static_cast<const Real*>(given.origin);
    const Real margin = Real(given.margin), extent = Real(given.extent);
    const int64_t count = given.particles, plane = given.batch * count;
    for (int64_t b = 0; b < given.batch; ++b) {
        bool finite = true;
        for (int p = 0; p < 13; ++p) finite &= all_finite(planes + p * plane + b * count, count);
        const Real *x = planes + b * count, *y = x + plane;
        const Real left = origin[2 * b], bottom = origin[2 * b + 1];
        int inside = 0;
#pragma omp simd reduction(| : inside)
        for (int64_t k = 0; k < given.robot; ++k) {
            const Real across = x[k] - left, up = y[k] - bottom;
            inside |= (across > margin) & (across < extent) & (up > 0) & (up < 1);
        }
        given.valid[b] = finite && inside;
    }
}

}  // namespace

extern "C" void dittogym_valid_float(const Simulations* given) { find_valid<float>(*given); }
extern "C" void dittogym_valid_double(const Simulations* given) { find_valid<double>(*given); }
