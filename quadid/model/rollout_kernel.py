"""Segment loop of the rollout: simulates every segment for a block of lanes and writes residuals.

Follows the state through rotors, body, AHRS and IMU, and compares it with what was measured.  One whole file, because
the loop is one pass over time.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

from quadid.model import layout as ix
from quadid.model.kernel import (
    A_M,
    C_AHRS,
    C_EC,
    C_ECH,
    C_ES,
    C_ESH,
    C_KAP,
    C_SIG,
    LANES,
    N_AGG,
    N_CONST,
    N_STATE,
    RING,
    _jit,
    flight_factors,
    lane_constants,
    rotors_step,
    step_core,
    step_full,
)

FloatArray = NDArray[np.float64]

N_TANGENT = 12
"""Directions of an initial state: attitude (body rotation vector), rate, velocity, position."""


@nb.njit(**_jit)
def _start(x0: FloatArray, dx: FloatArray, x: FloatArray) -> None:
    """Sets lane states from one segment's initial state (13,) and each lane's tangent offset (LANES, 12)."""
    for lane in range(LANES):
        a, b, c = 0.5 * dx[lane, 0], 0.5 * dx[lane, 1], 0.5 * dx[lane, 2]
        w = 1.0 / math.sqrt(1.0 + a * a + b * b + c * c)
        a, b, c = a * w, b * w, c * w
        q0, q1, q2, q3 = x0[0], x0[1], x0[2], x0[3]
        x[0, lane] = q0 * w - q1 * a - q2 * b - q3 * c
        x[1, lane] = q0 * a + q1 * w + q2 * c - q3 * b
        x[2, lane] = q0 * b - q1 * c + q2 * w + q3 * a
        x[3, lane] = q0 * c + q1 * b - q2 * a + q3 * w
        for i in range(9):
            x[4 + i, lane] = x0[4 + i] + dx[lane, 3 + i]


@nb.njit(**_jit)
def _filter(con: FloatArray, ec: int, es: int, h: float, u0: FloatArray, u1: FloatArray, y: FloatArray, yd: FloatArray) -> None:
    """Advances three second-order Butterworth filters by h for input linear from u0 to u1, each (3, LANES)."""
    for i in range(3):
        for lane in range(LANES):
            slope = (u1[i, lane] - u0[i, lane]) / h
            kappa, sigma, c, s = con[C_KAP, lane], con[C_SIG, lane], con[ec, lane], con[es, lane]
            z = y[i, lane] - (u0[i, lane] - slope * kappa)
            zd = yd[i, lane] - slope
            # The homogeneous solution at h; kappa = 1 / sigma.
            y[i, lane] = u1[i, lane] - slope * kappa + z * (c + s) + zd * s * kappa
            yd[i, lane] = slope + zd * (c - s) - 2.0 * sigma * z * s


@nb.njit(**_jit)
def _ahrs(dt: float, con: FloatArray, x: FloatArray, acc: FloatArray, e: FloatArray) -> None:
    """Advances the AHRS tilt error e (3, LANES): it turns towards the accelerometer's level with gain k."""
    for lane in range(LANES):
        qw, qx, qy, qz = x[0, lane], x[1, lane], x[2, lane], x[3, lane]
        gx, gy, gz = 2.0 * (qx * qz - qw * qy), 2.0 * (qy * qz + qw * qx), 1.0 - 2.0 * (qx * qx + qy * qy)
        ex, ey, ez = e[0, lane], e[1, lane], e[2, lane]
        hx, hy, hz = gx - (ey * gz - ez * gy), gy - (ez * gx - ex * gz), gz - (ex * gy - ey * gx)
        sx = 0.5 * (acc[0, 0, lane] + acc[1, 0, lane])
        sy = 0.5 * (acc[0, 1, lane] + acc[1, 1, lane])
        sz = 0.5 * (acc[0, 2, lane] + acc[1, 2, lane])
        k = -con[C_AHRS, lane] / math.sqrt(sx * sx + sy * sy + sz * sz + 1e-9)
        p, q, r = x[4, lane], x[5, lane], x[6, lane]
        e[0, lane] = ex + dt * (k * (sy * hz - sz * hy) - (q * ez - r * ey))
        e[1, lane] = ey + dt * (k * (sz * hx - sx * hz) - (r * ex - p * ez))
        e[2, lane] = ez + dt * (k * (sx * hy - sy * hx) - (p * ey - q * ex))


