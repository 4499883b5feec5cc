"""Rotor speeds of many parameter vectors at once: lag, delay, and the exact means of speed over each half step.

omega' = (u - omega) / tau.  Over each half step the means of omega and omega^2 are exact for first-order lag and pure
delay.  The input u, delayed by (j + f) dt, switches (held) or bends (linear) once within a step, f dt after its start;
each half step is therefore two pieces, one of which may have no length.  A held input may run on at a slope within its
samples, whose mean it is (`quadid.intersample`).

What one rotor needs is copied into the rows T_*, so that each loop works on one array: distances between rows are then
constants, and the compiler sees that rows do not overlap.
"""

from __future__ import annotations

import math

import numba as nb

from quadid.model import layout as ix
from quadid.model.layout import places
from quadid.types import FloatArray

# isort: off
from quadid.model.work_array import (
    A_DO, A_O1, A_S1, A_S2, A_X2, A_Y2, A_Z2, C_CURVE, C_PART, C_SHIFT, C_TAU, C_TAU_DOWN, C_W0, DOWN, HALF, P_AT, P_E,
    P_E1, P_E2, P_E3, P_H, PIECE, R_DRAG, R_GAIN, R_NEXT, R_NEXT_SLOPE, R_NOW, R_NOW_SLOPE, R_PAST, R_PAST_SLOPE,
    T_A0, T_A1, T_DRAG, T_GAIN, T_M1, T_M2, T_N1, T_N2, T_S0, T_S1, T_SPEED,
)  # fmt: skip

# isort: on
from quadid.model.simd import LANES, exact, inlined, jit, lane_kernel

THIRD = 1.0 / 3.0
A, B, C, D = 0, PIECE, 2 * PIECE, 3 * PIECE
"""Pieces of a step: its halves, each before and after the input switches."""
TAU, SLOWER = places("motor_lag")
(TELEMETRY,) = places("rotor_telemetry_delay")
DEAD_SPEED, OFFSET = places("thrust_curve")


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
        s[C_W0 + lane], s[C_CURVE + lane] = th[DEAD_SPEED], th[DEAD_SPEED] ** 2 + th[OFFSET] / th[ix.B]
        delay = (max(th[ix.DELAY], 0.0) - max(th[TELEMETRY], 0.0)) / dt
        f = delay - math.floor(delay)
        s[C_SHIFT + lane], s[C_PART + lane] = math.floor(delay), f
        s[C_TAU + lane], s[C_TAU_DOWN + lane] = max(th[TAU], 0.0), max(th[TAU] + th[SLOWER], 0.0)
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
            inv * (k1 + m1), inv * (k2 + m2), inv * (l1 + n1), inv * (l2 + n2), inv * (wm - w0), inv * (w1 - wm),
            x, y, spin, keep, lane, s,
        )  # fmt: skip


@nb.njit(**jit)
def next_input(r: int, held: bool, sloped: bool, inv: float, rot: FloatArray, s: FloatArray) -> None:
    """Writes value at the start and slope of both pieces of rotor r's input, before and after it switches or bends.

    Args:
        r: rotor.
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
