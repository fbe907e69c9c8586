// A substep: particles give mass and momentum to the nodes (P2G), nodes turn them into velocities, particles take these
// (G2P). One pass over the particles ends a substep and begins the next, as on the CPU.
#pragma once
#include "robot.cuh"

struct Particle {
    Real x, y, vx, vy;
    Mat2 C, F;
    Real Jp;
};

// A thread's share of a summary.
struct Survey {
    int left = NOWHERE, bottom = NOWHERE, right = NOWHERE, top = NOWHERE;
    int fastest = 0, heaviest = 0, failure = NONE;

    INLINE void include(int i, int j) {
        left = left > -i ? left : -i, bottom = bottom > -j ? bottom : -j;
        right = right > i ? right : i, top = top > j ? top : j;
    }
    INLINE void fast(Real speed) { fastest = raised(fastest, rank_of(speed)); }
    INLINE void heavy(Real mass) { heaviest = raised(heaviest, rank_of(mass)); }
    INLINE void fail(int why) { failure = raised(failure, why); }

    INLINE void join_particles(const Team& team, int substep) const {
        team.include(substep, LEFT, left), team.include(substep, BOTTOM, bottom);
        team.include(substep, RIGHT, right), team.include(substep, TOP, top);
        team.include(substep, FASTEST, fastest);
        team.include(substep, FAILURE, failure);
    }
    INLINE void join_masses(const Team& team, int substep) const {
        team.include(substep, HEAVIEST, heaviest);
        team.include(substep, SPILL, failure);
    }

private:
    INLINE static int raised(int a, int b) { return a > b ? a : b; }
};

// Nodes in use, inclusive, on the padded grid.
struct Box {
    int i, j, rows, columns;

    INLINE explicit Box(const int* summary)
        : i(-summary[LEFT]), j(-summary[BOTTOM]), rows(summary[RIGHT] - i + 3), columns(summary[TOP] - j + 3) {
        if (summary[RIGHT] < i) i = j = rows = columns = 0;
    }
    INLINE int nodes() const { return rows * columns; }
};

// Where a substep of the replay leaves what the adjoint needs of the nodes: three numbers each.
struct Record {
    Real *x, *y, *inverse;  // velocity before gravity, and one over the mass
};

// Two numbers of each node around a particle, for the sums of stencil.hpp.
struct Around {
    const Pair* first;
    int columns;

    INLINE Around(const Pair* nodes, const Window& window, const Place& at)
        : first(nodes + window.at(at.i, at.j)), columns(window.columns) {}

    INLINE Real operator()(int p, int q, int c) const {
        const Pair node = first[p * columns + q];
        return c ? node.y : node.x;
    }
};

INLINE Moments read(const Pair* nodes, const Window& window, const Place& at) {
    const auto wx = [&](int p) { return weight(at.fx, p); };
    const auto wy = [&](int q) { return weight(at.fy, q); };
    return gather(at.fx, at.fy, wx, wy, Around(nodes, window, at));
}

// Of the muscles of a particle.
INLINE Pair actuation(const Robot& robot, const Body& body, const Place& at) {
    if (!TORCHMPM_MUSCLES || !body.muscle) return {0, 0};
    const Moments field = read(robot.nodes.field, robot.window, at);
    return {field.value[0], field.value[1]};
}

class Substep {
public:
    Robot& robot;
    Scale scale;
    Window before;  // the window of the velocities, where it has moved since

    INLINE explicit Substep(Robot& robot) : robot(robot) {}

    INLINE Place locate(const Particle& p) const { return ::locate(robot.domain, p.x, p.y); }

    // G2P; returns whether the particle takes part.
    INLINE bool grid_to_particle(Particle& p) const {
        const Place at = locate(p);
        if (!at.on) return false;
        const Moments m = read(robot.nodes.velocity, before, at);
        const Real slope = 4 * robot.domain.inverse_h;
        p.x += robot.dt * m.value[0], p.y += robot.dt * m.value[1];
        p.vx = m.value[0], p.vy = m.value[1];
        p.C = {slope * m.slope_x[0], slope * m.slope_y[0], slope * m.slope_x[1], slope * m.slope_y[1]};
        return true;
    }

    // P2G: deform, and give mass and momentum to the nodes; returns whether the particle takes part. `survey` gets
    // where it is and how fast; `keep` is false for a trial without effect on the particle.
    INLINE bool particle_to_grid(Particle& p, int index, int body_index, bool keep, Survey& survey) const {
        const Place at = locate(p);
        if (!at.on) return false;
        survey.include(at.i, at.j);
        if (robot.window.holds(at.i, at.j))
            scatter(p, at, index, robot.bodies[body_index], keep, survey);
        else
            survey.fail(LEFT_WINDOW);
        return true;
    }

    // Nodes: from mass and momentum to velocity.
    template <bool record> INLINE void move_nodes(int substep, const Record& tape) const {
        const Box box(robot.team.of(substep));
        Survey survey;
        for (int k = robot.team.rank; k < box.nodes(); k += robot.team.size) {
            const int i = box.i + k / box.columns, j = box.j + k % box.columns;
            move_node<record>(i, j, survey, tape);
        }
        survey.join_masses(robot.team, substep);
    }

private:
    struct Impulse {
        Real x, y, xx, xy, yx, yy;  // momentum, and its change per cell
    };

