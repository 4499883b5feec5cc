"""Clock, sensors and events of the closed loop, and the way through a step: what `march` calls.

Within one step the order is that of a real autopilot: sensors are read, the stabiliser computes, the command leaves.
Whatever is logged at an instant is therefore the value just before the command of that instant acts.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.signal import butter, cont2discrete, lfilter, lfiltic

from quadid.flight.airframe import (
    STATES,
    Air,
    Body,
    Drive,
    Oddity,
    advance,
    kernel,
    load_input,
    orthonormalise,
    spin_up_kick,
)
from quadid.types import FloatArray

SUPPLY_FALL = 0.15
"""Share of its mean that the supply voltage loses over a flight in which it matters …"""
SUPPLY_DIP = 0.04
"""… and what the battery's resistance takes from it in hover: 10 milliohm and 45 A of a pack of 11 V."""
NO_TIME = 1e300
EPSILON = 1e-11


class Plan(NamedTuple):
    """Clock of a flight.

    Attributes:
        steps: number of steps; dt: length of a step [s]; start: time of the first step [s].
        control_every, pilot_every, log_every: steps between stabiliser, pilot and log instants.
        first_log: step of the first log row; rows: number of rows.
    """

    steps: int
    dt: float
    start: float
    control_every: int
    pilot_every: int
    log_every: int
    first_log: int
    rows: int


class OnBoard(NamedTuple):
    """Sensor errors the stabiliser sees, too.

    Attributes:
        gyro_matrix, gyro_bias: measured = matrix true + bias.
        accel_matrix, accel_bias: the same of the accelerometer.
        pull: gain k of the attitude filter towards the accelerometer's tilt [1/s].
        gyro_shake, accel_shake: rms of vibration in hover [rad/s], [m/s^2]; shake_mode: see `shake`.
    """

    gyro_matrix: FloatArray
    gyro_bias: FloatArray
    accel_matrix: FloatArray
    accel_bias: FloatArray
    pull: float
    gyro_shake: float
    accel_shake: float
    shake_mode: FloatArray


class Events(NamedTuple):
    """Events at some time, or over time; fractions are losses.

    Attributes:
        mass_time, mass_fraction: mass grows by the fraction.
        drop_time, drop_fraction: all rotors lose thrust and drag torque.
        sag_fraction, sag_start, sag_end: linear loss from start to end.
        supply_exponent: commands act times (voltage / its mean) to this.
        faint_rotor: rotor that fails now and then (-1: none); faint_share: thrust lost meanwhile;
            faint_times: shape (k, 2), start and end [s].
    """

    mass_time: float
    mass_fraction: float
    drop_time: float
    drop_fraction: float
    sag_fraction: float
    sag_start: float
    sag_end: float
    supply_exponent: float
    faint_rotor: int
    faint_share: float
    faint_times: FloatArray


class Track(NamedTuple):
    """Output of the loop.

    At every step: `gyro` body rates with vibration (k, 3), `accel` running integral of the specific force at the IMU
    (k, 3), `attitude` quaternion of the AHRS without noise (k, 4), both before the step's command acts.  At every
    control instant: `command` (c, n).  At every log row: `state` (rows, 33), `rotor` (rows, n), `reference` (rows, 4).
    """

    gyro: FloatArray
    accel: FloatArray
    attitude: FloatArray
    command: FloatArray
    state: FloatArray
    rotor: FloatArray
    reference: FloatArray


