"""Forces and moments beyond the catalogue: sums of coefficients times products of signals of the simulation.

What may be multiplied: `quadid.residual.SIGNALS`, in this
order; 0 stands for the constant one.
"""

from __future__ import annotations

import math

import numba as nb

from quadid.model import layout as ix
from quadid.types import FloatArray, IntArray

# isort: off
from quadid.model.work_array import (
    A_S2, A_X2, A_Y2, A_Z2, C_B, C_D, C_INVM, C_WE, C_WN, HALF, L_FX, L_NOW, L_PAST, X_P, X_Q, X_QW, X_QX, X_QY, X_QZ,
    X_R, X_VD, X_VE, X_VN,
)  # fmt: skip

# isort: on
from quadid.model.simd import LANES, exact, jit, lane_kernel

N_SIGNALS = 15


@nb.njit(**exact)
def residual_coefficients(theta: FloatArray, rotors: int, coefficients: FloatArray) -> None:
    """Copies the coefficients of all terms out of the parameter vectors (LANES, size) into (terms, LANES)."""
    for i in range(len(coefficients)):
        for lane in range(LANES):
            coefficients[i, lane] = theta[lane, ix.LOSS + 2 * rotors + i]


@nb.njit(**jit)
def residual_signals(s: FloatArray, signals: FloatArray) -> None:
    """Writes the signals at the start of a step, (N_SIGNALS, LANES): one, velocity, rates, gravity, rotors, speed."""
    lane_kernel()
    for lane in range(LANES):
        qw, qx, qy, qz = s[X_QW + lane], s[X_QX + lane], s[X_QY + lane], s[X_QZ + lane]
        rn, re, rd = s[X_VN + lane] - s[C_WN + lane], s[X_VE + lane] - s[C_WE + lane], s[X_VD + lane]
        gx, gy = 2.0 * (qx * qz - qw * qy), 2.0 * (qy * qz + qw * qx)
        gz = qw * qw - qx * qx - qy * qy + qz * qz
        u = (qw * qw + qx * qx - qy * qy - qz * qz) * rn + 2.0 * (qx * qy + qw * qz) * re + gx * rd
        v = 2.0 * (qx * qy - qw * qz) * rn + (qw * qw - qx * qx + qy * qy - qz * qz) * re + gy * rd
        w = 2.0 * (qx * qz + qw * qy) * rn + 2.0 * (qy * qz - qw * qx) * re + gz * rd
        signals[0, lane] = 1.0
        signals[1, lane], signals[2, lane], signals[3, lane] = u, v, w
        signals[4, lane], signals[5, lane], signals[6, lane] = s[X_P + lane], s[X_Q + lane], s[X_R + lane]
        signals[7, lane], signals[8, lane], signals[9, lane] = gx, gy, gz
        b, d = 0.5 * s[C_B + lane], 0.5 * s[C_D + lane]
        signals[10, lane] = b * (s[A_S2 + lane] + s[A_S2 + HALF + lane])
        signals[11, lane] = -b * (s[A_Y2 + lane] + s[A_Y2 + HALF + lane])
        signals[12, lane] = b * (s[A_X2 + lane] + s[A_X2 + HALF + lane])
        signals[13, lane] = d * (s[A_Z2 + lane] + s[A_Z2 + HALF + lane])
        signals[14, lane] = math.sqrt(u * u + v * v + w * w)


@nb.njit(**jit)
def residual_forces(terms: IntArray, coefficients: FloatArray, signals: FloatArray, first: bool, s: FloatArray) -> None:
    """Sums all terms into rows of specific force [m/s^2] and moment [N m], their means over the coming step.

    The mean is extrapolated from the starts of this step and the last (Adams and Bashforth, second order).

    Args:
        terms: (terms, 4): target (0..2 force along x, y, z; 3..5 moment about them), three signals.
        coefficients: (terms, LANES).
        signals: (N_SIGNALS, LANES), of `residual_signals`.
        first: this is the first step of a segment; there is no last one.
        s: rows.
    """
    lane_kernel()
    for i in range(6 * LANES):
        s[L_PAST + i] = s[L_NOW + i]
        s[L_NOW + i] = 0.0
    for i in range(len(terms)):
        target, a, b, c = terms[i, 0], terms[i, 1], terms[i, 2], terms[i, 3]
        at = L_NOW + target * LANES
        for lane in range(LANES):
            s[at + lane] += coefficients[i, lane] * signals[a, lane] * signals[b, lane] * signals[c, lane]
    for i in range(3):
        for lane in range(LANES):
            s[L_NOW + i * LANES + lane] *= s[C_INVM + lane]
    back = 0.0 if first else 0.5
    for i in range(6 * LANES):
        s[L_FX + i] = s[L_NOW + i] + back * (s[L_NOW + i] - s[L_PAST + i])
