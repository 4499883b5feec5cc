"""What the sensors make of the motion, for many parameter vectors at once: IMU filter, AHRS, errors of the IMU.

The rows S_* hold what reaches the sensors at one sample; each stage works on them in place, `compare` ends the chain.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

from quadid.model import layout as ix

# isort: off
from quadid.model.rows import (
    C_AB, C_AHRS, C_ATT_DELAY, C_EC, C_EC2, C_ES, C_ES2, C_GB, C_GS, C_KAPPA, C_MA, C_SIGMA, D_H, D_P, D_P0, D_Q, D_Q0,
    D_QW, D_QX, D_QY, D_QZ, D_R, D_R0, E_X, F1_X, F2_X, G_DF, G_DW, G_F, G_F0, G_FM, G_W, G_W0, RES, S_FX, S_FY, S_FZ,
    S_P, S_Q, S_QW, S_QX, S_QY, S_QZ, S_R, X_N, X_P, X_Q, X_QW, X_QX, X_QY, X_QZ, X_R, X_VN,
)  # fmt: skip

# isort: on
from quadid.model.simd import LANES, inlined, jit, lane_kernel

FloatArray = NDArray[np.float64]

Y1, Y2 = LANES, 2 * LANES
"""Offsets of the second and third component of a vector."""


@nb.njit(**jit)
def sensor_constants(theta: FloatArray, dt: float, s: FloatArray) -> None:
    """Derives the sensors' constants of all lanes from parameter vectors (LANES, size)."""
    for lane in range(LANES):
        th = theta[lane]
        # Butterworth poles at sigma (-1 +- i).  At period 0 both exponentials and kappa vanish: no filter.
        period = max(th[ix.IMU_PERIOD], 0.0)
        sigma = math.sqrt(2.0) * math.pi / max(period, 1e-7)
        s[C_SIGMA + lane], s[C_KAPPA + lane] = sigma, period / (math.sqrt(2.0) * math.pi)
        for row, h in ((C_EC, dt), (C_EC2, 0.5 * dt)):
            s[row + lane] = math.exp(-sigma * h) * math.cos(sigma * h)
            s[row + C_ES - C_EC + lane] = math.exp(-sigma * h) * math.sin(sigma * h)
        s[C_AHRS + lane], s[C_ATT_DELAY + lane] = th[ix.AHRS_K], max(th[ix.ATT_DELAY], 0.0) / dt
        for i in range(3):
            s[C_GB + i * LANES + lane], s[C_AB + i * LANES + lane] = th[ix.GBX + i], th[ix.ABX + i]
            s[C_GS + i * LANES + lane], s[C_MA + i * LANES + lane] = 1.0 + th[ix.GSX + i], th[ix.MAX_ + i]


@nb.njit(**inlined)
def _follow(u0, u1, y, dy, inv, kappa, sigma, c, e):  # type: ignore[no-untyped-def]
    """Value and derivative of a second-order Butterworth filter after its input went linearly from u0 to u1."""
    slope = (u1 - u0) * inv
    z = y - (u0 - slope * kappa)
    dz = dy - slope
    return u1 - slope * kappa + z * (c + e) + dz * e * kappa, slope + dz * (c - e) - 2.0 * sigma * z * e


@nb.njit(**jit)
def start_filter(dt: float, s: FloatArray) -> None:
    """Settles the IMU filter at the first step: on the rate's ramp, on the mean force."""
    lane_kernel()
    for i in range(0, 3 * LANES, LANES):
        for lane in range(LANES):
            slope = (s[X_P + i + lane] - s[S_P + i + lane]) / dt
            s[G_W + i + lane], s[G_DW + i + lane] = s[S_P + i + lane] - slope * s[C_KAPPA + lane], slope
            s[G_F + i + lane], s[G_DF + i + lane] = s[S_FX + i + lane], 0.0


@nb.njit(**jit)
def step_filter(dt: float, s: FloatArray) -> None:
    """Advances the IMU filter by one sample: rate linear over it, force linear over its halves."""
    lane_kernel()
    inv = 1.0 / dt
    for i in range(0, 3 * LANES, LANES):
        for lane in range(LANES):
            kappa, sigma = s[C_KAPPA + lane], s[C_SIGMA + lane]
            c, e = s[C_EC2 + lane], s[C_ES2 + lane]
            y, dy = _follow(
                s[G_W0 + i + lane], s[S_P + i + lane], s[G_W + i + lane], s[G_DW + i + lane], inv, kappa, sigma,
                s[C_EC + lane], s[C_ES + lane],
            )  # fmt: skip
            middle = s[G_FM + i + lane]
            f, df = _follow(
                s[G_F0 + i + lane], middle, s[G_F + i + lane], s[G_DF + i + lane], 2.0 * inv, kappa, sigma, c, e
            )
            f, df = _follow(middle, s[S_FX + i + lane], f, df, 2.0 * inv, kappa, sigma, c, e)
            s[G_W + i + lane], s[G_DW + i + lane], s[G_F + i + lane], s[G_DF + i + lane] = y, dy, f, df


