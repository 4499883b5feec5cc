"""Commands of 10 Hz that were filled up to the rate of the log show neither inertias nor lags."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from quadid_replay.writers import write_csv

import quadid
from quadid.flight import fly
from quadid.parameters import INERTIAS, Status
from quadid.vehicle import Vehicle


def test_nothing_that_needs_fast_commands_is_trusted(tmp_path: Path) -> None:
    pelican = Vehicle.shipped("pelican")
    flown = fly(pelican, seconds=40.0, seed=5, effects={"motor_lag": {"tau": 0.04}}).recording
    speed = flown.channels["rotor_speed"]
    filled = np.column_stack([np.interp(speed.t, speed.t[::5], column[::5]) for column in speed.values.T])
    channels = {**flown.channels, "rotor_speed": replace(speed, values=filled)}
    write_csv(tmp_path / "slow.csv", replace(flown, channels=channels))
    found = quadid.diagnose(quadid.load(tmp_path / "slow.csv", vehicle="pelican")).found
    assert not [p.name for p in found.parameters if p.name in INERTIAS and p.status is Status.IDENTIFIED]
    assert not [
        f.effect for f in found.findings if f.effect in ("motor_lag", "command_delay", "imu_lag") and f.confident
    ]
    assert any("rotor signal at 10 Hz is too slow" in warning for warning in found.warnings)
