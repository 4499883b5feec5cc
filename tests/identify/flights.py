"""Flights that several tests of the fit share: flown once a process, never written to."""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from quadid.data.window import Window
from quadid.flight import Flight, TruthParameters, draw_truth, fly
from quadid.identification.problem import Shooting
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import ParameterPrior, Vehicle

PELICAN = Vehicle.shipped("pelican")
SECONDS = 60.0


@lru_cache(maxsize=32)
def flown(seed: int, profile: str = "excited", seconds: float = SECONDS, noise_scale: float = 1.0) -> Flight:
    """A flight of the individual Pelican number `seed`."""
    return fly(PELICAN, draw_truth(PELICAN, seed), seconds, seed, profile, noise_scale=noise_scale)


def values_of(truth: TruthParameters) -> FloatArray:
    """The six true parameters, shape (6,)."""
    return np.array([truth.as_dict()[n] for n in NOMINAL_NAMES])


def true_theta(flight: Flight) -> FloatArray:
    """The full parameter vector that was flown, without effects."""
    theta = Layout(PELICAN).initial(PELICAN)
    theta[: len(NOMINAL_NAMES)] = values_of(flight.truth.parameters)
    return theta


def guessed(truth: TruthParameters, seed: int = 0, spread: float = 0.3) -> Vehicle:
    """A Pelican file whose guesses are off by up to the factor exp(`spread`)."""
    rng = np.random.default_rng([seed, 5])
    off = np.exp(rng.uniform(-spread, spread, len(NOMINAL_NAMES)))
    priors = {
        n: ParameterPrior(initial=float(v * f)) for n, v, f in zip(NOMINAL_NAMES, values_of(truth), off, strict=True)
    }
    return PELICAN.model_copy(update={"parameters": priors})


def at_truth(shooting: Shooting, truth: TruthParameters) -> FloatArray:
    """Full parameter vector of the true individual, shape (size,)."""
    theta = shooting.layout.initial(shooting.vehicle)
    theta[: len(NOMINAL_NAMES)] = values_of(truth)
    return theta


def with_noise(window: Window, seed: int, gyro: float = 0.01, attitude: float = 0.003, accel: float = 0.1) -> Window:
    """A noiseless window with white noise of known size: rates [rad/s], attitude [rad], specific force [m/s^2]."""
    rng = np.random.default_rng([seed, 0xA0])
    assert window.gyro is not None
    assert window.accel is not None
    assert window.attitude is not None
    turn = 0.5 * attitude * rng.standard_normal((len(window), 3))
    return replace(
        window,
        gyro=window.gyro + gyro * rng.standard_normal((len(window), 3)),
        accel=window.accel + accel * rng.standard_normal((len(window), 3)),
        attitude=turned(window.attitude, turn),
    )


def turned(q: FloatArray, half: FloatArray) -> FloatArray:
    """Quaternions (n, 4) turned by small body rotations, given as half rotation vectors (n, 3)."""
    w, v = q[:, :1], q[:, 1:]
    out = np.hstack([w - np.sum(v * half, axis=1, keepdims=True), v + w * half + np.cross(v, half)])
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def without_rows(window: Window, **rows: Any) -> Window:
    """The window with NaN in the given rows of the given channels."""
    changed: dict[str, Any] = {}
    for name, which in rows.items():
        values = np.array(getattr(window, name))
        values[which] = np.nan
        changed[name] = values
    return replace(window, **changed)
