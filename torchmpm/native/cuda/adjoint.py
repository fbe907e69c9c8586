"""The passes over the particles in the adjoint of a substep, as kernels: before and after the one over the nodes."""

import triton
import triton.language as tl

from torchmpm.native.cuda.grid import ADJOINT
from torchmpm.native.cuda.linalg import matmul
from torchmpm.native.cuda.material import DT, INVERSE_H, LARGEST_STRAIN, SNOW, H, deform, read_values
from torchmpm.native.cuda.material_adjoint import material_adjoint
from torchmpm.native.cuda.step import load_matrix, own_particles, store_matrix, values_at
from torchmpm.native.cuda.transfer import (
    SIZES,
    actuation_at,
    field_at,
    gather,
    include,
    locate,
    scatter,
    weight,
    weight_slope,
)


@triton.jit
def position_adjoint(
    node_bars, node, width, fx, fy, on, ux, uy, mvx, mvy, mass, cxx, cxy, cyx, cyy, pxx, pxy, pyx, pyy,
    field, i, j, gx, gy, resolution, MUSCLE: tl.constexpr,
):  # fmt: skip
    """Derivatives in the distances (fx, fy), through all weights and offsets of a substep, and that in the mass.

    Takes the derivatives u in the new velocity (those through the new position included), 4/h times those in the new
    affine matrix c, and those g in the actuation; and what the particle gives: momentum mv, mass, h times the affine
    momentum p.
    """
    fx_bar, fy_bar, masses = tl.zeros_like(fx), tl.zeros_like(fx), tl.zeros_like(fx)
    for p in tl.static_range(3):
        for q in tl.static_range(3):
            at = node_bars + ADJOINT * (node + p * width + q)
            vx, vy = tl.load(at, on, other=0.0), tl.load(at + 1, on, other=0.0)
            px, py, m = tl.load(at + 2, on, other=0.0), tl.load(at + 3, on, other=0.0), tl.load(at + 4, on, other=0.0)
            value = ux * vx + uy * vy + mass * m + mvx * px + mvy * py
            if MUSCLE:
                place, exists = field_at(field, i, j, p, q, on, resolution)
                value += gx * tl.load(place, exists, other=0.0)
                value += gy * tl.load(place + resolution * resolution, exists, other=0.0)
            along_x = cxx * vx + cyx * vy + pxx * px + pyx * py
            along_y = cxy * vx + cyy * vy + pxy * px + pyy * py
            value += (p - fx) * along_x + (q - fy) * along_y
            wx, wy = weight(fx, p), weight(fy, q)
            fx_bar += wy * (weight_slope(fx, p) * value - wx * along_x)
            fy_bar += wx * (weight_slope(fy, q) * value - wy * along_y)
            masses += wx * wy * m
    return fx_bar, fy_bar, masses


@triton.jit
def read_particle(state, at, stride, valid):
    """The components of a state, or derivatives in them."""
    x, y = tl.load(state + at, valid, other=0.0), tl.load(state + stride + at, valid, other=0.0)
    vx, vy = tl.load(state + 2 * stride + at, valid, other=0.0), tl.load(state + 3 * stride + at, valid, other=0.0)
    c0, c1, c2, c3 = load_matrix(state + 4 * stride + at, stride, valid)
    f0, f1, f2, f3 = load_matrix(state + 8 * stride + at, stride, valid)
    return x, y, vx, vy, c0, c1, c2, c3, f0, f1, f2, f3, tl.load(state + 12 * stride + at, valid, other=1.0)


