"""A running ArduCopter, flown through pymavlink, with `quadid serve` beside it: sets against the truth, and alarms.

    python -m quadid_evaluation.studies.sitl --binary build/sitl/bin/arducopter --defaults copter.parm,my.parm \\
        --frame frame.json --model x --vehicle my.yaml [--gains | --seconds 120 --changes] [b=1.94e-5 J_xx=0.011 …]

The binary is ArduCopter built for SITL (waf configure --board sitl; waf copter), the defaults are such as
Tools/autotest/default_params/copter.parm and what `quadid export --format ardupilot` writes, with FRAME_TYPE 1 for an
X; the frame file is the .sitl.json of that export.  `--keep` names a folder for the autopilot's log and for
`telemetry.tlog`, the bytes that the service received, at their times.

The plan: take off in Guided, hover, then move roll, pitch and yaw sticks in Loiter for `--seconds`, with multisines out
of step.  The table has first and last set against the truth, and every alarm; nothing changes in that time, so that
every alarm is false.  With `--changes` a payload is then taken up and dropped and rotors weaken and recover, in hover
and on the move, and a second table lists when each was seen and what it was called (weak rotors only where the vehicle
file reads pulses: measured speeds fall with them).  Wind is a line of the defaults (SIM_WIND_SPD, SIM_WIND_TURB).
Without a binary the study prints that and does nothing.  `--frame` must be a relative path for ArduPilot: the file is
copied into the folder that the binary runs in.
"""

import math
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from pymavlink import mavutil
from quadid_replay.dataflash import index_dataflash
from scipy.spatial.transform import Rotation

import quadid
from quadid.flight.pilot import AXES, PILOT_STEP, Segment, scripted
from quadid.report.autopilots import AXES as TURNS
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import Given, options, put, table
from quadid_evaluation.studies.autopilot import TITLE, Flown, Outcome, row, section, serving, stored
from quadid_evaluation.studies.gains import bandwidth, outside

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


def take_off(link: mavutil.mavfile, height: float) -> None:
    """Arms and climbs; raises TimeoutError where the autopilot does not come along."""
    link.wait_heartbeat(timeout=READY)
    for message in (mavutil.mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, mavutil.mavlink.MAVLINK_MSG_ID_ATTITUDE):
        _until(partial(_command, link, mavutil.mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message, 2e5))
    _wait(link, "GLOBAL_POSITION_INT", lambda m: m.lat != 0)
    _mode(link, "GUIDED")
    _until(lambda: _command(link, mavutil.mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0))
    _until(lambda: _command(link, mavutil.mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, height))
    _wait(link, "GLOBAL_POSITION_INT", lambda m: m.relative_alt > 900.0 * height)


def fly(link: mavutil.mavfile, seconds: float, seed: int, changes: Sequence["Change"] = ()) -> list[float]:
    """Takes off, hovers, moves the sticks, makes the changes and lands; returns when each change was made [s]."""
    take_off(link, HEIGHT)
    _mode(link, "LOITER", held=np.zeros(len(AXES)))
    calm, moments = np.zeros((round(HOVER / PILOT_STEP), len(AXES))), []
    _move(link, np.vstack([calm, sticks(seconds, seed)]))
    for k, change in enumerate(changes):
        _move(link, change.moving * sticks(BETWEEN, seed + k))
        _set(link, change.parameter, change.value)
        moments.append(time.time())
    if changes:
        _move(link, changes[-1].moving * sticks(BETWEEN, seed))
    _send_sticks(link, np.zeros(len(AXES)))
    _mode(link, "LAND")
    return moments


def _move(link: mavutil.mavfile, rows: FloatArray) -> None:
    begin = time.monotonic()
    for k, at in enumerate(rows):
        time.sleep(max(begin + k * PILOT_STEP - time.monotonic(), 0.0))
        _send_sticks(link, at)
        _drain(link)


def _send_sticks(link: mavutil.mavfile, row: FloatArray) -> None:
    values = [65535] * 8
    for axis, at in zip(AXES, row, strict=True):
        values[CHANNELS[axis]] = round(1500.0 + 400.0 * float(at))
    link.mav.rc_channels_override_send(link.target_system, link.target_component, *values)


