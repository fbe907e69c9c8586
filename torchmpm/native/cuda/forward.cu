// The forward kernel: advances robots by a step, each from its components to the result.
#include "step.cuh"

// The particles of a thread, which keeps them in registers, or, without a number of them per thread, in the result. It
// keeps what a substep needs of the one before; v and C only pass through, so those of a particle that leaves the
// domain go to the result at once.
class Particles {
public:
    INLINE explicit Particles(const Robot& robot) : robot(robot) {}

    INLINE void load() {
        for_own([&](int k, int index) {
            keep(k, index, read(robot.given.components, index));
            if (REGISTERS) body[k] = robot.body_of(index);
        });
    }

    template <class Function> INLINE void each(int substep, Function f) {
        for_own([&](int k, int index) {
            Particle p = recall(k, index);
            if (substep <= 0) {
                const Real* from = robot.given.components;
                p.vx = from[at(VX, index)], p.vy = from[at(VY, index)], p.C = read_matrix(from, C0, index);
            }
            if (f(p, index, REGISTERS ? body[k] : robot.body_of(index))) write_motion(p, index);
            if (substep >= 0) keep(k, index, {p.x, p.y, p.F, p.Jp});
        });
    }

    // After the last substep.
    INLINE void finish(const Substep& substep) const {
        for_own([&](int k, int index) {
            Particle p = recall(k, index);
            if (substep.grid_to_particle(p)) write_motion(p, index);
            write({p.x, p.y, p.F, SNOW ? p.Jp : robot.given.components[at(JP, index)]}, index);
        });
    }

private:
    static constexpr bool REGISTERS = TORCHMPM_PER_THREAD > 0;
    static constexpr bool SNOW = TORCHMPM_KINDS >> int(Kind::snow) & 1;  // else Jp stays as it is
    struct Kept {
        Real x, y;
        Mat2 F;
        Real Jp;
    };

    const Robot& robot;
    Kept own[REGISTERS ? TORCHMPM_PER_THREAD : 1];
    int body[REGISTERS ? TORCHMPM_PER_THREAD : 1];

    template <class Function> INLINE void for_own(Function f) const {
        const int particles = int(robot.given.particles);
        if (!REGISTERS) {
            for (int index = robot.team.rank; index < particles; index += robot.team.size) f(0, index);
            return;
        }
        const int first = robot.team.block * TORCHMPM_PER_THREAD * TORCHMPM_THREADS + THREAD;
#pragma unroll
        for (int k = 0; k < TORCHMPM_PER_THREAD; ++k)
            if (first + k * TORCHMPM_THREADS < particles) f(k, first + k * TORCHMPM_THREADS);
    }

    INLINE Particle recall(int k, int index) const {
        const Kept kept = REGISTERS ? own[k] : read(robot.given.result, index);
        return {kept.x, kept.y, 0, 0, {}, kept.F, kept.Jp};
    }
    INLINE void keep(int k, int index, const Kept& kept) {
        if (REGISTERS)
            own[k] = kept;
        else
            write(kept, index);
    }

    // Address of a component.
    INLINE int64_t at(int64_t c, int index) const {
        return (c * robot.given.batch + robot.element) * robot.given.particles + index;
    }
    INLINE Mat2 read_matrix(const Real* from, int c, int index) const {
        return {from[at(c, index)], from[at(c + 1, index)], from[at(c + 2, index)], from[at(c + 3, index)]};
    }
    INLINE Kept read(const Real* from, int index) const {
        return {from[at(X, index)], from[at(Y, index)], read_matrix(from, F0, index),
                SNOW ? from[at(JP, index)] : Real(1)};
    }
    INLINE void write_matrix(int c, int index, Mat2 m) const {
        Real* to = robot.given.result;
        to[at(c, index)] = m.a, to[at(c + 1, index)] = m.b, to[at(c + 2, index)] = m.c, to[at(c + 3, index)] = m.d;
    }
    INLINE void write(const Kept& kept, int index) const {
        Real* to = robot.given.result;
        to[at(X, index)] = kept.x, to[at(Y, index)] = kept.y, to[at(JP, index)] = kept.Jp;
        write_matrix(F0, index, kept.F);
    }
    INLINE void write_motion(const Particle& p, int index) const {
        robot.given.result[at(VX, index)] = p.vx, robot.given.result[at(VY, index)] = p.vy;
        write_matrix(C0, index, p.C);
    }
};

// Teams have small blocks, which leave registers for a second one.
constexpr int RESIDENT = !TORCHMPM_SHARED && sizeof(Real) == 4 && TORCHMPM_THREADS <= 256 ? 2 : 1;

KERNEL(RESIDENT) void torchmpm_forward(const GRID_CONSTANT Arguments given) {
    const int blocks = TORCHMPM_SHARED ? 1 : int(given.team), team = BLOCK / blocks;
    Arena scratch{given.scratch + team * given.scratch_bytes};
    Robot robot = Robot::make<false>(given, scratch);
    Substep substep(robot);
    Particles particles(robot);
    for (int64_t element = team; element < given.batch; element += BLOCKS / blocks) {
        if (!TORCHMPM_SHARED && given.status && given.status[element] == NONE) continue;
        robot.team.wait<FREE>();
        robot.prepare(element);
        particles.load();
        const int failure = advance(robot, substep, particles, NoTape{});
        if (TORCHMPM_SHARED && given.status && THREAD == 0) given.status[element] = failure;
        if (!failure) particles.finish(substep);
    }
}
