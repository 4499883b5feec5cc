"""Rotors of many parameter vectors at once: lag, delay, mean speeds, and their moments over each half step."""

import math
from typing import NamedTuple

import numba as nb

from quadid.model import layout as ix
from quadid.model.kernel import Needs
from quadid.model.layout import places
from quadid.model.simd import LANES, cache_aligned, cached, exact, inlined, jit, lane_kernel
from quadid.types import FloatArray

# isort: off
from quadid.model.simd import (
    ALL_MOMENTS, A_DO, A_O1, A_S1, A_S2, A_X1, A_X2, A_XX, A_XY, A_XZ, A_Y1, A_Y2, A_YY, A_YZ, A_Z1, A_Z2, A_ZZ,
    C_CURVE, C_GROWTH, C_HOVER, C_PART, C_ROW, C_SHIFT, C_TAU, C_TAU_DOWN, C_VOLT, C_W0, DOWN, HALF, N_ROWS, PIECE,
    P_AT, P_E, P_E1, P_E2, P_E3, P_H, ROTOR, R_DRAG, R_GAIN, R_NEXT, R_NEXT_SLOPE, R_NOW, R_NOW_SLOPE, R_PAST,
    R_PAST_SLOPE, R_SPEED, T_A0, T_A1, T_DRAG, T_GAIN, T_M1, T_M2, T_N1, T_N2, T_S0, T_S1, T_SPEED, T_VOLT,
)  # fmt: skip
# isort: on

# --- Rotor speeds of many parameter vectors at once: lag, delay, and the exact means of speed over each half step
#
# omega' = (u - omega) / tau.  Over each half step the means of omega and omega^2 are exact for first-order lag and
# pure delay.  The input u, delayed by (j + f) dt, switches (held) or bends (linear) once within a step, f dt after its
# start; each half step is therefore two pieces, one of which may have no length.  A held input may run on at a slope
# within its samples, whose mean it is (`quadid.data.rotor_signal`).
#
# What one rotor needs is copied into the rows T_*, so that each loop works on one array: distances between rows are
# then constants, and the compiler sees that rows do not overlap.


THIRD = 1.0 / 3.0
A, B, C, D = 0, PIECE, 2 * PIECE, 3 * PIECE
"""Pieces of a step: its halves, each before and after the input switches."""


@nb.njit(**exact)
def rotor_constants(theta: FloatArray, dt: float, rot: FloatArray, s: FloatArray) -> None:
    """Derives the rotors' constants of all lanes.

    Args:
        theta: parameter vectors (LANES, size).
        dt: step [s].
        rot: rows of the rotors (rotors, ROTOR); gains written.
        s: rows; written.
    """
    for lane in range(LANES):
        th = theta[lane]
        for r in range(len(rot)):
            loss = th[ix.LOSS + r]
            rot[r, R_GAIN + lane], rot[r, R_DRAG + lane] = 1.0 - loss, 1.0 - loss - th[ix.LOSS + len(rot) + r]
        s[C_W0 + lane], s[C_CURVE + lane] = th[ix.DEAD_SPEED], th[ix.DEAD_SPEED] ** 2 + th[ix.OFFSET] / th[ix.B]
        delay = (max(th[ix.DELAY], 0.0) - max(th[ix.TELEMETRY], 0.0)) / dt
        f = delay - math.floor(delay)
        s[C_SHIFT + lane], s[C_PART + lane] = math.floor(delay), f
        s[C_TAU + lane], s[C_TAU_DOWN + lane] = max(th[ix.TAU], 0.0), max(th[ix.TAU] + th[ix.SLOWER], 0.0)
        cuts = (min(f, 0.5), 0.5 - min(f, 0.5), max(f - 0.5, 0.0), 0.5 - max(f - 0.5, 0.0))
        begins = (1.0 - f, 0.0, 1.5 - f, max(0.5 - f, 0.0))  # of each piece, in its sample of the input
        for way in range(2):
            tau = s[(C_TAU if way == 0 else C_TAU_DOWN) + lane]
            for piece in range(4):
                h = cuts[piece] * dt
                e = math.exp(-h / max(tau, 1e-12))
                at = way * DOWN + piece * PIECE + lane
                s[P_AT + at] = (begins[piece] - 0.5) * dt
                s[P_E + at] = e
                s[P_E1 + at] = tau * (1.0 - e)
                s[P_E2 + at] = tau * (tau - (tau + h) * e)
                s[P_E3 + at] = 0.5 * tau * (1.0 - e * e)
                s[P_H + at] = h


