"""Trims of flights: how the rotors share the load when nothing is commanded, and the spread of healthy flights."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from quadid.checks.motion import flying_spans
from quadid.data.grid import linear, moving_mean
from quadid.data.rotor_signal import rotor_signal
from quadid.data.window import Recording, sample_period
from quadid.errors import NotIdentifiableError
from quadid.jsonable import jsonable
from quadid.types import BoolArray, FloatArray, IndexArray
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
_CLIMB_OUT = 1.5
"""Seconds after take-off and before landing that are no steady flight."""
_TURN = 0.2
"""Rates are averaged over this long [s], so that a propeller that shakes is no livelier flight."""
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
        turning: root mean square of the rates in steady flight, averaged over `_TURN` [rad/s]; NaN without a gyro.
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
    spans = [(a + _CLIMB_OUT, b - _CLIMB_OUT) for a, b in flying_spans(recording, vehicle)]
    starts = [np.arange(a, b - BLOCK + 1e-9, BLOCK) for a, b in spans if b - a >= BLOCK]
    edges = np.concatenate(starts) if starts else np.empty(0)
    load, kept = _block_means(rotors.t, rotors.values**2, edges)
    if kept.sum() < _FEWEST:
        raise NotIdentifiableError(
            f"{recording.name}: {kept.sum() * BLOCK:.0f} s of steady flight",
            f"{_FEWEST * BLOCK:.0f} s or more between take-off and landing",
            "fly longer, a hover will do",
        )
    edges, load = edges[kept], load[kept]
    force, from_what = _specific_force(recording, edges)
    total = load.sum(axis=1)
    trims = trim_of_load(load, force, vehicle)
    motion, moved = _motion(recording, edges)
    mean, rest = _at_rest(trims, motion)
    parts = [mean + rest[places].mean(axis=0) for places in _parts(edges)]
    return FlightTrim(
        recording.name,
        mean,
        np.array(parts),
        (load / total[:, None]).mean(axis=0),
        wander(rest),
        len(edges) * BLOCK,
        f"{rotors.source}; {from_what}; {moved}",
        _turning(recording, edges),
    )


def _turning(recording: Recording, edges: FloatArray) -> float:
    """Rate of turning in the blocks that begin at `edges`, see `FlightTrim.turning`."""
    gyro = recording.channels.get("gyro")
    if gyro is None or len(gyro.t) < 2:
        return math.nan
    rates = moving_mean(gyro.values, max(1, round(_TURN / sample_period(gyro.t))))
    squares, enough = _block_means(gyro.t, rates**2, edges)
    return float(np.sqrt(squares[enough].sum(axis=1).mean())) if enough.any() else math.nan


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
    """Motion that moves a trim beside the vehicle itself, over its prior size: velocity, else what stands for it."""
    velocity = _velocity(recording, edges)
    if velocity is not None:
        return velocity * _AIR_SLOPE, "motion from position or velocity"
    accel = recording.channels.get("accel")
    if accel is not None:
        force, _ = _block_means(accel.t, accel.values[:, :2], edges)
        return force * _AIR_SLOPE, "motion from in-plane force"
    return np.empty((len(edges), 0)), "no motion"


def _velocity(recording: Recording, edges: FloatArray) -> FloatArray | None:
    """Mean velocity of each block [m/s], shape (blocks, 3), turned with the heading where it is known; else None."""
    position, velocity = recording.channels.get("position"), recording.channels.get("velocity")
    if velocity is not None and len(velocity.t) > 1:
        means, _ = _block_means(velocity.t, velocity.values, edges)
    elif position is not None and len(position.t) > 1:
        begin, end = (linear(position.t, position.values, edges + late) for late in (0.0, BLOCK))
        means = (end - begin) / BLOCK
    else:
        return None
    attitude = recording.channels.get("attitude")
    if attitude is not None and len(attitude.t) > 1:
        w, x, y, z = linear(attitude.t, attitude.values, edges + 0.5 * BLOCK).T
        heading = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        c, s = np.cos(heading), np.sin(heading)
        means = np.column_stack([c * means[:, 0] + s * means[:, 1], c * means[:, 1] - s * means[:, 0], means[:, 2]])
    return means


def _at_rest(trims: FloatArray, motion: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Regresses trims on motion with its prior; returns the trim at rest (4,) and what remains, shape (blocks, 4)."""
    noise = np.median(np.abs(trims - np.median(trims, axis=0)), axis=0) / 0.6745 + 1e-6
    out = np.empty(trims.shape[1])
    rest = np.empty_like(trims)
    for k, column in enumerate(trims.T):
        design = np.column_stack([np.ones(len(motion)), motion])
        ridge = np.diag([0.0, *[float(noise[k] ** 2)] * motion.shape[1]])
        solved = np.linalg.solve(design.T @ design + ridge, design.T @ column)
        out[k], rest[:, k] = solved[0], column - design @ solved
    return out, rest


def _parts(edges: FloatArray) -> Sequence[IndexArray]:
    """Blocks of each part of a flight: between landings, else thirds."""
    breaks = np.flatnonzero(np.diff(edges) > 2.0 * BLOCK) + 1
    parts = np.split(np.arange(len(edges)), breaks)
    long = [part for part in parts if len(part) >= 3]
    return long if len(long) > 1 else np.array_split(np.arange(len(edges)), 3)


# --- How far healthy flights of one vehicle differ: the yardstick of every change
#
# Each trim's variance between healthy flights has an inverse-gamma posterior: what the baseline flights show, and,
# where they are few, what their own parts show (battery, landing and taking off again), counted as `PRIOR_FLIGHTS`
# flights. Roll and pitch share one variance, for propellers differ from each other whichever corner they sit on.


PRIOR_FLIGHTS = 4.0
"""Weight of the prior spread, in degrees of freedom."""
LEAST = np.array([0.005, 0.005, 0.005, 0.01])
"""Smallest prior spread of `AXES`: rotors of healthy vehicles share the load to 1 % each and better never."""
_GROUPS = ((0, 1), (2,), (3,))
"""Trims that share a variance."""


class Healthy(NamedTuple):
    """Healthy trim and its spread.

    Attributes:
        mean: shape (4,), see `trims.AXES`.
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


def healthy_spread(baseline: Sequence[FlightTrim]) -> Healthy:
    """Mean and spread of healthy flights.

    Args:
        baseline: one flight or more.
    """
    means = np.array([flight.mean for flight in baseline])
    centre = means.mean(axis=0)
    inner = [flight.parts - flight.parts.mean(axis=0) for flight in baseline]
    parts = sum(float(len(rows) - 1) for rows in inner)
    within = np.sqrt(sum((rows**2).sum(axis=0) for rows in inner) / max(parts, 1.0))
    # Flights differ twice as much as parts of one flight.
    prior = np.maximum(2.0 * within, LEAST)
    squares = ((means - centre) ** 2).sum(axis=0)
    freedom = _freedom(len(means))
    variance = np.zeros(len(AXES))
    for group in map(list, _GROUPS):
        variance[group] = (PRIOR_FLIGHTS * np.mean(prior[group] ** 2) + squares[group].sum()) / freedom[group]
    shares = np.mean([flight.shares for flight in baseline], axis=0)
    return Healthy(centre, np.sqrt(variance), freedom, len(means), shares)


def _freedom(flights: int) -> FloatArray:
    """Degrees of freedom of each trim's variance, shape (4,)."""
    out = np.zeros(len(AXES))
    for group in map(list, _GROUPS):
        out[group] = PRIOR_FLIGHTS + len(group) * (flights - 1)
    return out


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
