// The adjoint of a substep. Going back, one pass over the particles ends the adjoint of a substep and begins that of
// the one before, as on the CPU.
#pragma once
#include "node_adjoint.hpp"
#include "particle_adjoint.hpp"
#include "tape.cuh"

class Reverse {
public:
    Robot& robot;
    Real origin_bar[2], gain_bar[2];  // this thread's share, gain_bar of the velocity from gravity

    INLINE explicit Reverse(Robot& robot) : robot(robot) { clear(); }

    INLINE void clear() { origin_bar[0] = origin_bar[1] = gain_bar[0] = gain_bar[1] = 0; }

    // Adjoint of G2P: derivatives in the velocities of the nodes around a particle whose state was at `x`, `y`.
    INLINE void grid_to_particle_adjoint(Real x, Real y, const Particle& bar, const Window& window) const {
        const Place at = locate(robot.domain, x, y);
        if (!at.on) return;
        const Real dt = robot.dt, slope = 4 * robot.domain.inverse_h;
        const Mat2 C = slope * bar.C;
        const Real vx = bar.vx + dt * bar.x, vy = bar.vy + dt * bar.y;
        Pair* first = robot.nodes.velocity_bar + window.at(at.i, at.j);
        three([&](int p) {
            three([&](int q) {
                const Real w = weight(at.fx, p) * weight(at.fy, q), dx = p - at.fx, dy = q - at.fy;
                Pair* node = first + p * window.columns + q;
                add<ADD_VELOCITY_BAR_X>(&node->x, w * (vx + C.a * dx + C.b * dy));
                add<ADD_VELOCITY_BAR_Y>(&node->y, w * (vy + C.c * dx + C.d * dy));
            });
        });
    }

    // Adjoint of P2G and of the weights of both transfers: turns the derivatives in the state after the substep into
    // those in the state before it.
    INLINE void particle_to_grid_adjoint(const Particle& state, Particle& bar, int index, int body_index) {
        const Body& body = robot.bodies[body_index];
        const Place at = locate(robot.domain, state.x, state.y);
        if (at.on) {
            if (has_kind<Kind::von_mises>(body.kind))
                adjoint_as<Kind::von_mises>(state, bar, at, body, index);
            else if (has_kind<Kind::snow>(body.kind))
                adjoint_as<Kind::snow>(state, bar, at, body, index);
            else
                adjoint_as<Kind::elastic>(state, bar, at, body, index);
        }
        if (has_kind<Kind::snow>(body.kind) && unresolved(body.bounds, state.C)) bar = {};
    }

    // Nodes: from derivatives in their velocities to those in mass and momentum. The window is that of the substep.
    INLINE void nodes(const Box& box, const Record& tape) {
        for (int k = robot.team.rank; k < box.nodes(); k += robot.team.size)
            node(box.i + k / box.columns, box.j + k % box.columns, tape);
    }

