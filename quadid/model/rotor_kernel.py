"""Rotors of many parameter vectors at once: lag, delay, and their moments over each half step.

omega' = (u - omega) / tau.  Over each half step the means of omega and omega^2 are exact for first-order lag and pure
delay.  The input u, delayed by (j + f) dt, switches (held) or bends (linear) once within a step, f dt after its start;
each half step is therefore two pieces, one of which may have no length.  A held input may run on at a slope within its
samples, whose mean it is (`quadid.intersample`).
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from quadid.model import layout as ix

# isort: off
from quadid.model.rows import (
    A_DO, A_O1, A_S1, A_S2, A_X2, A_Y2, A_Z2, ALL_MOMENTS, C_PART, C_ROW, C_SHIFT, C_TAU, C_W0, HALF, N_ROWS, P_AT, P_E,
    P_E1, P_E2, P_E3, P_H, PIECE, R_GAIN, R_NEXT, R_NEXT_SLOPE, R_NOW, R_NOW_SLOPE, R_PAST, R_PAST_SLOPE, R_SPEED,
    ROTOR,
)  # fmt: skip

# isort: on
from quadid.model.simd import LANES, SOURCES, allocating, cache_aligned, cached, exact, inlined, jit, lane_kernel

FloatArray = NDArray[np.float64]

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
        for r in range(len(rot)):
            rot[r, R_GAIN + lane] = 1.0 - theta[lane, ix.LOSS + r]
        s[C_W0 + lane] = theta[lane, ix.DEAD_SPEED]
        tau = max(theta[lane, ix.TAU], 0.0)
        delay = max(theta[lane, ix.DELAY], 0.0) / dt
        f = delay - math.floor(delay)
        s[C_TAU + lane], s[C_SHIFT + lane], s[C_PART + lane] = tau, math.floor(delay), f
        cuts = (min(f, 0.5), 0.5 - min(f, 0.5), max(f - 0.5, 0.0), 0.5 - max(f - 0.5, 0.0))
        begins = (1.0 - f, 0.0, 1.5 - f, max(0.5 - f, 0.0))  # of each piece, in its sample of the input
        for piece in range(4):
            s[P_AT + piece * PIECE + lane] = (begins[piece] - 0.5) * dt
            h = cuts[piece] * dt
            e = math.exp(-h / max(tau, 1e-12))
            at = piece * PIECE + lane
            s[P_E + at] = e
            s[P_E1 + at] = tau * (1.0 - e)
            s[P_E2 + at] = tau * (tau - (tau + h) * e)
            s[P_E3 + at] = 0.5 * tau * (1.0 - e * e)
            s[P_H + at] = h


@nb.njit(**jit)
def rotors_start(u: FloatArray, k: int, rot: FloatArray) -> None:
    """Sets all rotors to the input of row k, as if it had acted for ever."""
    for r in range(len(rot)):
        for lane in range(LANES):
            for row in (R_SPEED, R_PAST, R_NOW, R_NEXT):
                rot[r, row + lane] = u[k, r]
            for row in (R_PAST_SLOPE, R_NOW_SLOPE, R_NEXT_SLOPE):
                rot[r, row + lane] = 0.0


@nb.njit(**inlined)
def _piece(w0, a, slope, tau, e, e1, e2, e3, h):  # type: ignore[no-untyped-def]
    """Integrals of omega and omega^2 over a piece of length h for input a + slope t, and omega at its end."""
    base = a - slope * tau
    c = w0 - base
    i1 = base * h + 0.5 * slope * h * h + c * e1
    i2 = base * base * h + base * slope * h * h + THIRD * slope * slope * h * h * h
    i2 += 2.0 * c * (base * e1 + slope * e2) + c * c * e3
    return i1, i2, base + slope * h + c * e


@nb.njit(**inlined)
def _held_piece(w0, a, e, e1, e3, h):  # type: ignore[no-untyped-def]
    """As `_piece` for a constant input a."""
    c = w0 - a
    part = c * e1
    i1 = a * h + part
    return i1, a * (i1 + part) + c * c * e3, a + c * e


@nb.njit(**inlined)
def _sloped_piece(w0, a, slope, tau, piece, lane, s):  # type: ignore[no-untyped-def]
    """As `_piece` for a sample of mean a and this slope; `piece`: which part of the step."""
    e, e1, e2 = s[P_E + piece + lane], s[P_E1 + piece + lane], s[P_E2 + piece + lane]
    e3, h, at = s[P_E3 + piece + lane], s[P_H + piece + lane], s[P_AT + piece + lane]
    return _piece(w0, a + slope * at, slope, tau, e, e1, e2, e3, h)


@nb.njit(**inlined)
def _add_rotor(m1, m2, w0, n1, n2, wm, w1, inv, x, y, spin, gain, keep, lane, s):  # type: ignore[no-untyped-def]
    """Adds one rotor to `keep` times the moments of both half steps.

    Integrals of omega and omega^2: m1, m2 over the first, n1, n2 over the second; omega: w0 at the start, wm, w1.
    """
    dead = s[C_W0 + lane]
    m1, m2, n1, n2 = inv * m1, inv * m2, inv * n1, inv * n2
    lift, next_lift = gain * (m2 + dead * (dead - 2.0 * m1)), gain * (n2 + dead * (dead - 2.0 * n1))
    s[A_S2 + lane] = keep * s[A_S2 + lane] + lift
    s[A_X2 + lane] = keep * s[A_X2 + lane] + x * lift
    s[A_Y2 + lane] = keep * s[A_Y2 + lane] + y * lift
    s[A_Z2 + lane] = keep * s[A_Z2 + lane] + spin * gain * m2
    s[A_O1 + lane] = keep * s[A_O1 + lane] + spin * m1
    s[A_S1 + lane] = keep * s[A_S1 + lane] + m1
    s[A_DO + lane] = keep * s[A_DO + lane] + spin * inv * (wm - w0)
    s[A_S2 + HALF + lane] = keep * s[A_S2 + HALF + lane] + next_lift
    s[A_X2 + HALF + lane] = keep * s[A_X2 + HALF + lane] + x * next_lift
    s[A_Y2 + HALF + lane] = keep * s[A_Y2 + HALF + lane] + y * next_lift
    s[A_Z2 + HALF + lane] = keep * s[A_Z2 + HALF + lane] + spin * gain * n2
    s[A_O1 + HALF + lane] = keep * s[A_O1 + HALF + lane] + spin * n1
    s[A_S1 + HALF + lane] = keep * s[A_S1 + HALF + lane] + n1
    s[A_DO + HALF + lane] = keep * s[A_DO + HALF + lane] + spin * inv * (w1 - wm)


@nb.njit(**jit)
def _turn_held(a, x, y, spin, r, inv, keep, rot, s):  # type: ignore[no-untyped-def]
    """Rotor r through one step of constant input a: two pieces, the half steps."""
    lane_kernel()
    for lane in range(LANES):
        gain, w0 = rot[r, R_GAIN + lane], rot[r, R_SPEED + lane]
        e, e1, e3, h = s[P_E + B + lane], s[P_E1 + B + lane], s[P_E3 + B + lane], s[P_H + B + lane]
        m1, m2, wm = _held_piece(w0, a, e, e1, e3, h)
        e, e1, e3, h = s[P_E + D + lane], s[P_E1 + D + lane], s[P_E3 + D + lane], s[P_H + D + lane]
        n1, n2, w1 = _held_piece(wm, a, e, e1, e3, h)
        rot[r, R_SPEED + lane] = w1
        _add_rotor(m1, m2, w0, n1, n2, wm, w1, inv, x, y, spin, gain, keep, lane, s)


@nb.njit(**jit)
def turn_delayed(x, y, spin, r, inv, keep, rot, s):  # type: ignore[no-untyped-def]
    """Rotor r through one step of held input that switches within the step."""
    lane_kernel()
    for lane in range(LANES):
        gain, w0 = rot[r, R_GAIN + lane], rot[r, R_SPEED + lane]
        a0, a1, a2 = rot[r, R_PAST + lane], rot[r, R_NOW + lane], rot[r, R_NEXT + lane]
        rot[r, R_PAST + lane], rot[r, R_NOW + lane] = a1, a2
        e, e1, e3, h = s[P_E + A + lane], s[P_E1 + A + lane], s[P_E3 + A + lane], s[P_H + A + lane]
        k1, k2, w = _held_piece(w0, a0, e, e1, e3, h)
        e, e1, e3, h = s[P_E + B + lane], s[P_E1 + B + lane], s[P_E3 + B + lane], s[P_H + B + lane]
        m1, m2, wm = _held_piece(w, a1, e, e1, e3, h)
        e, e1, e3, h = s[P_E + C + lane], s[P_E1 + C + lane], s[P_E3 + C + lane], s[P_H + C + lane]
        l1, l2, w = _held_piece(wm, a0, e, e1, e3, h)
        e, e1, e3, h = s[P_E + D + lane], s[P_E1 + D + lane], s[P_E3 + D + lane], s[P_H + D + lane]
        n1, n2, w1 = _held_piece(w, a1, e, e1, e3, h)
        rot[r, R_SPEED + lane] = w1
        _add_rotor(k1 + m1, k2 + m2, w0, l1 + n1, l2 + n2, wm, w1, inv, x, y, spin, gain, keep, lane, s)


@nb.njit(**jit)
def _turn_sloped(x, y, spin, r, inv, keep, rot, s):  # type: ignore[no-untyped-def]
    """Rotor r through one step of held input that runs on within its samples, and switches within the step."""
    lane_kernel()
    for lane in range(LANES):
        gain, w0, tau = rot[r, R_GAIN + lane], rot[r, R_SPEED + lane], s[C_TAU + lane]
        a0, a1 = rot[r, R_PAST + lane], rot[r, R_NOW + lane]
        s0, s1 = rot[r, R_PAST_SLOPE + lane], rot[r, R_NOW_SLOPE + lane]
        rot[r, R_PAST + lane], rot[r, R_NOW + lane] = a1, rot[r, R_NEXT + lane]
        rot[r, R_PAST_SLOPE + lane], rot[r, R_NOW_SLOPE + lane] = s1, rot[r, R_NEXT_SLOPE + lane]
        k1, k2, w = _sloped_piece(w0, a0, s0, tau, A, lane, s)
        m1, m2, wm = _sloped_piece(w, a1, s1, tau, B, lane, s)
        l1, l2, w = _sloped_piece(wm, a0, s0, tau, C, lane, s)
        n1, n2, w1 = _sloped_piece(w, a1, s1, tau, D, lane, s)
        rot[r, R_SPEED + lane] = w1
        _add_rotor(k1 + m1, k2 + m2, w0, l1 + n1, l2 + n2, wm, w1, inv, x, y, spin, gain, keep, lane, s)


@nb.njit(**jit)
def _turn_linear(x, y, spin, r, inv, keep, rot, s):  # type: ignore[no-untyped-def]
    """Rotor r through one step of piecewise linear input that bends within the step."""
    lane_kernel()
    for lane in range(LANES):
        gain, w0, tau = rot[r, R_GAIN + lane], rot[r, R_SPEED + lane], s[C_TAU + lane]
        a0, a1, a2 = rot[r, R_PAST + lane], rot[r, R_NOW + lane], rot[r, R_NEXT + lane]
        rot[r, R_PAST + lane], rot[r, R_NOW + lane] = a1, a2
        s0, s1 = 0.5 * inv * (a1 - a0), 0.5 * inv * (a2 - a1)
        a0 += (a1 - a0) * (1.0 - s[C_PART + lane])
        e, e1, e2, e3, h = (
            s[P_E + A + lane],
            s[P_E1 + A + lane],
            s[P_E2 + A + lane],
            s[P_E3 + A + lane],
            s[P_H + A + lane],
        )
        k1, k2, w = _piece(w0, a0, s0, tau, e, e1, e2, e3, h)
        a0 += s0 * h
        e, e1, e2, e3, h = (
            s[P_E + B + lane],
            s[P_E1 + B + lane],
            s[P_E2 + B + lane],
            s[P_E3 + B + lane],
            s[P_H + B + lane],
        )
        m1, m2, wm = _piece(w, a1, s1, tau, e, e1, e2, e3, h)
        a1 += s1 * h
        e, e1, e2, e3, h = (
            s[P_E + C + lane],
            s[P_E1 + C + lane],
            s[P_E2 + C + lane],
            s[P_E3 + C + lane],
            s[P_H + C + lane],
        )
        l1, l2, w = _piece(wm, a0, s0, tau, e, e1, e2, e3, h)
        e, e1, e2, e3, h = (
            s[P_E + D + lane],
            s[P_E1 + D + lane],
            s[P_E2 + D + lane],
            s[P_E3 + D + lane],
            s[P_H + D + lane],
        )
        n1, n2, w1 = _piece(w, a1, s1, tau, e, e1, e2, e3, h)
        rot[r, R_SPEED + lane] = w1
        _add_rotor(k1 + m1, k2 + m2, w0, l1 + n1, l2 + n2, wm, w1, inv, x, y, spin, gain, keep, lane, s)


@nb.njit(**jit)
def _read_inputs(u: FloatArray, slope: FloatArray, k: int, rot: FloatArray, s: FloatArray) -> None:
    """Reads the input one sample ahead of t_k - j dt, for each lane's own j; outside the window its end values hold."""
    lane_kernel()
    last = float(len(u) - 1)
    for lane in range(LANES):
        s[C_ROW + lane] = min(max(k + 1 - s[C_SHIFT + lane], 0.0), last)
    for r in range(len(rot)):
        for lane in range(LANES):
            rot[r, R_NEXT + lane] = u[int(s[C_ROW + lane]), r]
        if len(slope) > 0:
            for lane in range(LANES):
                rot[r, R_NEXT_SLOPE + lane] = slope[int(s[C_ROW + lane]), r]


