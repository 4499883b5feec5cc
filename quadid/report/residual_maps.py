"""Picture of a cause in the residual: binned against the quantity it depends on, with the cause and without.

A cause leaves a shape: a lag an error in step with the angular acceleration, drag one in step with speed, a failing
battery one in step with time.  Every effect lists the few pairs of channel and quantity where its equation puts it; the
pair where switching it off shows most is drawn.  Flat at zero is what a complete model leaves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from quadid.chi_square import Z95
from quadid.data.window import CHANNEL_NAMES, CHANNEL_UNITS, Window, beginning
from quadid.effects import EFFECTS, NEVER
from quadid.identification.noise import NoiseModel
from quadid.identification.problem import Linearised, Shooting
from quadid.identification.result import SCORE_SECONDS, covering, settle_states
from quadid.model.layout import Layout
from quadid.report.page import axis, figure, level, trace
from quadid.rotation import conjugate, rotated
from quadid.types import BoolArray, FloatArray, IndexArray
from quadid.vehicle import GRAVITY, Vehicle

Mode = Literal["value", "slope"]

BINS = 24
SLOPE_SECONDS = 0.1
"""Span over which a residual's rate of change is taken [s]."""
MOST_SECONDS = 300.0
"""Flight that a map is made of, at most [s]."""
_VELOCITY = slice(7, 10)


def _pair(text: str) -> tuple[Mode, int, str]:
    """Kind of residual, its channel, and what it is drawn against, from the table's words."""
    channel, against = text.split(": ")
    return ("slope" if channel.endswith("'") else "value"), CHANNEL_NAMES.index(channel.rstrip("'")), against


PAIRS = {e.name: tuple(_pair(text) for text in e.shows) for e in EFFECTS.values()}
"""Place at which each effect shows: how the residual is taken, its channel, and the quantity it is drawn against."""
_NAMES = {
    "time": ("time", "s"), "p": ("roll rate", "rad/s"), "q": ("pitch rate", "rad/s"), "r": ("yaw rate", "rad/s"),
    "p_dot": ("roll acceleration", "rad/s^2"), "q_dot": ("pitch acceleration", "rad/s^2"),
    "r_dot": ("yaw acceleration", "rad/s^2"), "v_x": ("forward speed", "m/s"), "v_y": ("speed to the right", "m/s"),
    "v_z": ("downward speed", "m/s"), "thrust": ("thrust over its mean", ""), "heading": ("heading", "rad"),
    "thrust_rate": ("rate of change of thrust over its mean", "1/s"), "rotor_speed": ("mean rotor speed", "rad/s"),
    "spin_rate": ("rate of change of the summed rotor speed", "rad/s^2"), "height": ("height", "m"),
    "v_n": ("logged velocity north", "m/s"), "v_e": ("logged velocity east", "m/s"),
    "v_d": ("logged velocity down", "m/s"),
}  # fmt: skip


@dataclass(frozen=True)
class ResidualMap:
    """Mean residual (measured less simulated) in bins of a quantity.

    Attributes:
        channel, unit: what is off.
        against, against_unit: what it is drawn against.
        x: middle of the bins, shape (bins,).
        before, after: mean residual without and with the cause, shape (bins,).
        before_error, after_error: 95 % half-widths from the spread between stretches of 1 s.
        seen: mean square of the bins without the cause less that with it, in variances of a sample with it.
    """

    channel: str
    unit: str
    against: str
    against_unit: str
    x: FloatArray
    before: FloatArray
    after: FloatArray
    before_error: FloatArray
    after_error: FloatArray
    seen: float


