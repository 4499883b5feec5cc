"""The online part beside Kalman filters: error after a minute, time to see 15 % more mass, processor time a second.

State of the filters: rates and the logarithms of b, d, J_xx, J_yy, J_zz; Euler's equations over one sample with the
measured rotor speeds, random walks of the logarithms; measured are the gyro and the accelerometer's z.  The filters are
those of filterpy.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
from quadid_node.recording import stream

from quadid.data.window import Window
from quadid.online import OnlineDiagnosis, Session
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.benchmarks.online import CHANGE, CHANGE_AT, PELICAN, drive, flown, published
from quadid_evaluation.harness import table
from quadid_evaluation.studies.truth import poor_guess

NAMES = ("b", "d", "J_xx", "J_yy", "J_zz")
SEEDS = range(1, 6)
SECONDS = 60.0
WALK = 5e-4
"""Random walk of a logarithm over one sample."""
SEEN = 0.5
"""Share of a change that an estimate must have moved."""
_NOISE = (0.02, 0.02, 0.02, 0.25)
_STEP = 1e-6


class _Model:
    """Rates over one sample, and what is measured."""

    def __init__(self, vehicle: Vehicle, dt: float) -> None:
        self._x, self._y = vehicle.rotor_positions[:, :2].T
        self._spins, self._mass, self._dt = vehicle.spins, vehicle.mass, dt
        self._J_r = float(vehicle.parameters["J_r"].initial)

    def step(self, state: FloatArray, dt: float, omega: FloatArray) -> FloatArray:
        """State after one sample, by two steps of the midpoint rule."""
        rate, (b, d, *inertia) = state[:3].copy(), np.exp(state[3:])
        J, square = np.array(inertia), omega**2
        torque = np.array([-b * self._y @ square, b * self._x @ square, d * self._spins @ square])
        spin = self._J_r * float(self._spins @ omega)

        def slope(w: FloatArray) -> FloatArray:  # np.cross would take several times as long
            turning = (
                (J[1] - J[2]) * w[1] * w[2] + spin * w[1],
                (J[2] - J[0]) * w[2] * w[0] - spin * w[0],
                (J[0] - J[1]) * w[0] * w[1],
            )
            return np.asarray((torque + turning) / J)

        for _ in range(2):
            rate = rate + 0.5 * self._dt * slope(rate + 0.25 * self._dt * slope(rate))
        return np.concatenate([rate, state[3:]])

    def measured(self, state: FloatArray, omega: FloatArray) -> FloatArray:
        """Gyro [rad/s] and the accelerometer's z [m/s^2], its mean over both speeds `omega`, shape (2, rotors)."""
        return np.append(state[:3], -np.exp(state[3]) * 0.5 * float(np.sum(omega**2)) / self._mass)


def _slopes(f: Callable[[FloatArray], FloatArray], x: FloatArray) -> FloatArray:
    base = f(x)
    return np.column_stack([(f(x + _STEP * e) - base) / _STEP for e in np.eye(len(x))])


def _started(filter_: Any, start: FloatArray) -> Any:
    filter_.x = start
    filter_.P = np.diag([1e-3] * 3 + [0.09] * 5)
    filter_.Q = np.diag([1e-6] * 3 + [WALK**2] * 5)
    filter_.R = np.diag(np.square(_NOISE))
    return filter_


def extended(window: Window, vehicle: Vehicle, start: FloatArray) -> Iterator[FloatArray]:
    """Logarithms of the parameters after each sample, extended Kalman filter."""
    model, ekf = _Model(vehicle, window.dt), _started(ExtendedKalmanFilter(8, 4), start)
    for z, before, both in _rows(window):
        ekf.F = _slopes(partial(model.step, dt=0.0, omega=before), ekf.x)
        ekf.x = model.step(ekf.x, 0.0, before)
        ekf.P = ekf.F @ ekf.P @ ekf.F.T + ekf.Q
        measured = partial(model.measured, omega=both)
        ekf.update(z, partial(_slopes, measured), measured)
        yield ekf.x[3:].copy()


