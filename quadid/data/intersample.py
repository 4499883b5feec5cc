"""Course of a held command within its samples where feedback that is faster than the log drives it.

A flight controller acts some hundred times a second; a log at 50 Hz keeps what its commands were on average over each
sample.  Within the sample they follow the feedback: the angular acceleration about an axis runs on at the slope
-(kp omega + kd omega').  At the samples the rate does not notice, for the mean is right.  Its integral, the angle,
does: over a sample of length T it moves further than the trapezoidal rule makes of the rates at both ends, and all
together by T^2 / 12 (kp angle + kd rate).  With kp = 66 1/s^2, kd = 14 1/s and T = 20 ms that is 0.2 % and 0.5 ms:
little, but the moment (J_zz - J_xx) p r that couples the axes is larger by these 0.2 % too, and with it J_zz and d,
which two minutes of flight give to 0.1 %.

The surplus of the measured angle's change is compared with measured rate and acceleration, frequency by frequency, so
that kp and kd are read off a flight without knowing any parameter of the vehicle, and speeds get their slope from them.
A gyro with a wrong scale makes a surplus of the same form as kp, but one of its own on each axis.  Where roll and pitch
disagree, or their kp would hardly damp, only kd is believed, and kp follows from it as in a well damped loop.
Motors that lag behind, or a delay, smooth the torque: then nothing is found, and the speeds stay as they were logged,
unless the vehicle file holds its stabiliser and how often it runs: then that control law gives the slope.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from quadid.chi_square import exceeded
from quadid.data.window import Window
from quadid.rotation import euler
from quadid.types import ComplexArray, FloatArray
from quadid.vehicle import Vehicle, mixer_matrix

STRETCH_SECONDS = 10.0
"""Stretches compared by themselves [s], each half over the one before."""
NEIGHBOURS = 5
"""Frequencies over which the spectrum of the errors is smoothed."""
FALSE_ALARM = 0.01
"""Probability of a slope in a flight without feedback; one that noise has made up is as small as the noise."""
DAMPING = 0.85
"""Damping ratio of a loop whose kp cannot be distinguished from the gyro's scale: between Butterworth and critical …"""


class Feedback(NamedTuple):
    """Inner loop of a flight controller as the log shows it.

    Attributes:
        proportional: kp [1/s^2], angular acceleration for an angle.
        derivative: kd [1/s], angular acceleration for a rate.
    """

    proportional: float
    derivative: float
    sigma: tuple[float, float]


def follow_feedback(windows: Sequence[Window], vehicle: Vehicle) -> tuple[list[Window], str]:
    """Gives the rotor speeds of a log the slope within each sample that feedback makes.

    Returns:
        The windows with `rotor_slope`, and a sentence for people; the same windows and "" without evidence.
    """
    slopes: list[FloatArray | None] = []
    known = vehicle.stabiliser
    if known is not None and known.rate is not None:
        slopes = [_slope_of_law(w, vehicle, known.gains, known.rate) for w in windows]
        why = f"the vehicle file's stabiliser runs at {known.rate:.0f} Hz, faster than this log"
    else:
        found = find_feedback(windows)
        if found is not None:
            slopes = [_slope_of_motion(w, vehicle, found) for w in windows]
            loop = f"about {found.proportional:.0f} 1/s^2 on the angle, {found.derivative:.0f} 1/s on the rate"
            why = f"the flight controller acted faster than this log ({loop})"
    if not slopes or any(slope is None for slope in slopes):
        return list(windows), ""
    text = f"{why}; the rotor speeds follow it within each sample, nothing to do"
    return [replace(w, rotor_slope=slope) for w, slope in zip(windows, slopes, strict=True)], text


def find_feedback(windows: Sequence[Window]) -> Feedback | None:
    """Feedback within the samples of held commands; None where the data do not show any.

    Least squares in the frequency domain, weighted by the spectrum that the errors turn out to have (Whittle): the
    gyro's noise rules at low frequencies, the attitude's at high ones.  Standard errors are of the scatter between
    stretches.
    """
    if not windows or any(w.sampling != "held" for w in windows):
        return None
    dt = windows[0].dt
    # A thousand give kp and kd to a hundredth; more are thinned evenly, as memory would grow with the log.
    every = max(math.ceil(2.0 * dt * sum(map(len, windows)) / STRETCH_SECONDS / 1000), 1)
    spectra = np.array([spectrum for w in windows for spectrum in _spectra(w, every)])
    if len(spectra) < 8 or not np.all(np.any(spectra != 0.0, axis=(0, 1))):
        return None  # too little, or a sensor that never changes
    shares, covariance = _weighted(spectra)
    scale = 12.0 / dt**2
    found = _feedback(scale * shares, scale**2 * covariance)
    stable = found is not None and found.derivative * dt < 1.0 and found.proportional * dt**2 < 1.0
    return found if stable else None


