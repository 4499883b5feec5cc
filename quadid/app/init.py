"""Vehicle files to begin with: a template to fill in, or what a log's own parameters describe."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from markupsafe import Markup
from quadid_replay import open_log
from quadid_replay.motors import Frame, frame_of

from quadid.app.logs import file_name, write_text
from quadid.app.options import Preset, Typed
from quadid.app.outcome import Outcome
from quadid.checks.motion import flying_spans, within
from quadid.data.rotor_signal import rotor_channel
from quadid.data.window import Channel, Recording
from quadid.errors import LogError, ParameterError, VehicleError
from quadid.report.tables import Cell, TextTable, heads
from quadid.report.templating import render
from quadid.vehicle import GRAVITY, Vehicle, to_fill_in


@dataclass(frozen=True, repr=False)
class Initial(Outcome):
    """A vehicle file to fill in; `result` has the form ``quadid.init/1``, its ``file`` None until it is written."""

    result: dict[str, Any]
    content: str

    def __repr__(self) -> str:
        return self.content

    def save(self, path: str | Path) -> Path:
        """Writes the file, unless there is one; returns its absolute path."""
        if Path(path).exists():
            raise VehicleError(f"{path} is there already", "a new file", "choose another name, or remove it")
        return write_text(path, self.content)

    def write(self, folder: Path, kept: str | None = None) -> list[tuple[str, Path]]:
        """Writes the file under the name of the vehicle."""
        path = self.save(folder / f"{file_name(self.result['vehicle'])}.yaml")
        self.result["file"] = str(path)
        return [("Written", path)]

    @property
    def sentences(self) -> list[Cell]:
        """Next step."""
        blanks = ", ".join(self.result["fill_in"])
        fill = [Cell(f"To fill in: {blanks} (then delete the words FILL IN)")] if blanks else []
        return [*fill, Cell(f"Next: quadid inspect LOG --vehicle {file_name(self.result['vehicle'])}.yaml")]


def init(
    name: Annotated[str, typer.Argument(metavar="NAME")],
    log: Annotated[str | Path | None, Typed(str | None, typer.Option("--from", metavar="LOG"))] = None,
    *,
    mass: Annotated[float | None, typer.Option(metavar="KG", min=0.001)] = None,
    arm: Annotated[float | None, typer.Option(metavar="M", min=0.001)] = None,
    preset: Preset = "auto",
) -> Initial:
    """A vehicle file to fill in; with a log, filled with what the autopilot's logged parameters describe.

    Args:
        name: name of the vehicle, and of its file.
        log: log whose autopilot's parameters give geometry, frame, motor order and limits.
        mass: mass as it flies [kg].
        arm: distance of the rotors from the centre [m], where the autopilot does not store it.
        preset: topic names of ROS logs.

    Raises:
        LogError: not readable, or neither airframe nor rotor signal in it.
        VehicleError: a name that no vehicle can have.
        ParameterError: a mass or an arm that is not positive.
    """
    for what, size, unit in (("mass", mass, "kg"), ("arm", arm, "m")):
        if size is not None and not 0.0 < size < 1e6:
            raise ParameterError(f"{what} {size:g} {unit}", f"more than 0 {unit}, less than 1e6")
    if log is None:
        text = render("new_vehicle.yaml", {"name": Markup(json.dumps(name)), "mass": mass})
        Vehicle.from_yaml(text, name)
    else:
        recording = open_log(Path(log), preset)
        text = vehicle_text(recording, name, mass, arm)
    blanks = to_fill_in(text)
    source = None if log is None else str(Path(log).absolute())
    return Initial({"schema": "quadid.init/1", "vehicle": name, "from": source, "fill_in": blanks, "file": None}, text)


@dataclass(frozen=True, repr=False)
class Shipped(Outcome):
    """The vehicles that ship; `result` has the form ``quadid.vehicles/1``."""

    rows = "vehicles"
    result: dict[str, Any]

    def tables(self) -> list[TextTable]:
        """One row a vehicle."""
        columns = heads("vehicle | rotors > | mass [kg] > | arm [m] > | command <1 | description <2")
        rows = tuple(
            (r["name"], str(r["rotors"]), f"{r['mass']:.4g}", f"{r['arm']:.3g}", r["command"], r["description"])
            for r in self.records()
        )
        return [TextTable("Vehicles that ship (--vehicle NAME)", columns, rows)]


def vehicles() -> Shipped:
    """Lists the vehicles that ship; a command takes each by its name, as ``--vehicle pelican``."""
    return Shipped({"schema": "quadid.vehicles/1", "vehicles": shipped()})


def shipped() -> list[dict[str, Any]]:
    """The vehicles that ship, each with what sets it apart, one row a vehicle."""
    out = []
    for name, text in Vehicle.shipped_texts().items():
        vehicle = Vehicle.from_yaml(text, name)
        out.append(
            {
                "name": vehicle.name,
                "rotors": len(vehicle.rotors),
                "mass": vehicle.mass,
                "arm": vehicle.arm,
                "command": f"{vehicle.command.kind}, {vehicle.command.sampling}",
                "description": text.splitlines()[0].removeprefix("# ").split(".")[0],
            }
        )
    return out


# --- A vehicle file from a log: airframe, motor order, meaning of the motor columns, first guesses
#
# What the autopilot stores is taken over (frame, output range, on-board filter).  Mass and, with ArduPilot, arm are
# guesses marked as such; thrust follows from them and the hover in the log, inertias from the recipe of
# docs/new-vehicle.md.


_MASS, _ARM, _MAX_SPEED = 1.5, 0.25, 900.0
_BLADE = 0.5
"""Propeller radius over arm, for first guesses."""
_RADIUS = (0.55, 1.0)
"""Propeller radius over the largest that does not touch its neighbour's."""
_THRUST = (0.006, 0.03)
"""Thrust over air density, disc area and squared tip speed, of propellers made for it."""
_AIR = 1.2
_ASSUMED = ("MOT_THST_EXPO", "MOT_SPIN_MIN", "MOT_THST_HOVER", "MOT_BAT_VOLT_MAX", "MOT_BAT_VOLT_MIN", "THR_MDL_FAC")


