"""From command to rotor speed, and one exact-in-time Runge-Kutta step of the whole vehicle.

Between two changes of the command every rotor speed is known in closed form (a straight line, or the first-order
response to one), so only the airframe is integrated numerically and no step ever straddles a jump.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quadid.flight.airframe import RIGID_STATES, STATES, Air, Body, Oddity, derivative, orthonormalise, rotor_wrench
from quadid.flight.jit import kernel
from quadid.types import FloatArray


class Drive(NamedTuple):
    """The way from command to rotor speed.

    Attributes:
        tau: first-order lag [s]; 0 for none.
        tau_down: the same while slowing [s].
        ramp: time in which the input moves to a new command [s]; 0 steps (held commands).
        slew: largest rate of rotor speed [rad/s^2]; 0 for no limit.
        knee: speed above which the rotors only follow a share of the command [rad/s]; 0 for none.
        above_knee: that share.
        grain: commands are rounded to multiples of this [rad/s]; 0 for none.
        hysteresis: thrust is (1 +- hysteresis) after the last change was up or down.
    """

    tau: float
    tau_down: float
    ramp: float
    slew: float = 0.0
    knee: float = 0.0
    above_knee: float = 1.0
    grain: float = 0.0
    hysteresis: float = 0.0


WITHOUT_LAG = Drive(0.0, 0.0, 0.0)


@kernel
def rotor_speed(
    omega: FloatArray, level: FloatArray, slope: FloatArray, drive: Drive, s: float, out: FloatArray
) -> None:
    """Evaluates rotor speeds after time s of one piece of input.

    Solves tau omega' = u - omega with u(s) = level + slope s:
    omega(s) = u(s) - slope tau + (omega(0) - level + slope tau) exp(-s / tau).  The lag is that of the way in which
    the rotor turns at the start of the piece; a command that ramps past it within the piece is not cut there.

    Args:
        omega: speeds at s = 0 [rad/s], shape (n,).
        level: input at s = 0 [rad/s].
        slope: its rate [rad/s^2].
        drive: lags; 0 makes the speed equal to the input.
        s: time since the start of the piece [s].
        out: speeds, written.
    """
    if s == 0.0:
        for i in range(omega.shape[0]):
            out[i] = omega[i]
    elif drive.tau > 0.0:
        for i in range(omega.shape[0]):
            tau = drive.tau if level[i] >= omega[i] else drive.tau_down
            fade = np.exp(-s / tau)
            lag = slope[i] * tau
            out[i] = level[i] + slope[i] * s - lag + (omega[i] - level[i] + lag) * fade
    else:
        for i in range(omega.shape[0]):
            out[i] = level[i] + slope[i] * s


@kernel
def load_input(
    drive: Drive, goal: FloatArray, boost: float, level: FloatArray, slope: FloatArray, memory: FloatArray
) -> None:
    """Starts a new piece of input towards a command that has just reached the rotors.

    Args:
        drive: lag, ramp, limits.
        goal: the command [rad/s], shape (n,).
        boost: factor of the supply voltage on it.
        level: present input on entry, input at the start of the piece on return [rad/s].
        slope: rate of the input [rad/s^2]; written.
        memory: +1 or -1, direction of the last change, shape (n,); written.
    """
    for i in range(goal.shape[0]):
        target = boost * goal[i]
        if drive.grain > 0.0:
            target = np.rint(target / drive.grain) * drive.grain
        if drive.knee > 0.0 and target > drive.knee:
            target = drive.knee + drive.above_knee * (target - drive.knee)
        if target != level[i]:
            memory[i] = 1.0 if target > level[i] else -1.0
        if drive.ramp > 0.0:
            slope[i] = (target - level[i]) / drive.ramp
        else:
            level[i] = target
            slope[i] = 0.0


@kernel
def limit_slew(drive: Drive, omega: FloatArray, level: FloatArray, slope: FloatArray, h: float) -> None:
    """Replaces the piece over the next step by one that respects the slew limit (first-order accurate in h)."""
    for i in range(omega.shape[0]):
        wish = level[i] + slope[i] * h
        step = min(max(wish - omega[i], -drive.slew * h), drive.slew * h)
        level[i] = omega[i]
        slope[i] = step / h


@kernel
def spin_up_torque(
    omega: FloatArray, level: FloatArray, slope: FloatArray, drive: Drive, s: float, body: Body
) -> float:
    """Torque J dOmega_r/dt [N m] at time s of a piece, where the speeds are `omega`; zero when J is zero."""
    if body.spin_up == 0.0:
        return 0.0
    rate = 0.0
    for i in range(omega.shape[0]):
        change = slope[i]
        if drive.tau > 0.0:
            behind = level[i] + slope[i] * s - omega[i]
            change = behind / (drive.tau if behind >= 0.0 else drive.tau_down)
        rate += body.spins[i] * change
    return body.spin_up * rate


@kernel
def advance(
    y: FloatArray, omega: FloatArray, level: FloatArray, slope: FloatArray, efficiency: FloatArray, powers: FloatArray,
    mass_factor: float, changed: int, push: FloatArray, drive: Drive, body: Body, air: Air, odd: Oddity, h: float,
    work: FloatArray,
) -> None:  # fmt: skip
    """Moves the vehicle by h with the classical Runge-Kutta scheme of order four; the input has no jump inside.

    Args:
        y: state of `airframe`, in place.
        omega: rotor speeds [rad/s], in place.
        level: input at the start of the step [rad/s]; moves along.
        slope: its rate [rad/s^2].
        efficiency: factors on thrust and drag torque, shape (n, 2).
        powers: factor on thrust at the start, middle and end, shape (3,).
        mass_factor: present mass / original mass.
        changed: 0 before, 1 after `mass_change`.
        push: outside disturbance, see `airframe.derivative`.
        h: step [s].
        work: scratch, shape (at least 5, max(33, n)).
    """
    rotors = omega.shape[0]
    states = STATES if odd.dynamic else RIGID_STATES
    total, k, probe, wrench = work[0], work[1], work[2], work[3]
    speed = work[4, :rotors]
    lags = drive
    if drive.slew > 0.0:
        limit_slew(drive, omega, level, slope, h)
        lags = WITHOUT_LAG
    steady = lags.tau == 0.0 and drive.ramp == 0.0 and drive.slew == 0.0
    for i in range(states):
        total[i] = 0.0
        probe[i] = y[i]
    # One call site for each kernel below, so that the compiler can take them in.
    for stage in range(4):
        s = 0.5 * h * ((stage + 1) // 2)
        if stage == 0 or (stage != 2 and not steady):
            rotor_speed(omega, level, slope, lags, s, speed)
            rotor_wrench(speed, efficiency, changed, body, wrench)
            wrench[6] = spin_up_torque(speed, level, slope, lags, s, body)
        derivative(probe, speed, wrench, powers[(stage + 1) // 2], mass_factor, changed, push, body, air, odd, k)
        weight = h / 6.0 if stage == 0 or stage == 3 else h / 3.0
        reach = h if stage == 2 else 0.5 * h
        for i in range(states):
            total[i] += weight * k[i]
            probe[i] = y[i] + reach * k[i]
    for i in range(states):
        y[i] += total[i]
    orthonormalise(y, 6)
    for i in range(rotors):
        omega[i] = speed[i]
        level[i] += slope[i] * h


@kernel
def spin_up_kick(y: FloatArray, jump: float, changed: int, body: Body) -> None:
    """Applies the impulse of a sudden change of Omega_r: J nu jumps by (0, 0, J_spin_up jump).

    The accelerometer's integral receives the matching velocity jump at the IMU.

    Args:
        y: state, in place.
        jump: change of Omega_r [rad/s].
        changed: selects the inertia.
    """
    impulse = body.spin_up * jump
    inverse = body.inverse[changed]
    d_p, d_q, d_r = inverse[0, 2] * impulse, inverse[1, 2] * impulse, inverse[2, 2] * impulse
    y[15] += d_p
    y[16] += d_q
    y[17] += d_r
    x, z = body.imu[changed, 0], body.imu[changed, 2]
    y[18] += d_q * z - d_r * body.imu[changed, 1]
    y[19] += d_r * x - d_p * z
    y[20] += d_p * body.imu[changed, 1] - d_q * x