    INLINE void scatter(Particle& p, const Place& at, int index, const Body& body, bool keep, Survey& survey) const {
        const Values m = robot.values_of(body, index);
        const Pair act = actuation(robot, body, at);
        Mat2 F = p.F;
        Real Jp = p.Jp;
        const Sym2 tau = deform_as(body.kind, m, body.bounds, p.C, act, F, Jp);
        if (keep) p.F = F, p.Jp = Jp;
        const Real h = robot.h, mvx = m.mass * p.vx, mvy = m.mass * p.vy;
        const Real xx = h * affine_momentum(m, tau.xx, p.C.a), xy = h * affine_momentum(m, tau.xy, p.C.b);
        const Real yx = h * affine_momentum(m, tau.xy, p.C.c), yy = h * affine_momentum(m, tau.yy, p.C.d);
        // Nodes are at most two cells away from a particle along each axis.
        const Real most_x = math::fabs(mvx) + 2 * (math::fabs(xx) + math::fabs(xy));
        const Real most_y = math::fabs(mvy) + 2 * (math::fabs(yx) + math::fabs(yy));
        const Real speed = (most_x > most_y ? most_x : most_y) / m.mass;
        // The comparisons also fail for NaN.
        if (!(speed <= scale.fastest) || !(most_x <= scale.fastest * m.mass)) return spoil(at, survey);
        survey.fast(speed);
        scatter(at, scale.mass * m.mass, scale.momentum, {mvx, mvy, xx, xy, yx, yy});
    }

    INLINE Sym2 deform_as(int kind, const Values& m, const Bounds& bounds, Mat2 C, Pair act, Mat2& F, Real& Jp) const {
        const Real dt = robot.dt;
        if (has_kind<Kind::von_mises>(kind)) return deform<Kind::von_mises>(dt, m, bounds, C, act.x, act.y, F, Jp);
        if (has_kind<Kind::snow>(kind)) return deform<Kind::snow>(dt, m, bounds, C, act.x, act.y, F, Jp);
        return deform<Kind::elastic>(dt, m, bounds, C, act.x, act.y, F, Jp);
    }

    // In shared memory the robot is given up, and starts again with wider sums in global memory.
    INLINE void spoil(const Place& at, Survey& survey) const {
        if (TORCHMPM_SHARED) return survey.fail(LEFT_RANGE);
#if !TORCHMPM_SHARED
        Sums* row = robot.nodes.sums + robot.window.at(at.i, at.j);
        for (int p = 0; p < 3; ++p, row += robot.window.columns)
            for (int q = 0; q < 3; ++q) mark(&row[q].spoilt);
#endif
    }

    INLINE void scatter(const Place& at, Real mass, Real scaling, Impulse in) const {
        const Real xx = scaling * in.xx, xy = scaling * in.xy, yx = scaling * in.yx, yy = scaling * in.yy;
        // Momentum on the first node of a row, then on the next ones.
        Real first_x = scaling * in.x - xx * at.fx - xy * at.fy, first_y = scaling * in.y - yx * at.fx - yy * at.fy;
        Sums* row = robot.nodes.sums + robot.window.at(at.i, at.j);
        three([&](int p) {
            Real x = first_x, y = first_y;
            three([&](int q) {
                const Real w = weight(at.fx, p) * weight(at.fy, q);
                add<ADD_MASS>(&row[q].mass, fixed(w * mass));
                add<ADD_MOMENTUM_X>(&row[q].x, fixed(w * x));
                add<ADD_MOMENTUM_Y>(&row[q].y, fixed(w * y));
                x += xy, y += yy;
            });
            first_x += xx, first_y += yx, row += robot.window.columns;
        });
    }

    template <bool record> INLINE void move_node(int i, int j, Survey& survey, const Record& tape) const {
        const int node = robot.window.at(i, j);
        const Sums sums = robot.nodes.sums[node];
        robot.nodes.sums[node] = {};
        Real mass = scale.mass_unit * Real(sums.mass);
        Real momentum[2] = {scale.momentum_unit * Real(sums.x), scale.momentum_unit * Real(sums.y)};
        survey.heavy(math::fabs(mass));
        constexpr Fixed most = Fixed(1) << RANGE;
        bool spoilt = sums.mass > most || sums.mass < -most;
#if TORCHMPM_SHARED
        if (spoilt) survey.fail(LEFT_RANGE);
#else
        spoilt |= sums.spoilt != 0;
#endif
        if (spoilt) mass = momentum[0] = momentum[1] = not_a_number();
        // Where the mass has been rounded to nothing, so has the momentum.
        const Real inverse = mass != 0 ? inverse_mass(mass, robot.mass_epsilon) : Real(0);
        Real v[2] = {0, 0};
        if (robot.exists(i, j)) {
            for (int c = 0; c < 2; ++c) v[c] = node_velocity(momentum[c], inverse, robot.gain[c], robot.damping);
            constrain(robot.rules, robot.codes[i * robot.width() + j], v);
        }
        robot.nodes.velocity[node] = {v[0], v[1]};
        if (record)
            tape.x[node] = momentum[0] * inverse, tape.y[node] = momentum[1] * inverse, tape.inverse[node] = inverse;
    }

    INLINE static Real not_a_number() { return Real(__builtin_bit_cast(float, 0x7fffffff)); }
};
