"""Trims of flights: how the rotors share the load when nothing is commanded, and the spread of healthy flights."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from quadid.checks.motion import TURN, flying_spans
from quadid.data.grid import linear, moving_mean
from quadid.data.rotor_signal import rotor_signal
from quadid.data.window import Recording, sample_period
from quadid.errors import NotIdentifiableError
from quadid.jsonable import jsonable
from quadid.rotation import euler
from quadid.types import BoolArray, FloatArray
from quadid.vehicle import GRAVITY, Vehicle

# --- What one flight shows of its trim: how the rotors share the load when nothing is commanded
#
# In steady flight the rotors balance moments and weight.  With w_i the square of rotor i's speed (or its commanded
# thrust), G the rows of `trim_directions` and f the specific force along -z, a flight's trim is
#
#     (G w)_k / sum(w)  for roll, pitch, yaw,   and   log(sum(w) / f),
#
# each a mean over blocks of a second, at zero velocity.


AXES = ("roll", "pitch", "yaw", "effort")
"""Parts of a trim; effort is the logarithm of rotor thrust commanded per specific force."""
BLOCK = 1.0
"""Trims are means over this long [s]."""
_FEWEST = 5
"""A flight with fewer blocks shows no trim."""
_AIR_SLOPE = 0.02
"""Prior standard deviation of a trim's change with velocity [1 per m/s], as drag at the hubs makes."""


class FlightTrim(NamedTuple):
    """The trim of one flight.

    Attributes:
        mean: trim at zero velocity, shape (4,), see `AXES`.
        parts: the same of parts of the flight (between landings, else thirds), shape (parts, 4).
        shares: each rotor's share of sum(w), shape (rotors,).
        wander: standard deviation of means of three seconds about the flight's, shape (4,).
        seconds: of steady flight.
        channels: what the effort and the motion were taken from, for people.
        turning: root mean square of the rates in steady flight, averaged over `TURN` [rad/s]; NaN without a gyro.
    """

    name: str
    mean: FloatArray
    parts: FloatArray
    shares: FloatArray
    wander: FloatArray
    seconds: float
    channels: str
    turning: float = math.nan


def trim_directions(vehicle: Vehicle) -> FloatArray:
    """Rows of G, shape (3, rotors): what a unit of thrust of each rotor adds to roll, pitch, yaw, in units of the arm.

    Roll and pitch are moments over the arm about the centroid of the rotors, yaw is the spin.
    """
    arms = vehicle.rotor_positions[:, :2] - vehicle.rotor_positions[:, :2].mean(axis=0)
    return np.stack([-arms[:, 1] / vehicle.arm, arms[:, 0] / vehicle.arm, vehicle.spins])


def trim_of_load(load: FloatArray, force: float | FloatArray, vehicle: Vehicle) -> FloatArray:
    """Trims of mean squared rotor speeds (…, rotors) at specific forces (…) [m/s²], shape (…, 4)."""
    total = load.sum(axis=-1)
    balance = load @ trim_directions(vehicle).T / total[..., None]
    return np.concatenate([balance, np.log(total / force)[..., None]], axis=-1)


