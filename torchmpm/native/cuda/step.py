"""The pass over the particles, as a kernel: it finishes one substep and begins the next."""

import triton
import triton.language as tl

from torchmpm.native.cuda.grid import SUMS
from torchmpm.native.cuda.material import DT, INVERSE_H, H, deform, read_values
from torchmpm.native.cuda.transfer import SIZES, actuation_at, gather, include, locate, scatter


@triton.jit
def load_matrix(planes, stride, mask):
    """Four planes; ones where there is no particle."""
    a, b = tl.load(planes, mask, other=1.0), tl.load(planes + stride, mask, other=1.0)
    c, d = tl.load(planes + 2 * stride, mask, other=1.0), tl.load(planes + 3 * stride, mask, other=1.0)
    return a, b, c, d


@triton.jit
def store_matrix(planes, stride, a, b, c, d, mask):
    """Four planes."""
    tl.store(planes, a, mask)
    tl.store(planes + stride, b, mask)
    tl.store(planes + 2 * stride, c, mask)
    tl.store(planes + 3 * stride, d, mask)


@triton.jit
def own_particles(first, count, particles, blocks, BLOCK: tl.constexpr):
    """The simulation of a program, and its particles: index in the body, offset in a plane, and whether they exist."""
    element = (tl.program_id(0) // blocks).to(tl.int64)
    k = tl.program_id(0) % blocks * BLOCK + tl.arange(0, BLOCK)
    return element, k, element * particles + first + k, k < count


@triton.jit
def values_at(values, element, k, column, columns, values_batch, VARYING: tl.constexpr):
    """Offsets of the values of particles in their table (8, values_batch, columns)."""
    at = tl.where(values_batch > 1, element, 0) * columns + column
    if VARYING:
        at += k
    else:
        at += tl.zeros_like(k)
    return at


@triton.jit
def advance(velocity, node, width, fx, fy, on, x, y, vx, vy, c0, c1, c2, c3, dt, inverse_h):
    """Position, velocity and affine matrix after a substep, from the velocities of the nodes."""
    ux, uy, xx, xy, yx, yy = gather(velocity, node, width, fx, fy, on, 2)
    scale = 4.0 * inverse_h
    x, y = tl.where(on, x + dt * ux, x), tl.where(on, y + dt * uy, y)
    vx, vy = tl.where(on, ux, vx), tl.where(on, uy, vy)
    c0, c1 = tl.where(on, scale * xx, c0), tl.where(on, scale * xy, c1)
    c2, c3 = tl.where(on, scale * yx, c2), tl.where(on, scale * yy, c3)
    return x, y, vx, vy, c0, c1, c2, c3


@triton.jit(do_not_specialize=SIZES)
def particles_pass(
    before, now, after, sums, velocity, box, field, origin, values, constants, bounds,
    particles, stride, first, count, blocks, column, columns, values_batch, resolution, width,
    KIND: tl.constexpr, VARYING: tl.constexpr, MUSCLE: tl.constexpr,
    FINISH: tl.constexpr, BEGIN: tl.constexpr, TAPE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Move the particles of one body, then deform them and add their mass and momentum to the nodes.

    ``before`` holds planes (13, B, N) with the positions at the start of the last substep, ``now`` those of this one,
    ``after`` gets the next deformation. All three are one buffer, or with ``TAPE`` three neighbours on a tape.
    """
    element, k, at, valid = own_particles(first, count, particles, blocks, BLOCK)
    stride = stride.to(tl.int64)
    origin += 2 * element
    cells = element * width * width
    h, inverse_h, dt = tl.load(constants + H), tl.load(constants + INVERSE_H), tl.load(constants + DT)
    x, y = tl.load(before + at, valid, other=0.0), tl.load(before + stride + at, valid, other=0.0)
    vx, vy = tl.load(before + 2 * stride + at, valid, other=0.0), tl.load(before + 3 * stride + at, valid, other=0.0)
    c0, c1, c2, c3 = load_matrix(before + 4 * stride + at, stride, valid)
    on, i, j, fx, fy = locate(x, y, origin, valid, constants, resolution)
    if FINISH:
        x, y, vx, vy, c0, c1, c2, c3 = advance(
            velocity + 2 * cells, i * width + j, width, fx, fy, on, x, y, vx, vy, c0, c1, c2, c3, dt, inverse_h
        )
        tl.store(now + at, x, valid)
        tl.store(now + stride + at, y, valid)
        on, i, j, fx, fy = locate(x, y, origin, valid, constants, resolution)
        # Particles that take part in the next substep get a new velocity before this one is read.
        kept = valid
        if BEGIN and not TAPE:
            kept = valid & (on == 0)
        tl.store(now + 2 * stride + at, vx, kept)
        tl.store(now + 3 * stride + at, vy, kept)
        store_matrix(now + 4 * stride + at, stride, c0, c1, c2, c3, kept)
    if BEGIN:
        place = values_at(values, element, k, column, columns, values_batch, VARYING)
        mass, factor, mu2, lam, s0, s1, s2, s3 = read_values(values, values_batch, columns, place, valid)
        f0, f1, f2, f3 = load_matrix(now + 8 * stride + at, stride, valid)
        Jp = tl.load(now + 12 * stride + at, valid, other=1.0)
        act_x, act_y = actuation_at(field, element, i, j, fx, fy, on, resolution, MUSCLE)
        e0, e1, e2, e3, grown, xx, xy, yy = deform(
            dt, c0, c1, c2, c3, f0, f1, f2, f3, Jp, factor, mu2, lam, s0, s1, s2, s3, act_x, act_y, constants,
            bounds, KIND,
        )  # fmt: skip
        kept = on
        if TAPE:
            kept = valid
            e0, e1, e2, e3 = tl.where(on, e0, f0), tl.where(on, e1, f1), tl.where(on, e2, f2), tl.where(on, e3, f3)
            grown = tl.where(on, grown, Jp)
        store_matrix(after + 8 * stride + at, stride, e0, e1, e2, e3, kept)
        tl.store(after + 12 * stride + at, grown, kept)
        include(box + 4 * element, i, j, on)
        scatter(
            sums + SUMS * cells, i * width + j, width, fx, fy, on, mass * vx, mass * vy,
            h * (xx + mass * c0), h * (xy + mass * c1), h * (xy + mass * c2), h * (yy + mass * c3), mass,
            True, SUMS,
        )  # fmt: skip
