"""The supply voltage that scales commands: relative to a reference, row by row."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quadid.errors import WindowError
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid.window import Window


def voltage_at(times: FloatArray, t: FloatArray, volts: FloatArray) -> FloatArray | None:
    """Voltage at `times` [V], linear between readings `volts` at `t`; None where no reading is above zero."""
    good = np.isfinite(volts) & (volts > 0.0)
    return np.interp(times, t[good], volts[good]) if good.any() else None


def _voltage(window: Window) -> FloatArray | None:
    """Voltage at every row [V], shape (n,); None without any."""
    rows = np.arange(len(window), dtype=np.float64)
    return None if window.battery is None else voltage_at(rows, rows, np.ravel(window.battery))


def with_reference_voltage(vehicle: Vehicle, windows: Sequence[Window]) -> Vehicle:
    """`vehicle` with its reference voltage: its own, or the mean over `windows` where each of them has a voltage."""
    known = [_voltage(w) for w in windows]
    volts = [v for v in known if v is not None]
    if vehicle.reference_voltage is not None or not volts or len(volts) < len(known):
        return vehicle
    return vehicle.model_copy(update={"reference_voltage": float(np.mean(np.concatenate(volts)))})


def relative_voltage(window: Window, vehicle: Vehicle) -> FloatArray:
    """Logarithm of the supply voltage over the vehicle's reference at each row; 0 where either is not known.

    Raises:
        WindowError: the vehicle's rotors follow the voltage, and it is not known.
    """
    volts = _voltage(window)
    if vehicle.reference_voltage is not None and volts is not None:
        return np.asarray(np.log(volts / vehicle.reference_voltage))
    if vehicle.effects.get("supply_voltage", {}).get("exponent"):
        raise WindowError(
            f"{window.name or 'window'}: no supply voltage, which scales this vehicle's commands (supply_voltage)",
            "battery voltage in the log and reference_voltage in the vehicle file",
            "log the battery, or leave supply_voltage out",
        )  # fmt: skip
    return np.zeros(len(window))