@nb.njit(**_jit)
def _delayed_attitude(
    k: int, first: int, dt: float, theta: FloatArray, ring_q: FloatArray, ring_w: FloatArray, out: FloatArray
) -> None:
    """Attitude at t_k - delay from the ring of past states; before `first` the oldest state is extrapolated."""
    for lane in range(LANES):
        steps = max(theta[lane, ix.ATT_DELAY], 0.0) / dt
        j = min(int(math.floor(steps)), RING - 2)
        back = max(k - j, first)
        h = (steps - (k - back)) * dt
        slot, prev = back % RING, max(back - 1, first) % RING
        phi = np.empty(3)
        for i in range(3):
            rate = (ring_w[slot, i, lane] - ring_w[prev, i, lane]) / dt
            phi[i] = -0.5 * (ring_w[slot, i, lane] * h - 0.5 * rate * h * h)
        w = 1.0 / math.sqrt(1.0 + phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2])
        a, b, c = phi[0] * w, phi[1] * w, phi[2] * w
        q0, q1, q2, q3 = ring_q[slot, 0, lane], ring_q[slot, 1, lane], ring_q[slot, 2, lane], ring_q[slot, 3, lane]
        out[0, lane] = q0 * w - q1 * a - q2 * b - q3 * c
        out[1, lane] = q0 * a + q1 * w + q2 * c - q3 * b
        out[2, lane] = q0 * b - q1 * c + q2 * w + q3 * a
        out[3, lane] = q0 * c + q1 * b - q2 * a + q3 * w


@nb.njit(**_jit)
def _compare(
    k: int, theta: FloatArray, wm: FloatArray, fm: FloatArray, qm: FloatArray, e: FloatArray,
    meas: FloatArray, with_imu: bool, with_ahrs: bool, out: FloatArray,
) -> None:  # fmt: skip
    """Writes predicted minus measured at sample k: gyro, attitude (body rotation vector), accel.

    Args:
        k: row of `meas`.
        theta: (LANES, size), for IMU scale, misalignment and bias.
        wm, fm: rate and specific force reaching the IMU (3, LANES).
        qm: attitude the AHRS reports (4, LANES), before its tilt error `e` (3, LANES).
        meas: (n, 16): gyro 3, quaternion 4, accel 3, velocity 3, position 3.
        out: (at least 9, LANES).
    """
    for lane in range(LANES):
        w0, w1, w2 = wm[0, lane], wm[1, lane], wm[2, lane]
        f0, f1, f2 = fm[0, lane], fm[1, lane], fm[2, lane]
        if with_imu:
            mx, my, mz = theta[lane, ix.MAX_], theta[lane, ix.MAY], theta[lane, ix.MAZ]
            # v_sensor = exp([m]x) v_body, to second order in the angle
            a0, a1, a2 = my * w2 - mz * w1, mz * w0 - mx * w2, mx * w1 - my * w0
            w0 += a0 + 0.5 * (my * a2 - mz * a1)
            w1 += a1 + 0.5 * (mz * a0 - mx * a2)
            w2 += a2 + 0.5 * (mx * a1 - my * a0)
            a0, a1, a2 = my * f2 - mz * f1, mz * f0 - mx * f2, mx * f1 - my * f0
            f0 += a0 + 0.5 * (my * a2 - mz * a1)
            f1 += a1 + 0.5 * (mz * a0 - mx * a2)
            f2 += a2 + 0.5 * (mx * a1 - my * a0)
            w0 = w0 * (1.0 + theta[lane, ix.GSX]) + theta[lane, ix.GBX]
            w1 = w1 * (1.0 + theta[lane, ix.GSY]) + theta[lane, ix.GBY]
            w2 = w2 * (1.0 + theta[lane, ix.GSZ]) + theta[lane, ix.GBZ]
            f0 += theta[lane, ix.ABX]
            f1 += theta[lane, ix.ABY]
            f2 += theta[lane, ix.ABZ]
        out[0, lane], out[1, lane], out[2, lane] = w0 - meas[k, 0], w1 - meas[k, 1], w2 - meas[k, 2]
        m0, m1, m2, m3 = meas[k, 3], meas[k, 4], meas[k, 5], meas[k, 6]
        q0, q1, q2, q3 = qm[0, lane], qm[1, lane], qm[2, lane], qm[3, lane]
        sign = 2.0 if m0 * q0 + m1 * q1 + m2 * q2 + m3 * q3 >= 0.0 else -2.0
        out[3, lane] = sign * (m0 * q1 - m1 * q0 - m2 * q3 + m3 * q2)
        out[4, lane] = sign * (m0 * q2 + m1 * q3 - m2 * q0 - m3 * q1)
        out[5, lane] = sign * (m0 * q3 - m1 * q2 + m2 * q1 - m3 * q0)
        out[6, lane], out[7, lane], out[8, lane] = f0 - meas[k, 7], f1 - meas[k, 8], f2 - meas[k, 9]
    if with_ahrs:
        for i in range(3):
            for lane in range(LANES):
                out[3 + i, lane] += e[i, lane]