def residual_map(
    windows: Sequence[Window],
    vehicle: Vehicle,
    theta: FloatArray,
    effect: str,
    names: Sequence[str],
    noise: NoiseModel | None = None,
) -> ResidualMap | None:
    """Residual with a cause and with it switched off, all else unchanged, where it shows most.

    Args:
        windows: flight; its first `MOST_SECONDS` are used.
        theta: full parameter vector with the cause, shape (size,).
        effect: name of the cause.
        names: its entries of the vector, as ``motor_lag.tau``.

    Returns:
        The map, against time only where nothing else of the equation is known; None where the flight lacks the
        channels.
    """
    shooting = Shooting.cut(beginning(windows, MOST_SECONDS, 2.0 * SCORE_SECONDS)[0], vehicle, SCORE_SECONDS)
    if not shooting.rollouts or effect not in PAIRS:
        return None
    shooting = shooting.with_noise(covering(noise, shooting.channels, vehicle))
    settled = settle_states(shooting, theta)
    after = _residuals(settled)
    signals = _signals(shooting, after, settled)
    before = _residuals(settle_states(shooting, switched_off(shooting.layout, theta, effect, names)))
    drawn = [
        (quantity == "time", _binned(shooting, before, after, mode, channel, quantity, signals[quantity]))
        for mode, channel, quantity in PAIRS[effect]
        if quantity in signals
    ]
    # Against time everything shows; what the equation depends on shows more.
    found = [(late, m) for late, m in drawn if m is not None]
    return max(found, key=lambda f: (not f[0], f[1].seen), default=(True, None))[1]


def switched_off(layout: Layout, theta: FloatArray, effect: str, names: Sequence[str]) -> FloatArray:
    """The vector with one cause at neutral."""
    out = layout.without(theta, names)
    if f"{effect}.time" in layout.entries:
        out[layout.entry(f"{effect}.time").index] = NEVER
    return out


def _residuals(lin: Linearised) -> FloatArray:
    """Measured less simulated, (segments, length, channels); NaN where not measured."""
    return np.where(lin.weights > 0.0, -lin.residuals, np.nan)


def _signals(shooting: Shooting, residual: FloatArray, settled: Linearised) -> dict[str, FloatArray]:
    """Quantities at the samples of all segments, (segments, length); rates are simulated ones, free of gyro noise."""
    starts = settled.states.at(settled.n_pre, shooting.rollouts, shooting.segments).x0
    parts: list[dict[str, FloatArray]] = []
    place = 0
    for rollout, segments, x0 in zip(shooting.rollouts, shooting.segments, starts, strict=True):
        rows = segments.rows
        mine = residual[place : place + len(rows)]
        place += len(rows)
        signals = _of_window(rollout.window, rows, rollout.measured[rows][..., :3] - mine[..., :3], shooting)
        parts.append(signals | _in_the_air(rollout.window, rows, x0[:, _VELOCITY], settled.n_pre))
    shared = set.intersection(*(set(p) for p in parts))
    return {name: np.concatenate([p[name] for p in parts]) for name in shared}


def _of_window(window: Window, rows: IndexArray, rates: FloatArray, shooting: Shooting) -> dict[str, FloatArray]:
    dt, speed = window.dt, window.rotor_speed
    square = np.mean(speed**2, axis=1)
    spins = shooting.vehicle.spins
    start = window.log_span[0] if np.isfinite(window.log_span[0]) else window.t0
    level = square / square.mean()
    out = {
        "time": window.t[rows] - start,
        "thrust": level[rows],
        "thrust_rate": np.gradient(level, dt)[rows],
        "rotor_speed": speed.mean(axis=1)[rows],
        "spin_rate": np.gradient(speed @ spins, dt)[rows],
    }
    for i, name in enumerate("pqr"):
        out[name] = rates[..., i]
        out[f"{name}_dot"] = np.gradient(rates[..., i], dt, axis=1)
    if window.velocity is not None:
        out |= {name: window.velocity[rows, i] for i, name in enumerate(("v_n", "v_e", "v_d"))}
    if window.position is not None:
        out["height"] = -window.position[rows, 2]
    return out


def _in_the_air(window: Window, rows: IndexArray, start: FloatArray, n_pre: int) -> dict[str, FloatArray]:
    """Heading, and body velocity: measured, else from the velocity fitted at each start and the accelerometer.

    Args:
        rows: of the samples, (segments, length).
        start: fitted velocity `n_pre` rows before each segment [m/s], (segments, 3).
        n_pre: rows between the start and the segment.
    """
    if window.attitude is None:
        return {}
    w, x, y, z = window.attitude[rows].transpose(2, 0, 1)
    out = {"heading": np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))}
    v = None if window.velocity is None else window.velocity[rows]
    if v is None and window.accel is not None:
        along = np.concatenate([rows[:, :1] + np.arange(1 - n_pre, 0), rows], axis=1)
        pull = rotated(window.attitude[along], window.accel[along]) + [0.0, 0.0, GRAVITY]
        v = (start[:, None] + window.dt * np.cumsum(pull, axis=1))[:, n_pre - 1 :]
    if v is not None:
        body = rotated(conjugate(window.attitude[rows]), v)
        out |= {"v_x": body[..., 0], "v_y": body[..., 1], "v_z": body[..., 2]}
    return out


