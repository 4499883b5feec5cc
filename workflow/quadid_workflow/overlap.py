"""Whether a flight was fitted before: the same log, a copy of it, a part of it, a second recorder.

Such a flight is no validation, and what a vehicle file learnt from it is no knowledge beside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from quadid.errors import LogError
from quadid.provenance import MOST_FLIGHTS, FittedFlight
from quadid.resample import linear
from quadid.sanitise import LONGEST_NAME
from quadid.types import FloatArray, IntArray
from quadid.vehicle import Vehicle
from quadid_workflow.loading import Log

Marks = NDArray[np.uint64]

RUN = 8
"""Gyro rows that must agree in a row: 24 numbers with sensor noise do not agree by chance."""
ROUNDED = 4
"""Decimals of the rates [rad/s] that are compared, so that a copy in another format agrees too."""
ALIKE = 0.8
"""Correlation of rates at the same date above which two recorders flew on one vehicle."""
SHORTEST = 2.0
"""Shortest common stretch that is called an overlap [s]."""
KEPT = 16
"""Runs of a fitted flight by which it is known again: those with the smallest hashes, wherever a part is cut."""
COMMON = 2
"""Of them so many in another log make it the same flight."""


def check_unseen(train: Sequence[Log], held: Sequence[Log], vehicle: Vehicle | None = None) -> None:
    """Raises LogError where a validation log holds flight that is fitted too, or that the file was fitted to."""
    for log in held:
        for other in train:
            seconds = max(common_rows(other, log), same_flight(other, log))
            if seconds > 0.0:
                raise LogError(
                    f"{log.name} cannot validate: {seconds:.1f} s of it are in {other.name}, which is fitted",
                    "a flight, or a part of one, that is not fitted",
                    "use another flight for --validate, or parts that do not overlap: LOG@0:60 --validate LOG@60:120",
                )

    for log in held:
        for flight in () if vehicle is None else fitted_before(vehicle, log):
            raise LogError(
                f"{log.name} cannot validate: {flight.log}, to which this vehicle file was fitted, is the same flight",
                "a flight that the file was not fitted to",
                "use another flight for --validate, or the vehicle file from before that fit",
            )


def without_own_priors(vehicle: Vehicle, train: Sequence[Log]) -> tuple[Vehicle, list[str]]:
    """The vehicle without standard deviations that come from the flights to be fitted, and a sentence that says so.

    A flight would count twice otherwise: as data, and as what was known before.
    """
    known = {log.name: flight for log in train for flight in fitted_before(vehicle, log)}
    if not known or all(p.sigma is None for p in vehicle.parameters.values()):
        return vehicle, []
    guesses = {n: p.model_copy(update={"sigma": None}) for n, p in vehicle.parameters.items()}
    told = ", ".join(name if name == flight.log else f"{name} ({flight.log})" for name, flight in known.items())
    return vehicle.model_copy(update={"parameters": guesses}), [
        f"the vehicle file was fitted to {told} already: its values start the fit, but its sigmas are not "
        "used, so that no flight counts twice"
    ]


def fitted_before(vehicle: Vehicle, log: Log) -> list[FittedFlight]:
    """Flights that the values of a vehicle file were fitted to and that this log holds, by content or by date."""
    fitted = () if vehicle.proof is None else vehicle.proof.fitted
    if not fitted:
        return []
    t, rates = gyro(log)
    here, epoch = _runs(rates), log.recording.epoch
    out = []
    for flight in fitted:
        marks = np.array([int(mark, 16) for mark in flight.marks.split()], dtype=np.uint64)
        alike = int(np.isin(marks, here).sum()) >= COMMON
        if not alike and flight.begin is not None and epoch is not None and len(t):
            begin, end = max(flight.begin, t[0] + epoch), min(flight.begin + flight.seconds, t[-1] + epoch)
            alike = end - begin >= SHORTEST
        out += [flight] if alike else []
    return out


def remembered(train: Sequence[Log], vehicle: Vehicle) -> tuple[FittedFlight, ...]:
    """The fitted flights, and those that the vehicle file rested on before, for a new file."""
    out = {}
    for log in train:
        t, rates = gyro(log)
        epoch = log.recording.epoch
        out[log.name] = FittedFlight(
            log=log.name[:LONGEST_NAME], seconds=round(float(np.ptp(t)), 2) if len(t) else 0.0,
            begin=None if epoch is None or not len(t) else round(epoch + float(t[0]), 2),
            marks=" ".join(f"{mark:016x}" for mark in np.unique(_runs(rates))[:KEPT].tolist()),
        )  # fmt: skip
    before = () if vehicle.proof is None else vehicle.proof.fitted
    return (*out.values(), *(flight for flight in before if flight.log not in out))[:MOST_FLIGHTS]


def common_rows(train: Log, held: Log) -> float:
    """Seconds of `held` whose gyro rows stand in `train` too, number by number."""
    (_, a), (t, b) = gyro(train), gyro(held)
    shared = np.isin(_runs(b), _runs(a))
    return (int(shared.sum()) + RUN - 1) * float(np.median(np.diff(t))) if shared.sum() > 1 else 0.0


def same_flight(train: Log, held: Log) -> float:
    """Seconds that both logs have in common by date, where their rates agree; else 0."""
    (s, a), (t, b) = gyro(train), gyro(held)
    begun = train.recording.epoch, held.recording.epoch
    if len(s) < 2 or len(t) < 2 or begun[0] is None or begun[1] is None:
        return 0.0
    t = t + (begun[1] - begun[0])
    inside = (t >= s[0]) & (t <= s[-1])
    common = float(np.ptp(t[inside])) if inside.any() else 0.0
    if common < SHORTEST:
        return 0.0
    again = linear(s, a, t[inside])
    here = b[inside] - b[inside].mean(axis=0)
    again = again - again.mean(axis=0)
    size = math.sqrt(float(np.sum(here**2)) * float(np.sum(again**2)))
    return common if size > 0.0 and float(np.sum(here * again)) / size > ALIKE else 0.0


def gyro(log: Log) -> tuple[FloatArray, FloatArray]:
    """Times [s] and rates [rad/s] (n, 3) inside the part of a log that is used."""
    channel = log.recording.channels.get("gyro")
    if channel is None:
        return np.zeros(0), np.zeros((0, 3))
    low, high = log.cut.span(log.recording)
    used = (channel.t >= low) & (channel.t <= high) & np.isfinite(channel.values).all(axis=1)
    return channel.t[used], channel.values[used]


def _runs(rates: FloatArray) -> Marks:
    """Hashes of the `RUN` rows that begin at each row, but for those in which a sensor does not move."""
    if len(rates) < RUN:
        return np.zeros(0, dtype=np.uint64)
    rounded: IntArray = np.rint(rates * 10.0**ROUNDED).astype(np.int64)
    changes = np.cumsum(np.vstack([np.zeros((1, 3), dtype=np.int64), np.diff(rounded, axis=0) != 0]), axis=0)
    moving = np.all(changes[RUN - 1 :] > changes[: len(changes) - RUN + 1], axis=1)
    axes: Marks = rounded.view(np.uint64)
    rows = _mixed(axes[:, 0] + _mixed(axes[:, 1] + _mixed(axes[:, 2] + np.uint64(1))))
    out = np.zeros(len(rows) - RUN + 1, dtype=np.uint64)
    for k in range(RUN):
        out = _mixed(out + rows[k : k + len(out)])
    return out[moving]


def _mixed(x: Marks) -> Marks:
    """A hash of 64 bits (the finaliser of splitmix64, Steele, Lea and Flood, OOPSLA 2014)."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
