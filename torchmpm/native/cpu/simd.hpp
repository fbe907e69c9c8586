// Blocks of particles, and the vector idioms that compilers do not find by themselves.
#pragma once
#include <cstddef>
#include <type_traits>

#include "../common/scalar.hpp"

#define INLINE_LAMBDA __attribute__((always_inline))
// Work on a whole block, where the cost of a call does not matter; profiles show these functions by name.
#define PASS inline __attribute__((noinline))
#define PASS_MEMBER __attribute__((noinline))

constexpr int LANES = 64;  // particles per block; blocks never mix bodies

typedef Real Real4 __attribute__((vector_size(4 * sizeof(Real))));
typedef Real Real8 __attribute__((vector_size(8 * sizeof(Real))));
// The same without guaranteed alignment, for rows of nodes.
typedef Real Row4 __attribute__((vector_size(4 * sizeof(Real)), aligned(sizeof(Real)), may_alias));
typedef Real Row8 __attribute__((vector_size(8 * sizeof(Real)), aligned(sizeof(Real)), may_alias));

#if defined(__clang__) || __GNUC__ >= 12
#define SHUFFLE(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else  // GCC 11
template <int count> struct Index {
    using Element = std::conditional<sizeof(Real) == 4, int32_t, int64_t>::type;
    typedef Element type __attribute__((vector_size(count * sizeof(Real))));
};
#define SHUFFLE(a, b, ...) __builtin_shuffle(a, b, Index<sizeof(a) / sizeof(Real)>::type{__VA_ARGS__})
#endif

// Two numbers of each operand, from all quarters alike. On x86 these shuffles run on more ports than unpacking does.
#define PAIRS4(a, b, i, j) SHUFFLE(a, b, i, j, 4 + i, 4 + j)
#define PAIRS8(a, b, i, j) SHUFFLE(a, b, i, j, 8 + i, 8 + j, 4 + i, 4 + j, 12 + i, 12 + j)

INLINE void transpose(Real4 (&v)[4]) {
    const Real4 a = PAIRS4(v[0], v[1], 0, 1), b = PAIRS4(v[2], v[3], 0, 1);
    const Real4 c = PAIRS4(v[0], v[1], 2, 3), d = PAIRS4(v[2], v[3], 2, 3);
    v[0] = PAIRS4(a, b, 0, 2), v[1] = PAIRS4(a, b, 1, 3), v[2] = PAIRS4(c, d, 0, 2), v[3] = PAIRS4(c, d, 1, 3);
}

// Transposes both halves separately.
INLINE void transpose(Real8 (&v)[4]) {
    const Real8 a = PAIRS8(v[0], v[1], 0, 1), b = PAIRS8(v[2], v[3], 0, 1);
    const Real8 c = PAIRS8(v[0], v[1], 2, 3), d = PAIRS8(v[2], v[3], 2, 3);
    v[0] = PAIRS8(a, b, 0, 2), v[1] = PAIRS8(a, b, 1, 3), v[2] = PAIRS8(c, d, 0, 2), v[3] = PAIRS8(c, d, 1, 3);
}

INLINE Real4 half(const Real8& v, int which) {
    Real4 result;
    __builtin_memcpy(&result, reinterpret_cast<const char*>(&v) + which * sizeof(Real4), sizeof(Real4));
    return result;
}

INLINE void transpose(Real8 (&v)[8]) {
    Real8 low[4] = {v[0], v[1], v[2], v[3]}, high[4] = {v[4], v[5], v[6], v[7]};
    transpose(low), transpose(high);
    for (int i = 0; i < 4; ++i) {
        v[i] = SHUFFLE(low[i], high[i], 0, 1, 2, 3, 8, 9, 10, 11);
        v[i + 4] = SHUFFLE(low[i], high[i], 4, 5, 6, 7, 12, 13, 14, 15);
    }
}