def flight_trim(recording: Recording, vehicle: Vehicle) -> FlightTrim:
    """The trim of one flight from whatever channels its log holds.

    Args:
        recording: a log with rotor speeds, motor commands or mixer inputs.
        vehicle: geometry, and what the rotor columns mean.

    Raises:
        LogError: no rotor signal, or one that does not fit the vehicle.
        NotIdentifiableError: too little steady flight.
    """
    rotors = rotor_signal(recording, vehicle)
    # 1.5 s after take-off and before landing are no steady flight.
    spans = [(a + 1.5, b - 1.5) for a, b in flying_spans(recording, vehicle)]
    starts = [np.arange(a, b - BLOCK + 1e-9, BLOCK) for a, b in spans if b - a >= BLOCK]
    edges = np.concatenate([np.empty(0), *starts])
    load, kept = _block_means(rotors.t, rotors.values**2, edges)
    if kept.sum() < _FEWEST:
        raise NotIdentifiableError(
            f"{recording.name}: {kept.sum() * BLOCK:.0f} s of steady flight",
            f"{_FEWEST * BLOCK:.0f} s or more between take-off and landing",
            "fly longer, a hover will do",
        )
    edges, load = edges[kept], load[kept]
    force, from_what = _specific_force(recording, edges)
    trims, (motion, moved) = trim_of_load(load, force, vehicle), _motion(recording, edges)
    # Each trim regressed on motion with its prior: the trim at rest and what remains
    noise = np.median(np.abs(trims - np.median(trims, axis=0)), axis=0) / 0.6745 + 1e-6
    mean, rest = np.empty(len(AXES)), np.empty_like(trims)
    design = np.column_stack([np.ones(len(motion)), motion])
    for k, column in enumerate(trims.T):
        ridge = np.diag([0.0, *[float(noise[k] ** 2)] * motion.shape[1]])
        solved = np.linalg.solve(design.T @ design + ridge, design.T @ column)
        mean[k], rest[:, k] = solved[0], column - design @ solved
    # Parts of the flight: between landings, else thirds
    places = np.split(np.arange(len(edges)), np.flatnonzero(np.diff(edges) > 2.0 * BLOCK) + 1)
    places = [part for part in places if len(part) >= 3]
    places = places if len(places) > 1 else np.array_split(np.arange(len(edges)), 3)
    turning = math.nan
    if (gyro := recording.channels.get("gyro")) is not None and len(gyro.t) > 1:
        # Averaged, so that a propeller that shakes is no livelier flight
        rates = moving_mean(gyro.values, max(1, round(TURN / sample_period(gyro.t))))
        squares, enough = _block_means(gyro.t, rates**2, edges)
        turning = float(np.sqrt(squares[enough].sum(axis=1).mean())) if enough.any() else math.nan
    return FlightTrim(
        recording.name,
        mean,
        np.array([mean + rest[part].mean(axis=0) for part in places]),
        (load / load.sum(axis=1)[:, None]).mean(axis=0),
        wander(rest),
        len(edges) * BLOCK,
        f"{rotors.source}; {from_what}; {moved}",
        turning,
    )


def wander(rest: FloatArray) -> FloatArray:
    """Standard deviation of means of three seconds about the flight's, shape (4,), from what remains, (seconds, 4)."""
    count = len(rest) // 3
    return np.asarray(rest[: 3 * count].reshape(count, 3, -1).mean(axis=1).std(axis=0))


