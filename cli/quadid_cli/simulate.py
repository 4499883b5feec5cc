"""`quadid simulate`: flies the closed-loop vehicle and logs it, to a file or live over MAVLink."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from quadid.errors import ParameterError, QuadidError, nearest
from quadid_cli.options import JsonTarget, Seed, VehicleName

if TYPE_CHECKING:
    from quadid.flight import Flight, Segment
    from quadid.vehicle import Vehicle
    from quadid.window import Recording

SUFFIXES = (".mcap", ".tlog", ".csv")
LIVE = "udpout:"
LONGEST = 3600.0
"""Longest flight [s]: every step of it is held in memory."""
_LARGEST_MANOEUVRE = 1 << 20


class SimulateError(QuadidError):
    """What was asked for cannot be flown or written."""


def simulate(
    out: Annotated[
        str, typer.Argument(metavar="OUT", help="File (.mcap, .tlog, .csv), or udpout:HOST:PORT for live MAVLink.")
    ],
    vehicle: VehicleName = "pelican",
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", help="Length of the flight.")] = 500.0,
    seed: Seed = 1,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            "--effect",
            metavar="NAME[:KEY=VALUE,...]",
            help="Hidden effect, as rotor_drag:k_x=0.3,k_y=0.3; without values it is drawn at a realistic size. "
            "May be given again.",
        ),
    ] = None,
    profile: Annotated[
        str, typer.Option("--profile", help="What the pilot does: excited, gentle, hover, one_axis, roll_pitch.")
    ] = "excited",
    manoeuvre: Annotated[
        Path | None, typer.Option("--manoeuvre", metavar="FILE", help="Fly the segments of this YAML file instead.")
    ] = None,
    noise: Annotated[float, typer.Option("--noise", metavar="FACTOR", min=0.0, help="Scales all sensor noise.")] = 1.0,
    rate: Annotated[float, typer.Option("--rate", metavar="HZ", help="Log rate.")] = 50.0,
    extra: Annotated[
        list[str] | None,
        typer.Option("--extra", metavar="CHANNEL", help="Log velocity, position or battery as well."),
    ] = None,
    spread: Annotated[
        float,
        typer.Option(
            "--spread", metavar="F", min=0.0, max=0.9, help="Draw the true parameters within this fraction of the type."
        ),
    ] = 0.0,
    json: JsonTarget = None,
) -> None:
    """Fly the closed-loop vehicle, controlled at 1 kHz, and log it at 50 Hz."""
    from quadid.flight import TruthParameters, draw_truth, fly
    from quadid_cli.loading import load_vehicle
    from quadid_cli.output import check_file, write_json

    check_target(out)
    check_file(json, "--json")
    if not (math.isfinite(seconds) and 0.0 < seconds <= LONGEST):
        raise SimulateError(f"a flight of {seconds:g} s", f"more than 0 and at most {LONGEST:g} s")
    described = load_vehicle(vehicle)
    truth = draw_truth(described, seed, spread) if spread > 0.0 else TruthParameters.of(described)
    effects, outside = parse_effects(effect or [], described, seed, seconds)
    segments = read_manoeuvre(manoeuvre) if manoeuvre is not None else None
    flight = fly(
        described,
        truth,
        seconds,
        seed,
        profile if segments is None else "scripted",
        effects={**described.effects, **effects},
        outside=outside,
        noise_scale=noise,
        log_rate=rate,
        segments=segments,
        extras=extra or (),
    )
    write_flight(out, flight)
    write_json(summary(out, flight, seed, profile if segments is None else "scripted"), json)
    if json != "-":
        rows = len(flight.window)
        typer.echo(f"{described.name}: {rows} rows at {rate:g} Hz flown and logged to {out}")


def check_target(out: str) -> None:
    """Raises SimulateError unless `out` can be written: a known suffix in a folder that exists, or a UDP address."""
    if out.startswith(LIVE):
        host, _, port = out.removeprefix(LIVE).rpartition(":")
        if not host or not port.isdigit() or not 0 < int(port) < 65536:
            raise SimulateError(f"cannot send to '{out}'", "udpout:HOST:PORT", "for example udpout:127.0.0.1:14550")
        return
    from quadid_cli.output import check_file

    if Path(out).suffix.lower() not in SUFFIXES:
        raise SimulateError(f"cannot tell the format of '{out}'", ", ".join(SUFFIXES) + " or udpout:HOST:PORT")
    check_file(out, "OUT")


def parse_effects(
    texts: Sequence[str], vehicle: Vehicle, seed: int, seconds: float
) -> tuple[dict[str, dict[str, float]], dict[str, dict[str, float]]]:
    """Reads effects as written on the command line.

    Args:
        texts: ``name`` or ``name:key=value,key=value``.
        vehicle: scales drawn sizes.
        seed: decides drawn sizes.
        seconds: length of the flight.

    Returns:
        Effects of the catalogue, and effects outside it.

    Raises:
        ParameterError: unknown name, or values that are not numbers.
    """
    from quadid.effects import EFFECTS
    from quadid.flight import OUTSIDE, check_effects, draw_effect, draw_outside

    effects: dict[str, dict[str, float]] = {}
    outside: dict[str, dict[str, float]] = {}
    for text in texts:
        name, _, rest = text.partition(":")
        values = _numbers(text, rest)
        if name in OUTSIDE:
            outside[name] = {**draw_outside(name, seed, 1.0, vehicle), **values}
        elif name not in EFFECTS:
            raise ParameterError(f"unknown effect '{name}'", fix=nearest(name, [*EFFECTS, *OUTSIDE]))
        elif values:
            effects[name] = values
        else:
            effects |= {k: v for k, v in draw_effect(name, seed, 1.0, vehicle, seconds).items() if k not in effects}
    check_effects(effects, len(vehicle.rotors))
    return effects, outside


def _numbers(text: str, rest: str) -> dict[str, float]:
    values: dict[str, float] = {}
    for part in filter(None, rest.split(",")):
        key, sign, number = part.partition("=")
        try:
            values[key.strip()] = float(number)
        except ValueError as error:
            raise ParameterError(f"cannot read '{part}' in '{text}'", "NAME:KEY=NUMBER,KEY=NUMBER") from error
        if not sign:
            raise ParameterError(f"'{part}' in '{text}' has no value", "NAME:KEY=NUMBER,KEY=NUMBER")
    return values


def read_manoeuvre(path: Path) -> list[Segment]:
    """Reads a manoeuvre file: a list of segments, or a mapping with that list as ``segments``.

    Raises:
        SimulateError: not a readable YAML list.
        ParameterError: a segment that cannot be flown.
    """
    import yaml

    from quadid.flight import Segment

    try:
        data = yaml.safe_load(path.read_bytes()[:_LARGEST_MANOEUVRE].decode("utf-8"))
    except FileNotFoundError as error:
        raise SimulateError(f"no manoeuvre file {path}", "a YAML file", "check the path") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise SimulateError(f"{path.name}: not YAML", "a list of segments") from error
    if isinstance(data, dict):
        data = data.get("segments")
    if not isinstance(data, list) or not all(isinstance(entry, dict) for entry in data) or not data:
        raise SimulateError(f"{path.name} holds no list of segments", "axis, kind, start, duration, amplitude each")
    return [Segment.from_mapping(entry) for entry in data]


def write_flight(out: str, flight: Flight) -> None:
    """Writes the log by suffix, or streams it in real time."""
    if out.startswith(LIVE):
        stream(out, flight.recording)
        return
    import quadid_replay

    suffix = Path(out).suffix.lower()
    if suffix == ".mcap":
        quadid_replay.write_mcap(out, flight.recording)
    elif suffix == ".tlog":
        quadid_replay.write_tlog(out, flight.recording)
    else:
        quadid_replay.write_csv(out, flight.recording)


def stream(address: str, recording: Recording) -> None:
    """Sends a recording as MAVLink 2 over UDP, each message when its time has come.

    Raises:
        SimulateError: the address cannot be reached.
    """
    from pymavlink import mavutil
    from pymavlink.dialects.v20 import ardupilotmega as dialect
    from quadid_replay.tlog_writer import COMPONENT, SYSTEM, mavlink_messages

    try:
        link = mavutil.mavlink_connection(address, source_system=SYSTEM, source_component=COMPONENT)
    except OSError as error:
        raise SimulateError(f"cannot send to {address} ({error.strerror})", fix="check host and port") from error
    mav = dialect.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)
    try:
        for message in in_real_time(mavlink_messages(recording)):
            link.write(message.pack(mav))
            mav.seq = (mav.seq + 1) % 256
    finally:
        link.close()


def in_real_time(messages: Iterator[tuple[float, Any]]) -> Iterator[Any]:
    """Yields messages when their time [s] has come, counted from the first."""
    begin: float | None = None
    for t, message in messages:
        now = time.monotonic()
        if begin is None:
            begin = now - t
        if begin + t > now:
            time.sleep(begin + t - now)
        yield message


def summary(out: str, flight: Flight, seed: int, profile: str) -> Mapping[str, Any]:
    """What was flown, as JSON: the truth, the effects, the stabiliser's gains and how much the vehicle moved."""
    from quadid.parameters import NOMINAL_UNITS

    truth = flight.truth
    parameters = truth.parameters.as_dict()
    w, x, y, z = truth.quaternion.T
    down = 1.0 - 2.0 * (x**2 + y**2)
    squares = (flight.window.rotor_speed**2).sum(axis=1)
    return {
        "schema": "quadid.simulate/1",
        "log": out if out.startswith(LIVE) else str(Path(out).absolute()),
        "vehicle": flight.vehicle.name,
        "seed": seed,
        "profile": profile,
        "seconds": len(flight.window) * flight.window.dt,
        "rows": len(flight.window),
        "mass": truth.parameters.mass,
        "parameters": [{"name": n, "unit": NOMINAL_UNITS[n], "value": v} for n, v in parameters.items()],
        "effects": {name: dict(values) for name, values in truth.effects.items()},
        "outside": {name: dict(values) for name, values in truth.outside.items()},
        "stabiliser": {"gains": dict(flight.gains)},
        "excitation": {
            "rates_rms": truth.rates.std(axis=0),
            "tilt_max": float(math.acos(max(-1.0, min(1.0, float(down.min()))))),
            "thrust_variation": float(squares.std() / squares.mean()),
        },
    }