@nb.njit(**jit)
def use_filter(s: FloatArray) -> None:
    """Remembers this sample as the filter's input, and lets its output reach the sensors."""
    lane_kernel()
    for i in range(3 * LANES):
        s[G_W0 + i], s[G_F0 + i] = s[S_P + i], s[S_FX + i]
        s[G_FM + i] = 0.5 * (s[F1_X + i] + s[F2_X + i])
        s[S_P + i], s[S_FX + i] = s[G_W + i], s[G_F + i]


@nb.njit(**jit)
def step_tilt_error(dt: float, s: FloatArray) -> None:
    """Advances the AHRS tilt error: it turns towards the accelerometer's level with gain k."""
    lane_kernel()
    for lane in range(LANES):
        qw, qx, qy, qz = s[X_QW + lane], s[X_QX + lane], s[X_QY + lane], s[X_QZ + lane]
        gx, gy, gz = 2.0 * (qx * qz - qw * qy), 2.0 * (qy * qz + qw * qx), 1.0 - 2.0 * (qx * qx + qy * qy)
        ex, ey, ez = s[E_X + lane], s[E_X + Y1 + lane], s[E_X + Y2 + lane]
        hx, hy, hz = gx - (ey * gz - ez * gy), gy - (ez * gx - ex * gz), gz - (ex * gy - ey * gx)
        sx = 0.5 * (s[F1_X + lane] + s[F2_X + lane])
        sy = 0.5 * (s[F1_X + Y1 + lane] + s[F2_X + Y1 + lane])
        sz = 0.5 * (s[F1_X + Y2 + lane] + s[F2_X + Y2 + lane])
        k = -s[C_AHRS + lane] / math.sqrt(sx * sx + sy * sy + sz * sz + 1e-9)
        p, q, r = s[X_P + lane], s[X_Q + lane], s[X_R + lane]
        s[E_X + lane] = ex + dt * (k * (sy * hz - sz * hy) - (q * ez - r * ey))
        s[E_X + Y1 + lane] = ey + dt * (k * (sz * hx - sx * hz) - (r * ex - p * ez))
        s[E_X + Y2 + lane] = ez + dt * (k * (sx * hy - sy * hx) - (p * ey - q * ex))


@nb.njit(**jit)
def remember_attitude(i: int, s: FloatArray, past: FloatArray) -> None:
    """Stores attitude and rate at step i of a segment in `past` (steps, 7, LANES)."""
    lane_kernel()
    for row in range(7):
        for lane in range(LANES):
            past[i, row, lane] = s[X_QW + row * LANES + lane]


@nb.njit(**jit)
def delay_attitude(i: int, dt: float, past: FloatArray, s: FloatArray) -> None:
    """Replaces the attitude that reaches the AHRS by that of step i less each lane's delay.

    Between stored steps, and before the first, attitude follows from rate and its backward difference.
    """
    for lane in range(LANES):
        back = max(i - int(s[C_ATT_DELAY + lane]), 0)
        before = max(back - 1, 0)
        for row in range(7):
            s[D_QW + row * LANES + lane] = past[back, row, lane]
        for row in range(3):
            s[D_P0 + row * LANES + lane] = past[before, 4 + row, lane]
        s[D_H + lane] = (s[C_ATT_DELAY + lane] - (i - back)) * dt
    _turn_back(dt, s)


@nb.njit(**jit)
def _turn_back(dt: float, s: FloatArray) -> None:
    lane_kernel()
    for lane in range(LANES):
        h = s[D_H + lane]
        p, q, r = s[D_P + lane], s[D_Q + lane], s[D_R + lane]
        a = -0.5 * (p * h - 0.5 * (p - s[D_P0 + lane]) / dt * h * h)
        b = -0.5 * (q * h - 0.5 * (q - s[D_Q0 + lane]) / dt * h * h)
        c = -0.5 * (r * h - 0.5 * (r - s[D_R0 + lane]) / dt * h * h)
        w = 1.0 / math.sqrt(1.0 + a * a + b * b + c * c)
        a, b, c = a * w, b * w, c * w
        q0, q1, q2, q3 = s[D_QW + lane], s[D_QX + lane], s[D_QY + lane], s[D_QZ + lane]
        s[S_QW + lane] = q0 * w - q1 * a - q2 * b - q3 * c
        s[S_QX + lane] = q0 * a + q1 * w + q2 * c - q3 * b
        s[S_QY + lane] = q0 * b - q1 * c + q2 * w + q3 * a
        s[S_QZ + lane] = q0 * c + q1 * b - q2 * a + q3 * w


