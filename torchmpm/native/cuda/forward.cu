// The forward kernel: advances robots by a step, each from its components to the result.
#include "step.cuh"

// The particles of a thread. Registers keep what a substep needs of the one before; v and C only pass through, so those of a
// particle that leaves the domain go to the result at once.
class Registers {
public:
    INLINE explicit Registers(const Robot& robot) : robot(robot) {}

    INLINE void load() {
        for_own([&](int k, int index) {
            const Real* from = robot.given.components;
            own[k] = {from[at(X, index)], from[at(Y, index)], read_matrix(F0, index), SNOW ? from[at(JP, index)] : Real(1)};
            body[k] = robot.given.num_bodies > 1 ? robot.body_of(index) : 0;
        });
    }

    template <class Function> INLINE void each(int substep, Function f) {
        for_own([&](int k, int index) {
            Particle p{own[k].x, own[k].y, 0, 0, {}, own[k].F, own[k].Jp};
            if (substep <= 0) {
                const Real* from = robot.given.components;
                p.vx = from[at(VX, index)], p.vy = from[at(VY, index)], p.C = read_matrix(C0, index);
            }
            if (f(p, index, body[k])) write_motion(p, index);
            own[k] = {p.x, p.y, p.F, p.Jp};
        });
    }

    // After the last substep.
    INLINE void finish(const Substep& substep) {
        for_own([&](int k, int index) {
            Particle p{own[k].x, own[k].y, 0, 0, {}, own[k].F, own[k].Jp};
            if (substep.take(p)) write_motion(p, index);
            Real* to = robot.given.result;
            to[at(X, index)] = p.x, to[at(Y, index)] = p.y;
            to[at(JP, index)] = SNOW ? p.Jp : robot.given.components[at(JP, index)];
            write_matrix(F0, index, p.F);
        });
    }

private:
    static constexpr bool SNOW = TORCHMPM_KINDS >> int(Kind::snow) & 1;
    struct Kept {
        Real x, y;
        Mat2 F;
        Real Jp;
    };

    const Robot& robot;
    Kept own[TORCHMPM_PER_THREAD];
    int body[TORCHMPM_PER_THREAD];

    template <class Function> INLINE void for_own(Function f) const {
        const int first = robot.team.block * TORCHMPM_PER_THREAD * TORCHMPM_THREADS + THREAD;
#pragma unroll
        for (int k = 0; k < TORCHMPM_PER_THREAD; ++k) {
            const int index = first + k * TORCHMPM_THREADS;
            if (index < robot.given.particles) f(k, index);
        }
    }

    // Address of a component.
    INLINE int64_t at(int64_t c, int index) const {
        return (c * robot.given.batch + robot.element) * robot.given.particles + index;
    }
    INLINE Mat2 read_matrix(int c, int index) const {
        const Real* from = robot.given.components;
        return {from[at(c, index)], from[at(c + 1, index)], from[at(c + 2, index)], from[at(c + 3, index)]};
    }
    INLINE void write_matrix(int c, int index, Mat2 m) const {
        Real* to = robot.given.result;
        to[at(c, index)] = m.a, to[at(c + 1, index)] = m.b, to[at(c + 2, index)] = m.c, to[at(c + 3, index)] = m.d;
    }
    INLINE void write_motion(const Particle& p, int index) const {
        robot.given.result[at(VX, index)] = p.vx, robot.given.result[at(VY, index)] = p.vy;
        write_matrix(C0, index, p.C);
    }
};

KERNEL void torchmpm_forward(const GRID_CONSTANT Arguments given) {
    const int blocks = TORCHMPM_SHARED ? 1 : int(given.team), team = BLOCK / blocks;
    Arena scratch{given.scratch + team * given.scratch_bytes};
    Robot robot = Robot::make<false>(given, scratch);
    Substep substep(robot);
    Registers particles(robot);
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
