"""What was simulated against what was measured: residuals of a sample, and their cost for one segment.

Channels are written out one by one: a short loop over them would be unrolled first and then never be vectorised.
"""

from __future__ import annotations

import numba as nb

# isort: off
from quadid.model.work_array import (
    C_VEL, C_VEL_Z, S_FX, S_FY, S_FZ, S_P, S_Q, S_QW, S_QX, S_QY, S_QZ, S_R, X_N, X_VN,
)  # fmt: skip

# isort: on
from quadid.model.simd import LANES, inlined, jit, lane_kernel
from quadid.types import FloatArray

Y1, Y2 = LANES, 2 * LANES
"""Offsets of the second and third component of a vector."""


@nb.njit(**jit)
def compare(
    seg: int, row: int, k: int, measured: FloatArray, scale: FloatArray, s: FloatArray, out: FloatArray
) -> None:
    """Writes predicted minus measured of sample k: gyro, attitude (body rotation vector), specific force.

    Args:
        seg: place in `out`.
        row: place in `out`.
        k: row of `measured` and `scale`.
        measured: (n, 16): gyro 3, quaternion 4, accel 3, velocity 3, position 3.
        scale: (n, channels), factor on each residual.
        s: rows.
        out: (segments, rows, channels * LANES); the first nine channels are written.
    """
    lane_kernel()
    m0, m1, m2, m3 = measured[k, 3], measured[k, 4], measured[k, 5], measured[k, 6]
    for lane in range(LANES):
        out[seg, row, lane] = scale[k, 0] * (s[S_P + lane] - measured[k, 0])
        out[seg, row, LANES + lane] = scale[k, 1] * (s[S_Q + lane] - measured[k, 1])
        out[seg, row, 2 * LANES + lane] = scale[k, 2] * (s[S_R + lane] - measured[k, 2])
        q0, q1, q2, q3 = s[S_QW + lane], s[S_QX + lane], s[S_QY + lane], s[S_QZ + lane]
        sign = 2.0 if m0 * q0 + m1 * q1 + m2 * q2 + m3 * q3 >= 0.0 else -2.0
        out[seg, row, 3 * LANES + lane] = scale[k, 3] * sign * (m0 * q1 - m1 * q0 - m2 * q3 + m3 * q2)
        out[seg, row, 4 * LANES + lane] = scale[k, 4] * sign * (m0 * q2 + m1 * q3 - m2 * q0 - m3 * q1)
        out[seg, row, 5 * LANES + lane] = scale[k, 5] * sign * (m0 * q3 - m1 * q2 + m2 * q1 - m3 * q0)
        out[seg, row, 6 * LANES + lane] = scale[k, 6] * (s[S_FX + lane] - measured[k, 7])
        out[seg, row, 7 * LANES + lane] = scale[k, 7] * (s[S_FY + lane] - measured[k, 8])
        out[seg, row, 8 * LANES + lane] = scale[k, 8] * (s[S_FZ + lane] - measured[k, 9])


@nb.njit(**jit)
def compare_motion(
    seg: int, row: int, k: int, measured: FloatArray, scale: FloatArray, s: FloatArray, out: FloatArray
) -> None:
    """Writes predicted minus measured velocity and, with 15 channels, position at sample k; before the step."""
    lane_kernel()
    for lane in range(LANES):
        out[seg, row, 9 * LANES + lane] = scale[k, 9] * (s[C_VEL + lane] * s[X_VN + lane] - measured[k, 10])
        out[seg, row, 10 * LANES + lane] = scale[k, 10] * (s[C_VEL + lane] * s[X_VN + Y1 + lane] - measured[k, 11])
        out[seg, row, 11 * LANES + lane] = scale[k, 11] * (s[C_VEL_Z + lane] * s[X_VN + Y2 + lane] - measured[k, 12])
    if scale.shape[1] > 12:
        for lane in range(LANES):
            out[seg, row, 12 * LANES + lane] = scale[k, 12] * (s[X_N + lane] - measured[k, 13])
            out[seg, row, 13 * LANES + lane] = scale[k, 13] * (s[X_N + Y1 + lane] - measured[k, 14])
            out[seg, row, 14 * LANES + lane] = scale[k, 14] * (s[X_N + Y2 + lane] - measured[k, 15])