def _binned(
    shooting: Shooting,
    before: FloatArray,
    after: FloatArray,
    mode: str,
    channel: int,
    quantity: str,
    signal: FloatArray,
) -> ResidualMap | None:
    if channel >= before.shape[2]:
        return None
    both = [before[..., channel], after[..., channel]]
    if mode == "slope":
        k = max(round(SLOPE_SECONDS / shooting.dt), 1)
        both = [(r[:, k:] - r[:, :-k]) / (k * shooting.dt) for r in both]
        total = np.cumsum(np.concatenate([np.zeros((len(signal), 1)), signal], axis=1), axis=1)
        signal = (total[:, k:-1] - total[:, : -k - 1]) / k
    good = np.isfinite(both[0]) & np.isfinite(both[1]) & np.isfinite(signal)
    if np.count_nonzero(good) < 20 * BINS or np.ptp(signal[good]) <= 0.0:
        return None
    values = signal[good]
    spread = np.linspace(values.min(), values.max(), BINS + 1)
    edges = spread if quantity == "time" else np.quantile(values, np.linspace(0.0, 1.0, BINS + 1))
    label = np.clip(np.searchsorted(edges, signal, side="right") - 1, 0, BINS - 1)
    x = np.array([np.mean(signal[good & (label == i)]) if (good & (label == i)).any() else np.nan for i in range(BINS)])
    (mean_b, error_b), (mean_a, error_a) = (_means(r, label, good) for r in both)
    told = np.isfinite(error_b) & np.isfinite(error_a) & (error_b > 0.0) & (error_a > 0.0)
    if np.count_nonzero(told) < BINS // 2:
        return None
    seen = float(np.mean(mean_b[told] ** 2 - mean_a[told] ** 2) / max(float(np.var(both[1][good])), 1e-300))
    name, unit = CHANNEL_NAMES[channel], CHANNEL_UNITS[channel]
    if mode == "slope":
        name, unit = f"d{name}/dt", f"{unit}^2" if unit.endswith("/s") else f"{unit}/s"
    return ResidualMap(
        name, unit, *_NAMES[quantity], x[told], mean_b[told], mean_a[told], error_b[told], error_a[told], seen
    )


def _means(values: FloatArray, label: IndexArray, good: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Mean of each bin, and its 95 % half-width from the means of the stretches, which are nearly independent."""
    segment = np.broadcast_to(np.arange(len(values))[:, None], values.shape)
    key = (segment * BINS + label)[good]
    size = len(values) * BINS
    count = np.bincount(key, minlength=size).reshape(-1, BINS)
    total = np.bincount(key, weights=values[good], minlength=size).reshape(-1, BINS)
    samples = count.sum(axis=0)
    stretches = np.count_nonzero(count, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = total.sum(axis=0) / samples
        scatter = np.sum((total - count * mean) ** 2, axis=0) / samples**2
        error = Z95 * np.sqrt(scatter * stretches / np.maximum(stretches - 1, 1))
    return mean, np.where(stretches >= 4, error, np.nan)


def map_figure(found: ResidualMap, identifier: str, title: str) -> dict[str, Any]:
    """The picture of a cause: residual against its quantity, with the cause in the model and with it switched off."""
    data = []
    for role, name, mean, error in (
        ("before", f"without {title}", found.before, found.before_error),
        ("after", f"with {title}", found.after, found.after_error),
    ):
        bars = {"type": "data", "array": error.tolist()}
        data.append(trace(role, name, found.x, mean, mode="lines+markers", error_y=bars, showlegend=True))
    unit = f" [{found.against_unit}]" if found.against_unit else ""
    layout = {
        "xaxis": axis(f"{found.against}{unit}"),
        "yaxis": axis(f"{found.channel} [{found.unit}]", zeroline=True),
        "hovermode": "closest",
        "shapes": [level(0.0)],
    }
    caption = f"mean of measured less simulated {found.channel} against {found.against}; flat at zero is right"
    return figure(identifier, "What it looks like", data, layout, 280, caption=caption)
