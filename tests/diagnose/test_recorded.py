"""A real vehicle whose nominal model follows nothing: what is known to be there must be found all the same."""

from __future__ import annotations

from pathlib import Path

from quadid_replay import open_log

from quadid.diagnose import diagnose
from quadid.grid import to_windows
from quadid.vehicle import Vehicle
from quadid.window import Window

LAG = (0.030, 0.045)
"""Between PWM and speed a regression gives about 40 ms; the split into lag and delay is not known."""


def windows_of(data: Path, vehicle: Vehicle, *names: str) -> list[Window]:
    """All windows of some flights at 50 Hz."""
    return [w for n in names for w in to_windows(open_log(data / "crazyflie_rpm" / f"{n}.csv"), vehicle)]


def test_lag_drag_and_its_moment_of_a_crazyflie_seen_through_its_commands(data_dir: Path) -> None:
    vehicle = Vehicle.from_yaml((data_dir / "crazyflie_rpm" / "vehicle_pwm.yaml").read_text(encoding="utf-8"))
    train = windows_of(data_dir, vehicle, "figure8_22_pwm")
    found, _ = diagnose(train, vehicle, windows_of(data_dir, vehicle, "figure8_35_pwm"))
    values = {f.effect: {p.name: p.value for p in f.parameters} for f in found.findings}
    assert {"rotor_drag", "rotor_drag_moment"} <= set(values), values
    late = values.get("motor_lag", {}).get("tau", 0.0) + values.get("command_delay", {}).get("delay", 0.0)
    assert LAG[0] < late < LAG[1], values
    assert found.validation.extended < 0.25 * found.validation.nominal