@kernel
def quaternion_of(m: FloatArray, out: FloatArray) -> None:
    """Writes the unit quaternion (w >= 0) of rotation matrix `m` (3, 3) into `out`, by the largest component."""
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    if trace > 0.0:
        s = 2.0 * np.sqrt(1.0 + trace)
        out[0], out[1] = 0.25 * s, (m[2, 1] - m[1, 2]) / s
        out[2], out[3] = (m[0, 2] - m[2, 0]) / s, (m[1, 0] - m[0, 1]) / s
    else:
        i = 0
        if m[1, 1] > m[0, 0]:
            i = 1
        if m[2, 2] > m[i, i]:
            i = 2
        j, k = (i + 1) % 3, (i + 2) % 3
        s = 2.0 * np.sqrt(max(1.0 + m[i, i] - m[j, j] - m[k, k], 1e-12))
        sign = 1.0 if m[k, j] >= m[j, k] else -1.0
        out[0] = sign * (m[k, j] - m[j, k]) / s
        out[1 + i] = sign * 0.25 * s
        out[1 + j] = sign * (m[j, i] + m[i, j]) / s
        out[1 + k] = sign * (m[k, i] + m[i, k]) / s


@kernel
def turned(m: FloatArray, angle: FloatArray, out: FloatArray) -> None:
    """Writes m exp([angle]x) into `out`: attitude `m` seen with a small body-frame rotation error [rad] (Rodrigues)."""
    x, y, z = angle[0], angle[1], angle[2]
    square = x * x + y * y + z * z
    size = np.sqrt(square)
    a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
    if size > 1e-4:
        a, b = np.sin(size) / size, (1.0 - np.cos(size)) / square
    for i in range(3):
        u, v, w = m[i, 0], m[i, 1], m[i, 2]
        along = u * x + v * y + w * z
        out[i, 0] = u + a * (v * z - w * y) + b * (along * x - square * u)
        out[i, 1] = v + a * (w * x - u * z) + b * (along * y - square * v)
        out[i, 2] = w + a * (u * y - v * x) + b * (along * z - square * w)


@kernel
def shake(phase: FloatArray, omega: FloatArray, mode: FloatArray, hover: float, out: FloatArray) -> None:
    """Vibration of the six IMU axes with unit rms in hover: every rotor's imbalance, growing with speed squared.

    Args:
        phase: angle of each rotor [rad].
        omega: rotor speeds [rad/s].
        mode: sine and cosine share of each axis and rotor, shape (6, rotors, 2).
        hover: rotor speed in hover [rad/s].
        out: shape (6,), written.
    """
    out[:] = 0.0
    gain = np.sqrt(2.0 / omega.shape[0]) / (hover * hover)
    for i in range(omega.shape[0]):
        strength = gain * omega[i] * omega[i]
        sine, cosine = strength * np.sin(phase[i]), strength * np.cos(phase[i])
        for axis in range(6):
            out[axis] += mode[axis, i, 0] * sine + mode[axis, i, 1] * cosine


@kernel
def pull_attitude(error: FloatArray, estimate: FloatArray, force: FloatArray, amount: float) -> None:
    """Turns the attitude filter's world-frame error towards the accelerometer's idea of down.

    With n = -f/|f| (down, by the accelerometer) and d the estimate's down, both in body axes, a complementary filter
    adds k (n x d) to its body rate.  Seen from the world the error matrix turns by R_hat k (n x d) dt.

    Args:
        error: E in R_hat = E R, nine numbers; in place.
        estimate: R_hat, shape (3, 3).
        force: measured specific force [m/s^2].
        amount: k dt.
    """
    size = np.sqrt(force[0] * force[0] + force[1] * force[1] + force[2] * force[2])
    if size < 1e-6:
        return
    n_x, n_y, n_z = -force[0] / size, -force[1] / size, -force[2] / size
    d_x, d_y, d_z = estimate[2, 0], estimate[2, 1], estimate[2, 2]
    e_x, e_y, e_z = n_y * d_z - n_z * d_y, n_z * d_x - n_x * d_z, n_x * d_y - n_y * d_x
    w_x = amount * (estimate[0, 0] * e_x + estimate[0, 1] * e_y + estimate[0, 2] * e_z)
    w_y = amount * (estimate[1, 0] * e_x + estimate[1, 1] * e_y + estimate[1, 2] * e_z)
    w_z = amount * (estimate[2, 0] * e_x + estimate[2, 1] * e_y + estimate[2, 2] * e_z)
    for j in range(3):
        a, b, c = error[j], error[3 + j], error[6 + j]
        error[j] = a + w_y * c - w_z * b
        error[3 + j] = b + w_z * a - w_x * c
        error[6 + j] = c + w_x * b - w_y * a
    orthonormalise(error, 0)


