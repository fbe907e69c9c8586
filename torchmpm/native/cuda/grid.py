"""The middle of a substep and its adjoint, in kernels: from sums on the nodes to velocities, and back.

Programs share the nodes of each simulation's box, read the sums there and leave zeros for the next substep.
"""

import triton
import triton.language as tl

from torchmpm.native.cuda.material import DAMPING, DT, MASS_EPSILON
from torchmpm.native.cuda.transfer import PAD, SIZES

#: Numbers of a velocity rule, see :class:`torchmpm.native.cuda.tables.DeviceTables`.
RULE = tl.constexpr(9)
#: Numbers of a node: sums forward, and sums and node_bars of the adjoint.
SUMS = tl.constexpr(4)
ADJOINT = tl.constexpr(8)


@triton.jit(do_not_specialize=SIZES)
def rule_codes(codes, rules, shift, rule_count, width, cells, programs, BLOCK: tl.constexpr):
    """Which rule holds on each node: one byte per slot, 0 where there is no rule, else its index plus one."""
    element = (tl.program_id(0) // programs).to(tl.int64)
    node = tl.program_id(0) % programs * BLOCK + tl.arange(0, BLOCK)
    i, j = (node // width - PAD).to(tl.float64), (node % width - PAD).to(tl.float64)
    shift_x = tl.load(shift + 2 * element).to(tl.float64)
    shift_y = tl.load(shift + 2 * element + 1).to(tl.float64)
    code = tl.zeros([BLOCK], tl.int32)
    for r in range(rule_count):
        rule = rules + RULE * r
        world = tl.load(rule + 7)
        x, y = i + world * shift_x, j + world * shift_y
        inside = (
            (x >= tl.load(rule + 2)) & (x <= tl.load(rule + 3)) & (y >= tl.load(rule + 4)) & (y <= tl.load(rule + 5))
        )
        bit = 8 * tl.load(rule + 8).to(tl.int32)
        first = inside & (((code >> bit) & 255) == 0)
        code = tl.where(first, code | ((r + 1) << bit), code)
    tl.store(codes + element * cells + node, code, node < cells)


@triton.jit
def read_rule(rules, code, vx, vy, SLOT: tl.constexpr):
    """The rule of nodes in a slot: whether along y, friction, normal and tangential velocity, and where it acts."""
    index = (code >> (8 * SLOT)) & 255
    some = index > 0
    rule = rules + RULE * (index - 1)
    on_y = tl.load(rule, some, other=0.0) > 0
    sign, friction = tl.load(rule + 1, some, other=0.0), tl.load(rule + 6, some, other=0.0)
    normal, tangent = tl.where(on_y, vy, vx), tl.where(on_y, vx, vy)
    return on_y, friction.to(vx.dtype), normal, tangent, some & (normal * sign.to(vx.dtype) > 0)


@triton.jit
def rubbed(tangent, normal, friction):
    """What friction leaves of the tangential speed, negative where it sticks."""
    return tl.where(friction == float("inf"), -1.0, tl.abs(tangent) - friction * tl.abs(normal))


@triton.jit
def constrain(rules, code, vx, vy, SLOT: tl.constexpr):
    """Velocity of nodes under the rule of one slot."""
    on_y, friction, normal, tangent, hit = read_rule(rules, code, vx, vy, SLOT)
    left = rubbed(tangent, normal, friction)
    slowed = tl.where(left < 0, 0.0, tl.where(tangent < 0, -left, left))
    tangent = tl.where(hit & (friction != 0), slowed, tangent)
    normal = tl.where(hit, 0.0, normal)
    return tl.where(on_y, tangent, normal), tl.where(on_y, normal, tangent)


@triton.jit
def constrain_adjoint(rules, code, vx, vy, bar_x, bar_y, SLOT: tl.constexpr):
    """From derivatives in the velocity that a rule left to those in the one before it, (vx, vy)."""
    on_y, friction, normal, tangent, hit = read_rule(rules, code, vx, vy, SLOT)
    normal_bar, tangent_bar = tl.where(on_y, bar_y, bar_x), tl.where(on_y, bar_x, bar_y)
    rubs = hit & (friction != 0)
    slides = rubbed(tangent, normal, friction) >= 0
    drag = tl.where((tangent > 0) == (normal > 0), -friction, friction) * tangent_bar
    normal_bar = tl.where(hit, tl.where(rubs & slides, drag, 0.0), normal_bar)
    tangent_bar = tl.where(rubs & (slides == 0), 0.0, tangent_bar)
    return tl.where(on_y, tangent_bar, normal_bar), tl.where(on_y, normal_bar, tangent_bar)


@triton.jit
def unpack_box(box):
    """First row, first column, rows and columns of a box of :func:`torchmpm.native.cuda.transfer.include`."""
    i0, j0 = tl.load(box), tl.load(box + 1)
    return i0, j0, tl.maximum(3 - tl.load(box + 2) - i0, 0), tl.maximum(3 - tl.load(box + 3) - j0, 0)


@triton.jit
def raw_velocity(sums, gravity, constants, exists):
    """Velocity before gravity, one over the mass, and velocity before the rules; zeros on nodes that do not exist."""
    inverse = 1.0 / (tl.load(sums + 2, exists, other=1.0) + tl.load(constants + MASS_EPSILON))
    raw_x, raw_y = tl.load(sums, exists, other=0.0) * inverse, tl.load(sums + 1, exists, other=0.0) * inverse
    dt, damping = tl.load(constants + DT), tl.load(constants + DAMPING)
    vx = (raw_x + dt * tl.load(gravity)) * damping
    vy = (raw_y + dt * tl.load(gravity + 1)) * damping
    return raw_x, raw_y, inverse, tl.where(exists, vx, 0.0), tl.where(exists, vy, 0.0)


@triton.jit(do_not_specialize=SIZES)
def node_velocities(
    sums, velocity, boxes, codes, rules, gravity, constants, resolution, width, programs,
    SLOTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Velocities (two numbers a node) from mass and momentum (four numbers a node), which become zero."""
    element = (tl.program_id(0) // programs).to(tl.int64)
    base = element * width * width
    i0, j0, rows, columns = unpack_box(boxes + 4 * element)
    for start in range(tl.program_id(0) % programs * BLOCK, rows * columns, programs * BLOCK):
        k = start + tl.arange(0, BLOCK)
        used = k < rows * columns
        i, j = i0 + k // columns, j0 + k % columns
        exists = used & (i >= PAD) & (i < PAD + resolution) & (j >= PAD) & (j < PAD + resolution)
        node = base + i * width + j
        _, _, _, vx, vy = raw_velocity(sums + SUMS * node, gravity + 2 * element, constants, exists)
        code = tl.zeros([BLOCK], tl.int32)
        if SLOTS > 0:
            code = tl.load(codes + node, exists, other=0)
        for slot in tl.static_range(SLOTS):
            vx, vy = constrain(rules, code, vx, vy, slot)
        tl.store(velocity + 2 * node, vx, used)
        tl.store(velocity + 2 * node + 1, vy, used)
        for r in tl.static_range(3):
            tl.store(sums + SUMS * node + r, tl.zeros_like(vx), used)


@triton.jit(do_not_specialize=SIZES)
def node_adjoint(
    sums, node_bars, boxes, codes, rules, gravity, gravity_bar, constants, resolution, width, programs,
    SLOTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Answers from the sums of the adjoint, which become zero.

    Sums of a node: momentum, mass, derivative in the velocity. Answers: velocity, derivatives in momentum and mass.
    """
    element = (tl.program_id(0) // programs).to(tl.int64)
    base = element * width * width
    i0, j0, rows, columns = unpack_box(boxes + 4 * element)
    for start in range(tl.program_id(0) % programs * BLOCK, rows * columns, programs * BLOCK):
        k = start + tl.arange(0, BLOCK)
        used = k < rows * columns
        i, j = i0 + k // columns, j0 + k % columns
        exists = used & (i >= PAD) & (i < PAD + resolution) & (j >= PAD) & (j < PAD + resolution)
        node = base + i * width + j
        at = sums + ADJOINT * node
        raw_x, raw_y, inverse, vx, vy = raw_velocity(at, gravity + 2 * element, constants, exists)
        bar_x, bar_y = tl.load(at + 3, exists, other=0.0), tl.load(at + 4, exists, other=0.0)
        code = tl.zeros([BLOCK], tl.int32)
        if SLOTS > 0:
            code = tl.load(codes + node, exists, other=0)
        for slot in tl.static_range(SLOTS - 1, -1, -1):
            before_x, before_y = vx, vy
            for earlier in tl.static_range(slot):
                before_x, before_y = constrain(rules, code, before_x, before_y, earlier)
            bar_x, bar_y = constrain_adjoint(rules, code, before_x, before_y, bar_x, bar_y, slot)
        for slot in tl.static_range(SLOTS):
            vx, vy = constrain(rules, code, vx, vy, slot)
        damping, dt = tl.load(constants + DAMPING), tl.load(constants + DT)
        bar_x *= damping
        bar_y *= damping
        tl.atomic_add(gravity_bar + 2 * element, dt * tl.sum(bar_x, axis=0), sem="relaxed")
        tl.atomic_add(gravity_bar + 2 * element + 1, dt * tl.sum(bar_y, axis=0), sem="relaxed")
        bar_x *= inverse
        bar_y *= inverse
        node_bar = node_bars + ADJOINT * node
        tl.store(node_bar, vx, used)
        tl.store(node_bar + 1, vy, used)
        tl.store(node_bar + 2, bar_x, used)
        tl.store(node_bar + 3, bar_y, used)
        tl.store(node_bar + 4, -(raw_x * bar_x + raw_y * bar_y), used)
        for r in tl.static_range(5):
            tl.store(at + r, tl.zeros_like(vx), used)