@nb.njit(**inlined)
def _held_piece(w0, a, at, s):  # type: ignore[no-untyped-def]
    """Integrals of omega and omega^2 over a piece of constant input a, and omega at its end.

    `at`: which piece of the step, and which lane.
    """
    c = w0 - a
    part = c * s[P_E1 + at]
    i1 = a * s[P_H + at] + part
    return i1, a * (i1 + part) + c * c * s[P_E3 + at], a + c * s[P_E + at]


@nb.njit(**inlined)
def _piece(w0, a, slope, at, lane, s):  # type: ignore[no-untyped-def]
    """As `_held_piece` for input a + slope t, with the lag of speeding up or of slowing down by where a lies."""
    down, faster = DOWN + at, a >= w0
    # Both are read before one is chosen: a choice of where to read would not become vectors.
    tau, e, e1, e2, e3 = s[C_TAU + lane], s[P_E + at], s[P_E1 + at], s[P_E2 + at], s[P_E3 + at]
    tau_d, f, f1, f2, f3 = s[C_TAU_DOWN + lane], s[P_E + down], s[P_E1 + down], s[P_E2 + down], s[P_E3 + down]
    tau, e, e1 = (tau if faster else tau_d), (e if faster else f), (e1 if faster else f1)
    e2, e3, h = (e2 if faster else f2), (e3 if faster else f3), s[P_H + at]
    base = a - slope * tau
    c = w0 - base
    i1 = base * h + 0.5 * slope * h * h + c * e1
    i2 = base * base * h + base * slope * h * h + THIRD * slope * slope * h * h * h
    i2 += 2.0 * c * (base * e1 + slope * e2) + c * c * e3
    return i1, i2, base + slope * h + c * e


@nb.njit(**inlined)
def _add_rotor(m1, m2, n1, n2, dw, dv, x, y, spin, keep, lane, s):  # type: ignore[no-untyped-def]
    """Adds one rotor to `keep` times the moments of both half steps, and keeps the means of its speed.

    Means of omega and omega^2: m1, m2 over the first half step, n1, n2 over the second; dw, dv: mean accelerations.
    """
    gain, drag, dead, curve = s[T_GAIN + lane], s[T_DRAG + lane], 2.0 * s[C_W0 + lane], s[C_CURVE + lane]
    lift, next_lift = gain * (m2 - dead * m1 + curve), gain * (n2 - dead * n1 + curve)
    s[T_M1 + lane], s[T_M2 + lane], s[T_N1 + lane], s[T_N2 + lane] = m1, m2, n1, n2
    s[A_S2 + lane] = keep * s[A_S2 + lane] + lift
    s[A_X2 + lane] = keep * s[A_X2 + lane] + x * lift
    s[A_Y2 + lane] = keep * s[A_Y2 + lane] + y * lift
    s[A_Z2 + lane] = keep * s[A_Z2 + lane] + spin * drag * m2
    s[A_O1 + lane] = keep * s[A_O1 + lane] + spin * m1
    s[A_S1 + lane] = keep * s[A_S1 + lane] + m1
    s[A_DO + lane] = keep * s[A_DO + lane] + spin * dw
    s[A_S2 + HALF + lane] = keep * s[A_S2 + HALF + lane] + next_lift
    s[A_X2 + HALF + lane] = keep * s[A_X2 + HALF + lane] + x * next_lift
    s[A_Y2 + HALF + lane] = keep * s[A_Y2 + HALF + lane] + y * next_lift
    s[A_Z2 + HALF + lane] = keep * s[A_Z2 + HALF + lane] + spin * drag * n2
    s[A_O1 + HALF + lane] = keep * s[A_O1 + HALF + lane] + spin * n1
    s[A_S1 + HALF + lane] = keep * s[A_S1 + HALF + lane] + n1
    s[A_DO + HALF + lane] = keep * s[A_DO + HALF + lane] + spin * dv


