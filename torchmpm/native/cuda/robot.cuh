// What a block knows about the robot that it advances, and the memory it works in.
#pragma once
#include "node.hpp"
#include "particle.hpp"
#include "stencil.hpp"
#include "team.cuh"

// Two numbers that are read together.
struct alignas(2 * sizeof(Real)) Pair {
    Real x, y;
};

constexpr int SHARES = 16;

// Whether a body has a material; decided by the compiler where all bodies have the same.
template <Kind kind> INLINE bool has_kind(int other) {
    constexpr int bit = 1 << int(kind);
    return TORCHMPM_KINDS == bit || (TORCHMPM_KINDS & bit && other == int(kind));
}

// In shared memory. The layouts are those that torchmpm/native/cuda/arguments.py counts.
struct Body {
    int first, count, kind, muscle, varying, column;
    Bounds bounds;
    Values values;  // of all particles, unless they vary
};
struct alignas(sizeof(Real)) BlockRule : Wall {
    int low[2], high[2];  // inclusive nodes in x and y
    int world, slot;
};
struct Shared {
    int summary[3][SUMMARY];
    Real shares[4][SHARES];  // of sums over all threads
};
// In global memory.
struct TeamMemory {
    int summary[3][SUMMARY];
};

// Nodes around a robot: all of the padded grid in global memory, or a window of it in shared memory that follows the
// robot.
struct Window {
    int rows, columns;
    int i, j;  // its first node on the padded grid

    INLINE int nodes() const { return rows * columns; }
    INLINE int at(int row, int column) const { return (row - i) * columns + column - j; }
    // Whether it has the nodes of a stencil that begins there.
    INLINE bool holds(int row, int column) const {
        return uint32_t(row - i) <= uint32_t(rows - 3) && uint32_t(column - j) <= uint32_t(columns - 3);
    }
    INLINE bool operator!=(const Window& other) const { return i != other.i || j != other.j; }
};

// First node of a window along an axis. It stays while stencils from `low` to `high` are inside, and would be if each
// particle moved by one node more; else the robot is in its middle again.
INLINE int follow(int first, int size, int low, int high, int width) {
    if (high < low) return first;
    low = low > 0 ? low - 1 : 0, high = high + 3 < width ? high + 3 : width - 1;
    if (low >= first && high < first + size) return first;
    const int middle = (low + high + 1 - size) / 2, last = width - size;
    return middle < 0 ? 0 : middle < last ? middle : last;
}

// What particles add up on a node, in fixed point. Side by side, so that all sums of a row of nodes have addresses at
// fixed distances.
struct Sums {
    Fixed mass, x, y;
#if !TORCHMPM_SHARED
    Fixed spoilt;  // not 0 where something not finite was to be added
#endif
};

// Numbers of the nodes. Those of the adjoint lie where the sums of the forward pass were.
struct Nodes {
    Pair* velocity;
    Pair* field;      // actuation
    Pair* field_bar;  // derivative in it
    Sums* sums;
    Pair* velocity_bar;
    Pair* momentum_bar;
    Real* mass_bar;
};

INLINE size_t aligned(size_t size) { return (size + 255) / 256 * 256; }

// Hands out pieces of memory, in the order of torchmpm/native/cuda/arguments.py.
struct Arena {
    char* next;

    template <class T> INLINE T* take(size_t count) {
        T* piece = reinterpret_cast<T*>(next);
        next += aligned(count * sizeof(T));
        return piece;
    }
};

template <bool adjoint> INLINE Nodes lay_out(char* memory, int count) {
    Nodes nodes{};
    Pair* pairs = reinterpret_cast<Pair*>(memory);
    nodes.velocity = pairs, pairs += count;
    if (TORCHMPM_MUSCLES) nodes.field = pairs, pairs += count;
    if (TORCHMPM_MUSCLES && adjoint) nodes.field_bar = pairs, pairs += count;
    nodes.sums = reinterpret_cast<Sums*>(pairs);
    if (adjoint) {
        nodes.velocity_bar = pairs, nodes.momentum_bar = pairs + count;
        nodes.mass_bar = reinterpret_cast<Real*>(pairs + 2 * count);
    }
    return nodes;
}

class Robot {
public:
    const Arguments& given;
    Team team;
    Shared* shared;
    Body* bodies;
    BlockRule* rules;
    uint32_t* codes;  // rules of each node of the padded grid
    Nodes nodes;
    Window window;  // of the sums that are being added up
    Domain domain;
    Real dt, h, damping, mass_epsilon;
    Real gain[2];  // velocity from gravity in a substep
    int64_t element = 0;

    template <bool adjoint> INLINE static Robot make(const Arguments& given, Arena& scratch) {
        Robot robot(given);
        Arena memory{shared_memory()};
        Team& team = robot.team;
        team.blocks = TORCHMPM_SHARED ? 1 : int(given.team);
        team.block = TORCHMPM_SHARED ? 0 : BLOCK % team.blocks;
        team.rank = team.block * TORCHMPM_THREADS + THREAD, team.size = team.blocks * TORCHMPM_THREADS;
        robot.shared = memory.take<Shared>(1);
        robot.bodies = memory.take<Body>(given.num_bodies);
        robot.rules = memory.take<BlockRule>(given.num_rules);
        team.own = robot.shared->summary;
        robot.dt = Real(given.dt), robot.h = Real(given.h);
        robot.damping = Real(given.damping), robot.mass_epsilon = Real(given.mass_epsilon);
        robot.codes = scratch.take<uint32_t>(square_of(robot.width()));
        robot.window = {int(given.rows), int(given.columns), 0, 0};
        char* nodes = memory.next;
        if (!TORCHMPM_SHARED) {
            nodes = scratch.take<char>(robot.window.nodes() * node_bytes<adjoint>());
            team.all = scratch.take<TeamMemory>(1)->summary;
            team.counter = given.counters + BLOCK / team.blocks * COUNTERS;
        }
        robot.nodes = lay_out<adjoint>(nodes, robot.window.nodes());
        return robot;
    }

