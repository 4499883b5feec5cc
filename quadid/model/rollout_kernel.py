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
        x[0 * LANES + lane] = q0 * w - q1 * a - q2 * b - q3 * c
        x[1 * LANES + lane] = q0 * a + q1 * w + q2 * c - q3 * b
        x[2 * LANES + lane] = q0 * b - q1 * c + q2 * w + q3 * a
        x[3 * LANES + lane] = q0 * c + q1 * b - q2 * a + q3 * w
        for i in range(9):
            x[(4 + i) * LANES + lane] = x0[4 + i] + dx[lane, 3 + i]


@nb.njit(**_jit)
def _filter(con: FloatArray, ec: int, es: int, h: float, u0: FloatArray, u1: FloatArray, y: FloatArray, yd: FloatArray) -> None:
    """Advances three second-order Butterworth filters by h for input linear from u0 to u1, each (3 * LANES,)."""
    for i in range(3):
        for lane in range(LANES):
            slope = (u1[i * LANES + lane] - u0[i * LANES + lane]) / h
            kappa, sigma, c, s = con[C_KAP * LANES + lane], con[C_SIG * LANES + lane], con[ec * LANES + lane], con[es * LANES + lane]
            z = y[i * LANES + lane] - (u0[i * LANES + lane] - slope * kappa)
            zd = yd[i * LANES + lane] - slope
            # The homogeneous solution at h; kappa = 1 / sigma.
            y[i * LANES + lane] = u1[i * LANES + lane] - slope * kappa + z * (c + s) + zd * s * kappa
            yd[i * LANES + lane] = slope + zd * (c - s) - 2.0 * sigma * z * s


@nb.njit(**_jit)
def _ahrs(dt: float, con: FloatArray, x: FloatArray, acc: FloatArray, e: FloatArray) -> None:
    """Advances the AHRS tilt error e (3 * LANES,): it turns towards the accelerometer's level with gain k."""
    for lane in range(LANES):
        qw, qx, qy, qz = x[0 * LANES + lane], x[1 * LANES + lane], x[2 * LANES + lane], x[3 * LANES + lane]
        gx, gy, gz = 2.0 * (qx * qz - qw * qy), 2.0 * (qy * qz + qw * qx), 1.0 - 2.0 * (qx * qx + qy * qy)
        ex, ey, ez = e[0 * LANES + lane], e[1 * LANES + lane], e[2 * LANES + lane]
        hx, hy, hz = gx - (ey * gz - ez * gy), gy - (ez * gx - ex * gz), gz - (ex * gy - ey * gx)
        sx = 0.5 * (acc[0 * LANES + lane] + acc[(1 * 3 + 0) * LANES + lane])
        sy = 0.5 * (acc[1 * LANES + lane] + acc[(1 * 3 + 1) * LANES + lane])
        sz = 0.5 * (acc[2 * LANES + lane] + acc[(1 * 3 + 2) * LANES + lane])
        k = -con[C_AHRS * LANES + lane] / math.sqrt(sx * sx + sy * sy + sz * sz + 1e-9)
        p, q, r = x[4 * LANES + lane], x[5 * LANES + lane], x[6 * LANES + lane]
        e[0 * LANES + lane] = ex + dt * (k * (sy * hz - sz * hy) - (q * ez - r * ey))
        e[1 * LANES + lane] = ey + dt * (k * (sz * hx - sx * hz) - (r * ex - p * ez))
        e[2 * LANES + lane] = ez + dt * (k * (sx * hy - sy * hx) - (p * ey - q * ex))


@nb.njit(**_jit)
def _delayed_attitude(
    k: int, first: int, dt: float, theta: FloatArray, ring_q: FloatArray, ring_w: FloatArray, out: FloatArray
) -> None:
    """Attitude at t_k - delay from the ring of past states; before `first` the oldest state is extrapolated."""
    for lane in range(LANES):
        steps = max(theta[ix.ATT_DELAY * LANES + lane], 0.0) / dt
        j = min(int(math.floor(steps)), RING - 2)
        back = max(k - j, first)
        h = (steps - (k - back)) * dt
        slot, prev = back % RING, max(back - 1, first) % RING
        phi = np.empty(3)
        for i in range(3):
            rate = (ring_w[slot, i * LANES + lane] - ring_w[prev, i * LANES + lane]) / dt
            phi[i] = -0.5 * (ring_w[slot, i * LANES + lane] * h - 0.5 * rate * h * h)
        w = 1.0 / math.sqrt(1.0 + phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2])
        a, b, c = phi[0] * w, phi[1] * w, phi[2] * w
        q0, q1, q2, q3 = ring_q[slot, 0 * LANES + lane], ring_q[slot, 1 * LANES + lane], ring_q[slot, 2 * LANES + lane], ring_q[slot, 3 * LANES + lane]
        out[0 * LANES + lane] = q0 * w - q1 * a - q2 * b - q3 * c
        out[1 * LANES + lane] = q0 * a + q1 * w + q2 * c - q3 * b
        out[2 * LANES + lane] = q0 * b - q1 * c + q2 * w + q3 * a
        out[3 * LANES + lane] = q0 * c + q1 * b - q2 * a + q3 * w