@nb.njit(**jit)
def turn_held(x: float, y: float, spin: float, inv: float, keep: float, s: FloatArray) -> None:
    """Turns one rotor through a step of constant input, row T_A1 [rad/s]: two pieces, the half steps.

    Args:
        x: place of its hub [m].
        y: place of its hub [m].
        spin: its sense.
        inv: 2 / dt [1/s].
        keep: what becomes of the moments so far: 0 for the first rotor, else 1.
        s: rows; speed T_SPEED advanced, means T_M1 to T_N2 written, moments of both half steps added to.
    """
    lane_kernel()
    for lane in range(LANES):
        w0, a = s[T_SPEED + lane], s[T_A1 + lane]
        m1, m2, wm = _held_piece(w0, a, B + lane, s)
        n1, n2, w1 = _held_piece(wm, a, D + lane, s)
        s[T_SPEED + lane] = w1
        _add_rotor(inv * m1, inv * m2, inv * n1, inv * n2, inv * (wm - w0), inv * (w1 - wm), x, y, spin, keep, lane, s)


@nb.njit(**jit)
def turn(x: float, y: float, spin: float, inv: float, keep: float, s: FloatArray) -> None:
    """Turns one rotor through a step of any input (rows T_A0 to T_S1); else as `turn_held`."""
    lane_kernel()
    for lane in range(LANES):
        w0 = s[T_SPEED + lane]
        a0, s0, a1, s1 = s[T_A0 + lane], s[T_S0 + lane], s[T_A1 + lane], s[T_S1 + lane]
        k1, k2, w = _piece(w0, a0, s0, A + lane, lane, s)
        m1, m2, wm = _piece(w, a1, s1, B + lane, lane, s)
        l1, l2, w = _piece(wm, a0 + s0 * s[P_H + A + lane], s0, C + lane, lane, s)
        n1, n2, w1 = _piece(w, a1 + s1 * s[P_H + B + lane], s1, D + lane, lane, s)
        s[T_SPEED + lane] = w1
        _add_rotor(
            inv * (k1 + m1),
            inv * (k2 + m2),
            inv * (l1 + n1),
            inv * (l2 + n2),
            inv * (wm - w0),
            inv * (w1 - wm),
            x,
            y,
            spin,
            keep,
            lane,
            s,
        )


