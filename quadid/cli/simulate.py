"""`quadid simulate`: flies the closed-loop vehicle and logs it, to a file or live over MAVLink."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from quadid.app.kernels import prepare
from quadid.app.options import Seed, VehicleName
from quadid.app.outcome import Advance, Outcome, silent
from quadid.app.simulate import Draw, Drawn, SimulateError, check_suffix, simulate_draws
from quadid.app.simulate import simulate as fly
from quadid.cli import terminal
from quadid.data.window import Recording

LIVE = "udpout:"


def simulate(
    out: Annotated[str, typer.Argument(metavar="OUT")],
    vehicle: VehicleName = "pelican",
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", help="Length of the flight.")] = 500.0,
    seed: Seed = 1,
    effect: Annotated[list[str] | None, typer.Option(metavar="NAME[:KEY=VALUE,...]")] = None,
    profile: Annotated[str, typer.Option()] = "excited",
    manoeuvre: Annotated[Path | None, typer.Option(metavar="FILE")] = None,
    noise: Annotated[float, typer.Option("--noise", metavar="FACTOR", min=0.0, help="Scales all sensor noise.")] = 1.0,
    rate: Annotated[float, typer.Option("--rate", metavar="HZ", help="Log rate.")] = 50.0,
    extra: Annotated[list[str] | None, typer.Option(metavar="CHANNEL")] = None,
    spread: Annotated[float, typer.Option(metavar="F", min=0.0, max=0.9)] = 0.0,
    draws: Annotated[int | None, typer.Option(metavar="N")] = None,
    *,
    advance: Advance = silent,
) -> Outcome:
    """Fly the closed-loop vehicle, controlled at 1 kHz, and log it at 50 Hz.

    Args:
        out: file (.mcap, .tlog, .csv), or udpout:HOST:PORT for live MAVLink.
        effect: hidden effect, as rotor_drag:k_x=0.3,k_y=0.3; without values it is drawn at a realistic size.
        profile: what the pilot does: excited, gentle, hover, one_axis, roll_pitch.
        manoeuvre: fly the segments of this YAML file instead.
        extra: log velocity, position or battery as well.
        spread: draw the true parameters within this fraction of the type.
        draws: fly N vehicles within the file's uncertainty, each under its random forces; the logs are numbered.
    """
    live = out.startswith(LIVE)
    if draws is not None and live:
        raise SimulateError(f"--draws {draws} to {out}", "a file", "leave one of them out")
    how: dict[str, Any] = {
        "seconds": seconds,
        "effects": effect or (),
        "profile": profile,
        "manoeuvre": manoeuvre,
        "noise": noise,
        "rate": rate,
        "extras": extra or (),
        "spread": spread,
    }
    prepare(("flight",), advance)
    advance("flying", 0.0)
    if draws is not None:
        return saved(Path(out), simulate_draws(vehicle, draws, seed, **how))
    done = fly(vehicle, seed=seed, **how)
    if live:
        stream(out, done.flight.recording, advance)
    done.result["log"] = out if live else str(done.save(out))
    return done


def saved(target: Path, draws: Sequence[Draw]) -> Drawn:
    """Writes the logs of several draws as ``OUT-1``, ``OUT-2`` and so on; returns which did not last."""
    paths = [target.with_name(f"{target.stem}-{i}{target.suffix}") for i in range(1, len(draws) + 1)]
    entries = [draw.entry for draw in draws]
    for entry, draw, path in zip(entries, draws, paths, strict=True):
        if draw.flown is not None:
            entry["log"] = str(draw.flown.save(path))
    lost = sum(bool(draw.failed) for draw in draws)
    result = {"schema": "quadid.simulate/1", "vehicle": draws[0].vehicle.name, "diverged": lost, "draws": entries}
    return Drawn(result, tuple(path.name for path in paths))


def check_target(out: str) -> None:
    """Raises SimulateError unless `out` can be written: a known suffix in a folder that exists, or a UDP address."""
    if out.startswith(LIVE):
        host, _, port = out.removeprefix(LIVE).rpartition(":")
        if not host or not port.isdigit() or not 0 < int(port) < 65536:
            raise SimulateError(f"cannot send to '{out}'", "udpout:HOST:PORT", "for example udpout:127.0.0.1:14550")
        return
    check_suffix(out)
    terminal.check_file(out, "OUT")


def stream(address: str, recording: Recording, advance: Advance = silent) -> None:
    """Sends a recording as MAVLink 2 over UDP, each message when its time has come.

    Raises:
        SimulateError: the address cannot be reached.
    """
    from pymavlink import mavutil
    from pymavlink.dialects.v20 import ardupilotmega as dialect
    from quadid_replay.writers import COMPONENT, SYSTEM, mavlink_messages

    try:
        link = mavutil.mavlink_connection(address, source_system=SYSTEM, source_component=COMPONENT)
    except OSError as error:
        raise SimulateError(f"cannot send to {address} ({error.strerror})", fix="check host and port") from error
    mav = dialect.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)
    try:
        begin, end = recording.channels["gyro"].t[[0, -1]]
        started: float | None = None
        for t, message in mavlink_messages(recording):
            # Each when its time has come, counted from the first.
            now = time.monotonic()
            started = now - t if started is None else started
            time.sleep(max(started + t - now, 0.0))
            advance("sending", (t - begin) / (end - begin))
            link.write(message.pack(mav))
            mav.seq = (mav.seq + 1) % 256
    finally:
        link.close()