@nb.njit(**_jit)
def _compare(
    k: int, theta: FloatArray, wm: FloatArray, fm: FloatArray, qm: FloatArray, e: FloatArray,
    meas: FloatArray, with_imu: bool, with_ahrs: bool, out: FloatArray,
) -> None:  # fmt: skip
    """Writes predicted minus measured at sample k: gyro, attitude (body rotation vector), accel.

    Args:
        k: row of `meas`.
        theta: (size * LANES,), for IMU scale, misalignment and bias.
        wm, fm: rate and specific force reaching the IMU (3 * LANES,).
        qm: attitude the AHRS reports (4 * LANES,), before its tilt error `e` (3 * LANES,).
        meas: (n, 16): gyro 3, quaternion 4, accel 3, velocity 3, position 3.
        out: (at least 9 * LANES,).
    """
    for lane in range(LANES):
        w0, w1, w2 = wm[0 * LANES + lane], wm[1 * LANES + lane], wm[2 * LANES + lane]
        f0, f1, f2 = fm[0 * LANES + lane], fm[1 * LANES + lane], fm[2 * LANES + lane]
        if with_imu:
            mx, my, mz = theta[ix.MAX_ * LANES + lane], theta[ix.MAY * LANES + lane], theta[ix.MAZ * LANES + lane]
            # v_sensor = exp([m]x) v_body, to second order in the angle
            a0, a1, a2 = my * w2 - mz * w1, mz * w0 - mx * w2, mx * w1 - my * w0
            w0 += a0 + 0.5 * (my * a2 - mz * a1)
            w1 += a1 + 0.5 * (mz * a0 - mx * a2)
            w2 += a2 + 0.5 * (mx * a1 - my * a0)
            a0, a1, a2 = my * f2 - mz * f1, mz * f0 - mx * f2, mx * f1 - my * f0
            f0 += a0 + 0.5 * (my * a2 - mz * a1)
            f1 += a1 + 0.5 * (mz * a0 - mx * a2)
            f2 += a2 + 0.5 * (mx * a1 - my * a0)
            w0 = w0 * (1.0 + theta[ix.GSX * LANES + lane]) + theta[ix.GBX * LANES + lane]
            w1 = w1 * (1.0 + theta[ix.GSY * LANES + lane]) + theta[ix.GBY * LANES + lane]
            w2 = w2 * (1.0 + theta[ix.GSZ * LANES + lane]) + theta[ix.GBZ * LANES + lane]
            f0 += theta[ix.ABX * LANES + lane]
            f1 += theta[ix.ABY * LANES + lane]
            f2 += theta[ix.ABZ * LANES + lane]
        out[0 * LANES + lane], out[1 * LANES + lane], out[2 * LANES + lane] = w0 - meas[k, 0], w1 - meas[k, 1], w2 - meas[k, 2]
        m0, m1, m2, m3 = meas[k, 3], meas[k, 4], meas[k, 5], meas[k, 6]
        q0, q1, q2, q3 = qm[0 * LANES + lane], qm[1 * LANES + lane], qm[2 * LANES + lane], qm[3 * LANES + lane]
        sign = 2.0 if m0 * q0 + m1 * q1 + m2 * q2 + m3 * q3 >= 0.0 else -2.0
        out[3 * LANES + lane] = sign * (m0 * q1 - m1 * q0 - m2 * q3 + m3 * q2)
        out[4 * LANES + lane] = sign * (m0 * q2 + m1 * q3 - m2 * q0 - m3 * q1)
        out[5 * LANES + lane] = sign * (m0 * q3 - m1 * q2 + m2 * q1 - m3 * q0)
        out[6 * LANES + lane], out[7 * LANES + lane], out[8 * LANES + lane] = f0 - meas[k, 7], f1 - meas[k, 8], f2 - meas[k, 9]
    if with_ahrs:
        for i in range(3):
            for lane in range(LANES):
                out[(3 + i) * LANES + lane] += e[i * LANES + lane]


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
        theta: parameter vectors (size * LANES,); dx: tangent offsets of the initial state (LANES, 12).
        full .. ahrs: which parts of the model any lane needs.
        channels: 9, 12 with velocity, 15 with position too.
        out: residuals (segments, n_seg, channels * LANES), written.
        ends: states one step after the last scored row (segments, 13 * LANES), written.
    """
    rotors = u.shape[1]
    con = np.empty(N_CONST * LANES)
    lane_constants(theta, mass, rotors, dt, reach, con)
    w, inputs = np.empty(rotors * LANES), np.empty(6 * LANES)
    for r in range(rotors):
        for lane in range(LANES):
            w[r * LANES + lane] = u[0, r]
    total = n_pre + n_seg + 1
    agg = np.ones((total, 2 * N_AGG * LANES))  # the factors of thrust and mass stay 1 unless asked for
    x = np.empty(N_STATE * LANES)
    acc = np.zeros(6 * LANES)
    before = np.zeros(3 * LANES)
    fm, wm, qm = np.empty(3 * LANES), np.empty(3 * LANES), np.empty(4 * LANES)
    e = np.zeros(3 * LANES)
    gy, gyd, ay, ayd = np.empty(3 * LANES), np.empty(3 * LANES), np.empty(3 * LANES), np.empty(3 * LANES)
    f_prev, f_mid, w_prev = np.empty(3 * LANES), np.empty(3 * LANES), np.empty(3 * LANES)
    ring_q, ring_w = np.empty((RING, 4 * LANES)), np.empty((RING, 3 * LANES))
    done = 0  # rotor steps already taken
    for seg in range(len(starts)):
        first = starts[seg] - n_pre
        kept = max(done - first, 0)
        for i in range(kept):
            agg[i] = agg[total - kept + i]
        for k in range(done, first):  # rows no segment covers: rotors still turn
            rotors_step(u, k, held, con, geometry, dt, w, agg[0], inputs, rotor_lanes)
        for i in range(kept, total):
            rotors_step(u, first + i, held, con, geometry, dt, w, agg[i], inputs, rotor_lanes)
            if factors:
                flight_factors(t0 + dt * (first + i), span0, span1, dt, con, agg[i])
        done = first + total
        _start(x0[seg], dx, x)
        e[:] = 0.0
        for i in range(total):
            k = first + i
            for c in range(3):
                for lane in range(LANES):
                    wm[c * LANES + lane] = x[(4 + c) * LANES + lane]
            for c in range(4):
                for lane in range(LANES):
                    qm[c * LANES + lane] = x[c * LANES + lane]
            if att_delay:
                ring_q[k % RING], ring_w[k % RING] = qm, wm
            # The step from t_k gives the first half of the accelerometer's mean at t_k; the previous gave the other.
            scored = i >= n_pre and i < n_pre + n_seg
            if i == total - 1:
                for c in range(N_STATE):
                    for lane in range(LANES):
                        ends[seg, c * LANES + lane] = x[c * LANES + lane]
                break
            if scored and channels > 9:
                for c in range(channels - 9):
                    for lane in range(LANES):
                        out[seg, i - n_pre, (9 + c) * LANES + lane] = x[(7 + c) * LANES + lane] - meas[k, 10 + c]
            if full:
                step_full(dt, con, agg[i], x, acc)
            else:
                step_core(dt, con, agg[i], x, acc)
            for c in range(3):
                for lane in range(LANES):
                    first_half = acc[c * LANES + lane]
                    fm[c * LANES + lane] = first_half if i == 0 else 0.5 * (before[c * LANES + lane] + first_half)
                    before[c * LANES + lane] = acc[(1 * 3 + c) * LANES + lane]
            if imu_lag:
                if i == 0:
                    for c in range(3):
                        for lane in range(LANES):
                            slope = (x[(4 + c) * LANES + lane] - wm[c * LANES + lane]) / dt
                            gy[c * LANES + lane] = wm[c * LANES + lane] - slope * con[C_KAP * LANES + lane]
                            gyd[c * LANES + lane] = slope
                            ay[c * LANES + lane], ayd[c * LANES + lane] = fm[c * LANES + lane], 0.0
                else:
                    _filter(con, C_EC, C_ES, dt, w_prev, wm, gy, gyd)
                    _filter(con, C_ECH, C_ESH, 0.5 * dt, f_prev, f_mid, ay, ayd)
                    _filter(con, C_ECH, C_ESH, 0.5 * dt, f_mid, fm, ay, ayd)
                for c in range(3):
                    for lane in range(LANES):
                        w_prev[c * LANES + lane], f_prev[c * LANES + lane] = wm[c * LANES + lane], fm[c * LANES + lane]
                        f_mid[c * LANES + lane] = 0.5 * (acc[c * LANES + lane] + acc[(1 * 3 + c) * LANES + lane])
                        wm[c * LANES + lane], fm[c * LANES + lane] = gy[c * LANES + lane], ay[c * LANES + lane]
            if scored:
                if att_delay:
                    _delayed_attitude(k, first, dt, theta, ring_q, ring_w, qm)
                _compare(
                    k, theta, wm, fm, qm, e, meas, imu_static, ahrs, out[seg, i - n_pre]
                )
            if ahrs and i >= n_pre:
                _ahrs(dt, con, x, acc, e)