@kernel
def power_at(t: float, after_drop: bool, events: Events) -> float:
    """Factor on thrust and drag torque of all rotors at time t [s]."""
    factor = 1.0
    if after_drop:
        factor -= events.drop_fraction
    if events.sag_fraction != 0.0:
        part = (t - events.sag_start) / (events.sag_end - events.sag_start)
        factor *= 1.0 - events.sag_fraction * min(max(part, 0.0), 1.0)
    return factor


@kernel
def supply(t: float, omega: FloatArray, hover: float, events: Events) -> float:
    """Supply voltage over its mean in hover at time t [s]: it falls in a straight line and dips with the rotors' power.

    Args:
        omega: rotor speeds [rad/s].
        hover: hover speed [rad/s]; power goes with the cube of speed.
    """
    part, load = (t - events.sag_start) / (events.sag_end - events.sag_start), 0.0
    for i in range(omega.shape[0]):
        load += (omega[i] / hover) ** 3 / omega.shape[0]
    return 1.0 + SUPPLY_FALL * (0.5 - min(max(part, 0.0), 1.0)) - SUPPLY_DIP * (load - 1.0)


@kernel
def efficiencies(base: FloatArray, memory: FloatArray, drive: Drive, events: Events, t: float, out: FloatArray) -> None:
    """Writes the factors on thrust and drag torque of every rotor at time t, shape (n, 2)."""
    for i in range(base.shape[0]):
        out[i, 0] = base[i, 0] * (1.0 + drive.hysteresis * memory[i])
        out[i, 1] = base[i, 1]
    if events.faint_rotor >= 0:
        for k in range(events.faint_times.shape[0]):
            if events.faint_times[k, 0] <= t < events.faint_times[k, 1]:
                out[events.faint_rotor, 0] *= 1.0 - events.faint_share
                out[events.faint_rotor, 1] *= 1.0 - events.faint_share


class Progress(NamedTuple):
    """Record of the way.

    Attributes:
        head: first command that has not reached the rotors.
        ramp_end: when the present ramp of the input ends [s].
        changed: 0 before, 1 after `mass_change`; dropped: after `thrust_drop`.
    """

    head: int
    ramp_end: float
    changed: int
    dropped: bool


BEGUN = Progress(0, NO_TIME, 0, False)


class Turning(NamedTuple):
    """Rotors on their way, changed in place, and room for a step.

    Attributes:
        speed: [rad/s], shape (n,); level, slope: present input and its rate.
        memory: direction of the last change of the input; phase: angle of each rotor [rad].
        efficiency: present factors on thrust and drag torque, (n, 2).
        work: scratch, see `advance`.
    """

    speed: FloatArray
    level: FloatArray
    slope: FloatArray
    memory: FloatArray
    phase: FloatArray
    efficiency: FloatArray
    work: FloatArray


def turning_at(speed: FloatArray, efficiency: FloatArray) -> Turning:
    """Rotors that have turned steadily at `speed` [rad/s], shape (n,)."""
    n = len(speed)
    work = np.zeros((5, max(STATES, n)))
    return Turning(speed, speed.copy(), np.zeros(n), np.zeros(n), np.zeros(n), efficiency.copy(), work)


