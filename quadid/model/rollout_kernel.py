"""Segment loop of the rollout: every segment for one block of lanes, to residuals or their cost."""

import math

import numba as nb

from quadid.model.body_kernel import (
    N_SIGNALS,
    residual_coefficients,
    residual_forces,
    residual_signals,
    step_in_air,
    step_solid,
)
from quadid.model.kernel import (
    Flight,
    Needs,
    body_constants,
    copy,
    flight_factors,
    load_payload,
    step_core,
    step_core_shared,
)
from quadid.model.rotor_kernel import (
    PLAIN_MOMENTS,
    Drive,
    input_constants,
    rotor_constants,
    rotors_start,
    rotors_step,
    spread_moments,
)
from quadid.model.simd import LANES, cache_aligned, cached, inlined, jit, lane_kernel
from quadid.types import FloatArray, IntArray

# isort: off
from quadid.model.sensor_kernel import (
    delay_attitude,
    distort_imu,
    remember_attitude,
    sensor_constants,
    start_filter,
    step_filter,
    step_tilt_error,
    tilt_attitude,
    use_filter,
)

# isort: on
# isort: off
from quadid.model.simd import (
    ALL_MOMENTS, A_G, C_VEL, C_VEL_Z, E_QW, E_QX, E_QY, E_QZ, F1_X, HALF, N_ROWS, N_STATE, ROTOR, S_FX, S_FY, S_FZ, S_P,
    S_Q, S_QW, S_QX, S_QY, S_QZ, S_R, X_N, X_P, X_QW, X_QX, X_QY, X_QZ, X_VN,
)  # fmt: skip
# isort: on

# --- What was simulated against what was measured: residuals of a sample, and their cost for one segment
#
# Channels are written out one by one: a short loop over them would be unrolled first and then never be vectorised.


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
    """Work of `collect` for channels c, c + 1 and c + 2."""
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


# --- Segment loop of the rollout: simulates every segment for one block of lanes; writes residuals or adds up their
# cost
#
# Follows the motion through rotors, body, AHRS and IMU, and compares it with what was measured, one pass over time.
# The march is kept whole because it is the order of events within a step.


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


@cached
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
        terms: beyond the catalogue, (terms, 4), see `body_kernel.residual_forces`.
        table: moments that all lanes share, see `rotor_table`; not read unless `need.shared`.
        measured: (n, 16), see `compare`.
        scale: (n, channels), factor on residuals: 1 where measured, else 0; or weights.
        memory: rows after which rotors have forgotten how they began.
        starts: first scored row of each segment, rising; rows start - n_pre to start + n_seg must exist.
        n_pre: steps rolled before the first scored row, at least 1.
        x0: initial state at start - n_pre, (segments, 13).
        theta: parameter vectors (LANES, size).
        dx: tangent offsets of the initial state (12, LANES).
        channels: 9, 12 with velocity, 15 with position too.
        n_seg: scored rows a segment.
        sums: add up the cost of the residuals instead of writing them.
        basis: see `collect`; read for sums.
        out: residuals (segments, n_seg, channels * LANES), written; for sums work space (1, 1, channels * LANES).
        ends: states one step after the last scored row (segments, 13, LANES), written unless for sums.
        cost: (LANES,), added to for sums.
    """
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
            if need.air:
                step_in_air(need, dt, s)
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
