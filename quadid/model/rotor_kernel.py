"""Rotors of many parameter vectors at once: their input, and their moments over each half step.

Speeds and their means are those of `quadid.model.lag_kernel`; here is what is read for them, and what is summed.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba as nb

from quadid.model.lag_kernel import next_input, rotor_constants, turn, turn_held
from quadid.model.layout import places
from quadid.model.needs_kernel import Needs
from quadid.types import FloatArray

# isort: off
from quadid.model.work_array import (
    A_S2, A_X1, A_XX, A_XY, A_XZ, A_Y1, A_YY, A_YZ, A_Z1, A_Z2, A_ZZ, ALL_MOMENTS, C_GROWTH, C_HOVER, C_ROW, C_SHIFT,
    C_VOLT, HALF, N_ROWS, R_NEXT, R_NEXT_SLOPE, R_NOW, R_NOW_SLOPE, R_PAST, R_PAST_SLOPE, R_SPEED, ROTOR, T_A1,
    T_DRAG, T_M1, T_M2, T_N1, T_N2, T_SPEED, T_VOLT,
)  # fmt: skip

# isort: on
from quadid.model.simd import LANES, SOURCES, cache_aligned, cached, exact, jit, lane_kernel

PLAIN_MOMENTS = 7
"""Moments that every model needs; the others belong to the air at each hub."""
(EXPONENT,) = places("supply_voltage.exponent")
(GROWTH,) = places("drag_torque_curve")


class Drive(NamedTuple):
    """What the rotors of a window get.

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
            for row in (R_SPEED, R_PAST, R_NEXT):
                rot[r, row + lane] = factor * drive.u[max(now - 1, k), r]
            rot[r, R_NOW + lane] = factor * drive.u[now, r]
            rot[r, R_SPEED + lane] = factor * drive.u[k, r]
            for row in (R_PAST_SLOPE, R_NOW_SLOPE, R_NEXT_SLOPE):
                rot[r, row + lane] = 0.0


@nb.njit(**exact)
def input_constants(theta: FloatArray, s: FloatArray) -> None:
    """Derives what scales input and drag torque of all lanes from parameter vectors (LANES, size)."""
    for lane in range(LANES):
        s[C_VOLT + lane], s[C_GROWTH + lane] = theta[lane, EXPONENT], theta[lane, GROWTH]


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
    plain: bool, r: int, held: bool, sloped: bool, geometry: FloatArray, dt: float, need: Needs,
    rot: FloatArray, s: FloatArray,
) -> None:  # fmt: skip
    """Advances rotor r over one step and adds it to the moments of both half steps.

    Args:
        plain: the input stays at row T_A1 [rad/s] over the whole step; else it is in the rows of the rotor.
        r: rotor; the first one begins the sums.
        held: the input acts held, else linear between samples.
        sloped: a held input runs on within its samples.
        geometry: see `Drive`.
        dt: step [s].
        need: which parts of the model any lane needs.
        rot: rows of the rotors, advanced in place.
        s: rows; moments written.
    """
    inv, keep = 2.0 / dt, 0.0 if r == 0 else 1.0
    x, y, spin, z = geometry[r, 0], geometry[r, 1], geometry[r, 2], geometry[r, 3]
    for i in range(3 * LANES):
        s[T_SPEED + i] = rot[r, R_SPEED + i]  # and both gains
    if plain and not need.uneven:
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
        drive: input of the window.
        k: step.
        need: which parts of the model any lane needs.
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


def _on_disk(sources: int) -> Any:
    @nb.njit(**cached)
    def rotor_table(drive: Drive, need: Needs, theta: FloatArray, table: FloatArray) -> None:
        """Moments of every step of a window for lanes that share all that acts on rotors.

        Args:
            drive: input of the window.
            need: which parts of the model the lanes need.
            theta: the same parameter vector in every lane, (LANES, size).
            table: (n, 2 * ALL_MOMENTS), written: moments of the first, then of the second half step.
        """
        _ = sources
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

    return rotor_table


rotor_table = _on_disk(SOURCES)
