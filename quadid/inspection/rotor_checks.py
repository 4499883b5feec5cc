"""Rotor signals against each other, the thrust felt and the motion: dead, stuck, halved, and out of time.

All checks need flight only, no fit: a rotor that reads nothing, holds one value or half its speed, thrust per speed
squared that changes by more than any battery or payload makes it, and torque that does not stand in one fixed place in
time before the angular acceleration that it causes.
"""

from __future__ import annotations

import numpy as np

from quadid.errors import QuadidError
from quadid.inspection.airborne import Spans, within
from quadid.inspection.findings import Check, CheckResult
from quadid.resample import true_runs
from quadid.rotor_signal import RotorSignal, rotor_signal
from quadid.types import BoolArray, FloatArray
from quadid.vehicle import Vehicle
from quadid.window import Channel, Recording

_BIN = 0.5
"""Means over this long [s] are compared: fast motion has passed by then."""
_DEAD, _DEAD_SHARE, _IDLE_SHARE = 0.1, 0.05, 0.5
"""A rotor below this share of the median speed for this share of the flight is dead; a command may rest longer."""
_LEVELS = 40
"""Rotors that read fewer different values may be too coarse."""
_STUCK = 1.0
"""A rotor that holds one value this long [s] while the vehicle moves is stuck."""
_IMBALANCE, _UNBALANCED = 0.72, 0.1
"""Mean moment of the squares about roll and pitch, over that of one hovering rotor at its arm, and how long it stands.

One of four that reads half its speed makes 0.75; one that lost 45 % of its thrust, and turns faster for it, 0.64.
"""
_THRUST_RANGE = 1.8
"""Thrust felt per speed squared: 90 % over 10 % quantile.  A payload of half the weight makes 1.5."""

Bins = tuple[FloatArray, BoolArray]
"""Means (m, columns) and which bins hold samples (m,)."""


Problem = tuple[str, dict[str, float]]
_NAME = "rotor_speed"
_FIX = "repair that sensor or its wiring, leave it out with motor commands, or use the part of the flight before it"
_COMMANDED = "these are commands: a damaged rotor is driven harder, which `quadid health` measures; or they mean thrust"


def readings_check(recording: Recording, vehicle: Vehicle, spans: Spans) -> Check | None:
    """A rotor that reads nothing or holds one value, all that read the same, coarse steps; None for none of these."""
    try:
        signal = rotor_signal(recording, vehicle)
    except QuadidError:
        return None
    inside = within(signal.t, spans)
    if np.count_nonzero(inside) < 20:
        return None
    most = _IDLE_SHARE if _commanded(signal, recording) else _DEAD_SHARE
    values = signal.values[inside]
    step = _coarse(values)
    if step:
        message = f"rotor speeds come in steps of {step:.3g} rad/s: too coarse for the motion ({signal.source})"
        return Check(_NAME, CheckResult.WARNING, message, "log them finer, or motor commands", {"step_rad_s": step})
    problem = _dead(values, most) or _same(values) or _stuck(signal, recording, inside)
    return problem and Check(_NAME, CheckResult.ERROR, f"{problem[0]} ({signal.source})", _FIX, problem[1])


def _coarse(speeds: FloatArray) -> float:
    """Step [rad/s] between the few values that rotors read; 0 where it is finer than half their spread."""
    levels = [np.unique(column) for column in speeds.T]
    if max(map(len, levels)) > _LEVELS or min(map(len, levels)) < 3:
        return 0.0
    step = float(np.median(np.concatenate([np.diff(values) for values in levels])))
    return step if step > 0.5 * float(np.median(np.std(speeds, axis=0))) else 0.0


def _same(speeds: FloatArray) -> Problem | None:
    """Columns that are one: their differences, which turn the vehicle, are lost."""
    if speeds.shape[1] < 3 or np.ptp(speeds) == 0.0 or np.any(speeds != speeds[:, :1]):
        return None
    return "all rotor columns are the same: one was written for all", {"columns": float(speeds.shape[1])}


def _commanded(signal: RotorSignal, recording: Recording) -> bool:
    command = recording.channels.get("motor_command")
    return command is not None and signal.source == command.source


def rotor_speed_check(recording: Recording, vehicle: Vehicle, spans: Spans) -> Check:
    """Each rotor against the others and all against the thrust felt; the first that cannot be true is named."""
    name = _NAME
    try:
        signal = rotor_signal(recording, vehicle)
    except QuadidError as error:
        return Check(name, CheckResult.UNKNOWN, error.found)
    edges = _edges(spans)
    inside = within(signal.t, spans)
    if len(edges) < 4 or np.count_nonzero(inside) < 20:
        return Check(name, CheckResult.UNKNOWN, "too little flight to compare the rotors")
    squares, known = _means(signal.t, signal.values**2, edges, spans)
    problem = (_unbalanced(squares[known], vehicle) if known.any() else None) or _against_thrust(
        recording, squares, known, edges, spans
    )
    if problem is not None and _commanded(signal, recording):
        return Check(name, CheckResult.WARNING, f"{problem[0]} ({signal.source})", _COMMANDED, problem[1])
    if problem is not None:
        return Check(name, CheckResult.ERROR, f"{problem[0]} ({signal.source})", _FIX, problem[1])
    return Check(name, CheckResult.OK, "the rotors agree with each other and with the thrust felt")


def _edges(spans: Spans) -> FloatArray:
    return np.arange(spans[0][0], spans[-1][1] + 0.5 * _BIN, _BIN) if spans else np.empty(0)


