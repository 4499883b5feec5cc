"""The missing force and moment: what acted on a vehicle and its model does not produce, with bands.

A random force is estimated beside the model by the smoother of `quadid.estimate.kalman`; a constant moment and the
sensors' biases belong to each flight and are not missing.  Models are compared at the sensor noise and the correlation
times of one of them; how large the random forces are beside each is estimated anew, or a right model would be said to
miss what a wrong one does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from quadid.chi_square import Z95
from quadid.data.window import Window
from quadid.estimate import kalman as k
from quadid.estimate.fit import (
    ALL_NOISE,
    MOST,
    NEAR_SECONDS,
    NO_NOISE,
    Estimate,
    scoring,
    settle_noise,
    tails,
    whitened,
)
from quadid.estimate.problem import Problem, measured
from quadid.estimate.track import from_window
from quadid.model.layout import Layout
from quadid.rotation import conjugate, rotated
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, RandomForces, RandomInput, Vehicle

RESIZING = 10
"""Most steps to the size of the random forces."""
_SIZES = (np.arange(k.N_NOISE) >= k.SIGMA) & (np.arange(k.N_NOISE) < k.SIGMA + 4)
MOTIONS = ("v_x", "v_y", "v_z", "p", "q", "r")
FACTORS = (*MOTIONS, "W", "V")
"""Signals of `quadid.vehicle.SIGNALS` beside what is missing: none is the rotors' own thrust or torque."""
TRIMMING = 3
"""Steps that trim moment and biases of a flight take: the likelihood is nearly a parabola in them."""


@dataclass(frozen=True)
class Missing:
    """Of one stretch of flight, body axes.

    Attributes:
        t: times [s], shape (n,).
        force: smoothed random force [N], shape (n, 3).
        force_sigma: its standard deviation, shape (n, 3).
        moment: smoothed random moment [N m], shape (n, 3).
        moment_sigma: its standard deviation, shape (n, 3).
        control: rotor moments [N m] at each time, shape (n, 3).
        factors: values of `FACTORS` at each time, shape (n, 8); a velocity that nobody measured is about zero.
        weight: [N].
        sizes: standard deviations of the random specific force and angular acceleration [m/s^2, rad/s^2], shape (6,).
        times: their correlation times [s], shape (6,).
        innovation: of gyro, attitude (rotation vector), accelerometer, velocity, in their units, shape (n, 12); not a
            number where not measured.
        innovation_sigma: its standard deviation, shape (n, 12).
    """

    t: FloatArray
    force: FloatArray
    force_sigma: FloatArray
    moment: FloatArray
    moment_sigma: FloatArray
    control: FloatArray
    factors: FloatArray
    weight: float
    sizes: FloatArray
    times: FloatArray
    innovation: FloatArray
    innovation_sigma: FloatArray

    def rows(self, first: int, last: int) -> Missing:
        """Rows `first` to before `last`."""
        names = (
            "t",
            "force",
            "force_sigma",
            "moment",
            "moment_sigma",
            "control",
            "factors",
            "innovation",
            "innovation_sigma",
        )
        return replace(self, **{name: getattr(self, name)[first:last] for name in names})


def smoothed(found: Estimate) -> list[Missing]:
    """Missing force and moment of every flight of an estimate."""
    return _smoothed(found.problem, found.z, found.psi)


def _smoothed(problem: Problem, z: FloatArray, psi: FloatArray) -> list[Missing]:
    out = []
    _, gains = problem.passes(z, psi)
    for j, (track, g) in enumerate(zip(problem.tracks, gains, strict=True)):
        p = problem.physics(z, j)
        _, mean, variance, *_ = k.backward(track, p, psi, g, True)
        sigma = np.sqrt(np.maximum(variance, 0.0))
        scale = np.concatenate([np.full(3, track.mass), p[k.JX : k.JX + 3]])
        square = 0.5 * (g.table[:, 1:4] + g.table[:, k.MOMENTS + 1 : k.MOMENTS + 4])
        control = square[:, [1, 0, 2]] * [-p[k.B], p[k.B], p[k.D]]
        wind = problem.vehicle.effects.get("wind", {})
        air = g.mean[:, 7:10] - [wind.get("north", 0.0), wind.get("east", 0.0), 0.0]
        body = rotated(conjugate(g.mean[:, :4]), air)
        speeds = 0.5 * (g.table[:, 5] + g.table[:, k.MOMENTS + 5])
        acted, spread = scale * mean[:, :6], scale * sigma[:, :6]
        out.append(
            Missing(
                track.t,
                acted[:, :3],
                spread[:, :3],
                acted[:, 3:],
                spread[:, 3:],
                control,
                np.column_stack([body, g.mean[:, 4:7], speeds, np.linalg.norm(body, axis=1)]),
                track.mass * GRAVITY,
                psi[k.SIGMA + np.array([0, 0, 1, 2, 2, 3])],
                psi[k.TIME + np.array([0, 0, 1, 2, 2, 3])],
                np.where(measured(track, g), g.nu, np.nan),
                np.sqrt(g.S),
            )
        )
    return out