@nb.njit(**jit)
def rotors_step(
    u: FloatArray, slope: FloatArray, k: int, held: bool, delayed: bool, geometry: FloatArray, dt: float,
    rot: FloatArray, s: FloatArray,
) -> None:  # fmt: skip
    """Advances all rotors over step k and sums their moments for both half steps.

    Args:
        u: shape (n, rotors), input [rad/s].
        slope: shape (n, rotors), of a held input within each sample [rad/s^2]; no rows: it stays the same.
        k: step, from t_k to t_k+1.
        held: the input acts held, else linear between samples.
        delayed: False when no lane has a delay.
        geometry: shape (rotors, 3): x, y [m], spin.
        dt: step [s].
        rot: rows of the rotors, (rotors, ROTOR), advanced in place.
        s: rows; moments of both half steps written.
    """
    sloped = len(slope) > 0
    plain = held and not delayed and not sloped
    if not plain:
        _read_inputs(u, slope, k, rot, s)
    inv = 2.0 / dt
    for r in range(len(geometry)):
        x, y, spin = geometry[r, 0], geometry[r, 1], geometry[r, 2]
        keep = 0.0 if r == 0 else 1.0
        if plain:
            _turn_held(u[k, r], x, y, spin, r, inv, keep, rot, s)
        elif sloped:
            _turn_sloped(x, y, spin, r, inv, keep, rot, s)
        elif held:
            turn_delayed(x, y, spin, r, inv, keep, rot, s)
        else:
            _turn_linear(x, y, spin, r, inv, keep, rot, s)