def _mode(link: mavutil.mavfile, name: str, held: FloatArray | None = None) -> None:
    """Asks for a mode until it is flown; `held` are sticks, which the autopilot forgets after 3 s."""
    number = link.mode_mapping()[name]

    def reached() -> bool:
        if held is not None:
            _send_sticks(link, held)
        _drain(link)
        link.set_mode(number)
        link.recv_match(type="HEARTBEAT", blocking=True, timeout=2.0)
        return str(link.flightmode) == name

    _until(reached, pause=0.0)


def _drain(link: mavutil.mavfile) -> None:
    """Reads all that has come: who reads later what came earlier waits for what has long been."""
    while link.recv_match(blocking=False) is not None:
        pass


def _command(link: mavutil.mavfile, number: int, *values: float) -> bool:
    given = [*values, *[0.0] * (7 - len(values))]
    link.mav.command_long_send(link.target_system, link.target_component, number, 0, *given)
    while (answer := link.recv_match(type="COMMAND_ACK", blocking=True, timeout=3.0)) is not None:
        if answer.command == number:
            return bool(answer.result == mavutil.mavlink.MAV_RESULT_ACCEPTED)
    return False


def _wait(link: mavutil.mavfile, kind: str, wanted: Callable[[Any], bool]) -> None:
    def come() -> bool:
        _drain(link)
        return (m := link.recv_match(type=kind, blocking=True, timeout=2.0)) is not None and wanted(m)

    _until(come, pause=0.0)


def _until(done: Callable[[], bool], pause: float = 0.5) -> None:
    end = time.monotonic() + READY
    while not done():
        if time.monotonic() > end:
            raise TimeoutError(f"the autopilot did not come along within {READY:g} s")
        time.sleep(pause)


@contextmanager
def running(given: Given, folder: Path, settings: Mapping[str, float]) -> Iterator[mavutil.mavfile]:
    """The autopilot in a folder, with `settings` over its defaults; yields a link to it."""
    model, own = given.model, folder / "own.parm"
    if given.frame != Path():
        shutil.copy(given.frame, folder / "frame.json")
        model = f"{given.model}:frame.json"
    own.write_text("".join(f"{name} {value}\n" for name, value in settings.items()), encoding="utf-8")
    defaults = ",".join(str(Path(name).resolve()) for name in (*given.defaults.split(","), own))
    autopilot = subprocess.Popen(
        [given.binary.resolve(), "--model", model, "--defaults", defaults, "--wipe", "--speedup", "1"],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.STDOUT,
    )
    try:
        yield mavutil.mavlink_connection(f"tcp:127.0.0.1:{PILOT}", retries=60)
    finally:
        autopilot.kill()
        autopilot.wait()


@contextmanager
def recorded(file: Path) -> Iterator[str]:
    """A connection to `SERVICE` through which the autopilot's frames are kept in a telemetry log; yields its URL."""
    with socket.create_server(("127.0.0.1", 0)) as door, file.open("wb") as log:
        threading.Thread(target=_relay, args=(door, log), daemon=True).start()
        yield f"tcp:127.0.0.1:{door.getsockname()[1]}"


