// All substeps of a step, for the particles of the forward kernel or those that the adjoint streams from its tape.
#pragma once
#include "substep.cuh"

// Where the adjoint finds what happened; see tape.cuh. The forward kernel has none.
struct NoTape {
    static constexpr bool records = false;
    INLINE Record record(int) const { return {}; }
    INLINE void note(int, const Robot&) const {}
};

// `particles.each(substep, f)` calls f(particle, index, body) for each particle of a thread; f returns whether the
// particle leaves the domain with this substep, or is outside from the beginning: it will not take part again, as the
// domain does not move during a step. Returns why the robot must be given up; all threads of the team call this
// together.
template <class Particles, class Tape>
INLINE int advance(Robot& robot, Substep& substep, Particles& particles, const Tape& tape) {
    const Team& team = robot.team;
    const int substeps = int(robot.given.substeps);
    // Before the first substep, find where the particles are, then the heaviest node and the fastest particle.
    Survey start;
    particles.each(-2, [&](Particle& p, int index, int body) {
        const Place at = substep.locate(p);
        if (!at.on) return false;
        start.include(at.i, at.j);
        start.heavy(robot.values_of(robot.bodies[body], index).mass);
        return false;
    });
    start.join_particles(team, -2), start.join_masses(team, -2);
    team.wait_and_summarise<SURVEYED>(-2);
    robot.follow(-2);
    robot.read_field();
    team.wait<PLACED>();
    substep.scale = survey_scale(value_of(team.of(-2)[HEAVIEST]));
    for (int s = -1; s < substeps; ++s) {
        Survey survey;
        particles.each(s, [&](Particle& p, int index, int body) {
            const bool takes_part = s <= 0 || substep.grid_to_particle(p);
            return takes_part && !substep.particle_to_grid(p, index, body, s >= 0, survey) && s >= 0;
        });
        survey.join_particles(team, s);
        team.wait_and_summarise<GIVEN>(s);
        if (const int failure = team.of(s)[FAILURE]) return failure;
        if (s >= 0) tape.note(s, robot);
        substep.move_nodes<Tape::records>(s, tape.record(s));
        team.clear(s + 1);
        team.wait_and_summarise<MOVED>(s);
        if (const int failure = team.of(s)[SPILL]) return failure;
        substep.before = robot.window;
        if (s + 1 == substeps) break;
        const int* summary = team.of(s);
        substep.scale = scale_of(value_of(summary[FASTEST]), value_of(summary[HEAVIEST]), robot.h / robot.dt);
        robot.follow(s);
        if (TORCHMPM_MUSCLES && robot.window != substep.before) {
            robot.read_field();
            team.wait<FOLLOWED>();
        }
    }
    return NONE;
}
