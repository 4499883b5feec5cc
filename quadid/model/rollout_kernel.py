"""Segment loop of the rollout: simulates every segment for one block of lanes; writes residuals or adds up their cost.

Follows the motion through rotors, body, AHRS and IMU, and compares it with what was measured, one pass over time.
The march is kept whole because it is the order of events within a step.
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb

from quadid.model.body_kernel import (
    step_air,
    step_air_solid,
    step_full,
    step_hub,
    step_hub_solid,
    step_rare,
    step_solid,
)
from quadid.model.compare_kernel import collect, compare, compare_motion, settle
from quadid.model.kernel import Flight, body_constants, copy, flight_factors, load_payload, step_core, step_core_shared
from quadid.model.lag_kernel import rotor_constants
from quadid.model.needs_kernel import Needs
from quadid.model.residual_kernel import N_SIGNALS, residual_coefficients, residual_forces, residual_signals
from quadid.model.rotor_kernel import PLAIN_MOMENTS, Drive, input_constants, rotors_start, rotors_step, spread_moments
from quadid.types import FloatArray, IntArray

# isort: off
from quadid.model.work_array import (
    A_G, ALL_MOMENTS, E_QW, E_QX, E_QY, E_QZ, F1_X, HALF, N_ROWS, N_STATE, ROTOR, S_FX, X_P, X_QW, X_QX, X_QY, X_QZ,
)  # fmt: skip
from quadid.model.sensor_kernel import (
    delay_attitude, distort_imu, remember_attitude, sensor_constants, start_filter, step_filter, step_tilt_error,
    tilt_attitude, use_filter,
)  # fmt: skip

# isort: on
from quadid.model.simd import LANES, SOURCES, cache_aligned, cached, jit, lane_kernel


@nb.njit(**jit)
def _start(seg: int, x0: FloatArray, dx: FloatArray, s: FloatArray) -> None:
    """Sets lane states from the initial state x0[seg] (13,) and each lane's tangent offset dx (12, LANES)."""
    lane_kernel()
    q0, q1, q2, q3 = x0[seg, 0], x0[seg, 1], x0[seg, 2], x0[seg, 3]
    for lane in range(LANES):
        a, b, c = 0.5 * dx[0, lane], 0.5 * dx[1, lane], 0.5 * dx[2, lane]
        w = 1.0 / math.sqrt(1.0 + a * a + b * b + c * c)
        a, b, c = a * w, b * w, c * w
        s[X_QW + lane] = q0 * w - q1 * a - q2 * b - q3 * c
        s[X_QX + lane] = q0 * a + q1 * w + q2 * c - q3 * b
        s[X_QY + lane] = q0 * b - q1 * c + q2 * w + q3 * a
        s[X_QZ + lane] = q0 * c + q1 * b - q2 * a + q3 * w
    for i in range(9):
        for lane in range(LANES):
            s[X_P + i * LANES + lane] = x0[seg, 4 + i] + dx[3 + i, lane]
    for lane in range(LANES):
        s[E_QW + lane], s[E_QX + lane], s[E_QY + lane], s[E_QZ + lane] = 1.0, 0.0, 0.0, 0.0


@nb.njit(**jit)
def _settle_force(s: FloatArray) -> None:
    """Without a step before it, the first mean force is that of the first half step."""
    for i in range(3 * LANES):
        s[S_FX + i] = s[F1_X + i]


