"""A running ArduCopter, flown through pymavlink, with `quadid serve` beside it: sets against the truth, and alarms.

    python -m quadid_evaluation.studies.sitl --binary build/sitl/bin/arducopter --defaults copter.parm \\
        --frame frame.json --vehicle my.yaml [--seconds 120] [b=1.94e-5 J_xx=0.011 …]

The binary is ArduCopter built for SITL (waf configure --board sitl; waf copter), the defaults are such as
Tools/autotest/default_params/copter.parm, the frame file is the .sitl.json of `quadid export --format ardupilot`.

The plan: take off in Guided, hover, then move roll, pitch and yaw sticks in Loiter for `--seconds`, with multisines out
of step.  The table has first and last set against the truth, and every alarm; nothing changes in flight, so that every
alarm is false.  Without a binary the study says so and does nothing.  `--frame` must be a relative path for ArduPilot:
the file is copied into the folder that the binary runs in.
"""

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink import mavutil

from quadid.flight.pilot import AXES, PILOT_STEP, Segment, scripted
from quadid.types import FloatArray
from quadid_evaluation.harness import Given, options, put
from quadid_evaluation.studies.autopilot import TITLE, Flown, Outcome, row, section, serving, stored

PILOT, SERVICE = 5760, 5762
"""TCP ports of ArduPilot's first two serial ports."""
HEIGHT, HOVER, READY = 20.0, 15.0, 120.0
"""Height [m]; hover before the sticks move [s]; longest wait for a position [s]."""
STICKS = {"roll": 0.35, "pitch": 0.35, "yaw": 0.3}
"""Size of each multisine, rms of full stick."""
BANDS = ((0.3, 1.0), (0.8, 2.0))
CHANNELS = {"roll": 0, "pitch": 1, "throttle": 2, "yaw": 3}


def sticks(seconds: float, seed: int) -> FloatArray:
    """Stick positions -1 to 1 every `PILOT_STEP`, shape (n, axes of `quadid.flight.pilot.AXES`)."""
    segments = [
        Segment(axis, "multisine", start, 6.0, size, *BANDS[int(start / 6.5) % len(BANDS)])
        for start in np.arange(0.0, seconds - 6.0, 6.5)
        for axis, size in STICKS.items()
    ]
    return np.clip(scripted(segments, seed, round(seconds / PILOT_STEP)), -1.0, 1.0)


def fly(link: mavutil.mavfile, seconds: float, seed: int) -> None:
    """Arms, takes off, hovers, moves the sticks; raises TimeoutError where the autopilot does not come along."""
    link.wait_heartbeat(timeout=READY)
    _wait(link, "GLOBAL_POSITION_INT", lambda m: m.lat != 0)
    _mode(link, "GUIDED")
    _until(lambda: _command(link, mavutil.mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0))
    _until(lambda: _command(link, mavutil.mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, HEIGHT))
    _wait(link, "GLOBAL_POSITION_INT", lambda m: m.relative_alt > 900.0 * HEIGHT)
    _send_sticks(link, np.zeros(len(AXES)))
    _mode(link, "LOITER")
    rows = np.vstack([np.zeros((round(HOVER / PILOT_STEP), len(AXES))), sticks(seconds, seed)])
    begin = time.monotonic()
    for k, at in enumerate(rows):
        time.sleep(max(begin + k * PILOT_STEP - time.monotonic(), 0.0))
        _send_sticks(link, at)
        while link.recv_match(blocking=False) is not None:
            pass
    _send_sticks(link, np.zeros(len(AXES)))
    _mode(link, "LAND")


def _send_sticks(link: mavutil.mavfile, row: FloatArray) -> None:
    values = [65535] * 8
    for axis, at in zip(AXES, row, strict=True):
        values[CHANNELS[axis]] = round(1500.0 + 400.0 * float(at))
    link.mav.rc_channels_override_send(link.target_system, link.target_component, *values)


def _mode(link: mavutil.mavfile, name: str) -> None:
    number = link.mode_mapping()[name]

    def reached() -> bool:
        link.set_mode(number)
        link.recv_match(type="HEARTBEAT", blocking=True, timeout=2.0)
        return str(link.flightmode) == name

    _until(reached)


def _command(link: mavutil.mavfile, number: int, *values: float) -> bool:
    given = [*values, *[0.0] * (7 - len(values))]
    link.mav.command_long_send(link.target_system, link.target_component, number, 0, *given)
    answer = link.recv_match(type="COMMAND_ACK", blocking=True, timeout=3.0)
    return answer is not None and answer.result == mavutil.mavlink.MAV_RESULT_ACCEPTED


def _wait(link: mavutil.mavfile, kind: str, wanted: Callable[[Any], bool]) -> None:
    _until(lambda: (m := link.recv_match(type=kind, blocking=True, timeout=2.0)) is not None and wanted(m))


def _until(done: Callable[[], bool]) -> None:
    end = time.monotonic() + READY
    while not done():
        if time.monotonic() > end:
            raise TimeoutError(f"the autopilot did not come along within {READY:g} s")
        time.sleep(0.5)


def flown(given: Given) -> Outcome:
    """Starts the autopilot and the service, flies, ends both; what the service had stored."""
    with tempfile.TemporaryDirectory() as folder:
        model = given.model
        if given.frame != Path():
            shutil.copy(given.frame, Path(folder) / "frame.json")
            model = f"{given.model}:frame.json"
        history = Path(folder) / "history.sqlite"
        autopilot = subprocess.Popen(
            [
                str(given.binary.resolve()),
                "--model",
                model,
                "--defaults",
                str(given.defaults.resolve()),
                "--wipe",
                "--speedup",
                "1",
            ],
            cwd=folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.STDOUT,
        )
        try:
            link = mavutil.mavlink_connection(f"tcp:127.0.0.1:{PILOT}", retries=60)
            with serving(given.vehicle, f"tcp:127.0.0.1:{SERVICE}", history) as said:
                fly(link, given.seconds, given.seed)
        finally:
            autopilot.kill()
            autopilot.wait()
        return stored(given.vehicle, history, said, HOVER + given.seconds)


def main() -> None:
    """Flies what was asked for and prints the table, or says why not."""
    given = options(
        __doc__,
        words="NAME=VALUE of parameters that are known",
        binary=Path(),
        defaults=Path(),
        model="+",
        frame=Path(),
        vehicle=Path(),
        seconds=120.0,
        seed=1,
    )
    if given.binary == Path():
        print("skipped: no ArduCopter binary is named (--binary)")
        return
    for name in ("defaults", "vehicle"):
        if getattr(given, name) == Path():
            sys.exit(f"--{name} is needed beside --binary")
    truth = {name: float(value) for name, value in (text.split("=", 1) for text in given.words)}
    one = Flown(given.binary.name, str(given.vehicle), truth)
    done = flown(given)
    text = [section("ArduCopter", "flown by this study", [row(one, done)], 1e9), *done.alarms]
    put(given, "autopilot.md", TITLE, "ArduCopter SITL", text)


if __name__ == "__main__":
    main()
