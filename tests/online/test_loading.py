"""In flight nothing is loaded: an import takes as long as ten steps of the node."""

import subprocess
import sys
from pathlib import Path

import numpy as np

from tests.online.driving import flight

CHILD = """
import sys
import numpy as np
from quadid.data.window import Block
from quadid.online import FitRequest, Session, SessionSettings
from quadid.vehicle import Vehicle

session = Session(Vehicle.shipped("pelican"), SessionSettings(window=5.0, diagnose=0.0))
flown = np.load(sys.argv[1])
before = set(sys.modules)
for k in range(len(flown["t"])):
    for name in ("attitude", "rotor_speed", "accel", "gyro"):
        session.push(Block.one(float(flown["t"][k]), name, flown[name][k]))
    session.poll()
assert isinstance(session.running, FitRequest), session.status()
print(*sorted(set(sys.modules) - before))
"""


def test_a_session_loads_nothing_on_its_way_to_the_first_fit(tmp_path: Path) -> None:
    window = flight(8.0).window
    channels = {name: getattr(window, name) for name in ("attitude", "rotor_speed", "accel", "gyro")}
    np.savez(tmp_path / "flown.npz", t=window.t, **channels)
    command = [sys.executable, "-c", CHILD, str(tmp_path / "flown.npz")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []
