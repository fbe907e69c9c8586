// The adjoint kernel: replays the substeps of a step onto a tape, then goes back through them. Particles are streamed
// from the tape, and their derivatives are kept where the result will be, so that a thread may have any number of them.
#include "reverse.cuh"
#include "step.cuh"

// The particles of a thread during the replay. Their state at the start of substep s is complete when it begins; F and
// Jp, which the substep before deforms, are there already.
struct Streamed {
    const Robot& robot;
    const Tape& tape;

    template <class Function> INLINE void each(int substep, Function f) const {
        for_own(robot, [&](int index) {
            Particle p = substep > 0 ? previous(substep, index) : given(index);
            if (substep == 0) deformed(0, index, p);
            f(p, index, robot.body_of(index));
            if (substep < 0) return;
            moved(substep, index, p);
            if (substep + 1 < robot.given.substeps) deformed(substep + 1, index, p);
        });
    }

    template <class Function> INLINE static void for_own(const Robot& robot, Function f) {
        for (int index = robot.team.rank; index < robot.given.particles; index += robot.team.size) f(index);
    }

    INLINE Particle at_start_of(int substep, int index) const {
        return read([&](int c) { return tape.state(substep, c, index); });
    }

    INLINE Particle given(int index) const { return from(robot.given.components, index); }

    // Of one of the tensors of components.
    INLINE Particle from(const Real* components, int index) const {
        return read([&](int c) { return components[at(c, index)]; });
    }
    INLINE void to(Real* components, int index, const Particle& p) const {
        write([&](int c, Real value) { components[at(c, index)] = value; }, p);
    }

private:
    INLINE int64_t at(int64_t c, int index) const {
        return (c * robot.given.batch + robot.element) * robot.given.particles + index;
    }

    INLINE Particle previous(int substep, int index) const {
        return read([&](int c) { return tape.state(c < F0 ? substep - 1 : substep, c, index); });
    }

    // What changes at the end of a substep, and what in its course.
    INLINE void moved(int substep, int index, const Particle& p) const {
        write(
            [&](int c, Real value) {
                if (c < F0) tape.state(substep, c, index) = value;
            },
            p);
    }
    INLINE void deformed(int substep, int index, const Particle& p) const {
        write(
            [&](int c, Real value) {
                if (c >= F0) tape.state(substep, c, index) = value;
            },
            p);
    }

    template <class Read> INLINE static Particle read(Read c) {
        return {c(X), c(Y), c(VX), c(VY), {c(C0), c(C1), c(C2), c(C3)}, {c(F0), c(F1), c(F2), c(F3)}, c(JP)};
    }
    template <class Write> INLINE static void write(Write put, const Particle& p) {
        const Real all[COMPONENTS] = {p.x,   p.y,   p.vx,  p.vy,  p.C.a, p.C.b, p.C.c,
                                      p.C.d, p.F.a, p.F.b, p.F.c, p.F.d, p.Jp};
#pragma unroll
        for (int c = 0; c < COMPONENTS; ++c) put(c, all[c]);
    }
};

class Adjoint {
public:
    INLINE Adjoint(Robot& robot, const Tape& tape) : robot(robot), tape(tape), particles{robot, tape}, reverse(robot) {}

    // Returns why the robot must be given up.
    INLINE int run(int64_t element) {
        const int substeps = int(robot.given.substeps);
        robot.prepare(element);
        clear_results();
        Substep substep(robot);
        if (const int failure = advance(robot, substep, particles, tape)) return failure;
        reverse.clear();
        Window window = robot.window;  // of the substep whose velocities the nodes have
        for (int s = substeps; s >= 0; --s) {
            if (s > 0) tape.rewind(s - 1, window);
            back(s, window);
            robot.team.wait<REVERSED>();
            if (s == 0) break;
            const bool moves = robot.window != window;
            if (moves) reverse.flush_field();
            robot.window = window;
            if (moves) robot.read_field();
            reverse.nodes(tape.box(s - 1), tape.record(s - 1));
            robot.team.wait<RETURNED>();
        }
        reverse.flush_field();
        store_sums();
        return NONE;
    }

private:
    Robot& robot;
    const Tape& tape;
    Streamed particles;
    Reverse reverse;

    INLINE void clear_results() const {
        const Arguments& given = robot.given;
        if (given.values_bar)
            Streamed::for_own(robot, [&](int index) {
                for (int r = 0; r < VALUES; ++r)
                    given.values_bar[(r * given.batch + robot.element) * given.particles + index] = 0;
            });
        if (robot.team.rank == 0)
            for (int axis = 0; axis < 2; ++axis)
                given.origin_bar[2 * robot.element + axis] = given.gravity_bar[2 * robot.element + axis] = 0;
        if (!given.field_bar) return;
        const int64_t nodes = 2 * given.resolution * given.resolution;
        for (int k = robot.team.rank; k < nodes; k += robot.team.size) given.field_bar[robot.element * nodes + k] = 0;
        if (TORCHMPM_MUSCLES)
            for (int k = robot.team.rank; k < robot.window.nodes(); k += robot.team.size)
                robot.nodes.field_bar[k] = {0, 0};
    }

    // The particles at the end of the adjoint of substep `s`, and at the beginning of that of the one before, whose
    // window is given.
    INLINE void back(int s, const Window& window) {
        const bool last = s == robot.given.substeps;
        Streamed::for_own(robot, [&](int index) {
            Particle bar = particles.from(last ? robot.given.result_bar : robot.given.components_bar, index);
            if (!last)
                reverse.particle_to_grid_adjoint(particles.at_start_of(s, index), bar, index, robot.body_of(index));
            particles.to(robot.given.components_bar, index, bar);
            if (s > 0)
                reverse.grid_to_particle_adjoint(
                    tape.state(s - 1, X, index), tape.state(s - 1, Y, index), bar, window);
        });
    }

    // Join the threads' shares of the derivatives in the origin and in gravity.
    INLINE void store_sums() const {
        const Arguments& given = robot.given;
        Real(*shares)[SHARES] = robot.shared->shares;
        for (int axis = 0; axis < 2; ++axis) {
            add<ADD_SHARE>(&shares[axis][THREAD % SHARES], reverse.origin_bar[axis]);
            add<ADD_SHARE>(&shares[2 + axis][THREAD % SHARES], reverse.gain_bar[axis] * robot.dt);
        }
        BARRIER(SHARED_OUT);
        if (THREAD >= 4) return;
        Real sum = 0;
        for (int k = 0; k < SHARES; ++k) sum += shares[THREAD][k];
        Real* to = THREAD < 2 ? given.origin_bar : given.gravity_bar;
        add<ADD_SUM>(to + 2 * robot.element + THREAD % 2, sum);
    }
};

KERNEL(1) void torchmpm_adjoint(const GRID_CONSTANT Arguments given) {
    const int blocks = TORCHMPM_SHARED ? 1 : int(given.team), team = BLOCK / blocks;
    Arena scratch{given.scratch + team * given.scratch_bytes};
    Robot robot = Robot::make<true>(given, scratch);
    const Tape tape(given, scratch);
    Adjoint adjoint(robot, tape);
    for (int64_t element = team; element < given.batch; element += BLOCKS / blocks) {
        if (!TORCHMPM_SHARED && given.status && given.status[element] == NONE) continue;
        robot.team.wait<FREE>();
        const int failure = adjoint.run(element);
        if (TORCHMPM_SHARED && given.status && THREAD == 0) given.status[element] = failure;
    }
}
