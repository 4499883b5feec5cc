"""The least-squares recipe of sysid.tools (arXiv 2404.07837) on its authors' Crazyflie logs, beside ours.

Motors follow their command with a first-order lag; thrust is a quadratic of the lagged command, fitted to the
accelerometer; the lag comes from a grid, by the residual of that fit; inertias follow from the smoothed derivative of
the gyro on the moments; yaw from one coefficient on the thrusts.  The grid of lags, the smoothing and the polynomial
are the authors' kind; the code is ours.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter, savgol_filter

import quadid
from quadid.data.grid import linear
from quadid.data.window import Recording
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import table
from quadid_evaluation.studies.flight_sets import shares_of_no_change

LOG, CUT, MODEL = "arpl/log15.csv", 18.0, "arpl/vehicle.yaml"
"""The log, fitted up to the cut [s] and predicted from there."""
RATE, LAGS = 1000.0, np.arange(0.01, 0.151, 0.005)
SMOOTH = 41
"""Samples of the smoothed derivative."""
AHEAD = (0.1, 0.5)
"""Horizons [s]."""


class Fitted(NamedTuple):
    """Lag [s], thrust polynomial of a rotor [N], acceleration per moment of the three axes, and its R²."""

    lag: float
    thrust: FloatArray
    scale: FloatArray
    r2: FloatArray


class Signals(NamedTuple):
    """At 1 kHz: commands (n, 4), rates (n, 3) [rad/s], specific force along z (n,) [m/s^2]."""

    u: FloatArray
    gyro: FloatArray
    az: FloatArray


def signals(recording: Recording, begin: float, end: float) -> Signals:
    """Channels of a part of a log on one grid."""
    c = recording.channels
    t = np.arange(max(begin, c["gyro"].t[0]), min(end, *(v.t[-1] for v in c.values())), 1.0 / RATE)
    u, gyro, accel = (linear(c[name].t, c[name].values, t) for name in ("motor_command", "gyro", "accel"))
    return Signals(u, gyro, accel[:, 2])


def _lagged(u: FloatArray, lag: float) -> FloatArray:
    pole = np.exp(-1.0 / (RATE * lag))
    return np.asarray(lfilter([1.0 - pole], [1.0, -pole], u, axis=0, zi=pole * u[:1])[0])


def _moments(vehicle: Vehicle, thrust: FloatArray, u: FloatArray) -> FloatArray:
    force = np.polynomial.polynomial.polyval(u, thrust)
    x, y = vehicle.rotor_positions[:, :2].T
    return np.column_stack([-force @ y, force @ x, force @ vehicle.spins])


def fitted(log: Signals, vehicle: Vehicle) -> Fitted:
    """The recipe."""
    fits, target = [], -vehicle.mass * log.az
    for lag in LAGS:
        u = _lagged(log.u, lag)
        columns = np.column_stack([(u**k).sum(axis=1) for k in range(3)])
        thrust = np.linalg.lstsq(columns, target, rcond=None)[0]
        fits.append((float(np.sum((columns @ thrust - target) ** 2)), lag, thrust, u))
    _, lag, thrust, u = min(fits, key=lambda one: one[0])
    turning = savgol_filter(log.gyro, SMOOTH, 3, deriv=1, delta=1.0 / RATE, axis=0)
    moments = savgol_filter(_moments(vehicle, thrust, u), SMOOTH, 3, axis=0)
    share = np.sum(moments * turning, axis=0) / np.sum(moments**2, axis=0)
    left = np.sum((turning - share * moments) ** 2, axis=0) / np.sum((turning - turning.mean(axis=0)) ** 2, axis=0)
    return Fitted(float(lag), thrust, share, 1.0 - left)


def rate_error(log: Signals, vehicle: Vehicle, found: Fitted, seconds: float) -> tuple[float, float]:
    """Mean error of the rate after `seconds` from the measured one, and that of no change."""
    steps, every = round(seconds * RATE), round(0.02 * RATE)
    turning = found.scale * _moments(vehicle, found.thrust, _lagged(log.u, found.lag))
    grown = np.vstack([np.zeros(3), np.cumsum(turning, axis=0)]) / RATE
    start = np.arange(0, len(log.u) - steps, every)
    change = log.gyro[start + steps] - log.gyro[start]
    miss = grown[start + steps] - grown[start] - change
    return float(np.linalg.norm(miss, axis=1).mean()), float(np.linalg.norm(change, axis=1).mean())


def section(data: Path) -> list[str]:
    """The part of the page."""
    vehicle = Vehicle.named(data / MODEL)
    train, other = (quadid.load(str(data / name), vehicle) for name in (f"{LOG}@:{CUT:g}", f"{LOG}@{CUT:g}:"))
    first, new = signals(train.recording, 0.0, CUT), signals(other.recording, CUT, np.inf)
    found = fitted(first, vehicle)
    errors = {"recipe": [[np.divide(*rate_error(log, vehicle, found, s)) for log in (first, new)] for s in AHEAD]}
    identified, diagnosed = quadid.identify([train]), quadid.diagnose([train])
    for name, model in (("quadid identify", identified.vehicle), ("quadid diagnose", diagnosed.vehicle)):
        errors[name] = [[shares_of_no_change(log.windows, model, s)["rate"] for log in (train, other)] for s in AHEAD]
    j = 1.0 / found.scale[:2]
    ours = {p["name"]: p for p in diagnosed.result["parameters"]}
    told = " and ".join(f"{ours[n]['value']:.2e} ({ours[n]['status']})" for n in ("J_xx", "J_yy"))
    heads = ("rate error, fitted and unseen", *(f"after {s:g} s" for s in AHEAD))
    return [
        "## The least squares of sysid.tools on its authors' logs",
        "",
        f"`python -m quadid_evaluation.studies.peers recipe`: fitted to {LOG} up to {CUT:g} s, predicted from there; "
        "rate errors relative to no change.",
        "",
        *table(heads, [(name, *(f"{a:.2f}, {b:.2f}" for a, b in cells)) for name, cells in errors.items()]),
        "",
        f"Recipe: J_xx {j[0]:.2e}, J_yy {j[1]:.2e} kg m^2 "
        f"without intervals, R² of its accelerations {', '.join(f'{v:.2f}' for v in found.r2)}. "
        f"`quadid diagnose`: {told}; the authors' notebook: 1.03e-5 and 1.11e-5.",
    ]