@nb.njit(**_jit)
def roll_segments(
    u: FloatArray, held: bool, geometry: FloatArray, mass: float, reach: float, t0: float, dt: float,
    span0: float, span1: float, meas: FloatArray, starts: NDArray[np.int64], n_pre: int, n_seg: int, x0: FloatArray,
    theta: FloatArray, dx: FloatArray, full: bool, rotor_lanes: bool, factors: bool, imu_lag: bool, att_delay: bool,
    imu_static: bool, ahrs: bool, channels: int, out: FloatArray, ends: FloatArray,
) -> None:  # fmt: skip
    """Rolls one block of lanes through all segments of one window.

    Args:
        u: rotor input (n, rotors) [rad/s]; `held` or linear between samples.
        geometry: (rotors, 3): x, y [m], spin.
        mass: [kg]; reach: half the smallest rotor distance [m].
        t0, dt: grid [s]; span0, span1: first and last time of the log [s].
        meas: measured (n, 16), see `_compare`.
        starts: first scored row of each segment; rows start - n_pre to start + n_seg must exist.
        n_pre: steps rolled before the first scored row, at least 1.
        n_seg: scored rows a segment.
        x0: initial state at start - n_pre, (segments, 13).
        theta: parameter vectors (LANES, size); dx: tangent offsets of the initial state (LANES, 12).
        full .. ahrs: which parts of the model any lane needs.
        channels: 9, 12 with velocity, 15 with position too.
        out: residuals (segments, n_seg, channels, LANES), written.
        ends: states one step after the last scored row (segments, 13, LANES), written.
    """
    rotors = u.shape[1]
    con = np.empty((N_CONST, LANES))
    lane_constants(theta, mass, rotors, dt, reach, con)
    w = np.empty((rotors, LANES))
    for r in range(rotors):
        for lane in range(LANES):
            w[r, lane] = u[0, r]
    total = n_pre + n_seg + 1
    agg = np.empty((total, 2, N_AGG, LANES))
    agg[:, :, A_M - 1, :] = 1.0
    agg[:, :, A_M, :] = 1.0
    x = np.empty((N_STATE, LANES))
    acc = np.zeros((2, 3, LANES))
    before = np.zeros((3, LANES))
    fm, wm, qm = np.empty((3, LANES)), np.empty((3, LANES)), np.empty((4, LANES))
    e = np.zeros((3, LANES))
    gy, gyd, ay, ayd = np.empty((3, LANES)), np.empty((3, LANES)), np.empty((3, LANES)), np.empty((3, LANES))
    f_prev, f_mid, w_prev = np.empty((3, LANES)), np.empty((3, LANES)), np.empty((3, LANES))
    ring_q, ring_w = np.empty((RING, 4, LANES)), np.empty((RING, 3, LANES))
    done = 0  # rotor steps already taken
    for seg in range(len(starts)):
        first = starts[seg] - n_pre
        kept = max(done - first, 0)
        for i in range(kept):
            agg[i] = agg[total - kept + i]
        for k in range(done, first):  # rows no segment covers: rotors still turn
            rotors_step(u, k, held, theta, con, geometry, dt, w, agg[0], rotor_lanes)
        for i in range(kept, total):
            rotors_step(u, first + i, held, theta, con, geometry, dt, w, agg[i], rotor_lanes)
            if factors:
                flight_factors(t0 + dt * (first + i), span0, span1, dt, con, agg[i])
        done = first + total
        _start(x0[seg], dx, x)
        e[:] = 0.0
        for i in range(total):
            k = first + i
            for c in range(3):
                for lane in range(LANES):
                    wm[c, lane] = x[4 + c, lane]
            for c in range(4):
                for lane in range(LANES):
                    qm[c, lane] = x[c, lane]
            if att_delay:
                ring_q[k % RING], ring_w[k % RING] = qm, wm
            # The step from t_k gives the first half of the accelerometer's mean at t_k; the previous gave the other.
            scored = i >= n_pre and i < n_pre + n_seg
            if i == total - 1:
                ends[seg] = x
                break
            if scored and channels > 9:
                for c in range(channels - 9):
                    for lane in range(LANES):
                        out[seg, i - n_pre, 9 + c, lane] = x[7 + c, lane] - meas[k, 10 + c]
            if full:
                step_full(dt, con, agg[i], x, acc)
            else:
                step_core(dt, con, agg[i], x, acc)
            for c in range(3):
                for lane in range(LANES):
                    first_half = acc[0, c, lane]
                    fm[c, lane] = first_half if i == 0 else 0.5 * (before[c, lane] + first_half)
                    before[c, lane] = acc[1, c, lane]
            if imu_lag:
                if i == 0:
                    for c in range(3):
                        for lane in range(LANES):
                            slope = (x[4 + c, lane] - wm[c, lane]) / dt
                            gy[c, lane] = wm[c, lane] - slope * con[C_KAP, lane]
                            gyd[c, lane] = slope
                            ay[c, lane], ayd[c, lane] = fm[c, lane], 0.0
                else:
                    _filter(con, C_EC, C_ES, dt, w_prev, wm, gy, gyd)
                    _filter(con, C_ECH, C_ESH, 0.5 * dt, f_prev, f_mid, ay, ayd)
                    _filter(con, C_ECH, C_ESH, 0.5 * dt, f_mid, fm, ay, ayd)
                for c in range(3):
                    for lane in range(LANES):
                        w_prev[c, lane], f_prev[c, lane] = wm[c, lane], fm[c, lane]
                        f_mid[c, lane] = 0.5 * (acc[0, c, lane] + acc[1, c, lane])
                        wm[c, lane], fm[c, lane] = gy[c, lane], ay[c, lane]
            if scored:
                if att_delay:
                    _delayed_attitude(k, first, dt, theta, ring_q, ring_w, qm)
                _compare(
                    k, theta, wm, fm, qm, e, meas, imu_static, ahrs, out[seg, i - n_pre]
                )
            if ahrs and i >= n_pre:
                _ahrs(dt, con, x, acc, e)
