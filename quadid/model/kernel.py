"""The hot kernel: rolls out many parameter vectors ("lanes") over the segments of one window.

Lanes are the innermost, fixed-length axis of every array, so that the compiler turns each lane loop into SIMD
instructions: no trigonometry in the loops, no allocation, no branch that depends on a lane.  Work arrays are flat,
with row times LANES plus lane written out: with a constant stride the compiler can prove that rows do not overlap,
without it the loops stay scalar.

Each segment starts from its own initial state, `n_pre` steps before its first scored sample, and ends one step after
the last, because a logged acceleration is the mean over one sample centred on its time.  Rotor speeds do not depend on
the vehicle's state; they run through the whole window.

Integration: over each half step the mean of omega and omega^2 of every rotor is exact for first-order lag and pure
delay; forces and moments are then taken linear in time over the step with those half-step means, and attitude, rate
and velocity are integrated with the classical Runge-Kutta rule.  Velocity matters only to some effects, so the full
right-hand side is used only when `full` asks for it; both are the same equations (see `quadid.model.equations`).

The file is one whole on purpose: the stages share registers and names.
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from quadid.model import layout as ix

FloatArray = NDArray[np.float64]

LANES = 16
"""Parameter vectors rolled out together; two AVX-512 or four AVX2 registers of float64."""
GRAVITY = 9.80665
RING = 16
"""Steps of attitude history kept for `attitude_delay`."""

# Rows of the per-lane constants.
(
    C_B, C_D, C_IXX, C_IYY, C_IZZ, C_IXY, C_IXZ, C_IYZ, C_JXX, C_JYY, C_JZZ, C_JXY, C_JXZ, C_JYZ, C_JR, C_JSPIN,
    C_INVM, C_MASS, C_HOVER, C_KX, C_KY, C_KZ, C_CPAR, C_HX, C_HY, C_LP, C_MQ, C_WN, C_WE, C_CGX, C_CGY, C_W0,
    C_RX, C_RY, C_RZ, C_SIG, C_EC, C_ES, C_KAP, C_ECH, C_ESH, C_AHRS, C_GROUND,
    C_SAG, C_DT_TIME, C_DT_FRAC, C_MT_TIME, C_MT_FRAC,
    C_TAU, C_SHIFT, C_PART, C_E, C_E1, C_E2, C_E3, C_H,
) = range(56)  # fmt: skip
C_GAIN = C_E + 5 * 4
MAX_ROTORS = 16
N_CONST = C_GAIN + MAX_ROTORS
# Rows of the rotor aggregates of one half step.
A_S2, A_X2, A_Y2, A_Z2, A_S1, A_O1, A_DO, A_G, A_M = range(9)
N_AGG = 9
N_STATE = 13

_jit: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}


@nb.njit(**_jit)
def lane_constants(theta: FloatArray, mass: float, rotors: int, dt: float, reach: float, out: FloatArray) -> None:
    """Derives the per-lane constants from parameter vectors.

    Args:
        theta: shape (size * LANES,), see `quadid.model.layout`.
        mass: [kg].
        rotors: number of rotors.
        dt: step [s].
        reach: half the smallest distance between rotors [m], scales ground effect.
        out: shape (N_CONST * LANES,), written.
    """
    for lane in range(LANES):
        jxx, jyy, jzz = theta[ix.JXX * LANES + lane], theta[ix.JYY * LANES + lane], theta[ix.JZZ * LANES + lane]
        jxy, jxz, jyz = -theta[ix.JXY * LANES + lane], -theta[ix.JXZ * LANES + lane], -theta[ix.JYZ * LANES + lane]
        det = jxx * (jyy * jzz - jyz * jyz) - jxy * (jxy * jzz - jyz * jxz) + jxz * (jxy * jyz - jyy * jxz)
        out[C_IXX * LANES + lane] = (jyy * jzz - jyz * jyz) / det
        out[C_IYY * LANES + lane] = (jxx * jzz - jxz * jxz) / det
        out[C_IZZ * LANES + lane] = (jxx * jyy - jxy * jxy) / det
        out[C_IXY * LANES + lane] = (jxz * jyz - jxy * jzz) / det
        out[C_IXZ * LANES + lane] = (jxy * jyz - jxz * jyy) / det
        out[C_IYZ * LANES + lane] = (jxy * jxz - jxx * jyz) / det
        out[C_JXX * LANES + lane], out[C_JYY * LANES + lane], out[C_JZZ * LANES + lane] = jxx, jyy, jzz
        out[C_JXY * LANES + lane], out[C_JXZ * LANES + lane], out[C_JYZ * LANES + lane] = jxy, jxz, jyz
        out[C_B * LANES + lane], out[C_D * LANES + lane], out[C_JR * LANES + lane], out[C_JSPIN * LANES + lane] = (
            theta[ix.B * LANES + lane], theta[ix.D * LANES + lane], theta[ix.JR * LANES + lane], theta[ix.JSPIN * LANES + lane],
        )  # fmt: skip
        out[C_INVM * LANES + lane], out[C_MASS * LANES + lane] = 1.0 / mass, mass
        out[C_HOVER * LANES + lane] = 1.0 / (rotors * math.sqrt(mass * GRAVITY / (abs(theta[ix.B * LANES + lane]) * rotors)))
        out[C_KX * LANES + lane], out[C_KY * LANES + lane], out[C_KZ * LANES + lane], out[C_CPAR * LANES + lane] = (
            theta[ix.KX * LANES + lane], theta[ix.KY * LANES + lane], theta[ix.KZ * LANES + lane], theta[ix.CPAR * LANES + lane],
        )  # fmt: skip
        out[C_HX * LANES + lane], out[C_HY * LANES + lane], out[C_LP * LANES + lane], out[C_MQ * LANES + lane] = theta[ix.HX * LANES + lane], theta[ix.HY * LANES + lane], theta[ix.LP * LANES + lane], theta[ix.MQ * LANES + lane]
        out[C_WN * LANES + lane], out[C_WE * LANES + lane] = theta[ix.WN * LANES + lane], theta[ix.WE * LANES + lane]
        out[C_CGX * LANES + lane], out[C_CGY * LANES + lane], out[C_W0 * LANES + lane] = theta[ix.CGX * LANES + lane], theta[ix.CGY * LANES + lane], theta[ix.DEAD_SPEED * LANES + lane]
        out[C_RX * LANES + lane], out[C_RY * LANES + lane], out[C_RZ * LANES + lane] = (
            theta[ix.LAX * LANES + lane] - theta[ix.CGX * LANES + lane], theta[ix.LAY * LANES + lane] - theta[ix.CGY * LANES + lane], theta[ix.LAZ * LANES + lane],
        )  # fmt: skip
        period = max(theta[ix.IMU_PERIOD * LANES + lane], 1e-7)
        sigma = 2.0 * math.pi / period / math.sqrt(2.0)
        out[C_SIG * LANES + lane], out[C_KAP * LANES + lane] = sigma, 1.0 / sigma
        out[C_EC * LANES + lane] = math.exp(-sigma * dt) * math.cos(sigma * dt)
        out[C_ES * LANES + lane] = math.exp(-sigma * dt) * math.sin(sigma * dt)
        out[C_ECH * LANES + lane] = math.exp(-0.5 * sigma * dt) * math.cos(0.5 * sigma * dt)
        out[C_ESH * LANES + lane] = math.exp(-0.5 * sigma * dt) * math.sin(0.5 * sigma * dt)
        out[C_AHRS * LANES + lane] = theta[ix.AHRS_K * LANES + lane]
        out[C_GROUND * LANES + lane] = (theta[ix.GROUND * LANES + lane] * reach / 4.0) * abs(theta[ix.GROUND * LANES + lane] * reach / 4.0)
        out[C_SAG * LANES + lane] = theta[ix.SAG * LANES + lane]
        out[C_DT_TIME * LANES + lane], out[C_DT_FRAC * LANES + lane] = theta[ix.DROP_TIME * LANES + lane], theta[ix.DROP_FRACTION * LANES + lane]
        out[C_MT_TIME * LANES + lane], out[C_MT_FRAC * LANES + lane] = theta[ix.MASS_TIME * LANES + lane], theta[ix.MASS_FRACTION * LANES + lane]
        # The delayed input switches (or bends) once within a step, at fraction f; four pieces, two a half step.
        tau = max(theta[ix.TAU * LANES + lane], 1e-9)
        delay = max(theta[ix.DELAY * LANES + lane], 0.0) / dt
        f = delay - math.floor(delay)
        out[C_TAU * LANES + lane], out[C_SHIFT * LANES + lane], out[C_PART * LANES + lane] = tau, math.floor(delay), f
        for r in range(rotors):
            out[(C_GAIN + r) * LANES + lane] = 1.0 - theta[(ix.LOSS + r) * LANES + lane]
        cuts = (min(f, 0.5), 0.5 - min(f, 0.5), max(f - 0.5, 0.0), 0.5 - max(f - 0.5, 0.0))
        for piece in range(4):
            h = cuts[piece] * dt
            e = math.exp(-h / tau)
            row = C_E + 5 * piece
            out[row * LANES + lane] = e
            out[(row + 1) * LANES + lane] = tau * (1.0 - e)
            out[(row + 2) * LANES + lane] = tau * (tau - (tau + h) * e)
            out[(row + 3) * LANES + lane] = 0.5 * tau * (1.0 - e * e)
            out[(row + 4) * LANES + lane] = h


@nb.njit(inline="always")
def _piece(w0, a, s, tau, e, e1, e2, e3, h):  # type: ignore[no-untyped-def]
    """Integrals of omega and omega^2 over one piece of length h with input a + s t, and omega at its end."""
    base = a - s * tau
    c = w0 - base
    i1 = base * h + 0.5 * s * h * h + c * e1
    i2 = base * base * h + base * s * h * h + s * s * h * h * h / 3.0 + 2.0 * c * (base * e1 + s * e2) + c * c * e3
    return i1, i2, base + s * h + c * e


@nb.njit(**_jit)
def rotors_step(
    u: FloatArray, k: int, held: bool, con: FloatArray, geometry: FloatArray, dt: float, w: FloatArray,
    agg: FloatArray, inputs: FloatArray, per_lane: bool,
) -> None:  # fmt: skip
    """Advances all rotors over step k and sums their moments for both half steps.

    The input, delayed by (j + f) dt, switches (held) or bends (linear) once, at f dt after t_k: before that it is
    a0 + s0 t, after it a1 + s1 t.  Each half step is therefore two pieces, one of which may have no length.

    Args:
        u: shape (n, rotors), input [rad/s].
        k: step, from t_k to t_k+1.
        held: the input acts held, else linear between samples.
        con: lane constants.
        geometry: shape (rotors, 3): x, y [m], spin.
        dt: step [s].
        w: rotor speeds at the start, (rotors * LANES,), advanced in place.
        agg: shape (2 * N_AGG * LANES,), rows A_S2 .. A_DO written: means over each half step.
        inputs: work space (6 * LANES,).
        per_lane: False when all lanes share lag, delay, dead speed and losses: lane 0 is computed and spread.
    """
    n, rotors = u.shape
    inv = 2.0 / dt
    for half in range(2):
        for i in range(7 * LANES):
            agg[half * N_AGG * LANES + i] = 0.0
    for r in range(rotors):
        x, y, spin = geometry[r, 0], geometry[r, 1], geometry[r, 2]
        for lane in range(LANES if per_lane else 1):
            j, f = int(con[C_SHIFT * LANES + lane]), con[C_PART * LANES + lane]
            i0, im = min(max(k - j, 0), n - 1), min(max(k - j - 1, 0), n - 1)
            if held:
                inputs[lane], inputs[LANES + lane] = u[im, r], 0.0
                inputs[2 * LANES + lane], inputs[3 * LANES + lane] = u[i0, r], 0.0
            else:
                ip = min(max(k - j + 1, 0), n - 1)
                slope = (u[i0, r] - u[im, r]) / dt
                inputs[lane], inputs[LANES + lane] = u[im, r] + slope * (1.0 - f) * dt, slope
                inputs[2 * LANES + lane], inputs[3 * LANES + lane] = u[i0, r], (u[ip, r] - u[i0, r]) / dt
        for lane in range(LANES):
            inputs[4 * LANES + lane] = con[(C_GAIN + r) * LANES + lane]
            inputs[5 * LANES + lane] = w[r * LANES + lane]
        if per_lane:
            for lane in range(LANES):
                _one_rotor(lane, inv, x, y, spin, con, inputs, agg)
            for lane in range(LANES):
                w[r * LANES + lane] = inputs[5 * LANES + lane]
        else:
            _one_rotor(0, inv, x, y, spin, con, inputs, agg)
            for lane in range(LANES):
                w[r * LANES + lane] = inputs[5 * LANES]
    if not per_lane:
        for half in range(2):
            for row in range(7):
                base = (half * N_AGG + row) * LANES
                for lane in range(1, LANES):
                    agg[base + lane] = agg[base]


@nb.njit(inline="always")
def _one_rotor(lane, inv, x, y, spin, con, inputs, agg):  # type: ignore[no-untyped-def]
    """Adds one rotor of one lane to the aggregates of both half steps.

    Few arrays, because the compiler checks every pair for overlap and gives up beyond a handful of pairs.
    """
    # All loads first: a load after a store to the same array stops the vectoriser.
    g0 = agg[A_S2 * LANES + lane]
    g1 = agg[A_X2 * LANES + lane]
    g2 = agg[A_Y2 * LANES + lane]
    g3 = agg[A_Z2 * LANES + lane]
    g4 = agg[A_S1 * LANES + lane]
    g5 = agg[A_O1 * LANES + lane]
    g6 = agg[A_DO * LANES + lane]
    g7 = agg[(N_AGG + A_S2) * LANES + lane]
    g8 = agg[(N_AGG + A_X2) * LANES + lane]
    g9 = agg[(N_AGG + A_Y2) * LANES + lane]
    g10 = agg[(N_AGG + A_Z2) * LANES + lane]
    g11 = agg[(N_AGG + A_S1) * LANES + lane]
    g12 = agg[(N_AGG + A_O1) * LANES + lane]
    g13 = agg[(N_AGG + A_DO) * LANES + lane]
    a0, s0 = inputs[lane], inputs[LANES + lane]
    a1, s1 = inputs[2 * LANES + lane], inputs[3 * LANES + lane]
    tau, dead, gain = con[C_TAU * LANES + lane], con[C_W0 * LANES + lane], inputs[4 * LANES + lane]
    h0, h1 = con[C_H * LANES + lane], con[(C_H + 5) * LANES + lane]
    ws = inputs[5 * LANES + lane]
    p1, p2, we = _piece(
        ws, a0, s0, tau, con[C_E * LANES + lane], con[C_E1 * LANES + lane], con[C_E2 * LANES + lane],
        con[C_E3 * LANES + lane], h0,
    )  # fmt: skip
    o1, o2, wm = _piece(
        we, a1, s1, tau, con[(C_E + 5) * LANES + lane], con[(C_E1 + 5) * LANES + lane],
        con[(C_E2 + 5) * LANES + lane], con[(C_E3 + 5) * LANES + lane], h1,
    )  # fmt: skip
    m1a, m2a = (p1 + o1) * inv, (p2 + o2) * inv
    p1, p2, we = _piece(
        wm, a0 + s0 * h0, s0, tau, con[(C_E + 10) * LANES + lane], con[(C_E1 + 10) * LANES + lane],
        con[(C_E2 + 10) * LANES + lane], con[(C_E3 + 10) * LANES + lane], con[(C_H + 10) * LANES + lane],
    )  # fmt: skip
    o1, o2, wn = _piece(
        we, a1 + s1 * h1, s1, tau, con[(C_E + 15) * LANES + lane], con[(C_E1 + 15) * LANES + lane],
        con[(C_E2 + 15) * LANES + lane], con[(C_E3 + 15) * LANES + lane], con[(C_H + 15) * LANES + lane],
    )  # fmt: skip
    m1b, m2b = (p1 + o1) * inv, (p2 + o2) * inv
    lift_a = gain * (m2a - 2.0 * dead * m1a + dead * dead)
    lift_b = gain * (m2b - 2.0 * dead * m1b + dead * dead)
    agg[A_S2 * LANES + lane] = g0 + lift_a
    agg[A_X2 * LANES + lane] = g1 + x * lift_a
    agg[A_Y2 * LANES + lane] = g2 + y * lift_a
    agg[A_Z2 * LANES + lane] = g3 + spin * gain * m2a
    agg[A_S1 * LANES + lane] = g4 + m1a
    agg[A_O1 * LANES + lane] = g5 + spin * m1a
    agg[A_DO * LANES + lane] = g6 + spin * (wm - ws) * inv
    agg[(N_AGG + A_S2) * LANES + lane] = g7 + lift_b
    agg[(N_AGG + A_X2) * LANES + lane] = g8 + x * lift_b
    agg[(N_AGG + A_Y2) * LANES + lane] = g9 + y * lift_b
    agg[(N_AGG + A_Z2) * LANES + lane] = g10 + spin * gain * m2b
    agg[(N_AGG + A_S1) * LANES + lane] = g11 + m1b
    agg[(N_AGG + A_O1) * LANES + lane] = g12 + spin * m1b
    agg[(N_AGG + A_DO) * LANES + lane] = g13 + spin * (wn - wm) * inv
    inputs[5 * LANES + lane] = wn


@nb.njit(**_jit)
def flight_factors(t: float, span0: float, span1: float, dt: float, con: FloatArray, agg: FloatArray) -> None:
    """Writes thrust and inverse-mass factors of both half steps: battery sag, thrust drop, mass change."""
    inv = 1.0 / max(span1 - span0, 1e-9)
    half = 0.5 * dt
    for h in range(2):
        ts = t + h * half
        mid = (ts + 0.5 * half - span0) * inv
        for lane in range(LANES):
            dropped = min(max((ts + half - con[C_DT_TIME * LANES + lane]) / half, 0.0), 1.0)
            loaded = min(max((ts + half - con[C_MT_TIME * LANES + lane]) / half, 0.0), 1.0)
            agg[(h * N_AGG + A_G) * LANES + lane] = (1.0 - con[C_SAG * LANES + lane] * mid) * (1.0 - con[C_DT_FRAC * LANES + lane] * dropped)
            agg[(h * N_AGG + A_M) * LANES + lane] = 1.0 / (1.0 + con[C_MT_FRAC * LANES + lane] * loaded)


@nb.njit(inline="always")
def _rotation_rate(qw, qx, qy, qz, p, q, r):  # type: ignore[no-untyped-def]
    """Eq. 1 as a quaternion: d/dt q = q (0, p, q, r) / 2."""
    return (
        0.5 * (-qx * p - qy * q - qz * r),
        0.5 * (qw * p + qy * r - qz * q),
        0.5 * (qw * q + qz * p - qx * r),
        0.5 * (qw * r + qx * q - qy * p),
    )


@nb.njit(**_jit)
def step_core(dt: float, con: FloatArray, agg: FloatArray, x: FloatArray, acc: FloatArray) -> None:
    """One step of attitude and rate without velocity: Eqs. 1 and 9 with a diagonal inertia.

    Args:
        dt: step [s].
        con: lane constants.
        agg: rotor aggregates of this step, (2 * N_AGG * LANES,).
        x: state (N_STATE * LANES,): quaternion, rates; advanced in place.
        acc: shape (6 * LANES,): mean specific force of both half steps [m/s^2], written.
    """
    for lane in range(LANES):
        b, d = con[C_B * LANES + lane], con[C_D * LANES + lane]
        ixx, iyy, izz = con[C_IXX * LANES + lane], con[C_IYY * LANES + lane], con[C_IZZ * LANES + lane]
        jxx, jyy, jzz, jr = con[C_JXX * LANES + lane], con[C_JYY * LANES + lane], con[C_JZZ * LANES + lane], con[C_JR * LANES + lane]
        tx1, tx2 = -b * agg[A_Y2 * LANES + lane], -b * agg[(1 * N_AGG + A_Y2) * LANES + lane]
        ty1, ty2 = b * agg[A_X2 * LANES + lane], b * agg[(1 * N_AGG + A_X2) * LANES + lane]
        tz1, tz2 = d * agg[A_Z2 * LANES + lane], d * agg[(1 * N_AGG + A_Z2) * LANES + lane]
        o1, o2 = jr * agg[A_O1 * LANES + lane], jr * agg[(1 * N_AGG + A_O1) * LANES + lane]
        acc[0 * LANES + lane], acc[1 * LANES + lane], acc[2 * LANES + lane] = 0.0, 0.0, -b * agg[A_S2 * LANES + lane] * con[C_INVM * LANES + lane]
        acc[(1 * 3 + 0) * LANES + lane], acc[(1 * 3 + 1) * LANES + lane], acc[(1 * 3 + 2) * LANES + lane] = 0.0, 0.0, -b * agg[(1 * N_AGG + A_S2) * LANES + lane] * con[C_INVM * LANES + lane]
        qw, qx, qy, qz = x[0 * LANES + lane], x[1 * LANES + lane], x[2 * LANES + lane], x[3 * LANES + lane]
        p, q, r = x[4 * LANES + lane], x[5 * LANES + lane], x[6 * LANES + lane]
        cx, cy, cz = (jyy - jzz) * ixx, (jzz - jxx) * iyy, (jxx - jyy) * izz
        # stage 1
        tx, ty, tz, o = 1.5 * tx1 - 0.5 * tx2, 1.5 * ty1 - 0.5 * ty2, 1.5 * tz1 - 0.5 * tz2, 1.5 * o1 - 0.5 * o2
        a1x, a1y, a1z = cx * q * r + (tx + o * q) * ixx, cy * p * r + (ty - o * p) * iyy, cz * p * q + tz * izz
        k1w, k1x, k1y, k1z = _rotation_rate(qw, qx, qy, qz, p, q, r)
        # stage 2
        h = 0.5 * dt
        tx, ty, tz, o = 0.5 * (tx1 + tx2), 0.5 * (ty1 + ty2), 0.5 * (tz1 + tz2), 0.5 * (o1 + o2)
        p2, q2, r2 = p + h * a1x, q + h * a1y, r + h * a1z
        a2x, a2y, a2z = cx * q2 * r2 + (tx + o * q2) * ixx, cy * p2 * r2 + (ty - o * p2) * iyy, cz * p2 * q2 + tz * izz
        k2w, k2x, k2y, k2z = _rotation_rate(qw + h * k1w, qx + h * k1x, qy + h * k1y, qz + h * k1z, p2, q2, r2)
        # stage 3
        p3, q3, r3 = p + h * a2x, q + h * a2y, r + h * a2z
        a3x, a3y, a3z = cx * q3 * r3 + (tx + o * q3) * ixx, cy * p3 * r3 + (ty - o * p3) * iyy, cz * p3 * q3 + tz * izz
        k3w, k3x, k3y, k3z = _rotation_rate(qw + h * k2w, qx + h * k2x, qy + h * k2y, qz + h * k2z, p3, q3, r3)
        # stage 4
        tx, ty, tz, o = 1.5 * tx2 - 0.5 * tx1, 1.5 * ty2 - 0.5 * ty1, 1.5 * tz2 - 0.5 * tz1, 1.5 * o2 - 0.5 * o1
        p4, q4, r4 = p + dt * a3x, q + dt * a3y, r + dt * a3z
        a4x, a4y, a4z = cx * q4 * r4 + (tx + o * q4) * ixx, cy * p4 * r4 + (ty - o * p4) * iyy, cz * p4 * q4 + tz * izz
        k4w, k4x, k4y, k4z = _rotation_rate(qw + dt * k3w, qx + dt * k3x, qy + dt * k3y, qz + dt * k3z, p4, q4, r4)
        s = dt / 6.0
        qw += s * (k1w + 2.0 * (k2w + k3w) + k4w)
        qx += s * (k1x + 2.0 * (k2x + k3x) + k4x)
        qy += s * (k1y + 2.0 * (k2y + k3y) + k4y)
        qz += s * (k1z + 2.0 * (k2z + k3z) + k4z)
        scale = 1.5 - 0.5 * (qw * qw + qx * qx + qy * qy + qz * qz)  # one Newton step to unit length
        x[0 * LANES + lane], x[1 * LANES + lane], x[2 * LANES + lane], x[3 * LANES + lane] = qw * scale, qx * scale, qy * scale, qz * scale
        x[4 * LANES + lane] = p + s * (a1x + 2.0 * (a2x + a3x) + a4x)
        x[5 * LANES + lane] = q + s * (a1y + 2.0 * (a2y + a3y) + a4y)
        x[6 * LANES + lane] = r + s * (a1z + 2.0 * (a2z + a3z) + a4z)


@nb.njit(inline="always")
def _body(qw, qx, qy, qz, p, q, r, vn, ve, vd, s2, x2, y2, z2, s1, o1, do, g, im, con, lane, height_gain):  # type: ignore[no-untyped-def]
    """Right-hand side with every effect: angular acceleration, specific force at the CG, acceleration in NED."""
    # Velocity relative to the air, in body axes.
    rn, re, rd = vn - con[C_WN * LANES + lane], ve - con[C_WE * LANES + lane], vd
    r00, r01, r02 = 1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qx * qy - qw * qz), 2.0 * (qx * qz + qw * qy)
    r10, r11, r12 = 2.0 * (qx * qy + qw * qz), 1.0 - 2.0 * (qx * qx + qz * qz), 2.0 * (qy * qz - qw * qx)
    r20, r21, r22 = 2.0 * (qx * qz - qw * qy), 2.0 * (qy * qz + qw * qx), 1.0 - 2.0 * (qx * qx + qy * qy)
    u = r00 * rn + r10 * re + r20 * rd
    v = r01 * rn + r11 * re + r21 * rd
    w = r02 * rn + r12 * re + r22 * rd
    share = s1 * con[C_HOVER * LANES + lane]
    speed = con[C_CPAR * LANES + lane] * math.sqrt(u * u + v * v + w * w)
    b, m = con[C_B * LANES + lane] * g * height_gain, con[C_MASS * LANES + lane]
    # Specific force of the unloaded mass; im scales all of it when mass is taken up.
    thrust = b * s2 * con[C_INVM * LANES + lane] + con[C_KZ * LANES + lane] * w * share
    hx, hy = -con[C_KX * LANES + lane] * u * share, -con[C_KY * LANES + lane] * v * share
    sx, sy, sz = (hx - speed * u) * im, (hy - speed * v) * im, (-thrust - speed * w) * im
    jr = con[C_JR * LANES + lane] * o1
    tx = -b * (y2 - con[C_CGY * LANES + lane] * s2) + m * con[C_HY * LANES + lane] * hy + jr * q
    ty = b * (x2 - con[C_CGX * LANES + lane] * s2) - m * con[C_HX * LANES + lane] * hx - jr * p
    tz = con[C_D * LANES + lane] * g * z2 + con[C_JSPIN * LANES + lane] * do
    jxx, jyy, jzz = con[C_JXX * LANES + lane], con[C_JYY * LANES + lane], con[C_JZZ * LANES + lane]
    jxy, jxz, jyz = con[C_JXY * LANES + lane], con[C_JXZ * LANES + lane], con[C_JYZ * LANES + lane]
    lx, ly, lz = jxx * p + jxy * q + jxz * r, jxy * p + jyy * q + jyz * r, jxz * p + jyz * q + jzz * r
    tx -= q * lz - r * ly
    ty -= r * lx - p * lz
    tz -= p * ly - q * lx
    ap = con[C_IXX * LANES + lane] * tx + con[C_IXY * LANES + lane] * ty + con[C_IXZ * LANES + lane] * tz - con[C_LP * LANES + lane] * p
    aq = con[C_IXY * LANES + lane] * tx + con[C_IYY * LANES + lane] * ty + con[C_IYZ * LANES + lane] * tz - con[C_MQ * LANES + lane] * q
    ar = con[C_IXZ * LANES + lane] * tx + con[C_IYZ * LANES + lane] * ty + con[C_IZZ * LANES + lane] * tz
    an = r00 * sx + r01 * sy + r02 * sz
    ae = r10 * sx + r11 * sy + r12 * sz
    ad = r20 * sx + r21 * sy + r22 * sz + GRAVITY
    # Specific force where the IMU sits: rigid-body acceleration of a point at (rx, ry, rz) from the CG.
    rx, ry, rz = con[C_RX * LANES + lane], con[C_RY * LANES + lane], con[C_RZ * LANES + lane]
    dot = p * rx + q * ry + r * rz
    sq = p * p + q * q + r * r
    fx = sx + aq * rz - ar * ry + p * dot - rx * sq
    fy = sy + ar * rx - ap * rz + q * dot - ry * sq
    fz = sz + ap * ry - aq * rx + r * dot - rz * sq
    return ap, aq, ar, an, ae, ad, fx, fy, fz


@nb.njit(**_jit)
def step_full(dt: float, con: FloatArray, agg: FloatArray, x: FloatArray, acc: FloatArray) -> None:
    """One step of attitude, rate, velocity and position with every effect; arguments as `step_core`."""
    h = 0.5 * dt
    for lane in range(LANES):
        s2a, s2b = agg[A_S2 * LANES + lane], agg[(1 * N_AGG + A_S2) * LANES + lane]
        x2a, x2b = agg[A_X2 * LANES + lane], agg[(1 * N_AGG + A_X2) * LANES + lane]
        y2a, y2b = agg[A_Y2 * LANES + lane], agg[(1 * N_AGG + A_Y2) * LANES + lane]
        z2a, z2b = agg[A_Z2 * LANES + lane], agg[(1 * N_AGG + A_Z2) * LANES + lane]
        s1a, s1b = agg[A_S1 * LANES + lane], agg[(1 * N_AGG + A_S1) * LANES + lane]
        o1a, o1b = agg[A_O1 * LANES + lane], agg[(1 * N_AGG + A_O1) * LANES + lane]
        doa, dob = agg[A_DO * LANES + lane], agg[(1 * N_AGG + A_DO) * LANES + lane]
        ga, gb = agg[A_G * LANES + lane], agg[(1 * N_AGG + A_G) * LANES + lane]
        ma, mb = agg[A_M * LANES + lane], agg[(1 * N_AGG + A_M) * LANES + lane]
        qw, qx, qy, qz = x[0 * LANES + lane], x[1 * LANES + lane], x[2 * LANES + lane], x[3 * LANES + lane]
        p, q, r = x[4 * LANES + lane], x[5 * LANES + lane], x[6 * LANES + lane]
        vn, ve, vd = x[7 * LANES + lane], x[8 * LANES + lane], x[9 * LANES + lane]
        height = max(-x[12 * LANES + lane], 0.3)
        lift = 1.0 + con[C_GROUND * LANES + lane] / (height * height)
        # stage 1
        a1x, a1y, a1z, n1, e1, d1, f1x, f1y, f1z = _body(
            qw, qx, qy, qz, p, q, r, vn, ve, vd, 1.5 * s2a - 0.5 * s2b, 1.5 * x2a - 0.5 * x2b, 1.5 * y2a - 0.5 * y2b,
            1.5 * z2a - 0.5 * z2b, 1.5 * s1a - 0.5 * s1b, 1.5 * o1a - 0.5 * o1b, 1.5 * doa - 0.5 * dob, ga, ma,
            con, lane, lift,
        )  # fmt: skip
        k1w, k1x, k1y, k1z = _rotation_rate(qw, qx, qy, qz, p, q, r)
        # stage 2
        s2, x2, y2, z2 = 0.5 * (s2a + s2b), 0.5 * (x2a + x2b), 0.5 * (y2a + y2b), 0.5 * (z2a + z2b)
        s1, o1, do, g, im = 0.5 * (s1a + s1b), 0.5 * (o1a + o1b), 0.5 * (doa + dob), 0.5 * (ga + gb), 0.5 * (ma + mb)
        p2, q2, r2 = p + h * a1x, q + h * a1y, r + h * a1z
        a, b, c, d = qw + h * k1w, qx + h * k1x, qy + h * k1y, qz + h * k1z
        a2x, a2y, a2z, n2, e2, d2, f2x, f2y, f2z = _body(
            a, b, c, d, p2, q2, r2, vn + h * n1, ve + h * e1, vd + h * d1, s2, x2, y2, z2, s1, o1, do, g, im,
            con, lane, lift,
        )  # fmt: skip
        k2w, k2x, k2y, k2z = _rotation_rate(a, b, c, d, p2, q2, r2)
        # stage 3
        p3, q3, r3 = p + h * a2x, q + h * a2y, r + h * a2z
        a, b, c, d = qw + h * k2w, qx + h * k2x, qy + h * k2y, qz + h * k2z
        a3x, a3y, a3z, n3, e3, d3, f3x, f3y, f3z = _body(
            a, b, c, d, p3, q3, r3, vn + h * n2, ve + h * e2, vd + h * d2, s2, x2, y2, z2, s1, o1, do, g, im,
            con, lane, lift,
        )  # fmt: skip
        k3w, k3x, k3y, k3z = _rotation_rate(a, b, c, d, p3, q3, r3)
        # stage 4
        p4, q4, r4 = p + dt * a3x, q + dt * a3y, r + dt * a3z
        a, b, c, d = qw + dt * k3w, qx + dt * k3x, qy + dt * k3y, qz + dt * k3z
        a4x, a4y, a4z, n4, e4, d4, f4x, f4y, f4z = _body(
            a, b, c, d, p4, q4, r4, vn + dt * n3, ve + dt * e3, vd + dt * d3,
            1.5 * s2b - 0.5 * s2a, 1.5 * x2b - 0.5 * x2a, 1.5 * y2b - 0.5 * y2a, 1.5 * z2b - 0.5 * z2a,
            1.5 * s1b - 0.5 * s1a, 1.5 * o1b - 0.5 * o1a, 1.5 * dob - 0.5 * doa, gb, mb, con, lane, lift,
        )  # fmt: skip
        k4w, k4x, k4y, k4z = _rotation_rate(a, b, c, d, p4, q4, r4)
        s = dt / 6.0
        qw += s * (k1w + 2.0 * (k2w + k3w) + k4w)
        qx += s * (k1x + 2.0 * (k2x + k3x) + k4x)
        qy += s * (k1y + 2.0 * (k2y + k3y) + k4y)
        qz += s * (k1z + 2.0 * (k2z + k3z) + k4z)
        scale = 1.5 - 0.5 * (qw * qw + qx * qx + qy * qy + qz * qz)
        x[0 * LANES + lane], x[1 * LANES + lane], x[2 * LANES + lane], x[3 * LANES + lane] = qw * scale, qx * scale, qy * scale, qz * scale
        x[4 * LANES + lane] = p + s * (a1x + 2.0 * (a2x + a3x) + a4x)
        x[5 * LANES + lane] = q + s * (a1y + 2.0 * (a2y + a3y) + a4y)
        x[6 * LANES + lane] = r + s * (a1z + 2.0 * (a2z + a3z) + a4z)
        x[7 * LANES + lane] = vn + s * (n1 + 2.0 * (n2 + n3) + n4)
        x[8 * LANES + lane] = ve + s * (e1 + 2.0 * (e2 + e3) + e4)
        x[9 * LANES + lane] = vd + s * (d1 + 2.0 * (d2 + d3) + d4)
        x[10 * LANES + lane] += dt * vn + dt * s * (n1 + n2 + n3)
        x[11 * LANES + lane] += dt * ve + dt * s * (e1 + e2 + e3)
        x[12 * LANES + lane] += dt * vd + dt * s * (d1 + d2 + d3)
        # Means over the halves from a parabola through the stages.
        fx, fy, fz = 0.5 * (f2x + f3x), 0.5 * (f2y + f3y), 0.5 * (f2z + f3z)
        acc[0 * LANES + lane] = (5.0 * f1x + 8.0 * fx - f4x) / 12.0
        acc[1 * LANES + lane] = (5.0 * f1y + 8.0 * fy - f4y) / 12.0
        acc[2 * LANES + lane] = (5.0 * f1z + 8.0 * fz - f4z) / 12.0
        acc[(1 * 3 + 0) * LANES + lane] = (-f1x + 8.0 * fx + 5.0 * f4x) / 12.0
        acc[(1 * 3 + 1) * LANES + lane] = (-f1y + 8.0 * fy + 5.0 * f4y) / 12.0
        acc[(1 * 3 + 2) * LANES + lane] = (-f1z + 8.0 * fz + 5.0 * f4z) / 12.0
