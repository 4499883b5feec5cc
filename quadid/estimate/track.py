"""Flights as the filter reads them: every channel at its own times, rotor speeds as they acted."""

import numpy as np
from scipy.interpolate import CubicSpline

from quadid.data.grid import linear
from quadid.data.rotor_signal import rotor_signal
from quadid.data.window import Recording, Sampling, Window, copied, in_body_axes, sample_period
from quadid.estimate.kalman import M, Track, nothing_beyond
from quadid.types import BoolArray, FloatArray
from quadid.vehicle import Vehicle

STILL = 3.0
"""Standard deviation of a velocity that nobody measures [m/s], where air matters."""
LAGS = 4
"""Samples of all rotors from which the next one is foreseen."""
TOGETHER = 1e-4
"""Measurements closer than this are taken at one time [s]."""
PIECES, GAP = 8, 2.5
"""Straight lines that stand for the curve from one rotor reading to the next; sampling steps that are a gap."""
REACH = 16
"""Readings to either side of which the curve between two of them is made."""
# Low-pass by a window, in NumPy: scipy.signal takes half a second and 25 MB to load.
_TAPS = (np.sinc(np.arange(-REACH * PIECES, REACH * PIECES + 1) / PIECES) * np.kaiser(2 * REACH * PIECES + 1, 7.0))[:-1]
_BETWEEN = _TAPS.reshape(-1, PIECES)[::-1] / _TAPS.reshape(-1, PIECES).sum(axis=0)  # what stays the same does so here
_COLUMNS = (("gyro", 0, 3), ("attitude", 3, 7), ("accel", 7, 10), ("velocity", 10, 13))


def from_window(window: Window, vehicle: Vehicle, air: bool = False) -> Track:
    """A window on a uniform grid, a row each; NaN rows are no measurements.

    Args:
        window: the data.
        vehicle: where its rotors are.
        air: velocity matters though it is not measured.
    """
    channels = {}
    for name, _, _ in _COLUMNS:
        values = getattr(window, name)
        if values is not None:
            good = np.isfinite(values).all(axis=1)
            channels[name] = window.t[good], values[good]
    return _track(
        channels, window.t, window.t, window.rotor_speed, window.rotor_slope, window.sampling, window.dt, vehicle, air
    )


def from_recording(recording: Recording, vehicle: Vehicle, air: bool = False) -> Track:
    """A log, channels at their own rates: an update where a new value was measured; a repeated one is none.

    Args:
        recording: the log.
        vehicle: what its rotor columns mean.
        air: velocity matters though it is not measured.

    Raises:
        LogError, NotIdentifiableError: see `rotor_signal`.
    """
    recording = in_body_axes(recording, vehicle)
    rotor = rotor_signal(recording, vehicle)
    channels = {}
    for name, _, _ in _COLUMNS:
        channel = recording.channels.get(name)
        if channel is not None:
            rows = (channel.t >= rotor.t[0]) & (channel.t <= rotor.t[-1]) & _new(channel.values)
            channels[name] = channel.t[rows], channel.values[rows]
    period = sample_period(recording.channels["accel"].t) if "accel" in recording.channels else 0.02
    return _track(channels, np.empty(0), rotor.t, rotor.values, None, rotor.sampling, period, vehicle, air)


def _new(values: FloatArray) -> BoolArray:
    """Rows that differ from the one before."""
    return np.concatenate([[True], ~copied(values)])


def _track(
    channels: dict[str, tuple[FloatArray, FloatArray]],
    rows: FloatArray,
    rotor_t: FloatArray,
    speed: FloatArray,
    slope: FloatArray | None,
    sampling: Sampling,
    period: float,
    vehicle: Vehicle,
    air: bool,
) -> Track:
    """Merges channels onto one rising axis of times, with `rows` whether or not something was measured then."""
    every = np.unique(np.concatenate([rows, *(t for t, _ in channels.values())]))
    t = every[np.concatenate([[True], np.diff(every) > TOGETHER])]
    y, seen = np.zeros((len(t), 13)), np.zeros((len(t), 4), dtype=np.bool_)
    for group, (name, first, last) in enumerate(_COLUMNS):
        if name in channels:
            times, values = channels[name]
            at = np.searchsorted(t, times + 0.5 * TOGETHER, side="right") - 1
            y[at, first:last], seen[at, group] = values, True
    new = _new(speed)
    still = STILL if air and not seen[:, 3].any() else 0.0
    hub_x, hub_y, hub_z = vehicle.rotor_positions.T
    share = np.ascontiguousarray([np.ones_like(hub_x), hub_x, hub_y, vehicle.spins])
    hubs = float(np.mean(hub_x**2)), float(np.mean(hub_y**2)), float(np.mean(hub_z))
    between = np.diff(rotor_t[new]) if new.sum() > 1 else np.diff(rotor_t)
    if sampling == "held":
        piece_t, pieces = _held(rotor_t, speed, slope)
    else:
        piece_t, pieces = _curved(rotor_t, speed, sampling == "smooth")
    return Track(
        t, y, seen, 0.5 * period, piece_t, pieces, share, vehicle.mass, len(vehicle.rotors), hubs,
        wavering(vehicle, vehicle.initial), float(np.median(between)),
        vehicle.command.sampling == "instant", _speed_noise(speed[new]), still, np.empty((0, M)), nothing_beyond(),
    )  # fmt: skip