def _on_disk(sources: int) -> Any:
    @nb.njit(**cached)
    def roll_segments(
        drive: Drive, terms: IntArray, flight: Flight, table: FloatArray,
        measured: FloatArray, scale: FloatArray, memory: int, starts: IntArray, n_pre: int, x0: FloatArray,
        theta: FloatArray, dx: FloatArray, need: Needs, channels: int, n_seg: int, sums: bool, basis: FloatArray,
        out: FloatArray, ends: FloatArray, cost: FloatArray,
    ) -> None:  # fmt: skip
        """Rolls one block of lanes through all segments of one window.

        Each segment starts from its own initial state, `n_pre` steps before its first scored sample, and ends one step
        after the last, because a logged acceleration is the mean over one sample centred on its time.  Rotor speeds do
        not depend on the vehicle's state; they run through, or begin `memory` rows before a segment that comes later
        than that.

        Args:
            drive: rotor input of the window.
            terms: beyond the catalogue, (terms, 4), see `residual_kernel.residual_forces`.
            flight: numbers of the window.
            table: moments that all lanes share, see `rotor_table`; not read unless `need.shared`.
            measured: (n, 16), see `compare`.
            scale: (n, channels), factor on residuals: 1 where measured, else 0; or weights.
            memory: rows after which rotors have forgotten how they began.
            starts: first scored row of each segment, rising; rows start - n_pre to start + n_seg must exist.
            n_pre: steps rolled before the first scored row, at least 1.
            x0: initial state at start - n_pre, (segments, 13).
            theta: parameter vectors (LANES, size).
            dx: tangent offsets of the initial state (12, LANES).
            need: which parts of the model any lane needs.
            channels: 9, 12 with velocity, 15 with position too.
            n_seg: scored rows a segment.
            sums: add up the cost of the residuals instead of writing them.
            basis: see `collect`; read for sums.
            out: residuals (segments, n_seg, channels * LANES), written; for sums work space (1, 1, channels * LANES).
            ends: states one step after the last scored row (segments, 13, LANES), written unless for sums.
            cost: (LANES,), added to for sums.
        """
        _ = sources
        rotors, dt = len(drive.geometry), flight.dt
        s = cache_aligned(N_ROWS * LANES)
        s[:] = 0.0
        s[A_G : A_G + 2 * LANES] = 1.0  # the factors of thrust and mass stay 1 unless asked for
        s[A_G + HALF : A_G + HALF + 2 * LANES] = 1.0
        rot = cache_aligned(rotors * ROTOR).reshape(rotors, ROTOR)
        ahead = cache_aligned(rotors * ROTOR).reshape(rotors, ROTOR)
        steps = n_pre + n_seg
        past = cache_aligned(steps * 7 * LANES if need.att_delay else 0).reshape(-1, 7, LANES)
        total = cache_aligned(LANES)
        inside = cache_aligned(basis.shape[2] * LANES).reshape(basis.shape[2], LANES)
        total[:] = 0.0
        inside[:] = 0.0
        body_constants(theta, flight, rotors, s)
        input_constants(theta, s)
        sensor_constants(theta, dt, s)
        rotor_constants(theta, dt, rot, s)
        coefficients = cache_aligned(len(terms) * LANES).reshape(len(terms), LANES)
        signals = cache_aligned(N_SIGNALS * LANES).reshape(N_SIGNALS, LANES)
        residual_coefficients(theta, rotors, coefficients)
        turned = max(starts[0] - n_pre - memory, 0)  # rotor steps already taken
        rotors_start(drive, turned, need, rot, s)
        for seg in range(len(starts)):
            first = starts[seg] - n_pre
            following = starts[seg + 1] - n_pre if seg + 1 < len(starts) else -1
            if not need.shared:
                if turned > first:
                    copy(ahead, rot)
                elif first - turned > memory:  # what they did before is forgotten
                    turned = first - memory
                    rotors_start(drive, turned, need, rot, s)
                for k in range(turned, first):  # rows no segment covers: rotors still turn
                    rotors_step(drive, k, need, rot, s)
                turned = first + steps
            _start(seg, x0, dx, s)
            for i in range(steps):
                k = first + i
                if need.shared:
                    if need.full:
                        spread_moments(table, k, ALL_MOMENTS if need.hub else PLAIN_MOMENTS, s)
                else:
                    if k == following:
                        copy(rot, ahead)
                    rotors_step(drive, k, need, rot, s)
                if need.factors:
                    flight_factors(flight.t0 + dt * k, flight.span0, flight.span1, dt, s)
                if need.payload:
                    load_payload(flight.t0 + dt * k, dt, theta, s)
                if need.att_delay:
                    remember_attitude(i, s, past)
                scored = i >= n_pre
                at, row = (0, 0) if sums else (seg, i - n_pre)
                if scored and channels > 9:
                    compare_motion(at, row, k, measured, scale, s, out)
                if need.learned:
                    residual_signals(s, signals)
                    residual_forces(terms, coefficients, signals, i == 0, s)
                # This step gives the second half of the accelerometer's mean at t_k; the step before, the first.
                if need.rare and need.solid:
                    step_full(dt, s)
                elif need.rare:
                    step_rare(dt, s)
                elif need.hub and need.solid:
                    step_hub_solid(dt, s)
                elif need.hub:
                    step_hub(dt, s)
                elif need.air and need.solid:
                    step_air_solid(dt, s)
                elif need.air:
                    step_air(dt, s)
                elif need.solid:
                    step_solid(dt, s)
                elif need.shared:
                    step_core_shared(dt, table, k, s)
                else:
                    step_core(dt, s)
                if i == 0:
                    _settle_force(s)
                if need.imu_lag:
                    if i == 0:
                        start_filter(dt, s)
                    else:
                        step_filter(dt, s)
                    use_filter(s)
                if scored:
                    if need.ahrs:
                        step_tilt_error(s)
                    if need.att_delay:
                        delay_attitude(i, dt, past, s)
                    if need.ahrs:
                        tilt_attitude(s)
                    if need.imu_static:
                        distort_imu(s)
                    compare(at, row, k, measured, scale, s, out)
                    if sums:
                        collect(seg, i - n_pre, basis, out, total, inside, channels)
            if sums:
                settle(total, inside, cost)
            else:
                for c in range(N_STATE):
                    for lane in range(LANES):
                        ends[seg, c, lane] = s[X_QW + c * LANES + lane]

    return roll_segments


roll_segments = _on_disk(SOURCES)