class _Command(NamedTuple):
    """The `command` line and the rotor speed [rad/s] that one unit of the logged columns stands for."""

    line: str
    low: float
    scale: float


def vehicle_text(recording: Recording, name: str, mass: float | None = None, arm: float | None = None) -> str:
    """Returns the text of a vehicle file for the vehicle that flew this log.

    Args:
        recording: a log; of an autopilot, with its parameters, for the airframe.
        mass: as it flies [kg]; without it a guess, marked to be filled in.
        arm: distance of the rotors from the centre [m], where the autopilot does not store it.

    Raises:
        LogError: neither airframe nor rotor signal in the log, or it is no multirotor's.
    """
    if recording.other:
        raise LogError(f"{recording.name}: {recording.other}", "a log of a multirotor", "choose another log")
    frame = frame_of(recording.autopilot, arm or _ARM)
    channel, notes = rotor_channel(recording, None)
    if frame is None:
        raise LogError(
            f"{recording.name}: no parameters that describe the airframe",
            "a log with the autopilot's parameters: ArduPilot FRAME_CLASS and FRAME_TYPE, PX4 CA_ROTOR*",
            "write the file by hand: docs/new-vehicle.md",
        )
    if channel is not None and channel.values.shape[1] != len(frame.rotors):
        raise LogError(
            f"{recording.name}: {channel.values.shape[1]} motor columns ({channel.source}), {frame.name} has "
            f"{len(frame.rotors)}",
            "as many columns as rotors",
            "write the file by hand: docs/new-vehicle.md",
        )
    weight = mass if mass is not None else _MASS
    command = _command(recording, channel)
    # Thrust coefficient [N s^2/rad^2] that carries the weight at the speeds of the flight; else at 0.55 of full
    squares = len(frame.rotors) * (0.55 * _MAX_SPEED) ** 2
    spans = flying_spans(recording, None)
    if channel is not None and spans:
        inside = within(channel.t, spans)
        speed = np.maximum(channel.values[inside] - command.low, 0.0) * command.scale
        squares = float(np.mean(np.sum(speed**2, axis=1))) if inside.any() and speed.any() else squares
    b = weight * GRAVITY / squares
    known_size = arm is not None or not frame.scaled
    judged = known_size and channel is not None and channel.name == "rotor_speed"
    weigh = "" if mass is not None else "  FILL IN: weigh it as it flies"
    mark = "  FILL IN: the arm is a guess; the autopilot stores none" if frame.scaled and arm is None else ""
    places = [f"  - {{position: [{r.x:.4f}, {r.y:.4f}, {r.z:.4f}], spin: {r.spin:+d}}}" for r in frame.rotors]
    # The autopilot's own filter of gyro and accelerometer, where the log holds what has passed it
    known, gyro = recording.autopilot, recording.channels.get("gyro")
    filtered = gyro is not None and gyro.source.startswith(("IMU", "RAW_IMU", "SCALED_IMU", "HIGHRES_IMU"))
    cutoff, effects = known.get("INS_GYRO_FILTER", 0.0), list[str]()
    if filtered and 1.0 <= cutoff <= 500.0 and known.get("INS_ACCEL_FILTER") == cutoff:
        lag = f"  imu_lag: {{cutoff: {cutoff:g}}}    # INS_GYRO_FILTER, INS_ACCEL_FILTER of this log"
        effects = ["effects:", lag]
    # Assumptions of the autopilot on thrust and battery, for the reader
    held = [f"{name} {known[name]:g}" for name in _ASSUMED if name in known]
    lines = [
        f"name: {json.dumps(name)}",
        f"mass: {weight:g}             # kg{weigh}",
        f"rotors:                 # forward, right, down [m]; {frame.name}{mark}",
        *places,
        f"command: {command.line}",
        *_guesses(frame, weight, b, judged),
        *effects,
        *(f"# {note}" for note in notes),
        *([f"# The autopilot assumes: {', '.join(held)}"] if held else []),
    ]
    text = "".join(f"{line}\n" for line in lines)
    Vehicle.from_yaml(text, name)  # what is handed out is valid
    return text