def wavering(vehicle: Vehicle, six: FloatArray) -> FloatArray:
    """Variances of the specific thrust and the angular accelerations for a variance 1 of every rotor's thrust / b.

    Shape (4,): thrust, roll, pitch, yaw, by the nominal six; to be multiplied with a sum over rotors.
    """
    x, y = vehicle.rotor_positions[:, :2].T
    unit = six[[0, 0, 0, 1]] / [vehicle.mass, *six[2:5]]
    return np.asarray(np.array([1.0, np.mean(y**2), np.mean(x**2), 1.0]) * unit**2)


def quantum(values: FloatArray) -> float:
    """Standard deviation of rounding: the least step between numbers / sqrt 12; 0 where all are the same."""
    steps = np.diff(np.unique(values))
    least = float(np.min(steps[steps > 1e-9], initial=np.inf))
    return least / np.sqrt(12.0) if np.isfinite(least) else 0.0


def _speed_noise(speed: FloatArray) -> tuple[float, float]:
    """Least and most noise of rotor samples: rounding; what a line through all rotors' past leaves of the next."""
    if len(speed) < 8 * LAGS * speed.shape[1]:
        return quantum(speed), np.inf
    earlier = [speed[LAGS - i : len(speed) - i] for i in range(1, LAGS + 1)]
    past = np.column_stack([*earlier, np.ones(len(speed) - LAGS)])
    left = speed[LAGS:] - past @ np.linalg.lstsq(past, speed[LAGS:], rcond=None)[0]
    return quantum(speed), float(np.sqrt(np.mean(left**2)))


def _held(t: FloatArray, speed: FloatArray, slope: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """`Track.piece_t` and `Track.speed` of speeds that are held, with a `slope` about their mean."""
    step = np.append(np.diff(t), np.median(np.diff(t)))[:, None]
    rise = np.zeros_like(speed) if slope is None else slope
    return np.ascontiguousarray(t), np.stack([speed - 0.5 * rise * step, rise], axis=-1)


def _curved(t: FloatArray, speed: FloatArray, smooth: bool) -> tuple[FloatArray, FloatArray]:
    """The same of readings: a curve through them, by straight lines.

    Integrated from reading to reading, lines lose 13 % of what turns at a fifth of the rate, and inertias would be as
    much too small.  A cubic spline loses 28 % of what turns at two fifths: behind a low-pass that ends there (`smooth`)
    it is the curve without frequencies above half the rate, which would ring where nothing was low-passed.
    """
    every = np.interp(np.arange(PIECES * (len(t) - 1) + 1) / PIECES, np.arange(len(t)), t)
    if smooth:
        longer = np.pad(speed, ((REACH, REACH), (0, 0)), mode="reflect", reflect_type="odd")
        near = np.lib.stride_tricks.sliding_window_view(longer, 2 * REACH, axis=0)[1:]
        curve = np.einsum("nrk,kp->npr", near, _BETWEEN).reshape(-1, speed.shape[1])[: len(every)]
    else:
        curve = CubicSpline(t, speed)(every)
    lost = np.append(np.repeat(np.diff(t) > GAP * np.median(np.diff(t)), PIECES), False)
    value = np.where(lost[:, None], linear(t, speed, every), np.maximum(curve, 0.0))
    rise = np.vstack([np.diff(value, axis=0) / np.diff(every)[:, None], np.zeros((1, speed.shape[1]))])
    return every, np.stack([value, rise], axis=-1)