@triton.jit(do_not_specialize=SIZES)
def begin_adjoint(
    state, bars, sums, box, field, origin, values, constants, bounds,
    particles, stride, first, count, blocks, column, columns, values_batch, resolution, width,
    KIND: tl.constexpr, VARYING: tl.constexpr, MUSCLE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Add to the nodes what the particles of one body gave them at the start of a substep, and derivatives at its end.

    ``state`` holds planes (13, B, N) at the start, ``bars`` the derivatives in those at the end. The sums of a node
    become momentum, mass, and the derivative in its velocity.
    """
    element, k, at, valid = own_particles(first, count, particles, blocks, BLOCK)
    stride = stride.to(tl.int64)
    place = values_at(values, element, k, column, columns, values_batch, VARYING)
    mass, factor, mu2, lam, s0, s1, s2, s3 = read_values(values, values_batch, columns, place, valid)
    h, inverse_h, dt = tl.load(constants + H), tl.load(constants + INVERSE_H), tl.load(constants + DT)
    x, y, vx, vy, c0, c1, c2, c3, f0, f1, f2, f3, Jp = read_particle(state, at, stride, valid)
    on, i, j, fx, fy = locate(x, y, origin + 2 * element, valid, constants, resolution)
    node = i * width + j
    sums += ADJOINT * element * width * width
    act_x, act_y = actuation_at(field, element, i, j, fx, fy, on, resolution, MUSCLE)
    _, _, _, _, _, xx, xy, yy = deform(
        dt, c0, c1, c2, c3, f0, f1, f2, f3, Jp, factor, mu2, lam, s0, s1, s2, s3, act_x, act_y, constants, bounds,
        KIND,
    )  # fmt: skip
    include(box + 4 * element, i, j, on)
    scatter(
        sums, node, width, fx, fy, on, mass * vx, mass * vy,
        h * (xx + mass * c0), h * (xy + mass * c1), h * (xy + mass * c2), h * (yy + mass * c3), mass, True, ADJOINT,
    )  # fmt: skip
    x_bar, y_bar, vx_bar, vy_bar, c0_bar, c1_bar, c2_bar, c3_bar, _, _, _, _, _ = read_particle(bars, at, stride, valid)
    scale = 4.0 * inverse_h
    scatter(
        sums + 3, node, width, fx, fy, on, vx_bar + dt * x_bar, vy_bar + dt * y_bar,
        scale * c0_bar, scale * c1_bar, scale * c2_bar, scale * c3_bar, mass, False, ADJOINT,
    )  # fmt: skip


@triton.jit
def scatter_actuation(field_bar, i, j, fx, fy, act_x_bar, act_y_bar, on, resolution):
    """Add derivatives in the actuation of particles to the field (2, G, G)."""
    for p in tl.static_range(3):
        for q in tl.static_range(3):
            place, exists = field_at(field_bar, i, j, p, q, on, resolution)
            w = weight(fx, p) * weight(fy, q)
            tl.atomic_add(place, w * act_x_bar, exists, sem="relaxed")
            tl.atomic_add(place + resolution * resolution, w * act_y_bar, exists, sem="relaxed")


@triton.jit
def add_matrix(planes, stride, a, b, c, d, mask):
    """Add to four planes, in numbers that belong to this program alone."""
    e, f, g, h = load_matrix(planes, stride, mask)
    store_matrix(planes, stride, e + a, f + b, g + c, h + d, mask)


@triton.jit
def drop_unresolved(bars, stride, c0, c1, c2, c3, bounds, mask, KIND: tl.constexpr):
    """Forget the derivatives in snow that moves faster than a substep resolves, see :class:`torchmpm.Snow`."""
    if KIND == SNOW:
        limit, zero = LARGEST_STRAIN * tl.load(bounds + 3), tl.zeros_like(c0)
        drop = mask & (c0 * c0 + c1 * c1 + c2 * c2 + c3 * c3 > limit * limit)
        for plane in tl.static_range(13):
            tl.store(bars + plane * stride, zero, drop)


@triton.jit(do_not_specialize=SIZES)
def finish_adjoint(
    state, bars, values_bar, field_bar, origin_bar, node_bars, field, origin, values, constants, bounds,
    particles, stride, first, count, blocks, column, columns, values_batch, resolution, width,
    KIND: tl.constexpr, VARYING: tl.constexpr, MUSCLE: tl.constexpr, WANT_FIELD: tl.constexpr,
    WANT_VALUES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """From the derivatives in the state after a substep to those in the state before, in place; sums up all others."""
    element, k, at, valid = own_particles(first, count, particles, blocks, BLOCK)
    stride = stride.to(tl.int64)
    place = values_at(values, element, k, column, columns, values_batch, VARYING)
    mass, factor, mu2, lam, s0, s1, s2, s3 = read_values(values, values_batch, columns, place, valid)
    h, inverse_h, dt = tl.load(constants + H), tl.load(constants + INVERSE_H), tl.load(constants + DT)
    x, y, vx, vy, c0, c1, c2, c3, f0, f1, f2, f3, Jp = read_particle(state, at, stride, valid)
    x_bar, y_bar, vx_bar, vy_bar, c0_bar, c1_bar, c2_bar, c3_bar, f0_bar, f1_bar, f2_bar, f3_bar, Jp_bar = (
        read_particle(bars, at, stride, valid)
    )
    on, i, j, fx, fy = locate(x, y, origin + 2 * element, valid, constants, resolution)
    node = i * width + j
    node_bars += ADJOINT * element * width * width
    act_x, act_y = actuation_at(field, element, i, j, fx, fy, on, resolution, MUSCLE)
    field += 2 * resolution * resolution * element
    field_bar += 2 * resolution * resolution * element
    # Derivatives in the momentum (m v) and the affine momentum.
    px_bar, py_bar, pxx_bar, pxy_bar, pyx_bar, pyy_bar = gather(node_bars + 2, node, width, fx, fy, on, ADJOINT)
    pxx_bar, pxy_bar, pyx_bar, pyy_bar = h * pxx_bar, h * pxy_bar, h * pyx_bar, h * pyy_bar
    g0, g1, g2, g3 = 1.0 + dt * c0, dt * c1, dt * c2, 1.0 + dt * c3
    t0, t1, t2, t3 = matmul(g0, g1, g2, g3, f0, f1, f2, f3)
    (
        e0_bar, e1_bar, e2_bar, e3_bar, new_Jp_bar, xx, xy, yy, act_x_bar, act_y_bar,
        factor_bar, mu2_bar, lam_bar, s0_bar, s1_bar, s2_bar, s3_bar,
    ) = material_adjoint(
        t0, t1, t2, t3, Jp, mass, factor, mu2, lam, s0, s1, s2, s3, act_x, act_y, pxx_bar, pxy_bar + pyx_bar, pyy_bar,
        f0_bar, f1_bar, f2_bar, f3_bar, Jp_bar, constants, bounds, KIND,
    )  # fmt: skip
    d0, d1, d2, d3 = matmul(e0_bar, e1_bar, e2_bar, e3_bar, f0, f2, f1, f3)
    e0_bar, e1_bar, e2_bar, e3_bar = matmul(g0, g2, g1, g3, e0_bar, e1_bar, e2_bar, e3_bar)
    d0, d1 = mass * pxx_bar + dt * d0, mass * pxy_bar + dt * d1
    d2, d3 = mass * pyx_bar + dt * d2, mass * pyy_bar + dt * d3
    scale = 4.0 * inverse_h
    fx_bar, fy_bar, masses = position_adjoint(
        node_bars, node, width, fx, fy, on, vx_bar + dt * x_bar, vy_bar + dt * y_bar, mass * vx, mass * vy, mass,
        scale * c0_bar, scale * c1_bar, scale * c2_bar, scale * c3_bar,
        h * (xx + mass * c0), h * (xy + mass * c1), h * (xy + mass * c2), h * (yy + mass * c3),
        field, i, j, act_x_bar, act_y_bar, resolution, MUSCLE,
    )  # fmt: skip
    fx_bar, fy_bar = tl.where(on, fx_bar * inverse_h, 0.0), tl.where(on, fy_bar * inverse_h, 0.0)
    tl.atomic_add(origin_bar + 2 * element, -tl.sum(fx_bar, axis=0), sem="relaxed")
    tl.atomic_add(origin_bar + 2 * element + 1, -tl.sum(fy_bar, axis=0), sem="relaxed")
    bars += at
    store_matrix(bars, stride, x_bar + fx_bar, y_bar + fy_bar, mass * px_bar, mass * py_bar, on)
    store_matrix(bars + 4 * stride, stride, d0, d1, d2, d3, on)
    store_matrix(bars + 8 * stride, stride, e0_bar, e1_bar, e2_bar, e3_bar, on)
    tl.store(bars + 12 * stride, new_Jp_bar, on)
    drop_unresolved(bars, stride, c0, c1, c2, c3, bounds, valid, KIND)
    if MUSCLE and WANT_FIELD:
        scatter_actuation(field_bar, i, j, fx, fy, act_x_bar, act_y_bar, on, resolution)
    if WANT_VALUES:
        mass_bar = vx * px_bar + vy * py_bar + pxx_bar * c0 + pxy_bar * c1 + pyx_bar * c2 + pyy_bar * c3 + masses
        add_matrix(values_bar + at, stride, mass_bar, factor_bar, mu2_bar, lam_bar, on)
        add_matrix(values_bar + 4 * stride + at, stride, s0_bar, s1_bar, s2_bar, s3_bar, on)