def _relay(door: socket.socket, log: BinaryIO) -> None:
    """Passes on what comes from either side until one of them ends."""
    with suppress(OSError, ValueError):  # the service or the autopilot has ended, or the log is closed
        near = door.accept()[0]
        far = socket.create_connection(("127.0.0.1", SERVICE))
        threading.Thread(target=_pass_on, args=(near, far), daemon=True).start()
        frames = mavutil.mavlink.MAVLink(None)
        frames.robust_parsing = True
        while data := far.recv(65536):
            near.sendall(data)
            stamp = struct.pack(">Q", time.time_ns() // 1000)
            for message in frames.parse_buffer(data) or ():
                log.write(stamp + bytes(message.get_msgbuf()))


def _pass_on(near: socket.socket, far: socket.socket) -> None:
    with suppress(OSError):
        while data := near.recv(65536):
            far.sendall(data)


def flown(given: Given, changes: Sequence["Change"]) -> tuple[Outcome, list[float]]:
    """Starts the autopilot and the service, flies, ends both; what the service had stored, and when what changed."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) if given.keep == Path() else given.keep
        folder.mkdir(parents=True, exist_ok=True)
        history = folder / "history.sqlite"
        with (
            running(given, folder, STRENGTH if changes else {}) as link,
            recorded(folder / "telemetry.tlog") as url,
            serving(given.vehicle, url, history) as said,
        ):
            moments = fly(link, given.seconds, given.seed, changes)
        return stored(given.vehicle, history, said, HOVER + given.seconds), moments


# --- Changes in flight, and what the service said of them


@dataclass(frozen=True)
class Change:
    """A simulator's parameter that is set, with sticks at `moving` times their size around it, and what that does."""

    what: str
    parameter: str
    value: float
    moving: float = 0.0


PAYLOAD, ENGINES = "SIM_SPR_ENABLE", "SIM_ENGINE_FAIL"
STRENGTH = {"SIM_ENGINE_MUL": 0.92, PAYLOAD: 0.0}
"""Share of its pulse above the least that a weak motor gets, so that its thrust falls by some 15 %; no payload yet."""
BETWEEN = 20.0
"""Time between two changes [s]."""
MASSES = tuple(
    Change(f"{what}, {how}", PAYLOAD, on, size)
    for how, size in (("hover", 0.0), ("moving", 0.6))
    for what, on in (("+0.25 kg", 1.0), ("-0.25 kg", 0.0))
)
ROTORS = tuple(
    Change(f"{what}, {how}", ENGINES, mask, size)
    for how, size, rotor in (("hover", 0.0, 1), ("moving", 0.6, 2))
    for what, mask in ((f"rotor {rotor} weak", float(rotor)), (f"rotor {rotor} recovers", 0.0))
)


def changes_seen(changes: Sequence[Change], moments: Sequence[float], done: Outcome) -> str:
    """Markdown: when each change was seen and shown, and what it was called, and the alarms between them."""
    rows = []
    for change, at, end in zip(changes, moments, [*moments[1:], math.inf], strict=True):
        seen = [e for e in done.events if at <= e["wall"] < end and e["kind"] in ("change", "finding")]
        first = next((f"{e['wall'] - at:.1f}" for e in seen if e["kind"] == "change"), "not")
        named = next((f"{e['wall'] - at:.1f}: {e['text']}" for e in seen if e["kind"] == "finding"), "not named")
        rows.append((change.what, first, named, sum(e["kind"] == "change" for e in seen)))
    return "\n".join(table(("change", "shown after [s]", "named after [s], how", "alarms until the next"), rows))


# --- Steps of rate and attitude, with the gains of the defaults and with proposed ones


NAMES = ("RLL", "PIT", "YAW")
STEP = {"rate": (0.5, 0.5, 0.5), "attitude": (0.05, 0.05, 0.2)}
"""Size of a step about each axis [rad/s], [rad]."""
LASTS = {"rate": (0.8, 0.8, 3.0), "attitude": (1.6, 1.6, 3.5)}
"""Time between two steps [s]."""
REST = 6.0
"""Level flight between axes [s]."""
SETTINGS = {
    **{f"ATC_ACCEL_{axis}_MAX": 0.0 for axis in "RPY"},
    "LOG_BITMASK": float(176126 | 1 | 1 << 19),
    "INS_RAW_LOG_OPT": 1.0,
}
"""Commands are not shaped; attitude is logged at the rate of the loop, and the gyro as it is read."""


def step(link: mavutil.mavfile, gains: Mapping[str, float]) -> None:
    """Steps to and fro, an axis at a time: of the attitude, then of the rate while no attitude is held."""
    take_off(link, 2.0 * HEIGHT)
    for name, value in gains.items():
        _set(link, name, value)
    heading = np.array([0.0, 0.0, link.recv_match(type="ATTITUDE", blocking=True, timeout=READY).yaw])
    for loop, halves in (("attitude", (1.0,) * 6), ("rate", (0.5, 1.0, 1.0, 1.0, 1.0, 0.5))):
        for k, axis in enumerate(NAMES):
            _set(link, "ATC_RATE_FF_ENAB", 0.0)
            _ask(link, REST, heading)
            unit = 0.5 * STEP[loop][k] * np.eye(3)[k]
            if loop == "rate":  # is passed on as it is
                _set(link, "ATC_RATE_FF_ENAB", 1.0)
                _set(link, f"ATC_ANG_{axis}_P", 0.0)
            for i, part in enumerate(halves):
                asked = unit * (-1.0) ** i
                _ask(link, part * LASTS[loop][k], *((heading + asked,) if loop == "attitude" else (None, asked)))
            if loop == "rate":
                _set(link, f"ATC_ANG_{axis}_P", gains.get(f"ATC_ANG_{axis}_P", HELD))
    _set(link, "ATC_RATE_FF_ENAB", 0.0)
    _ask(link, REST, heading)
    _mode(link, "LAND")


HELD = 4.5
"""ArduCopter's default of ATC_ANG_RLL_P, ATC_ANG_PIT_P and ATC_ANG_YAW_P [1/s]."""


def _ask(link: mavutil.mavfile, seconds: float, angle: FloatArray | None, rate: Sequence[float] = (0.0,) * 3) -> None:
    """Asks for an attitude (roll, pitch, yaw [rad]), or for body rates [rad/s], at constant height, for some time."""
    mask = mavutil.mavlink.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE if angle is None else 0
    q = [1.0, 0.0, 0.0, 0.0] if angle is None else Rotation.from_euler("ZYX", angle[::-1]).as_quat()[[3, 0, 1, 2]]
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        link.mav.set_attitude_target_send(0, link.target_system, link.target_component, mask, q, *rate, 0.5)
        _drain(link)
        time.sleep(0.1)


def _set(link: mavutil.mavfile, name: str, value: float) -> None:
    def taken() -> bool:
        link.mav.param_set_send(link.target_system, link.target_component, name.encode(), value, 9)
        answer = link.recv_match(type="PARAM_VALUE", blocking=True, timeout=2.0)
        return answer is not None and answer.param_id == name and bool(np.isclose(answer.param_value, value))

    _until(taken)


def responses(log: Path) -> dict[tuple[str, str], tuple[float, FloatArray]]:
    """Mean response to a unit step of each axis and loop, of the log of `step`; the period first [s]."""
    index, out = index_dataflash(log), {}

    def columns(name: str, *wanted: str) -> tuple[FloatArray, FloatArray]:
        own = index.column(name, "I") == 0 if index.has(name, "I") else slice(None)
        time_of = "SampleUS" if index.has(name, "SampleUS") else "TimeUS"
        values = np.column_stack([index.column(name, one) for one in wanted])
        return 1e-6 * index.column(name, time_of)[own], values[own]

    for loop, given, read in (
        ("rate", ("RATE", "RDes", "PDes", "YDes"), ("GYR", "GyrX", "GyrY", "GyrZ")),
        ("attitude", ("ANG", "DesRoll", "DesPitch", "DesYaw"), ("ANG", "Roll", "Pitch", "Yaw")),
    ):
        (t, wanted), (seen, values) = columns(*given), columns(*read)
        wanted, values = np.radians(wanted), np.radians(values) if loop == "attitude" else values
        for k, axis in enumerate(TURNS):
            size, lasts = STEP[loop][k], 0.9 * LASTS[loop][k]
            asked, came = np.unwrap(wanted[:, k]), np.unwrap(values[:, k])
            change, rows = np.diff(asked), []
            for i in np.flatnonzero(np.abs(change) > 0.8 * size):
                before = slice(np.searchsorted(t, t[i] - lasts), i + 1)
                after = slice(i + 1, np.searchsorted(t, t[i] + lasts))
                if max(np.ptp(asked[before]), np.ptp(asked[after])) < 0.02 * size:
                    grid = t[i + 1] + np.arange(-0.05, lasts, PERIOD)  # from what had come by then
                    response = np.interp(grid, seen, came)
                    start = response[grid < t[i + 1]].mean()
                    rows.append((response[grid >= t[i + 1]] - start) / change[i])
            shortest = min(map(len, rows))
            out[axis, loop] = PERIOD, np.mean([one[:shortest] for one in rows], axis=0)
    return out


def gains_flown(given: Given) -> list[str]:
    """Promise and flight of the gains that the autopilot had, and of those that are proposed, as Markdown."""
    rows, found, settings = [], None, SETTINGS
    for when in ("as it came", "proposed"):
        with tempfile.TemporaryDirectory() as folder:
            with running(given, Path(folder), settings) as link:
                step(link, {} if found is None else found.values)
            (log,) = Path(folder, "logs").glob("*.BIN")
            flew = responses(log)
            found = found or quadid.gains(given.vehicle, "ardupilot", current=log, motor_lag=0.0, delay=given.delay)
        for (axis, loop), (period, response) in flew.items():
            loops, angle = (found.before if when == "as it came" else found.loops)[axis], loop == "attitude"
            t, band = loops.step(angle)
            promised = float(loops.bandwidth(angle)[0]), 100.0 * max(float(band[0].max()) - 1.0, 0.0)
            rows.append(
                (
                    when,
                    f"{axis} {loop}",
                    f"{promised[0]:.2f}, {bandwidth(period, response):.2f}",
                    f"{promised[1]:.0f}, {100.0 * max(response.max() - 1.0, 0.0):.0f}",
                    f"{1e3 * rise(t, band[0]):.0f}, {1e3 * rise(period * np.arange(len(response)), response):.0f}",
                    f"{outside((period, response), loops, angle):.3f}",
                )
            )
    heads = ("gains", "loop", "bandwidth [Hz]", "overshoot [%]", "rise, 10 to 90 % [ms]", "outside of the band")
    return [
        "`python -m quadid_evaluation.studies.sitl --gains`: steps of ArduCopter in its own simulator, with the gains "
        "of its defaults, then with those proposed for a file fitted to its flight. Promised, then flown; last the "
        "largest distance of the response to a unit step from its band over the 95 % intervals.",
        "",
        *table(heads, rows),
    ]


PERIOD = 1.0 / 400.0
"""Grid of a response [s]."""


def rise(t: FloatArray, response: FloatArray) -> float:
    """Time from a tenth to nine tenths [s]; infinite where it stays below."""
    return float(t[np.argmax(response >= 0.9)] - t[np.argmax(response >= 0.1)]) if response.max() > 0.9 else math.inf


def main() -> None:
    """Flies what was asked for and prints the table, or says why not."""
    given = options(
        __doc__,
        words="NAME=VALUE of parameters that are known",
        binary=Path(),
        defaults="",
        gains=False,
        changes=False,
        delay=0.0,
        keep=Path(),
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
        if getattr(given, name) in ("", Path()):
            sys.exit(f"--{name} is needed beside --binary")
    if given.gains:
        put(given, "gains.md", "Gains, flown", "ArduCopter", gains_flown(given))
        return
    truth = {name: float(value) for name, value in (text.split("=", 1) for text in given.words)}
    one, file = Flown(given.binary.name, str(given.vehicle), truth), Vehicle.named(given.vehicle)
    changes = () if not given.changes else (*MASSES, *ROTORS) if file.command.kind == "pwm" else MASSES
    done, moments = flown(given, changes)
    before = replace(done, events=[e for e in done.events if not moments or e["wall"] < moments[0]])
    text = [section("ArduCopter", "flown by this study", [row(one, before)], 1e9), *before.told("change")]
    if changes:
        text += ["", changes_seen(changes, moments, done)]
    put(given, "autopilot.md", TITLE, "ArduCopter SITL", "\n".join(text))


if __name__ == "__main__":
    main()
