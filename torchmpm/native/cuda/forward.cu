// The forward kernel: advances robots by a step, each from its components to the result.
#include "step.cuh"

// The particles of a thread, in registers.
struct Registers {
    const Robot& robot;
    Particle own[TORCHMPM_PER_THREAD];
    int body[TORCHMPM_PER_THREAD];

    INLINE int index(int k) const { return robot.team.block * TORCHMPM_PER_THREAD * TORCHMPM_THREADS + k * TORCHMPM_THREADS + THREAD; }

    template <class Function> INLINE void each(int, Function f) {
#pragma unroll
        for (int k = 0; k < TORCHMPM_PER_THREAD; ++k)
            if (index(k) < robot.given.particles) f(own[k], index(k), body[k]);
    }

    // Component c of particle k.
    INLINE int64_t at(int c, int k) const {
        const Arguments& given = robot.given;
        return (c * given.batch + robot.element) * given.particles + index(k);
    }

    INLINE void load() {
        const Real* from = robot.given.components;
#pragma unroll
        for (int k = 0; k < TORCHMPM_PER_THREAD; ++k) {
            if (index(k) >= robot.given.particles) continue;
            const auto matrix = [&](int c) { return Mat2{from[at(c, k)], from[at(c + 1, k)], from[at(c + 2, k)], from[at(c + 3, k)]}; };
            own[k] = {from[at(X, k)], from[at(Y, k)], from[at(VX, k)], from[at(VY, k)], matrix(C0), matrix(F0), from[at(JP, k)]};
            body[k] = robot.body_of(index(k));
        }
    }

    INLINE void store() const {
        Real* to = robot.given.result;
#pragma unroll
        for (int k = 0; k < TORCHMPM_PER_THREAD; ++k) {
            if (index(k) >= robot.given.particles) continue;
            const Particle& p = own[k];
            const auto put = [&](int c, Mat2 m) { to[at(c, k)] = m.a, to[at(c + 1, k)] = m.b, to[at(c + 2, k)] = m.c, to[at(c + 3, k)] = m.d; };
            to[at(X, k)] = p.x, to[at(Y, k)] = p.y, to[at(VX, k)] = p.vx, to[at(VY, k)] = p.vy;
            put(C0, p.C), put(F0, p.F), to[at(JP, k)] = p.Jp;
        }
    }
};

KERNEL void torchmpm_forward(const GRID_CONSTANT Arguments given) {
    const int blocks = TORCHMPM_SHARED ? 1 : int(given.team), team = BLOCK / blocks;
    Arena scratch{given.scratch + team * given.scratch_bytes};
    Robot robot = Robot::make<false>(given, scratch);
    Substep substep(robot);
    Registers particles{robot};
    for (int64_t element = team; element < given.batch; element += BLOCKS / blocks) {
        if (!TORCHMPM_SHARED && given.status && given.status[element] == NONE) continue;
        robot.team.wait<FREE>();
        robot.prepare(element);
        particles.load();
        const int failure = advance(robot, substep, particles, NoTape{});
        if (TORCHMPM_SHARED && given.status && THREAD == 0) given.status[element] = failure;
        if (failure) continue;
        if (given.substeps > 0) particles.each(0, [&](Particle& p, int, int) { substep.take(p); });
        particles.store();
    }
}