@nb.njit(**jit)
def next_input(r: int, held: bool, sloped: bool, inv: float, rot: FloatArray, s: FloatArray) -> None:
    """Writes value at the start and slope of both pieces of rotor r's input, before and after it switches or bends.

    Args:
        held: the input acts held, else linear between samples.
        sloped: a held input runs on within its samples.
        inv: 2 / dt [1/s].
        rot: rows of the rotors; the input moves on by one sample.
        s: rows; T_A0 to T_S1 written.
    """
    lane_kernel()
    for lane in range(LANES):
        s[T_A0 + lane], s[T_A1 + lane] = rot[r, R_PAST + lane], rot[r, R_NOW + lane]
    for lane in range(LANES):
        s[T_S0 + lane], s[T_S1 + lane] = 0.0, 0.0
    if sloped:
        for lane in range(LANES):
            s[T_S0 + lane], s[T_S1 + lane] = rot[r, R_PAST_SLOPE + lane], rot[r, R_NOW_SLOPE + lane]
        for lane in range(LANES):
            s[T_A0 + lane] += s[T_S0 + lane] * s[P_AT + A + lane]
            s[T_A1 + lane] += s[T_S1 + lane] * s[P_AT + B + lane]
        for lane in range(LANES):
            rot[r, R_PAST_SLOPE + lane], rot[r, R_NOW_SLOPE + lane] = (
                rot[r, R_NOW_SLOPE + lane],
                rot[r, R_NEXT_SLOPE + lane],
            )
    elif not held:
        for lane in range(LANES):
            s[T_S1 + lane] = 0.5 * inv * (rot[r, R_NEXT + lane] - s[T_A1 + lane])
        for lane in range(LANES):
            a0, a1 = s[T_A0 + lane], s[T_A1 + lane]
            s[T_S0 + lane] = 0.5 * inv * (a1 - a0)
            s[T_A0 + lane] = a0 + (a1 - a0) * (1.0 - s[C_PART + lane])
    for lane in range(LANES):
        rot[r, R_PAST + lane], rot[r, R_NOW + lane] = rot[r, R_NOW + lane], rot[r, R_NEXT + lane]


# --- Their input, and their moments over each half step


PLAIN_MOMENTS = 7
"""Moments that every model needs; the others belong to the air at each hub."""
(GROWTH,) = places("drag_torque_curve")


class Drive(NamedTuple):
    """Inputs of the rotors of a window.

    Attributes:
        u: shape (n, rotors), input [rad/s].
        slope: shape (n, rotors), of a held input within each sample [rad/s^2]; no rows: it stays the same.
        volts: shape (n,), logarithm of supply voltage over its reference.
        held: the input acts held, else linear between samples.
        geometry: shape (rotors, 4): x, y [m], spin, z from the mean plane of the hubs [m].
        dt: step [s].
    """

    u: FloatArray
    slope: FloatArray
    volts: FloatArray
    held: bool
    geometry: FloatArray
    dt: float


@nb.njit(**jit)
def rotors_start(drive: Drive, k: int, need: Needs, rot: FloatArray, s: FloatArray) -> None:
    """Sets all rotors to the input of row k, as if it had acted for ever."""
    for r in range(len(rot)):
        for lane in range(LANES):
            factor = math.exp(s[C_VOLT + lane] * drive.volts[k]) if need.voltage else 1.0
            # A reading that comes late shows what the rotors did before: their input lies ahead in the log.
            now = min(k + max(int(-s[C_SHIFT + lane]), 0), len(drive.u) - 1)
            for row in (R_PAST, R_NEXT):
                rot[r, row + lane] = factor * drive.u[max(now - 1, k), r]
            rot[r, R_NOW + lane] = factor * drive.u[now, r]
            rot[r, R_SPEED + lane] = factor * drive.u[k, r]
            for row in (R_PAST_SLOPE, R_NOW_SLOPE, R_NEXT_SLOPE):
                rot[r, row + lane] = 0.0


@nb.njit(**exact)
def input_constants(theta: FloatArray, s: FloatArray) -> None:
    """Derives what scales input and drag torque of all lanes from parameter vectors (LANES, size)."""
    for lane in range(LANES):
        s[C_VOLT + lane], s[C_GROWTH + lane] = theta[lane, ix.EXPONENT], theta[lane, GROWTH]


@nb.njit(**jit)
def _read_inputs(drive: Drive, k: int, need: Needs, rot: FloatArray, s: FloatArray) -> None:
    """Reads the input one sample ahead of t_k - j dt, for each lane's own j; outside the window its end values hold."""
    lane_kernel()
    last = float(len(drive.u) - 1)
    for lane in range(LANES):
        s[C_ROW + lane] = min(max(k + 1 - s[C_SHIFT + lane], 0.0), last)
    for r in range(len(rot)):
        for lane in range(LANES):
            rot[r, R_NEXT + lane] = drive.u[int(s[C_ROW + lane]), r]
        if len(drive.slope) > 0:
            for lane in range(LANES):
                rot[r, R_NEXT_SLOPE + lane] = drive.slope[int(s[C_ROW + lane]), r]
    if need.voltage:
        _scale_inputs(drive, rot, s)