@kernel
def fly_on(
    left: float, end: float, issued: int, progress: Progress, commands: FloatArray, arrival: FloatArray,
    efficiency: FloatArray, push: FloatArray, body: Body, air: Air, odd: Oddity, drive: Drive, events: Events,
    y: FloatArray, rotors: Turning,
) -> Progress:  # fmt: skip
    """Flies from time `left` to `end` [s], cut wherever something jumps: commands, ramps, mass, thrust.

    Args:
        issued: number of commands given so far.
        commands: (at least issued, n) [rad/s].
        arrival: when each reaches the rotors [s], non-decreasing.
        efficiency: factors on thrust and drag torque, shape (n, 2).
        push: disturbance, see `airframe.derivative`.
        y: state, shape (33,); in place.
        rotors: in place.
    """
    head, ramp_end, changed, dropped = progress
    omega, n, powers = rotors.speed, rotors.speed.shape[0], np.ones(3)
    while end - left > EPSILON:
        # What is due takes effect: the end of a ramp, then every command that has reached the rotors.
        if ramp_end <= left + EPSILON:
            rotors.slope[:] = 0.0
            ramp_end = NO_TIME
        boost = 1.0
        if events.supply_exponent != 0.0:
            boost = supply(left, omega, air.hover_sum / n, events) ** events.supply_exponent
        while head < issued and arrival[head] <= left + EPSILON:
            before, after = 0.0, 0.0
            for i in range(n):
                before += body.spins[i] * omega[i]
            load_input(drive, commands[head], boost, rotors.level, rotors.slope, rotors.memory)
            if drive.ramp > 0.0:
                ramp_end = arrival[head] + drive.ramp
            elif drive.tau == 0.0 and drive.slew == 0.0:
                for i in range(n):
                    omega[i] = rotors.level[i]
                    after += body.spins[i] * omega[i]
                if body.spin_up != 0.0:
                    spin_up_kick(y, after - before, changed, body)
            head += 1
        if events.mass_time <= left + EPSILON:
            changed = 1
        if events.drop_time <= left + EPSILON:
            dropped = True
        # As far as nothing else jumps.
        stop = min(end, ramp_end)
        if head < issued:
            stop = min(stop, arrival[head])
        if changed == 0:
            stop = min(stop, events.mass_time)
        if not dropped:
            stop = min(stop, events.drop_time)
        h = end - left if end - stop < EPSILON else stop - left
        if drive.hysteresis != 0.0 or events.faint_rotor >= 0:
            efficiencies(efficiency, rotors.memory, drive, events, left, rotors.efficiency)
        for i in range(3):
            powers[i] = power_at(left + 0.5 * i * h, dropped, events)
        for i in range(n):
            rotors.phase[i] += 0.5 * h * omega[i]
        mass_factor = 1.0 + events.mass_fraction if changed == 1 else 1.0
        advance(
            y, omega, rotors.level, rotors.slope, rotors.efficiency, powers, mass_factor, changed, push, drive, body,
            air, odd, h, rotors.work,
        )  # fmt: skip
        for i in range(n):
            rotors.phase[i] += 0.5 * h * omega[i]
        left += h
    return Progress(head, ramp_end, changed, dropped)


# --- Measured and logged signals: noise, vibration, telemetry filters, sampling at the log rate
#
# Gyro, attitude, velocity and position are instants at t; acceleration is the mean over one sample centred on t.


@dataclass(frozen=True)
class SensorNoise:
    """One-sigma noise of MEMS sensors on a small multirotor.

    Attributes:
        gyro: white, a sample [rad/s].
        accel: white, on the mean over a 20 ms sample [m/s^2].
        attitude: white [rad] per axis.
        attitude_slow: slowly coloured [rad] per axis, correlation time `attitude_time` [s] (first-order Gauss-Markov).
        gyro_shake, accel_shake: rms of vibration at rotor frequency in hover [rad/s], [m/s^2], before sampling.
        velocity [m/s], position [m], battery [V]: white.
    """

    gyro: float = 0.02
    accel: float = 0.2
    attitude: float = 0.003
    attitude_slow: float = 0.004
    attitude_time: float = 1.0
    gyro_shake: float = 0.005
    accel_shake: float = 0.5
    velocity: float = 0.05
    position: float = 0.02
    battery: float = 0.02

    def scaled(self, factor: float) -> "SensorNoise":
        """Returns the same noise `factor` times as large."""
        return SensorNoise(
            **{name: value if name == "attitude_time" else value * factor for name, value in vars(self).items()}
        )