def unscented(window: Window, vehicle: Vehicle, start: FloatArray) -> Iterator[FloatArray]:
    """As `extended`, by an unscented Kalman filter."""
    model = _Model(vehicle, window.dt)
    points = MerweScaledSigmaPoints(8, alpha=0.1, beta=2.0, kappa=0.0)
    ukf = _started(UnscentedKalmanFilter(8, 4, window.dt, hx=model.measured, fx=model.step, points=points), start)
    for z, before, both in _rows(window):
        ukf.predict(omega=before)
        ukf.update(z, omega=both)
        yield ukf.x[3:].copy()


def _rows(window: Window) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
    """Measurements of each sample, and rotor speeds before it, and both before and from it on."""
    assert window.gyro is not None
    assert window.accel is not None
    for k in range(1, len(window)):
        both = window.rotor_speed[k - 1 : k + 1]
        yield np.append(window.gyro[k], window.accel[k, 2]), both[0], both


FILTERS = {"extended Kalman filter": extended, "unscented Kalman filter": unscented}


def _filtered(who: str, seed: int) -> tuple[FloatArray, float, float]:
    """Errors after a minute (5,), seconds until a change of mass is seen, processor time per second of flight."""
    flight = flown(SECONDS + 1.0, seed)
    truth = flight.truth.parameters.as_dict()
    vehicle = poor_guess(PELICAN, truth, seed)
    start = np.concatenate([np.zeros(3), np.log([vehicle.parameters[n].initial for n in NAMES])])
    begin = time.process_time()
    *_, last = FILTERS[who](flight.window, vehicle, start)
    cost = (time.process_time() - begin) / SECONDS
    changed = flown(CHANGE_AT + 12.0, seed, mass_change={"time": CHANGE_AT, "fraction": CHANGE}).window
    path = np.array([x[0] for x in FILTERS[who](changed, vehicle, start)])
    t = changed.t[1:]
    before = float(np.median(path[(t > CHANGE_AT - 2.0) & (t < CHANGE_AT)]))
    seen = (t > CHANGE_AT) & (path < before - SEEN * np.log1p(CHANGE))
    after = float(t[seen][0] - CHANGE_AT) if seen.any() else float("nan")
    return last - np.log([truth[n] for n in NAMES]), after, cost


def _session(seed: int) -> tuple[FloatArray, float, float]:
    flight = flown(SECONDS + 1.0, seed)
    truth: Mapping[str, float] = flight.truth.parameters.as_dict()
    begin = time.process_time()
    actions = list(drive(Session(poor_guess(PELICAN, truth, seed)), stream(flight.recording)))
    cost = (time.process_time() - begin) / SECONDS
    last = published(actions, "candidate")[-1].parameters
    changed = flown(CHANGE_AT + 12.0, seed, mass_change={"time": CHANGE_AT, "fraction": CHANGE})
    found = [a for a in drive(Session(PELICAN), stream(changed.recording)) if isinstance(a, OnlineDiagnosis)]
    named = [a.t - CHANGE_AT for a in found if a.findings and a.findings[0].effect == "mass_change"]
    return np.log([last[n].value / truth[n] for n in NAMES]), named[0] if named else float("nan"), cost


def section() -> list[str]:
    """The part of the page."""
    rows = []
    for who in (*FILTERS, "quadid.online.Session"):
        runs = [_filtered(who, seed) if who in FILTERS else _session(seed) for seed in SEEDS]
        rms = np.sqrt(np.mean(np.square([error for error, _, _ in runs]), axis=0))
        after, cost = (float(np.median([run[k] for run in runs])) for k in (1, 2))
        names = "none" if who in FILTERS else "mass_change"
        rows.append((who, ", ".join(f"{100 * v:.2g}" for v in rms), f"{after:.1f}", names, f"{cost:.3f}"))
    errors = f"RMS error after 60 s of {', '.join(NAMES)} [%]"
    return [
        "## Online: Kalman filters",
        "",
        f"`python -m quadid_evaluation.studies.peers online`: {len(SEEDS)} flights of a Pelican (seeds {SEEDS[0]} to "
        f"{SEEDS[-1]}), the guess off by up to 35 %. The filters receive J_r, the true noise and a random walk of "
        f"{WALK:g} per sample; a change counts as seen when b has moved half of it.",
        "",
        *table(("estimator", errors, "delay to +15 % mass [s]", "name", "processor [s per s]"), rows),
    ]