def _feedback(gains: FloatArray, covariance: FloatArray) -> Feedback | None:
    """Loop from kp of roll, kp of pitch and the kd of both, as they look if the gyro's scale is right.

    Args:
        gains: the three, shape (3,).
        covariance: of them, shape (3, 3).
    """
    apart = (gains[0] - gains[1]) ** 2 / (covariance[0, 0] + covariance[1, 1] - 2.0 * covariance[0, 1])
    same = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    precision = np.linalg.inv(covariance)
    both = np.linalg.inv(same.T @ precision @ same)
    kp, kd = (float(k) for k in both @ same.T @ precision @ gains)
    sigma_p, sigma_d = (float(k) for k in np.sqrt(np.diag(both)))
    strongest = (0.5 * (kd + 2.0 * sigma_d) / 0.5) ** 2 + 2.0 * sigma_p
    if apart < exceeded(FALSE_ALARM, 1) and 0.0 < kp < strongest:
        evidence = float(gains @ precision @ same @ both @ same.T @ precision @ gains)
        # A smooth torque has a share of the angle, so that of the rate must be more than nothing.
        significant = evidence > exceeded(FALSE_ALARM, 2) and kd > 1.5 * sigma_d
        return Feedback(kp, kd, (sigma_p, sigma_d)) if significant else None
    kd, sigma_d = float(gains[2]), float(np.sqrt(covariance[2, 2]))
    kp = (0.5 * kd / DAMPING) ** 2
    significant = kd > np.sqrt(exceeded(FALSE_ALARM, 1)) * sigma_d
    return Feedback(kp, kd, (2.0 * kp / kd * sigma_d, sigma_d)) if significant else None