@nb.njit(**jit)
def _scale_inputs(drive: Drive, rot: FloatArray, s: FloatArray) -> None:
    """Multiplies the input just read by (voltage / reference) to each lane's exponent."""
    for lane in range(LANES):
        s[T_VOLT + lane] = math.exp(s[C_VOLT + lane] * drive.volts[int(s[C_ROW + lane])])
    for r in range(len(rot)):
        for lane in range(LANES):
            rot[r, R_NEXT + lane] *= s[T_VOLT + lane]
        if len(drive.slope) > 0:
            for lane in range(LANES):
                rot[r, R_NEXT_SLOPE + lane] *= s[T_VOLT + lane]


@nb.njit(**jit)
def turn_rotor(
    plain: bool,
    r: int,
    held: bool,
    sloped: bool,
    geometry: FloatArray,
    dt: float,
    need: Needs,
    rot: FloatArray,
    s: FloatArray,
) -> None:
    """Advances rotor r over one step and adds it to the moments of both half steps.

    Args:
        plain: the input stays at row T_A1 [rad/s] over the whole step; else it is in the rows of the rotor.
        r: rotor; the first one begins the sums.
        held: the input acts held, else linear between samples.
        sloped: a held input runs on within its samples.
        geometry: see `Drive`.
        dt: step [s].
        rot: rows of the rotors, advanced in place.
        s: rows; moments written.
    """
    inv, keep = 2.0 / dt, 0.0 if r == 0 else 1.0
    x, y, spin, z = geometry[r, 0], geometry[r, 1], geometry[r, 2], geometry[r, 3]
    for i in range(3 * LANES):
        s[T_SPEED + i] = rot[r, R_SPEED + i]  # and both gains
    if plain:
        turn_held(x, y, spin, inv, keep, s)
    else:
        next_input(r, held, sloped, inv, rot, s)
        turn(x, y, spin, inv, keep, s)
    for lane in range(LANES):
        rot[r, R_SPEED + lane] = s[T_SPEED + lane]
    if need.hub:
        _add_hub(x, y, z, keep, s)
    if need.growth:
        _add_growth(spin, len(rot), s)


@nb.njit(**jit)
def _add_hub(x, y, z, keep, s):  # type: ignore[no-untyped-def]
    """Adds the rotor at (x, y, z) to the moments of speed that the air at each hub needs."""
    lane_kernel()
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    for lane in range(LANES):
        m, n = s[T_M1 + lane], s[T_N1 + lane]
        s[A_X1 + lane], s[A_X1 + HALF + lane] = keep * s[A_X1 + lane] + x * m, keep * s[A_X1 + HALF + lane] + x * n
        s[A_Y1 + lane], s[A_Y1 + HALF + lane] = keep * s[A_Y1 + lane] + y * m, keep * s[A_Y1 + HALF + lane] + y * n
        s[A_XX + lane], s[A_XX + HALF + lane] = keep * s[A_XX + lane] + xx * m, keep * s[A_XX + HALF + lane] + xx * n
        s[A_YY + lane], s[A_YY + HALF + lane] = keep * s[A_YY + lane] + yy * m, keep * s[A_YY + HALF + lane] + yy * n
        s[A_XY + lane], s[A_XY + HALF + lane] = keep * s[A_XY + lane] + xy * m, keep * s[A_XY + HALF + lane] + xy * n
        s[A_Z1 + lane], s[A_Z1 + HALF + lane] = keep * s[A_Z1 + lane] + z * m, keep * s[A_Z1 + HALF + lane] + z * n
        s[A_ZZ + lane], s[A_ZZ + HALF + lane] = keep * s[A_ZZ + lane] + zz * m, keep * s[A_ZZ + HALF + lane] + zz * n
        s[A_XZ + lane], s[A_XZ + HALF + lane] = keep * s[A_XZ + lane] + xz * m, keep * s[A_XZ + HALF + lane] + xz * n
        s[A_YZ + lane], s[A_YZ + HALF + lane] = keep * s[A_YZ + lane] + yz * m, keep * s[A_YZ + HALF + lane] + yz * n


