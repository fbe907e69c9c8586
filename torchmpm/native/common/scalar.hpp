// Numbers and functions of one number, for a C++ compiler and for NVRTC, which has no standard headers.
#pragma once

#ifdef __CUDACC_RTC__
typedef int int32_t;
typedef unsigned int uint32_t;
typedef long long int64_t;
typedef unsigned long long uint64_t;
namespace math {
using ::copysign;
using ::fabs;
using ::isinf;
using ::nearbyint;
using ::sqrt;
using ::trunc;
}  // namespace math
#define INLINE __device__ __forceinline__
#else
#include <cmath>
#include <cstdint>
namespace math = std;
#define INLINE inline __attribute__((always_inline))
#endif

using Real = TORCHMPM_REAL;

constexpr int PAD = 3;  // as torchmpm.grid.PAD

template <class Function> INLINE void three(Function f) {
    f(0);
    f(1);
    f(2);
}

INLINE Real square(Real a) { return a * a; }
// Propagates a NaN in `a`.
INLINE Real at_least(Real a, Real low) { return a < low ? low : a; }
INLINE Real clamp(Real s, Real low, Real high) { return s < low ? low : (s > high ? high : s); }

// The integer with the bits of a Real, and 2^exponent from its bits.
template <class> struct BitsOf;
template <> struct BitsOf<float> {
    using type = uint32_t;
    static constexpr int mantissa = 23, bias = 127;
    static constexpr float largest = 3.4028234e38f;
};
template <> struct BitsOf<double> {
    using type = uint64_t;
    static constexpr int mantissa = 52, bias = 1023;
    static constexpr double largest = 1.7976931348623157e308;
};
using Bits = BitsOf<Real>;

INLINE Real power_of_two(int exponent) {
    const Bits::type one = 1, bias = Bits::bias;
    return __builtin_bit_cast(Real, (one * exponent + bias) << Bits::mantissa);
}

// e^x without a call, so that loops over it become vectors: 2^n times a Taylor polynomial on |r| <= ln(2) / 2.
INLINE Real exponential(Real x) {
    constexpr bool single = sizeof(Real) == 4;
    constexpr Real limit = single ? 250 : 2040;
    x = x < -limit ? -limit : x;  // far below, the polynomial would overflow
    Real n = math::nearbyint(x * Real(1.4426950408889634));
    n = n > -limit ? n : -limit;  // also takes a NaN, which stays in r
    n = n < limit ? n : limit;
    const Real r = (x - n * Real(single ? 0.693359375 : 0.693145751953125)) -
                   n * Real(single ? -2.12194440e-4 : 1.42860682030941723212e-6);
    Real sum = 1;
    for (int k = single ? 8 : 14; k > 0; --k) sum = 1 + sum * r * (Real(1) / Real(k));
    // Two factors: each is a representable power of two, while their product may overflow or underflow.
    const int first = int(n) / 2, second = int(n) - first;
    return sum * power_of_two(first) * power_of_two(second);
}