    INLINE int width() const { return int(given.resolution) + 2 * PAD; }
    INLINE bool exists(int i, int j) const {
        return uint32_t(i - PAD) < uint32_t(given.resolution) && uint32_t(j - PAD) < uint32_t(given.resolution);
    }

    // Begin with another robot: all that is the same during a step.
    INLINE void prepare(int64_t which) {
        element = which;
        domain = {given.origin[2 * element], given.origin[2 * element + 1], Real(1 / given.h), Real(given.margin),
                  Real(given.extent),        int(given.resolution)};
        for (int axis = 0; axis < 2; ++axis) gain[axis] = dt * given.gravity[2 * element + axis];
        window.i = window.j = 0;
        for (int substep = -2; substep < 1; ++substep) team.clear(substep);
        for (int k = THREAD; k < given.num_bodies; k += TORCHMPM_THREADS) bodies[k] = body(given.bodies[k]);
        for (int k = THREAD; k < given.num_rules; k += TORCHMPM_THREADS) rules[k] = rule(given.rules[k]);
        for (int k = THREAD; k < 4 * SHARES; k += TORCHMPM_THREADS) shared->shares[k / SHARES][k % SHARES] = 0;
        for (int k = team.rank; k < window.nodes(); k += team.size) nodes.sums[k] = {};
        team.wait<PREPARED>();
        find_rules();
    }

    // Let the window follow the particles, from where they were in a substep.
    INLINE void follow(int substep) {
        if (!TORCHMPM_SHARED) return;
        const int* summary = team.of(substep);
        window.i = ::follow(window.i, window.rows, -summary[LEFT], summary[RIGHT], width());
        window.j = ::follow(window.j, window.columns, -summary[BOTTOM], summary[TOP], width());
    }

    // Read the actuation of the nodes in the window.
    INLINE void read_field() const {
        if (!TORCHMPM_MUSCLES) return;
        const int n = int(given.resolution);
        const Real* field = given.field + 2 * element * n * n;
        for (int k = team.rank; k < window.nodes(); k += team.size) {
            const int i = window.i + k / window.columns, j = window.j + k % window.columns;
            const int node = (i - PAD) * n + j - PAD;
            nodes.field[k] = exists(i, j) ? Pair{field[node], field[n * n + node]} : Pair{0, 0};
        }
    }

    INLINE int body_of(int particle) const {
        int k = 0;
        while (k + 1 < given.num_bodies && particle >= bodies[k + 1].first) ++k;
        return k;
    }

    INLINE Values values_of(const Body& body, int particle) const {
        if (!body.varying) return body.values;
        return read_values(body.column + particle - body.first);
    }

private:
    INLINE explicit Robot(const Arguments& given) : given(given) {}

    INLINE static int64_t square_of(int64_t n) { return n * n; }

    template <bool adjoint> INLINE static size_t node_bytes() {
        size_t sums = sizeof(Sums);
        if (adjoint && sums < 5 * sizeof(Real)) sums = 5 * sizeof(Real);
        return sums + sizeof(Pair) * (TORCHMPM_MUSCLES ? adjoint ? 3 : 2 : 1);
    }

    INLINE Values read_values(int64_t column) const {
        const int64_t row = given.values_batch == 1 ? 0 : element;
        const int64_t stride = given.values_batch * given.value_columns;
        const Real* t = given.values + row * given.value_columns + column;
        return {t[0],          t[stride],     t[2 * stride], t[3 * stride],
                t[4 * stride], t[5 * stride], t[6 * stride], t[7 * stride]};
    }

    INLINE Body body(const BodyTable& table) const {
        return {int(table.first),
                int(table.count),
                int(table.kind),
                int(table.muscle),
                int(table.varying),
                int(table.column),
                table.bounds(Real(given.stretch_floor)),
                table.varying ? Values{} : read_values(table.column)};
    }

    // Ends of ranges may be infinite, and far away.
    INLINE static int whole(double end) { return int(end<-(1 << 28) ? -(1 << 28) : end>(1 << 28) ? 1 << 28 : end); }

    INLINE static BlockRule rule(const RuleTable& table) {
        BlockRule rule;
        rule.axis = int(table.axis), rule.sign = Real(table.sign), rule.friction = Real(table.friction);
        rule.low[0] = whole(table.i_low), rule.high[0] = whole(table.i_high);
        rule.low[1] = whole(table.j_low), rule.high[1] = whole(table.j_high);
        rule.world = int(table.world), rule.slot = int(table.slot);
        return rule;
    }

    // Which rules hold on each node; of those in one slot the first.
    INLINE void find_rules() {
        const int shift[2] = {whole(double(given.shift[2 * element])), whole(double(given.shift[2 * element + 1]))};
        for (int k = team.rank; k < width() * width(); k += team.size) {
            const int i = k / width() - PAD, j = k % width() - PAD;
            uint32_t code = 0;
            for (int r = int(given.num_rules) - 1; r >= 0; --r) {
                const BlockRule& rule = rules[r];
                const int x = i + (rule.world ? shift[0] : 0), y = j + (rule.world ? shift[1] : 0), bit = 8 * rule.slot;
                if (x >= rule.low[0] && x <= rule.high[0] && y >= rule.low[1] && y <= rule.high[1])
                    code = (code & ~(255u << bit)) | uint32_t(r + 1) << bit;
            }
            codes[k] = code;
        }
    }
};
