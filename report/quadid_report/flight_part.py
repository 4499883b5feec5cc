"""What a log tells of its flight beside the outputs: flight modes, and the spectrum of its vibration."""

from __future__ import annotations

from typing import Any

import numpy as np

from quadid.inspection.airborne import Spans, flying_spans, within
from quadid.resample import sample_period
from quadid.rotor_signal import rotor_channel
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid.window import Channel, Recording
from quadid_report.parts import axis, figure, rows_of, section, trace, upright

SECONDS = 2.0
"""Length of the stretches whose spectra are averaged: lines half a hertz apart are told apart."""
MOST_POINTS = 400
_AXES = ("forward", "to the right", "downwards")
_ROLES = ("measured", "before", "after")


def flight_section(recording: Recording, vehicle: Vehicle, place: int) -> dict[str, Any] | None:
    """Modes and vibration of one log as a section of a page; None where it tells neither.

    Args:
        recording: as read, each channel at its own rate.
        vehicle: whose log it is.
        place: of the log among those of the page.
    """
    spans = flying_spans(recording, vehicle)
    drawn, said = _vibration(recording, vehicle, spans, f"log{place}-vibration") if spans else (None, "")
    modes = mode_rows(recording)
    if drawn is None and not modes:
        return None
    figures = [] if drawn is None else [drawn]
    tables = [rows_of(("flight mode", "from (s)", "to (s)"), modes)] if modes else []
    return section(f"flight-{place}", f"Flight of {recording.name}", said, figures, tables)


def mode_rows(recording: Recording) -> list[list[str]]:
    """Flight modes with the times between which they held [s after the first IMU sample]."""
    imu = [c.t for n, c in recording.channels.items() if n in ("gyro", "accel")]
    if not recording.modes or not imu:
        return []
    zero, end = min(float(t[0]) for t in imu), max(float(t[-1]) for t in imu)
    starts = [t for t, _ in recording.modes]
    held = zip(recording.modes, [*starts[1:], end], strict=True)
    return [
        [name, f"{max(begin - zero, 0.0):.1f}", f"{stop - zero:.1f}"] for (begin, name), stop in held if stop > zero
    ]


def _vibration(
    recording: Recording, vehicle: Vehicle, spans: Spans, identifier: str
) -> tuple[dict[str, Any] | None, str]:
    """Amplitude spectrum of the accelerometer in the air, and a sentence about where the rotors are in it."""
    accel = recording.channels.get("accel")
    found = None if accel is None else spectrum(accel, spans)
    if found is None:
        return None, ""
    frequency, density = found
    data = [
        trace(role, name, frequency, density[:, i]) for i, (role, name) in enumerate(zip(_ROLES, _AXES, strict=True))
    ]
    turning, said = _turning(recording, vehicle, spans, float(frequency[-1]))
    layout = {
        "xaxis": axis("frequency (Hz)"),
        "yaxis": axis("(m/s²)/√Hz", type="log"),
        "shapes": [] if turning is None else [upright(turning)],
    }
    return figure(identifier, "Vibration in the air", data, layout, 300), said


def spectrum(accel: Channel, spans: Spans) -> tuple[FloatArray, FloatArray] | None:
    """Amplitude spectral density of the specific force, averaged over the flight (Welch).

    Args:
        accel: at its own rate.
        spans: when it flies [s].

    Returns:
        Frequencies [Hz], shape (n,), and densities [(m/s^2)/sqrt(Hz)], shape (n, 3); None where no stretch is long
        enough.
    """
    from scipy.signal import welch

    rate = 1.0 / sample_period(accel.t)
    rows = round(SECONDS * rate)
    parts = [accel.values[(accel.t >= a) & (accel.t <= b)] for a, b in spans]
    parts = [p for p in parts if len(p) >= rows]
    if rows < 8 or not parts:
        return None
    each = [welch(p, rate, nperseg=rows, axis=0) for p in parts]
    power = np.average([p for _, p in each], axis=0, weights=[len(p) for p in parts])
    keep = np.unique(np.linspace(1, len(power) - 1, MOST_POINTS).astype(int))
    return each[0][0][keep], np.sqrt(power[keep])


def _turning(recording: Recording, vehicle: Vehicle, spans: Spans, highest: float) -> tuple[float | None, str]:
    """Where the mean rotor speed in flight shows in the spectrum [Hz], and that in words."""
    rotors, _ = rotor_channel(recording, vehicle)
    if rotors is None or rotors.name != "rotor_speed":
        return None, "The rotor speed is not logged; peaks are most often rotors out of balance."
    turns = float(np.mean(rotors.values[within(rotors.t, spans)])) / (2.0 * np.pi)
    if turns <= highest:
        return turns, f"The rotors turn {turns:.0f} times a second (dashed): a peak there is imbalance."
    folded = abs(turns - 2.0 * highest * round(turns / (2.0 * highest)))
    return None, (
        f"The rotors turn {turns:.0f} times a second, faster than this log can show ({highest:.0f} Hz): without a "
        f"filter before sampling their imbalance appears at {folded:.0f} Hz."
    )