def _means(t: FloatArray, values: FloatArray, edges: FloatArray, spans: Spans) -> Bins:
    """Means of columns over the bins that lie in flight."""
    row = np.digitize(t, edges)
    count = np.bincount(row, minlength=len(edges) + 1)[1:-1]
    sums = [np.bincount(row, column, minlength=len(edges) + 1)[1:-1] for column in values.T]
    inside = np.any([(edges[:-1] >= a) & (edges[1:] <= b) for a, b in spans], axis=0)
    return np.column_stack(sums) / np.maximum(count, 1)[:, None], np.asarray(inside & (count > 2))


def _dead(speeds: FloatArray, most: float) -> Problem | None:
    """A rotor that reads nothing for a share `most` of the time in which the others turn (else it is closed)."""
    turning = speeds[speeds > 0.0]
    if not len(turning):
        return None
    still = _DEAD * np.median(turning)
    others = np.median(speeds, axis=1) > still
    share = np.mean(speeds[others] < still, axis=0) if others.any() else np.zeros(speeds.shape[1])
    if share.max() < most:
        return None
    rotor = int(np.argmax(share))
    return (
        f"rotor {rotor + 1} reads nothing for {share[rotor]:.0%} of the flight: its speed signal is dead",
        {"rotor": rotor + 1.0, "dead_share": float(share[rotor])},
    )


def _stuck(signal: RotorSignal, recording: Recording, inside: BoolArray) -> Problem | None:
    """A value held while the vehicle moves, unless it is a limit that all rotors share."""
    gyro = recording.channels.get("gyro")
    t, values = signal.t[inside], signal.values[inside]
    low, high = np.min(values), np.max(values)
    if np.ptp(values, axis=0).max() == 0.0 and gyro is not None and _moves(gyro, t[0], t[-1]):
        return (
            "no rotor ever changes its speed, though the vehicle moves: the speed signal is stuck",
            {"stuck_s": float(t[-1] - t[0])},
        )  # fmt: skip
    for rotor, column in enumerate(values.T):
        same = np.append(column[1:] == column[:-1], False) & (column > low) & (column < high)
        begin, end = _longest(t, same)
        if end - begin > _STUCK and gyro is not None and _moves(gyro, begin, end):
            return (
                f"rotor {rotor + 1} holds {column[np.searchsorted(t, begin)]:.4g} rad/s for {end - begin:.2g} s of "
                "moving flight: its speed signal is stuck",
                {"rotor": rotor + 1.0, "stuck_s": end - begin},
            )
    return None


def _longest(t: FloatArray, same: BoolArray) -> tuple[float, float]:
    first, end = true_runs(same)
    if not len(first):
        return 0.0, 0.0
    begins, ends = t[first], t[np.minimum(end, len(t) - 1)]
    longest = int(np.argmax(ends - begins))
    return float(begins[longest]), float(ends[longest])


def _moves(gyro: Channel, begin: float, end: float) -> bool:
    inside = (gyro.t >= begin) & (gyro.t <= end)
    return bool(inside.any() and np.max(np.std(gyro.values[inside], axis=0)) > 0.1)


def _unbalanced(squares: FloatArray, vehicle: Vehicle) -> Problem | None:
    """Mean roll and pitch moment of the rotors: half a second without balance turns a vehicle over.

    Yaw is left free, for a vehicle may turn for long.  One rotor is named: that whose square, set to what balance
    needs, agrees best with the others.
    """
    lever = vehicle.torque_arms[:, :2] / vehicle.arm
    share = squares / np.maximum(squares.sum(axis=1, keepdims=True), 1e-9)
    odd = np.linalg.norm(share @ lever, axis=1) > _IMBALANCE / (len(lever) - 0.25)
    if odd.mean() < _UNBALANCED:
        return None
    typical = np.median(share[odd], axis=0)
    fits = []
    for rotor, arm in enumerate(lever):
        needed = typical.copy()
        needed[rotor] -= float(typical @ lever @ arm / (arm @ arm))
        if needed[rotor] > 0.0:
            fits.append(
                (float(np.std(needed) / np.mean(needed)), rotor, float(np.sqrt(typical[rotor] / needed[rotor])))
            )
    if not fits:
        return "the rotor speeds are far from balance", {"share": float(odd.mean())}
    _, rotor, ratio = min(fits)
    return (
        f"rotor {rotor + 1} reads {ratio:.2f} times the speed that balance needs for {odd.mean():.0%} of the flight",
        {"rotor": rotor + 1.0, "speed_ratio": ratio, "share": float(odd.mean())},
    )


def _against_thrust(
    recording: Recording, squares: FloatArray, known: BoolArray, edges: FloatArray, spans: Spans
) -> Problem | None:
    accel = recording.channels.get("accel")
    if accel is None:
        return None
    force, felt = _means(accel.t, -accel.values[:, 2:], edges, spans)
    total = squares.sum(axis=1)
    used = known & felt & (total > 0.0)
    if np.count_nonzero(used) < 10:
        return None
    low, high = np.quantile(force[used, 0] / total[used], [0.1, 0.9])
    if low > 0.0 and high < _THRUST_RANGE * low:
        return None
    ratio = float(high / low) if low > 0.0 else float("inf")
    return (
        f"thrust felt per rotor speed squared changes by a factor of {ratio:.2g} within the flight: "
        "the rotor speeds disagree with the accelerometer",
        {"thrust_range": ratio},
    )