@nb.njit(**inlined)
def _collect_three(c, seg, at, basis, r, total, inside):  # type: ignore[no-untyped-def]
    """What `collect` does for channels c, c + 1 and c + 2."""
    x, y, z = c * LANES, (c + 1) * LANES, (c + 2) * LANES
    for lane in range(LANES):
        r0, r1, r2 = r[0, 0, x + lane], r[0, 0, y + lane], r[0, 0, z + lane]
        total[lane] += r0 * r0 + r1 * r1 + r2 * r2
    for j in range(basis.shape[2]):
        b0, b1, b2 = basis[seg, at + c, j], basis[seg, at + c + 1, j], basis[seg, at + c + 2, j]
        for lane in range(LANES):
            r0, r1, r2 = r[0, 0, x + lane], r[0, 0, y + lane], r[0, 0, z + lane]
            inside[j, lane] += b0 * r0 + b1 * r1 + b2 * r2


@nb.njit(**jit)
def collect(
    seg: int, row: int, basis: FloatArray, r: FloatArray, total: FloatArray, inside: FloatArray, channels: int
) -> None:
    """Adds the weighted residuals of a sample to their sum of squares and to their components along the basis.

    Args:
        seg: segment.
        row: its scored row.
        basis: (segments, length * channels, directions).
        r: weighted residuals (1, 1, channels * LANES).
        total: sum of squares (LANES,), added to.
        inside: components (directions, LANES), added to.
        channels: 9, 12 or 15.
    """
    lane_kernel()
    at = row * channels
    for lane in range(LANES):
        r0, r1, r2 = r[0, 0, lane], r[0, 0, LANES + lane], r[0, 0, 2 * LANES + lane]
        r3, r4, r5 = r[0, 0, 3 * LANES + lane], r[0, 0, 4 * LANES + lane], r[0, 0, 5 * LANES + lane]
        r6, r7, r8 = r[0, 0, 6 * LANES + lane], r[0, 0, 7 * LANES + lane], r[0, 0, 8 * LANES + lane]
        total[lane] += r0 * r0 + r1 * r1 + r2 * r2 + r3 * r3 + r4 * r4 + r5 * r5 + r6 * r6 + r7 * r7 + r8 * r8
    for j in range(basis.shape[2]):
        b0, b1, b2 = basis[seg, at, j], basis[seg, at + 1, j], basis[seg, at + 2, j]
        b3, b4, b5 = basis[seg, at + 3, j], basis[seg, at + 4, j], basis[seg, at + 5, j]
        b6, b7, b8 = basis[seg, at + 6, j], basis[seg, at + 7, j], basis[seg, at + 8, j]
        for lane in range(LANES):
            rate = b0 * r[0, 0, lane] + b1 * r[0, 0, LANES + lane] + b2 * r[0, 0, 2 * LANES + lane]
            turn = b3 * r[0, 0, 3 * LANES + lane] + b4 * r[0, 0, 4 * LANES + lane] + b5 * r[0, 0, 5 * LANES + lane]
            push = b6 * r[0, 0, 6 * LANES + lane] + b7 * r[0, 0, 7 * LANES + lane] + b8 * r[0, 0, 8 * LANES + lane]
            inside[j, lane] += rate + turn + push
    for c in range(9, channels, 3):
        _collect_three(c, seg, at, basis, r, total, inside)


@nb.njit(**jit)
def settle(total: FloatArray, inside: FloatArray, cost: FloatArray) -> None:
    """Adds a segment's cost, sum of squares less squared components, to `cost` (LANES,); empties the sums."""
    lane_kernel()
    for lane in range(LANES):
        cost[lane] += total[lane]
        total[lane] = 0.0
    for j in range(len(inside)):
        for lane in range(LANES):
            cost[lane] -= inside[j, lane] * inside[j, lane]
            inside[j, lane] = 0.0