def _block_means(t: FloatArray, values: FloatArray, edges: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Means over the blocks that begin at `edges`, shape (blocks, columns), and which blocks hold enough samples."""
    first, end = np.searchsorted(t, edges), np.searchsorted(t, edges + BLOCK)
    sums = np.vstack([np.zeros(values.shape[1]), np.cumsum(values, axis=0)])
    count = end - first
    enough = count >= max(0.6 * BLOCK / sample_period(t), 2.0)
    return (sums[end] - sums[first]) / np.maximum(count, 1)[:, None], enough


def _specific_force(recording: Recording, edges: FloatArray) -> tuple[FloatArray, str]:
    """Thrust over mass in each block [m/s²], shape (blocks,); that of hover without an accelerometer."""
    for name in ("accel", "accel_z", "accel_world"):
        channel = recording.channels.get(name)
        if channel is None or len(channel.t) < 2:
            continue
        world = name == "accel_world"
        values = np.linalg.norm(channel.values, axis=1)[:, None] if world else -channel.values[:, -1:]
        means, enough = _block_means(channel.t, values, edges)
        if enough.all() and (means > 0.1 * GRAVITY).all():
            return means[:, 0], f"force from {channel.source or name}"
    return np.full(len(edges), GRAVITY), "force taken for that of hover"


def _motion(recording: Recording, edges: FloatArray) -> tuple[FloatArray, str]:
    """Motion that moves a trim beside the vehicle itself, over its prior size: velocity, else what stands for it.

    Velocity is the mean of each block [m/s], shape (blocks, 3), turned with the heading where that is known.
    """
    known = {name: channel for name, channel in recording.channels.items() if len(channel.t) > 1}
    position, velocity, attitude = (known.get(name) for name in ("position", "velocity", "attitude"))
    if velocity is not None:
        means, _ = _block_means(velocity.t, velocity.values, edges)
    elif position is not None:
        begin, end = (linear(position.t, position.values, edges + late) for late in (0.0, BLOCK))
        means = (end - begin) / BLOCK
    elif (accel := recording.channels.get("accel")) is not None:
        force, _ = _block_means(accel.t, accel.values[:, :2], edges)
        return force * _AIR_SLOPE, "motion from in-plane force"
    else:
        return np.empty((len(edges), 0)), "no motion"
    if attitude is not None:
        heading = euler(linear(attitude.t, attitude.values, edges + 0.5 * BLOCK))[:, 2]
        c, s = np.cos(heading), np.sin(heading)
        means = np.column_stack([c * means[:, 0] + s * means[:, 1], c * means[:, 1] - s * means[:, 0], means[:, 2]])
    return means * _AIR_SLOPE, "motion from position or velocity"


# --- How far healthy flights of one vehicle differ: the yardstick of every change
#
# Each trim's variance between healthy flights has an inverse-gamma posterior: what the baseline flights show, and,
# where they are few, what their own parts show (battery, landing and taking off again), counted as `PRIOR_FLIGHTS`
# flights. Roll and pitch share one variance, for propellers differ from each other whichever corner they sit on.


PRIOR_FLIGHTS = 4.0
"""Weight of the prior spread, in degrees of freedom."""
_SHARED = np.array([[0.5, 0.5, 0.0, 0.0], [0.5, 0.5, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""Means over the trims that share a variance."""


class Healthy(NamedTuple):
    """Healthy trim and its spread.

    Attributes:
        mean: shape (4,), see `AXES`.
        deviation: standard deviation between healthy flights, shape (4,).
        freedom: degrees of freedom of each, shape (4,).
        shares: each rotor's share of the load, shape (rotors,).
    """

    mean: FloatArray
    deviation: FloatArray
    freedom: FloatArray
    flights: int
    shares: FloatArray

    def predictive(self, flights: int) -> FloatArray:
        """Standard deviation of the mean of `flights` new healthy flights from `mean`, shape (4,)."""
        return np.asarray(self.deviation * np.sqrt(1.0 / flights + 1.0 / self.flights))

    def known_from(self, flights: int) -> "Healthy":
        """The same trim and spread as so many baseline flights would show them."""
        return self._replace(flights=flights, freedom=_freedom(flights))


def _freedom(flights: int) -> FloatArray:
    """Degrees of freedom of each trim's variance, shape (4,)."""
    return np.asarray(PRIOR_FLIGHTS + (flights - 1) / np.diag(_SHARED))


def healthy_spread(baseline: Sequence[FlightTrim]) -> Healthy:
    """Mean and spread of healthy flights.

    Args:
        baseline: one flight or more.
    """
    means = np.array([flight.mean for flight in baseline])
    centre, freedom = means.mean(axis=0), _freedom(len(means))
    inner = [flight.parts - flight.parts.mean(axis=0) for flight in baseline]
    parts = sum(float(len(rows) - 1) for rows in inner)
    within = np.sqrt(sum((rows**2).sum(axis=0) for rows in inner) / max(parts, 1.0))
    # Flights differ twice as much as parts of one flight; rotors of healthy vehicles share the load to 1 % each and
    # better never.
    prior = _SHARED @ np.maximum(2.0 * within, [0.005, 0.005, 0.005, 0.01]) ** 2
    squares = _SHARED @ ((means - centre) ** 2).sum(axis=0) / np.diag(_SHARED)
    shares = np.mean([flight.shares for flight in baseline], axis=0)
    return Healthy(centre, np.sqrt((PRIOR_FLIGHTS * prior + squares) / freedom), freedom, len(means), shares)


# --- Trims of flights as plain data, for whoever keeps them


def flight_to_dict(flight: FlightTrim) -> dict[str, Any]:
    """A flight's trim as plain data."""
    data: dict[str, Any] = jsonable(flight._asdict())
    return data


def flight_from_dict(data: Mapping[str, Any]) -> FlightTrim:
    """The trim of such data; raises ValueError, KeyError or TypeError for what is none."""
    mean, parts, shares, wander = (np.array(data[k], dtype=np.float64) for k in ("mean", "parts", "shares", "wander"))
    if mean.shape != (len(AXES),) or parts.ndim != 2 or parts.shape[1] != len(AXES) or wander.shape != mean.shape:
        raise ValueError(f"a trim of shape {mean.shape}, parts {parts.shape}")
    if shares.ndim != 1 or not all(np.isfinite(v).all() for v in (mean, parts, shares, wander)):
        raise ValueError("numbers that are not finite")
    seconds = float(data["seconds"])
    turning = data.get("turning")
    turns = math.nan if turning is None else float(turning)
    return FlightTrim(str(data["name"]), mean, parts, shares, wander, seconds, str(data["channels"]), turns)