    // Add the derivatives in the actuation that have been collected in the window to those of the field.
    INLINE void flush_field() const {
        if (!TORCHMPM_MUSCLES || !robot.given.field_bar) return;
        const int n = int(robot.given.resolution);
        const Window& window = robot.window;
        Real* out = robot.given.field_bar + 2 * robot.element * n * n;
        for (int k = robot.team.rank; k < window.nodes(); k += robot.team.size) {
            const int i = window.i + k / window.columns, j = window.j + k % window.columns;
            Pair& bar = robot.nodes.field_bar[k];
            if (robot.exists(i, j)) {
                const int node = (i - PAD) * n + j - PAD;
                out[node] += bar.x, out[n * n + node] += bar.y;
            }
            bar = {0, 0};
        }
    }

private:
    template <Kind kind>
    INLINE void adjoint_as(const Particle& state, Particle& bar, const Place& at, const Body& body, int index) {
        const Values m = robot.values_of(body, index);
        const Real dt = robot.dt, h = robot.h, slope = 4 * robot.domain.inverse_h;
        const Nodes& nodes = robot.nodes;
        const Window& window = robot.window;
        const Moments P = read(nodes.momentum_bar, window, at);
        const Mat2 P_bar = h * Mat2{P.slope_x[0], P.slope_y[0], P.slope_x[1], P.slope_y[1]};
        const Pair act = actuation(robot, body, at);
        const DeformedBar out =
            deform_adjoint<kind>(dt, m, body.bounds, state.C, state.F, state.Jp, act.x, act.y, P_bar, bar.F, bar.Jp);
        const PositionFactors factors{
            m.mass,        m.mass * state.vx, m.mass * state.vy,  bar.vx + dt * bar.x, bar.vy + dt * bar.y,
            slope * bar.C, h * out.affine,    out.material.act_x, out.material.act_y};
        const Real* masses = nodes.mass_bar + window.at(at.i, at.j);
        const Around field(nodes.field, window, at);
        const PositionBar sum = position_adjoint<TORCHMPM_MUSCLES>(
            at.fx, at.fy, [&](int p) { return weight(at.fx, p); }, [&](int q) { return weight(at.fy, q); }, factors,
            Around(nodes.velocity, window, at), Around(nodes.momentum_bar, window, at),
            [&](int p, int q) { return masses[p * window.columns + q]; },
            [&](int p, int q, int c) { return body.muscle ? field(p, q, c) : Real(0); });
        const Real x = sum.fx * robot.domain.inverse_h, y = sum.fy * robot.domain.inverse_h;
        origin_bar[0] -= x, origin_bar[1] -= y;
        bar = {bar.x + x,
               bar.y + y,
               m.mass * P.value[0],
               m.mass * P.value[1],
               out.C,
               out.F,
               kind == Kind::snow ? out.Jp : bar.Jp};
        if (robot.given.values_bar) {
            const Real mass = state.vx * P.value[0] + state.vy * P.value[1] + P_bar.a * state.C.a +
                              P_bar.b * state.C.b + P_bar.c * state.C.c + P_bar.d * state.C.d + sum.mass;
            add_values(index, mass, out.material.values);
        }
        if (TORCHMPM_MUSCLES && body.muscle && robot.given.field_bar)
            scatter_actuation(at, out.material.act_x, out.material.act_y);
    }

    INLINE void add_values(int index, Real mass, const Values& bar) const {
        const int64_t n = robot.given.particles, stride = robot.given.batch * n;
        Real* to = robot.given.values_bar + robot.element * n + index;
        const Real of[VALUES] = {mass, bar.factor, bar.mu2, bar.lam, bar.tanh2, bar.exp, bar.cosh2, bar.sinh2};
#pragma unroll
        for (int r = 0; r < VALUES; ++r) to[r * stride] += of[r];
    }

    INLINE void scatter_actuation(const Place& at, Real x, Real y) const {
        Pair* first = robot.nodes.field_bar + robot.window.at(at.i, at.j);
        three([&](int p) {
            three([&](int q) {
                const Real w = weight(at.fx, p) * weight(at.fy, q);
                Pair* node = first + p * robot.window.columns + q;
                add<ADD_FIELD_BAR_X>(&node->x, w * x);
                add<ADD_FIELD_BAR_Y>(&node->y, w * y);
            });
        });
    }

    INLINE void node(int i, int j, const Record& tape) {
        const int node = robot.window.at(i, j);
        Pair& velocity_bar = robot.nodes.velocity_bar[node];
        Real bar[2] = {velocity_bar.x, velocity_bar.y}, v[2] = {0, 0};
        velocity_bar = {0, 0};
        NodeBar out{{0, 0}, 0};
        if (robot.exists(i, j)) {
            const Real raw[2] = {tape.x[node], tape.y[node]};
            for (int c = 0; c < 2; ++c) v[c] = (raw[c] + robot.gain[c]) * robot.damping;
            constrain_adjoint(robot.rules, robot.codes[i * robot.width() + j], v, bar);
            for (int c = 0; c < 2; ++c) bar[c] *= robot.damping, gain_bar[c] += bar[c];
            out = node_adjoint(bar, raw, tape.inverse[node]);
        }
        robot.nodes.velocity[node] = {v[0], v[1]};
        robot.nodes.momentum_bar[node] = {out.momentum[0], out.momentum[1]};
        robot.nodes.mass_bar[node] = out.mass;
    }
};
