"""The substep of ``torchmpm.Solver`` for one von Mises robot with muscles, in Taichi, as something to compare with.

Made to be fast in Taichi: return mapping and polar factor in closed form instead of ``ti.svd``, nodes without mass
skipped, and one kernel call a substep going forward. For gradients it does what DiffTaichi does: particles have one
slot for every substep, and the reverse pass fills the one grid again before the gradient kernels run.

Call ``ti.init(ti.cpu, ...)`` before making a :class:`TaichiRobot`; the next ``ti.init`` makes it invalid.
"""

import math

import numpy as np
import taichi as ti

import torchmpm

PAD = 3  # rows of nodes around the window; they take what would fall outside and stay at rest
FLOOR = 0.05  # principal stretches below this count as this in the yield test


@ti.data_oriented
class TaichiRobot:
    """A batch of robots of equal size, each in its own window of 128x128 nodes.

    Args:
        solver: Where body, gravity, damping and rules come from: a single :class:`torchmpm.VonMises` body, and rules
            without friction or sticky.
        batch: Number of simulations.
        history: Substeps that :meth:`gradient` can go back; 0 makes it forward only.
        origin_x: Left end of the windows, m.
        block: Particles or nodes that a thread takes at a time. Threads that add to the same nodes wait for each other:
            with particles in the order of their place and long blocks they seldom do.
    """

    def __init__(
        self, solver: torchmpm.Solver, batch: int, history: int = 0, origin_x: float = 0.0, block: int = 128
    ) -> None:
        self.block = block
        (body,) = solver.bodies
        gel = body.material
        self.batch, self.count, self.history = batch, body.count, history
        self.nodes, self.h, self.dt = solver.grid.resolution, solver.grid.h, solver.dt
        self.inverse_h = 1.0 / self.h
        self.mu, self.lam, self.mass, self.volume = gel.mu, gel.lam, body.mass, body.volume
        self.gravity, self.damping, self.origin_x = solver.gravity, solver.damping, origin_x
        self.margin = solver.grid.margin
        limit = gel.yield_stress / (2 * gel.mu)
        self.ratio = math.exp(math.sqrt(2 * (limit * limit - 1e-8)))  # of the principal stretches at yield
        self.root = math.sqrt(self.ratio)
        self.shift = math.trunc(origin_x / self.h)
        far = 10**6
        self.rules = []
        for rule in solver.rules:
            assert rule.frame == "world" and rule.friction in (0.0, math.inf)
            axis, sign = "xy".index(rule.direction[1]), 1 if rule.direction[0] == "+" else -1
            i0, i1, j0, j1 = (
                default if bound is None else bound
                for bound, default in zip((*rule.i, *rule.j), (-far, far, -far, far), strict=True)
            )
            self.rules.append((axis, sign, math.isinf(rule.friction), i0, i1, j0, j1))

        grads = history > 0
        particles = (max(history, 1) + 1, batch, body.count)
        self.x, self.v = (ti.Vector.field(2, ti.f32, particles, needs_grad=grads) for _ in range(2))
        self.C, self.F = (ti.Matrix.field(2, 2, ti.f32, particles, needs_grad=grads) for _ in range(2))
        grid = (batch, self.nodes + 2 * PAD, self.nodes + 2 * PAD)
        self.actuation = ti.Vector.field(2, ti.f32, grid, needs_grad=grads)
        self.node_mass = ti.field(ti.f32, grid, needs_grad=grads)
        self.momentum, self.velocity = (ti.Vector.field(2, ti.f32, grid, needs_grad=grads) for _ in range(2))

    def start(self, x: np.ndarray, actuation: np.ndarray) -> None:
        """Begin at rest at x (batch, count, 2) with muscle actuation (batch, 2, nodes, nodes) in Pa."""
        self._start(np.ascontiguousarray(x))
        field = np.pad(actuation, ((0, 0), (0, 0), (PAD, PAD), (PAD, PAD)))
        self.actuation.from_numpy(np.ascontiguousarray(field.transpose(0, 2, 3, 1)))

    def positions(self) -> np.ndarray:
        """Where the last run ended, (batch, count, 2)."""
        return self.x.to_numpy()[-1]

    def run(self, substeps: int) -> None:
        """Advance from the start; with a history every substep is kept."""
        for t in range(substeps):
            if self.history:
                self.substep(t, t + 1)
            else:
                self.substep(min(t, 1), 1)
        ti.sync()

    def gradient(self, cotangent: np.ndarray) -> ti.MatrixField:
        """Take the derivative in final positions (batch, count, 2) back to the actuation, after ``run(history)``.

        The result is a field over nodes, (batch, i, j), with ``PAD`` more on every side.
        """
        for field in (self.x, self.v, self.C, self.F, self.actuation):
            field.grad.fill(0.0)
        self._seed(cotangent)
        for t in reversed(range(self.history)):
            self._reset()
            self._to_grid(t, t + 1)
            self._on_grid()
            self._to_particles.grad(t, t + 1)
            self._on_grid.grad()
            self._to_grid.grad(t, t + 1)
        ti.sync()
        return self.actuation.grad

    @ti.kernel
    def substep(self, now: ti.i32, then: ti.i32):
        """One substep from one slot into another, or in place."""
        ti.loop_config(block_dim=self.block)
        for b, i, j in ti.ndrange(self.batch, self.nodes + 2 * PAD, self.nodes + 2 * PAD):
            self.reset(b, i, j)
        ti.loop_config(block_dim=self.block)
        for b, n in ti.ndrange(self.batch, self.count):
            self.to_grid(now, then, b, n)
        ti.loop_config(block_dim=self.block)
        for b, i, j in ti.ndrange(self.batch, self.nodes + 2 * PAD, self.nodes + 2 * PAD):
            self.on_grid(b, i, j)
        ti.loop_config(block_dim=self.block)
        for b, n in ti.ndrange(self.batch, self.count):
            self.to_particles(now, then, b, n)

    @ti.kernel
    def _reset(self):
        ti.loop_config(block_dim=self.block)
        for b, i, j in ti.ndrange(self.batch, self.nodes + 2 * PAD, self.nodes + 2 * PAD):
            self.reset(b, i, j)

    @ti.kernel
    def _to_grid(self, now: ti.i32, then: ti.i32):
        ti.loop_config(block_dim=self.block)
        for b, n in ti.ndrange(self.batch, self.count):
            self.to_grid(now, then, b, n)

    @ti.kernel
    def _on_grid(self):
        ti.loop_config(block_dim=self.block)
        for b, i, j in ti.ndrange(self.batch, self.nodes + 2 * PAD, self.nodes + 2 * PAD):
            self.on_grid(b, i, j)

    @ti.kernel
    def _to_particles(self, now: ti.i32, then: ti.i32):
        ti.loop_config(block_dim=self.block)
        for b, n in ti.ndrange(self.batch, self.count):
            self.to_particles(now, then, b, n)

    @ti.kernel
    def _start(self, x: ti.types.ndarray()):
        for b, p in ti.ndrange(self.batch, self.count):
            self.x[0, b, p] = ti.Vector([x[b, p, 0], x[b, p, 1]])
            self.v[0, b, p] = ti.Vector.zero(ti.f32, 2)
            self.C[0, b, p] = ti.Matrix.zero(ti.f32, 2, 2)
            self.F[0, b, p] = ti.Matrix.identity(ti.f32, 2)

    @ti.kernel
    def _seed(self, cotangent: ti.types.ndarray()):
        for b, p in ti.ndrange(self.batch, self.count):
            self.x.grad[self.history, b, p] = ti.Vector([cotangent[b, p, 0], cotangent[b, p, 1]])

    @ti.func
    def reset(self, b, i, j):
        """Empty the nodes that have something."""
        if self.node_mass[b, i, j] > 0.0:
            self.node_mass[b, i, j] = 0.0
            self.momentum[b, i, j] = ti.Vector.zero(ti.f32, 2)
            if ti.static(self.history > 0):
                self.node_mass.grad[b, i, j] = 0.0
                self.momentum.grad[b, i, j] = ti.Vector.zero(ti.f32, 2)
                self.velocity.grad[b, i, j] = ti.Vector.zero(ti.f32, 2)

    @ti.func
    def inside(self, x):
        """Whether a particle takes part."""
        return (x[0] - self.origin_x > self.margin) and (x[0] - self.origin_x < 1.0 - self.margin)

    @ti.func
    def place(self, x):
        """Address of the first of 3x3 nodes, and the distance from it in cells."""
        u = (x - ti.Vector([self.origin_x, 0.0])) * self.inverse_h
        base = ti.cast(u - 0.5, ti.i32)
        return ti.min(ti.max(base, -PAD), self.nodes) + PAD, u - ti.cast(base, ti.f32)

    @ti.func
    def weights(self, f):
        """Quadratic B-spline."""
        return [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2]

    @ti.func
    def returned(self, trial):
        """Von Mises return mapping; sum and difference of the stretches rescale rotation and reflection part."""
        F = trial
        p, q = trial[0, 0] + trial[1, 1], trial[1, 0] - trial[0, 1]
        r, s = trial[0, 0] - trial[1, 1], trial[0, 1] + trial[1, 0]
        rotation, reflection = p * p + q * q, r * r + s * s
        large, small = ti.max(rotation, reflection), ti.min(rotation, reflection)
        if small > ((self.ratio - 1.0) / (self.ratio + 1.0)) ** 2 * large:
            total, difference = ti.sqrt(large), ti.sqrt(small)
            major, minor = ti.max(0.5 * (total + difference), FLOOR), ti.max(0.5 * (total - difference), FLOOR)
            if major > minor * self.ratio:
                half = 0.5 * ti.sqrt(major * minor)
                grow, shrink = (
                    half * (self.root + 1.0 / self.root) / total,
                    half * (self.root - 1.0 / self.root) / difference,
                )
                a = ti.select(rotation >= reflection, grow, shrink)
                c = ti.select(rotation >= reflection, shrink, grow)
                F = ti.Matrix([[p * a + r * c, s * c - q * a], [q * a + s * c, p * a - r * c]])
        return F

    @ti.func
    def polar(self, F):
        """Orthogonal factor; a reflection where det F < 0."""
        p, q, r, s = F[0, 0] + F[1, 1], F[1, 0] - F[0, 1], F[0, 0] - F[1, 1], F[0, 1] + F[1, 0]
        R = ti.Matrix.identity(ti.f32, 2)
        rotation, reflection = p * p + q * q, r * r + s * s
        if rotation >= reflection:
            if rotation > 0.0:
                k = 1.0 / ti.sqrt(rotation)
                R = ti.Matrix([[p * k, -q * k], [q * k, p * k]])
        else:
            k = 1.0 / ti.sqrt(reflection)
            R = ti.Matrix([[r * k, s * k], [s * k, -r * k]])
        return R

    @ti.func
    def to_grid(self, now, then, b, n):
        """Deform, return, sample the muscles, find the stress, and scatter mass and momentum."""
        x = self.x[now, b, n]
        if self.inside(x):
            C = self.C[now, b, n]
            F = self.returned((ti.Matrix.identity(ti.f32, 2) + self.dt * C) @ self.F[now, b, n])
            self.F[then, b, n] = F
            base, f = self.place(x)
            w = self.weights(f)
            pull = ti.Vector.zero(ti.f32, 2)
            for i, j in ti.static(ti.ndrange(3, 3)):
                pull += w[i][0] * w[j][1] * self.actuation[b, base[0] + i, base[1] + j]
            J = F.determinant()
            R = self.polar(F)
            muscle = ti.Matrix([[pull[0], 0.0], [0.0, pull[1]]])
            tau = (2.0 * self.mu * (F - R) + F @ muscle) @ F.transpose()
            tau += self.lam * J * (J - 1.0) * ti.Matrix.identity(ti.f32, 2)
            P = -self.dt * self.volume * 4.0 * self.inverse_h**2 * tau + self.mass * C
            momentum = self.mass * self.v[now, b, n]
            for i, j in ti.static(ti.ndrange(3, 3)):
                weight = w[i][0] * w[j][1]
                d = (ti.Vector([float(i), float(j)]) - f) * self.h
                self.momentum[b, base[0] + i, base[1] + j] += weight * (momentum + P @ d)
                self.node_mass[b, base[0] + i, base[1] + j] += weight * self.mass
        else:
            self.F[then, b, n] = self.F[now, b, n]

    @ti.func
    def on_grid(self, b, i, j):
        """Velocity of the nodes that have mass: gravity, damping, rules."""
        mass = self.node_mass[b, i, j]
        if mass > 0.0 and ti.max(i, j) < self.nodes + PAD and ti.min(i, j) >= PAD:
            v = self.momentum[b, i, j] / (mass + 1e-10) + self.dt * ti.Vector([self.gravity[0], self.gravity[1]])
            v *= self.damping
            world_i, world_j = i - PAD + self.shift, j - PAD
            for k in ti.static(range(len(self.rules))):
                axis, sign, stick, i0, i1, j0, j1 = ti.static(self.rules[k])
                hit = i0 <= world_i and world_i <= i1 and j0 <= world_j and world_j <= j1 and sign * v[axis] > 0.0
                if ti.static(stick):
                    v[1 - axis] = ti.select(hit, 0.0, v[1 - axis])
                v[axis] = ti.select(hit, 0.0, v[axis])
            self.velocity[b, i, j] = v

    @ti.func
    def to_particles(self, now, then, b, n):
        """Gather velocity and affine matrix, and move."""
        x = self.x[now, b, n]
        if self.inside(x):
            base, f = self.place(x)
            w = self.weights(f)
            v = ti.Vector.zero(ti.f32, 2)
            C = ti.Matrix.zero(ti.f32, 2, 2)
            for i, j in ti.static(ti.ndrange(3, 3)):
                moved = w[i][0] * w[j][1] * self.velocity[b, base[0] + i, base[1] + j]
                v += moved
                C += 4.0 * self.inverse_h * moved.outer_product(ti.Vector([float(i), float(j)]) - f)
            self.v[then, b, n] = v
            self.C[then, b, n] = C
            self.x[then, b, n] = x + self.dt * v
        else:
            self.v[then, b, n] = self.v[now, b, n]
            self.C[then, b, n] = self.C[now, b, n]
            self.x[then, b, n] = x