class Vehicles:
    """Flights on which models of one vehicle are compared by what they miss.

    Attributes:
        psi: noise numbers, those of the first model on the flights that it was fitted to.
        tail: tails of its innovations there, see `fit.tails`.
    """

    def __init__(self, windows: Sequence[Window], vehicle: Vehicle, theta: FloatArray) -> None:
        """Estimates the noise numbers beside a parameter vector of `quadid.model`, from its liveliest minute."""
        self.vehicle = vehicle
        problem, z = settled(windows, vehicle, theta, None)
        part = problem.liveliest(NEAR_SECONDS)
        z, self.psi, gains = settle_noise(part, z, problem.first_noise())
        self.tail = tails(part.tracks, gains)
        if self.tail.any():
            _, self.psi, *_ = scoring(replace(part, tail=self.tail), z, self.psi, MOST, ALL_NOISE)

    def missing(self, windows: Sequence[Window], theta: FloatArray, vehicle: Vehicle | None = None) -> list[Missing]:
        """Missing force and moment of a parameter vector on these flights, which need not be those of the noise.

        Args:
            windows: the flights.
            theta: full parameter vector.
            vehicle: whose vector that is, where it is not that of the noise.
        """
        return self._missing(*settled(windows, vehicle or self.vehicle, theta, self.psi, self.tail))

    def mean_square(self, windows: Sequence[Window], theta: FloatArray) -> float:
        """Mean over channels and rows of squared innovations of a parameter vector, whitened at `psi` and `tail`.

        One where the model, random forces included, is right about its own errors; infinite where it diverges.
        """
        return self._mean_square(*settled(windows, self.vehicle, theta, self.psi, self.tail))

    def both(self, windows: Sequence[Window], theta: FloatArray) -> tuple[list[Missing], float]:
        """Results of `missing` and `mean_square`, trim and biases fitted once."""
        problem, z = settled(windows, self.vehicle, theta, self.psi, self.tail)
        return self._missing(problem, z), self._mean_square(problem, z)

    def _missing(self, problem: Problem, z: FloatArray) -> list[Missing]:
        _, psi, *_ = scoring(problem.liveliest(NEAR_SECONDS), z, self.psi, RESIZING, _SIZES)
        return _smoothed(problem, z, psi)

    def _mean_square(self, problem: Problem, z: FloatArray) -> float:
        value, gains = problem.passes(z, self.psi)
        each = zip(whitened(problem.tracks, gains), problem.tracks, gains, strict=True)
        squares = np.concatenate([white[measured(track, g)] for white, track, g in each]) ** 2
        return float(np.mean(squares)) if np.isfinite(value) and len(squares) else np.inf


def settled(
    windows: Sequence[Window],
    vehicle: Vehicle,
    theta: FloatArray,
    psi: FloatArray | None,
    tail: FloatArray | None = None,
) -> tuple[Problem, FloatArray]:
    """The problem of a model with fixed physics, and trim and biases of each flight, fitted.

    Args:
        windows: the flights.
        vehicle: geometry and mass.
        theta: full parameter vector; effects are simulated along the filtered states.
        psi: noise numbers; None: the first guess.
        tail: of the innovations; None: Gaussian ones.
    """
    air = bool(np.any(theta[6:] != Layout(vehicle).neutral()[6:]))
    problem = Problem.fixed([from_window(w, vehicle, air=air) for w in windows], vehicle, theta, windows)
    problem = problem if tail is None else replace(problem, tail=tail)
    z, noise = problem.start(), problem.first_noise() if psi is None else psi
    problem = problem.along(z, noise).frozen(z)
    z, _, _, gains, _ = scoring(problem, z, noise, TRIMMING, NO_NOISE)
    return problem.weighted(gains), z


def size(parts: Sequence[Missing], force: bool) -> tuple[FloatArray, FloatArray]:
    """Root mean square over flights, sensor noise taken off, and its 95 % interval, shapes (3,) and (2, 3).

    The mean square is that of the smoothed value and its variance; the interval that of as many independent values as
    there are pairs of correlation times.
    """
    value = np.concatenate([m.force if force else m.moment for m in parts])
    sigma = np.concatenate([m.force_sigma if force else m.moment_sigma for m in parts])
    square = np.mean(value**2 + sigma**2, axis=0)
    seconds = sum(float(m.t[-1] - m.t[0]) for m in parts)
    times = parts[0].times[:3] if force else parts[0].times[3:]
    independent = np.maximum(0.5 * seconds / times, 1.0)
    spread = Z95 * np.sqrt(np.mean(4.0 * value**2 * sigma**2 + 2.0 * sigma**4, axis=0) / independent)
    interval = np.sqrt(np.maximum([square - spread, square + spread], 0.0))
    return np.sqrt(square), interval


def random_forces(parts: Sequence[Missing]) -> RandomForces:
    """Random force and moment of flights together: mean squares, and the correlation times of the first."""
    seconds = [float(m.t[-1] - m.t[0]) for m in parts]
    sizes = np.sqrt(np.average([m.sizes**2 for m in parts], axis=0, weights=seconds))
    inputs = [RandomInput(sigma=_short(sizes[i]), time=_short(parts[0].times[i])) for i in (0, 2, 3, 5)]
    return RandomForces(horizontal=inputs[0], vertical=inputs[1], roll_pitch=inputs[2], yaw=inputs[3])


def _short(value: float) -> float:
    return float(f"{value:.4g}")


def control_size(parts: Sequence[Missing]) -> FloatArray:
    """Standard deviation of the rotor moments over flights, shape (3,) [N m]."""
    return np.asarray(np.concatenate([m.control for m in parts]).std(axis=0))


def removed(before: Sequence[Missing], after: Sequence[Missing]) -> float:
    """Share of the squared missing force and moment that a larger model takes away.

    Each axis counts in units of what the smaller model misses there: weight and rotor moment.
    """
    shares = []
    for parts in (before, after):
        weight, control = parts[0].weight, control_size(parts)
        shares.append(np.sum((size(parts, True)[0] / weight) ** 2) + np.sum((size(parts, False)[0] / control) ** 2))
    return float(1.0 - shares[1] / shares[0])
