"""Uses an extended vehicle file in one's own simulation.

    python examples/own_simulator.py [VEHICLE.yaml]

Without a file, one is made first: a vehicle whose motors lag is flown and diagnosed, which takes a few seconds.  Then
your own code takes over: here, a step on one rotor is simulated with and without what the diagnosis found, and the time
to reach half of the final roll rate is compared.  The same file works with `quadid export` for RotorPy, Gazebo, ...
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from quadid.model.step import simulate
from quadid.vehicle import Vehicle

DT = 0.005


def main() -> None:
    """Compares the step response of the nominal and the extended vehicle."""
    text = Path(sys.argv[1]).read_text(encoding="utf-8") if len(sys.argv) > 1 else diagnosed()
    extended = Vehicle.from_yaml(text)
    nominal = extended.model_copy(update={"effects": {}})
    print("effects in the file:", ", ".join(extended.effects) or "none")
    for name, vehicle in (("nominal", nominal), ("extended", extended)):
        print(f"{name:9} roll rate reaches half of its value at 0.2 s after {1e3 * half_time(vehicle):.0f} ms")


def half_time(vehicle: Vehicle) -> float:
    """Time [s] in which the roll rate reaches half of what it is 0.2 s after a step of the rotors on one side."""
    side = np.sign(vehicle.rotor_positions[:, 1])
    speeds = vehicle.hover_speed() * np.ones((round(0.2 / DT), len(vehicle.rotors)))
    speeds[1:] *= 1.0 - 0.02 * side
    rate = simulate(vehicle, speeds, DT).rate[:, 0]
    return float(DT * (1 + np.argmax(rate > 0.5 * rate[-1])))


def diagnosed() -> str:
    """Flies a Pelican with a motor lag of 40 ms, diagnoses the flight, and returns the extended vehicle file."""
    from quadid.data.grid import to_windows
    from quadid.diagnosis import diagnose
    from quadid.flight import fly

    pelican = Vehicle.shipped("pelican")
    flight = fly(pelican, seconds=60.0, seed=3, effects={"motor_lag": {"tau": 0.04}})
    found, _ = diagnose(to_windows(flight.recording, pelican), pelican)
    return found.vehicle_yaml


if __name__ == "__main__":
    main()