def _spectra(window: Window, every: int) -> list[ComplexArray]:
    """Rate in roll and in pitch, its change, surplus of the angle's change; (frequencies, 4) of every n-th stretch."""
    if window.gyro is None or window.attitude is None:
        return []
    angles = euler(window.attitude)[:, :2]
    roll, pitch = angles.T
    p, q, r = window.gyro.T
    turning = q * np.sin(roll) + r * np.cos(roll)
    rates = np.column_stack([p + np.tan(pitch) * turning, q * np.cos(roll) - r * np.sin(roll)])
    middle, change = 0.5 * (rates[1:] + rates[:-1]), np.diff(rates, axis=0) / window.dt
    turned = np.remainder(np.diff(angles, axis=0) + np.pi, 2.0 * np.pi) - np.pi
    columns = np.stack([middle, change, turned / window.dt - middle], axis=2)
    length = round(STRETCH_SECONDS / window.dt)
    taper = np.hanning(length)[:, None]
    out = []
    for start in range(0, len(columns) - length + 1, every * (length // 2)):
        rows = columns[start : start + length]
        if (
            np.isfinite(rows).all() and np.abs(pitch[start : start + length]).max() < 1.2
        ):  # Euler's angles go wild at 1.57
            for axis in range(2):
                rate, *others = np.fft.rfft(taper * rows[:, axis], axis=0)[1:].T
                out.append(np.column_stack([*(rate * (axis == i) for i in range(2)), *others]))
    return out


def _weighted(spectra: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Shares of the rates and their change in the surplus, from spectra (stretches, frequencies, 4); covariance."""
    x, y = spectra[:, :, :-1], spectra[:, :, -1]
    weights = np.ones(x.shape[1])
    for _ in range(3):
        inverse = np.linalg.inv(np.einsum("sfi,sfj,f->ij", x.conj(), x, weights).real)
        shares = inverse @ np.einsum("sfi,sf,f->i", x.conj(), y, weights).real
        power = np.pad(np.mean(np.abs(y - x @ shares) ** 2, axis=0), NEIGHBOURS // 2, mode="edge")
        power = np.convolve(power, np.full(NEIGHBOURS, 1.0 / NEIGHBOURS), "valid")
        if not np.any(power):
            break  # nothing left: noise-free data
        weights = 1.0 / np.maximum(power, 1e-9 * power.mean())
    inverse = np.linalg.inv(np.einsum("sfi,sfj,f->ij", x.conj(), x, weights).real)
    scores = np.einsum("sfi,sf,f->si", x.conj(), y - x @ shares, weights).real
    return shares, inverse @ scores.T @ scores @ inverse


def _slope_of_law(window: Window, vehicle: Vehicle, gains: Mapping[str, float], rate: float) -> FloatArray | None:
    """Slope of the speeds [rad/s^2], shape (n, rotors), that the control law of `quadid.attitude_controller` makes.

    Nothing runs on where the gyro is missing or a speed is at its limit; None where a sample holds one step of the law.
    """
    steps = rate * window.dt
    if window.gyro is None or window.sampling != "held" or steps < 1.5:
        return None
    speed, middle, turn = window.rotor_speed, *_motion(window)
    mixer = mixer_matrix(vehicle, gains)
    torque = _torques(speed, mixer)
    miss, wanted = torque - torque.mean(axis=0), np.zeros((len(window), 4))
    for i, axis in enumerate(("roll", "pitch", "yaw")):
        of_angle, of_rate = gains[f"{axis}_p"], gains[f"{axis}_rate_p"]
        wanted[:, 1 + i] = -of_rate * (of_angle * middle[:, i] + turn[:, i])
        wanted[:, 1 + i] += gains[f"{axis}_rate_i"] / of_rate * miss[:, i]
    wanted[~np.isfinite(wanted).all(axis=1)] = 0.0
    free = (speed > gains["min_speed"]) & (speed < gains["max_speed"])
    share = 1.0 - 1.0 / steps**2  # of a straight line's first moment in a staircase of so many steps
    return _of_squares(np.where(free, share * (wanted @ mixer.T), 0.0), speed)


def _slope_of_motion(window: Window, vehicle: Vehicle, found: Feedback) -> FloatArray | None:
    """Slope of the speeds [rad/s^2], shape (n, rotors); where the gyro is missing, nothing runs on.

    None where the motion does not follow the speeds.
    """
    speed, middle, turn = window.rotor_speed, *_motion(window)
    mixer = mixer_matrix(vehicle, {"thrust_coefficient": 1.0, "drag_coefficient": 1.0})
    torque = _torques(speed, mixer)
    effect = np.array([_effect(turn[:-1, i], torque[:-1, i]) for i in range(2)])
    if np.isnan(effect).any():
        return None
    wanted = np.zeros((len(window), 4))
    wanted[:, 1:3] = -(found.proportional * middle + found.derivative * turn)[:, :2] / effect
    wanted[~np.isfinite(wanted).all(axis=1)] = 0.0
    return _of_squares(wanted @ mixer.T, speed)


def _motion(window: Window) -> tuple[FloatArray, FloatArray]:
    """Rate [rad/s] in the middle of each sample and angular acceleration [rad/s^2] over it, shape (n, 3)."""
    assert window.gyro is not None
    turn = np.diff(window.gyro, axis=0, append=window.gyro[-1:]) / window.dt
    return window.gyro + 0.5 * window.dt * turn, turn


def _torques(speed: FloatArray, mixer: FloatArray) -> FloatArray:
    """Torques about the body axes that a mixer commanded with these speeds, shape (n, 3)."""
    return np.asarray((speed**2 @ np.linalg.pinv(mixer).T)[:, 1:])


def _of_squares(slope: FloatArray, speed: FloatArray) -> FloatArray:
    """Slope of speeds from that of their squares; a rotor that stands still goes on standing."""
    return np.asarray(np.where(speed > 0.0, slope / np.maximum(2.0 * speed, 1e-9), 0.0))


def _effect(turn: FloatArray, moment: FloatArray) -> float:
    """Angular acceleration for a moment of one rotor unit; NaN where one does not follow the other."""
    known = np.isfinite(turn)
    if np.count_nonzero(known) < 2 or np.std(moment[known]) == 0.0 or np.std(turn[known]) == 0.0:
        return float("nan")
    (a, b), (_, c) = np.cov(moment[known], turn[known])
    return float(b / a) if b > 0.5 * np.sqrt(a * c) else float("nan")