def _command(recording: Recording, channel: Channel | None) -> _Command:
    """Measured speeds are readings; pulse widths have the range that the autopilot uses in flight."""
    known = recording.autopilot
    if channel is None or channel.name == "rotor_speed":
        return _Command("{kind: rotor_speed, sampling: instant}", 0.0, 1.0)
    speed = f"max_speed: {_MAX_SPEED:g}}}  # rad/s at full command, anything near it"
    if float(np.median(np.abs(channel.values))) < 100.0:
        return _Command(f"{{kind: normalized, {speed}", 0.0, _MAX_SPEED)
    low, high = known.get("MOT_PWM_MIN", 1000.0), known.get("MOT_PWM_MAX", 2000.0)
    if not 500.0 <= low < high <= 2500.0:
        low, high = 1000.0, 2000.0
    spin_min, spin_max = known.get("MOT_SPIN_MIN", 0.0), known.get("MOT_SPIN_MAX", 1.0)
    if 0.0 <= spin_min < spin_max <= 1.0:  # thrust begins at the one and ends at the other
        low, high = low + spin_min * (high - low), low + spin_max * (high - low)
    return _Command(f"{{kind: pwm, range: [{low:g}, {high:g}], {speed}", low, _MAX_SPEED / (high - low))


def _guesses(frame: Frame, mass: float, b: float, judged: bool) -> list[str]:
    """First guesses of the parameters; where `judged`, thrust of propellers that fit the frame.

    The thrust coefficients [N s^2/rad^2] that they can have follow from its size, not from the logged speeds, which
    they are to judge; rotors that are all in one place tell nothing.
    """
    place = np.array([(r.x, r.y) for r in frame.rotors])
    arm = float(np.mean(np.linalg.norm(place, axis=1)))
    apart = np.linalg.norm(place[:, None] - place[None, :], axis=2)
    apart = apart[apart > 0.1 * np.max(apart)]  # those of one axle are none
    thrust = f"  b: {b:.3g}"
    if judged and apart.size:
        radius = 0.5 * float(np.min(apart))
        low, high = (c * _AIR * np.pi * (share * radius) ** 4 for c, share in zip(_THRUST, _RADIUS, strict=True))
        b = min(max(b, low), high)
        bounds = f"[{0.995 * low:.3g}, {1.005 * high:.3g}]"
        thrust = f"  b: {{initial: {b:.3g}, bounds: {bounds}}}    # of propellers that fit this frame"
    inertia, blade = 0.25 * mass * arm**2, _BLADE * arm
    return [
        "parameters:             # first guesses: docs/new-vehicle.md",
        thrust,
        f"  d: {{initial: {b * blade / 6.0:.3g}, bounds: [{b * blade / 60.0:.3g}, {b * blade / 0.6:.3g}]}}",
        f"  J_xx: {inertia:.3g}",
        f"  J_yy: {inertia:.3g}",
        f"  J_zz: {1.9 * inertia:.3g}",
        f"  J_r: {{initial: {inertia / 400.0:.3g}, bounds: [{inertia / 40000.0:.3g}, {inertia / 20.0:.3g}]}}",
    ]
