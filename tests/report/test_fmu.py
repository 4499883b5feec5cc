"""The FMU that `export --format fmu` leads to flies as the simulator of the file does, in another program's loop."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quadid
from quadid.vehicle import Vehicle

ROWS, DT = 60, 0.01


def test_an_fmu_flies_as_the_simulator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pythonfmu3 = pytest.importorskip("pythonfmu3", reason="pip install 'quadid[fmu]'")
    fmpy: Any = pytest.importorskip("fmpy", reason="pip install fmpy")
    monkeypatch.chdir(tmp_path)
    effects = {"motor_lag": {"tau": 0.04}, "rotor_drag": {"k_x": 0.3, "k_y": 0.3}, "supply_voltage": {"exponent": 1.0}}
    vehicle = Vehicle.shipped("hexacopter").model_copy(update={"effects": effects})
    (script,) = quadid.export(vehicle, "fmu").save("mine_fmu.py")
    file = str(pythonfmu3.FmuBuilder.build_FMU(script, dest=tmp_path))
    assert fmpy.read_model_description(file).fmiVersion == "3.0"
    # Six commands and a voltage that wander, and what the simulator makes of them.
    t = DT * np.arange(ROWS)
    hover = vehicle.hover_speed()
    command = hover * (1.0 + 0.1 * np.sin(3.0 * t[:, None] + np.arange(6)))
    given = np.zeros(
        ROWS, dtype=[(name, "f8") for name in ("time", "voltage", *(f"command.{i + 1}" for i in range(6)))]
    )
    given["time"], given["voltage"] = t, 1.0 - 0.1 * t
    for i in range(6):
        given[f"command.{i + 1}"] = command[:, i]
    names = [f"position.{axis}" for axis in "ned"] + [f"rate.{axis}" for axis in "pqr"] + ["rotor_speed.6"]
    found = fmpy.simulate_fmu(file, stop_time=float(t[-1]), step_size=DT, output_interval=DT, input=given, output=names)
    simulator = quadid.Simulator(vehicle)
    state = simulator.start()
    for row in range(ROWS - 1):
        simulator.advance(state, command[row], DT, 1.0 - 0.1 * t[row])
    flown = np.concatenate([state.position[0], state.rate[0], state.rotor_speed[0, 5:]])
    np.testing.assert_allclose([found[name][-1] for name in names], flown, rtol=1e-9, atol=1e-12)
    assert np.abs(flown).min() > 1e-3