@nb.njit(**allocating)
def _table(
    u: FloatArray, slope: FloatArray, held: bool, delayed: bool, geometry: FloatArray, dt: float, theta: FloatArray,
    table: FloatArray,
) -> None:  # fmt: skip
    """Moments of every step of a window for lanes that share lag, delay, dead speed and losses.

    Arguments as in `rotors_step`, and: theta, the same parameter vector in every lane, (LANES, size); table,
    (n, 2 * ALL_MOMENTS), written: moments of the first, then of the second half step.
    """
    s = cache_aligned(N_ROWS * LANES)
    rot = cache_aligned(len(geometry) * ROTOR).reshape(len(geometry), ROTOR)
    rotor_constants(theta, dt, rot, s)
    rotors_start(u, 0, rot)
    s[A_S2 : A_S2 + 2 * HALF] = 0.0
    for k in range(len(u)):
        rotors_step(u, slope, k, held, delayed, geometry, dt, rot, s)
        for row in range(ALL_MOMENTS):
            table[k, row] = s[A_S2 + row * LANES]
            table[k, ALL_MOMENTS + row] = s[A_S2 + HALF + row * LANES]


@nb.njit(**jit)
def spread_moments(table: FloatArray, k: int, s: FloatArray) -> None:
    """Writes the shared moments of step k into all lanes."""
    lane_kernel()
    for lane in range(LANES):
        s[A_S2 + lane], s[A_S2 + HALF + lane] = table[k, 0], table[k, ALL_MOMENTS]
        s[A_X2 + lane], s[A_X2 + HALF + lane] = table[k, 1], table[k, ALL_MOMENTS + 1]
        s[A_Y2 + lane], s[A_Y2 + HALF + lane] = table[k, 2], table[k, ALL_MOMENTS + 2]
        s[A_Z2 + lane], s[A_Z2 + HALF + lane] = table[k, 3], table[k, ALL_MOMENTS + 3]
        s[A_O1 + lane], s[A_O1 + HALF + lane] = table[k, 4], table[k, ALL_MOMENTS + 4]
        s[A_S1 + lane], s[A_S1 + HALF + lane] = table[k, 5], table[k, ALL_MOMENTS + 5]
        s[A_DO + lane], s[A_DO + HALF + lane] = table[k, 6], table[k, ALL_MOMENTS + 6]


def _on_disk(sources: int) -> Any:
    @nb.njit(**cached)
    def rotor_table(*arguments):  # type: ignore[no-untyped-def]
        _ = sources
        _table(*arguments)

    return rotor_table


rotor_table = _on_disk(SOURCES)