@nb.njit(**jit)
def _add_growth(spin, count, s):  # type: ignore[no-untyped-def]
    """Adds to the rotor's drag torque what grows with the cube of its speed, from the means of speed and its square."""
    lane_kernel()
    for lane in range(LANES):
        gain, rotors = spin * s[T_DRAG + lane] * s[C_GROWTH + lane], float(count)
        m1, m2, n1, n2 = s[T_M1 + lane], s[T_M2 + lane], s[T_N1 + lane], s[T_N2 + lane]
        # The mean of a cube without its skewness, which a half step is too short to show.
        m3, n3 = m1 * (3.0 * m2 - 2.0 * m1 * m1), n1 * (3.0 * n2 - 2.0 * n1 * n1)
        s[A_Z2 + lane] += gain * (m3 * rotors * s[C_HOVER + lane] - m2)
        s[A_Z2 + HALF + lane] += gain * (n3 * rotors * s[C_HOVER + lane] - n2)


@nb.njit(**jit)
def rotors_step(drive: Drive, k: int, need: Needs, rot: FloatArray, s: FloatArray) -> None:
    """Advances all rotors over step k, from t_k to t_k+1, and sums their moments for both half steps.

    Args:
        rot: rows of the rotors, (rotors, ROTOR), advanced in place.
        s: rows; moments of both half steps written.
    """
    sloped = len(drive.slope) > 0
    plain = drive.held and not (need.delayed or sloped or need.voltage or need.uneven)
    if not plain:
        _read_inputs(drive, k, need, rot, s)
    for r in range(len(rot)):
        if plain:
            for lane in range(LANES):
                s[T_A1 + lane] = drive.u[k, r]
        turn_rotor(plain, r, drive.held, sloped, drive.geometry, drive.dt, need, rot, s)


@nb.njit(**jit)
def spread_moments(table: FloatArray, k: int, moments: int, s: FloatArray) -> None:
    """Writes the first so many of the shared moments of step k into all lanes."""
    lane_kernel()
    for row in range(moments):
        first, second, at = table[k, row], table[k, ALL_MOMENTS + row], A_S2 + row * LANES
        for lane in range(LANES):
            s[at + lane], s[at + HALF + lane] = first, second


@cached
def rotor_table(drive: Drive, need: Needs, theta: FloatArray, table: FloatArray) -> None:
    """Moments of every step of a window for lanes that share all that acts on rotors.

    Args:
        theta: the same parameter vector in every lane, (LANES, size).
        table: (n, 2 * ALL_MOMENTS), written: moments of the first, then of the second half step.
    """
    s = cache_aligned(N_ROWS * LANES)
    rotors = len(drive.geometry)
    rot = cache_aligned(rotors * ROTOR).reshape(rotors, ROTOR)
    rotor_constants(theta, drive.dt, rot, s)
    input_constants(theta, s)
    s[A_S2 : A_S2 + 2 * HALF] = 0.0
    for k in range(len(drive.u)):
        if k == 0:
            rotors_start(drive, k, need, rot, s)
        rotors_step(drive, k, need, rot, s)
        for row in range(ALL_MOMENTS):
            table[k, row] = s[A_S2 + row * LANES]
            table[k, ALL_MOMENTS + row] = s[A_S2 + HALF + row * LANES]