def coloured(rng: np.random.Generator, n: int, sigma: float, time: float, dt: float) -> FloatArray:
    """First-order Gauss-Markov noise, stationary from the first sample; shape (n, 3)."""
    pole = float(np.exp(-dt / time))
    drive = rng.standard_normal((n, 3))
    drive[1:] *= np.sqrt(1.0 - pole**2)
    return np.asarray(sigma * lfilter([1.0], [1.0, -pole], drive, axis=0))


def butterworth(signal: FloatArray, cutoff: float, dt: float) -> FloatArray:
    """Second-order Butterworth low-pass of a continuous signal known at steps of dt, linear in between (exact).

    Args:
        signal: shape (n, k); assumed constant at its first value before.
        cutoff: [Hz].
        dt: step [s].
    """
    numerator, denominator = butter(2, 2.0 * np.pi * cutoff, analog=True)
    matrix, bottom, _ = cont2discrete((numerator, denominator), dt, method="foh")
    top = np.ravel(matrix)
    columns = []
    for column in signal.T:
        start = lfiltic(top, bottom, np.full(2, column[0]), np.full(2, column[0]))
        columns.append(lfilter(top, bottom, column, zi=start)[0])
    return np.column_stack(columns)


def attitude_at(track: Track, steps: FloatArray) -> FloatArray:
    """AHRS attitude at fractional step numbers, normalised linear interpolation; shape (n, 4)."""
    steps = np.clip(steps, 0.0, len(track.attitude) - 1.0)
    low = np.minimum(np.floor(steps).astype(np.int64), len(track.attitude) - 2)
    part = (steps - low)[:, None]
    a, b = track.attitude[low], track.attitude[low + 1]
    b = np.where(np.einsum("ij,ij->i", a, b)[:, None] < 0.0, -b, b)
    q = a if not part.any() else (1.0 - part) * a + part * b
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))


def rows_at(values: FloatArray, steps: FloatArray) -> FloatArray:
    """Rows of `values` at fractional step numbers, linear in between."""
    steps = np.clip(steps, 0.0, len(values) - 1.0)
    low = np.minimum(np.floor(steps).astype(np.int64), len(values) - 2)
    part = (steps - low)[:, None]
    return values[low] if not part.any() else (1.0 - part) * values[low] + part * values[low + 1]


def log_steps(plan: Plan) -> FloatArray:
    """Step numbers of the log rows, as floats."""
    return plan.first_log + plan.log_every * np.arange(plan.rows, dtype=np.float64)


def read_gyro(track: Track, plan: Plan, on_board: OnBoard, cutoff: float, steps: FloatArray) -> FloatArray:
    """Gyro without white noise at the given steps, shape (rows, 3) [rad/s]."""
    rates = butterworth(track.gyro, cutoff, plan.dt) if np.isfinite(cutoff) else track.gyro
    return np.asarray(rows_at(rates, steps) @ on_board.gyro_matrix.T + on_board.gyro_bias)


def read_accel(track: Track, plan: Plan, on_board: OnBoard, cutoff: float, steps: FloatArray) -> FloatArray:
    """Accelerometer without white noise: mean over one sample centred on the given steps, shape (rows, 3) [m/s^2]."""
    running = track.accel
    if np.isfinite(cutoff):
        filtered = butterworth(np.diff(running, axis=0), cutoff, plan.dt)
        running = np.vstack([np.zeros(3), np.cumsum(filtered, axis=0)])
    half = 0.5 * plan.log_every
    mean = (rows_at(running, steps + half) - rows_at(running, steps - half)) / (plan.log_every * plan.dt)
    return np.asarray(mean @ on_board.accel_matrix.T + on_board.accel_bias)