@nb.njit(**inlined)
def _misalign(x, y, z, mx, my, mz):  # type: ignore[no-untyped-def]
    """exp([m]x) v to second order in the angle."""
    ax, ay, az = my * z - mz * y, mz * x - mx * z, mx * y - my * x
    return x + ax + 0.5 * (my * az - mz * ay), y + ay + 0.5 * (mz * ax - mx * az), z + az + 0.5 * (mx * ay - my * ax)


@nb.njit(**jit)
def distort_imu(s: FloatArray) -> None:
    """Turns rate and force into the sensor's axes, scales the gyro, adds biases."""
    lane_kernel()
    for lane in range(LANES):
        mx, my, mz = s[C_MA + lane], s[C_MA + Y1 + lane], s[C_MA + Y2 + lane]
        x, y, z = _misalign(s[S_P + lane], s[S_Q + lane], s[S_R + lane], mx, my, mz)
        s[S_P + lane] = x * s[C_GS + lane] + s[C_GB + lane]
        s[S_Q + lane] = y * s[C_GS + Y1 + lane] + s[C_GB + Y1 + lane]
        s[S_R + lane] = z * s[C_GS + Y2 + lane] + s[C_GB + Y2 + lane]
        x, y, z = _misalign(s[S_FX + lane], s[S_FY + lane], s[S_FZ + lane], mx, my, mz)
        s[S_FX + lane] = x + s[C_AB + lane]
        s[S_FY + lane] = y + s[C_AB + Y1 + lane]
        s[S_FZ + lane] = z + s[C_AB + Y2 + lane]


@nb.njit(**jit)
def compare(k: int, measured: FloatArray, s: FloatArray) -> None:
    """Writes predicted minus measured of sample k: gyro, attitude (body rotation vector), specific force.

    Args:
        k: row of `measured`.
        measured: (n, 16): gyro 3, quaternion 4, accel 3, velocity 3, position 3.
        s: rows; RES to RES + 8 written.
    """
    lane_kernel()
    m0, m1, m2, m3 = measured[k, 3], measured[k, 4], measured[k, 5], measured[k, 6]
    wx, wy, wz, fx, fy, fz = (
        measured[k, 0],
        measured[k, 1],
        measured[k, 2],
        measured[k, 7],
        measured[k, 8],
        measured[k, 9],
    )
    for lane in range(LANES):
        s[RES + lane] = s[S_P + lane] - wx
        s[RES + LANES + lane] = s[S_Q + lane] - wy
        s[RES + 2 * LANES + lane] = s[S_R + lane] - wz
        q0, q1, q2, q3 = s[S_QW + lane], s[S_QX + lane], s[S_QY + lane], s[S_QZ + lane]
        sign = 2.0 if m0 * q0 + m1 * q1 + m2 * q2 + m3 * q3 >= 0.0 else -2.0
        s[RES + 3 * LANES + lane] = sign * (m0 * q1 - m1 * q0 - m2 * q3 + m3 * q2)
        s[RES + 4 * LANES + lane] = sign * (m0 * q2 + m1 * q3 - m2 * q0 - m3 * q1)
        s[RES + 5 * LANES + lane] = sign * (m0 * q3 - m1 * q2 + m2 * q1 - m3 * q0)
        s[RES + 6 * LANES + lane] = s[S_FX + lane] - fx
        s[RES + 7 * LANES + lane] = s[S_FY + lane] - fy
        s[RES + 8 * LANES + lane] = s[S_FZ + lane] - fz


@nb.njit(**jit)
def compare_motion(k: int, channels: int, measured: FloatArray, s: FloatArray) -> None:
    """Writes predicted minus measured velocity and, with 15 channels, position at sample k; before the step."""
    lane_kernel()
    for lane in range(LANES):
        s[RES + 9 * LANES + lane] = s[X_VN + lane] - measured[k, 10]
        s[RES + 10 * LANES + lane] = s[X_VN + Y1 + lane] - measured[k, 11]
        s[RES + 11 * LANES + lane] = s[X_VN + Y2 + lane] - measured[k, 12]
    if channels > 12:
        for lane in range(LANES):
            s[RES + 12 * LANES + lane] = s[X_N + lane] - measured[k, 13]
            s[RES + 13 * LANES + lane] = s[X_N + Y1 + lane] - measured[k, 14]
            s[RES + 14 * LANES + lane] = s[X_N + Y2 + lane] - measured[k, 15]


@nb.njit(**jit)
def add_tilt_error(s: FloatArray) -> None:
    """Adds the AHRS tilt error to the attitude residual."""
    lane_kernel()
    for i in range(3 * LANES):
        s[RES + 3 * LANES + i] += s[E_X + i]
