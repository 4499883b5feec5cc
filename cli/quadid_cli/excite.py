"""`quadid excite`: which manoeuvre to fly next, and what it would gain."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from quadid.errors import ParameterError
from quadid_cli.identify import GRID, file_name
from quadid_cli.options import JsonTarget, OutFolder, Preset, Rate, ReportFile, Seed, Unchecked, VehicleName

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from quadid.identify.noise_model import NoiseModel
    from quadid.vehicle import Vehicle
    from quadid_cli.exciting import Limits, Proposal
    from quadid_cli.terminal import Advance

MOST_SECONDS = 600.0


def excite(
    logs: Annotated[list[str] | None, typer.Argument(metavar="LOG", help="Flights so far, if any.")] = None,
    vehicle: VehicleName = "pelican",
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", help="Length of the manoeuvre.")] = 60.0,
    tilt: Annotated[float, typer.Option("--tilt", metavar="DEG", help="Largest tilt.")] = 25.0,
    rate_limit: Annotated[float, typer.Option("--rate-limit", metavar="DEG/S", help="Largest body rate.")] = 150.0,
    seed: Seed = 1,
    rate: Rate = None,
    preset: Preset = "auto",
    unchecked: Unchecked = False,
    report: ReportFile = None,
    json: JsonTarget = None,
    out: OutFolder = Path(),
) -> None:
    """Propose the manoeuvre that shrinks the intervals most, within tilt and rate limits; write it to a file."""
    from quadid_cli import loading, output, terminal
    from quadid_cli.exciting import Limits

    check_limits(seconds, tilt, rate_limit)
    output.check_file(json, "--json")
    output.check_file(report, "--report")
    described = loading.load_vehicle(vehicle)
    folder = output.out_folder(out)
    opened = loading.load_logs(logs or [], described, GRID if rate is None else rate, None, None, preset, unchecked)
    limits = Limits(math.radians(tilt), math.radians(rate_limit))
    with terminal.progress() as advance:
        believed, known, noise = knowledge(described, [w for log in opened for w in log.windows], seed, advance)
        proposal, result = run(believed, known, noise, limits, seconds, seed, folder, advance)
    result["logs"] = [str(log.path) for log in opened]
    if report is not None:
        from quadid.report.excite_page import excite_html

        result["report"] = str(output.write_text(report, excite_html(result, proposal.flight.window)))
    output.write_json(result, json)
    show(result, quiet=json == "-")
    terminal.warn([text for log in opened for text in log.warnings])


def check_limits(seconds: float, tilt: float, rate_limit: float) -> None:
    """Raises ParameterError for a manoeuvre that nobody can fly."""
    if not 6.5 <= seconds <= MOST_SECONDS:
        raise ParameterError(f"--seconds {seconds:g}", f"6.5 to {MOST_SECONDS:g} s")
    if not 2.0 <= tilt <= 60.0:
        raise ParameterError(f"--tilt {tilt:g} degrees", "2 to 60 degrees")
    if not 10.0 <= rate_limit <= 1000.0:
        raise ParameterError(f"--rate-limit {rate_limit:g} deg/s", "10 to 1000 deg/s")


def knowledge(
    vehicle: Vehicle, windows: Sequence[Any], seed: int, advance: Advance
) -> tuple[Vehicle, NDArray[np.float64], NoiseModel | None]:
    """What is known so far: vehicle with believed values, information (6, 6) of the log parameters, sensor noise.

    Without logs that is the vehicle file: its sigma, else half of its bounds on the log scale.
    """
    from quadid.identify.result import fitted_vehicle
    from quadid.parameters import NOMINAL_NAMES
    from quadid_cli.searching import search

    if windows:
        fit = search("pso_polish", windows, vehicle, seed, advance)
        return fitted_vehicle(fit), np.asarray(np.linalg.inv(fit.uncertainty.covariance), dtype=np.float64), fit.noise
    sigma = []
    for name in NOMINAL_NAMES:
        prior = vehicle.parameters[name]
        low, high = prior.limits
        sigma.append(prior.sigma / prior.initial if prior.sigma else 0.5 * math.log(high / low))
    return vehicle, np.diag(1.0 / np.array(sigma) ** 2), None


def run(
    vehicle: Vehicle, known: NDArray[np.float64], noise: NoiseModel | None, limits: Limits, seconds: float, seed: int,
    folder: Path, advance: Advance,
) -> tuple[Proposal, dict[str, Any]]:  # fmt: skip
    """Proposes a manoeuvre, writes its file, and returns both it and the result of the form ``quadid.excite/1``."""
    from quadid.parameters import NOMINAL_NAMES
    from quadid_cli.exciting import Simulator, manoeuvre_file, propose
    from quadid_cli.output import write_text

    proposal = propose(Simulator(vehicle, noise, seed), known, limits, seconds, advance)
    target = folder / f"{file_name(vehicle.name)}.manoeuvre.yaml"
    written = write_text(target, manoeuvre_file(vehicle.name, proposal))
    rows = zip(NOMINAL_NAMES, proposal.now, proposal.pilot, proposal.after, strict=True)
    worst = int(np.argmax(proposal.pilot))
    return proposal, {
        "schema": "quadid.excite/1",
        "vehicle": vehicle.name,
        "seconds": proposal.seconds,
        "limits": {"tilt_deg": math.degrees(limits.tilt), "rate_deg_s": math.degrees(limits.rate)},
        "peak": {"tilt_deg": math.degrees(proposal.peak.tilt), "rate_deg_s": math.degrees(proposal.peak.rate)},
        "movements": [
            {"name": m.name, "amplitudes": {s.axis: s.amplitude for s in m.segments}} for m in proposal.movements
        ],
        "parameters": [
            {"name": n, "now": float(a), "gentle_flight": float(b), "manoeuvre": float(c)} for n, a, b, c in rows
        ],
        "worst": NOMINAL_NAMES[worst],
        "gain": float(np.log1p(proposal.pilot[worst]) / np.log1p(proposal.after[worst])),
        "manoeuvre_file": str(written),
    }


def show(result: Mapping[str, Any], quiet: bool) -> None:
    """Prints the result for people."""
    from rich.table import Table

    from quadid_cli import terminal

    console = terminal.console(quiet)
    table = Table(title=f"Relative 95 % half-width (±) before and after {result['seconds']:g} s")
    for name in ("parameter", "now", "after a gentle flight", "after the manoeuvre"):
        table.add_column(name, justify="left" if name == "parameter" else "right")
    for p in result["parameters"]:
        table.add_row(p["name"], *(percent(p[k]) for k in ("now", "gentle_flight", "manoeuvre")))
    console.print(table)
    moves = Table(title="Manoeuvre")
    for name in ("movement", "amplitude (rms)"):
        moves.add_column(name)
    for m in result["movements"]:
        moves.add_row(m["name"], ", ".join(amplitude(a, v) for a, v in m["amplitudes"].items()))
    console.print(moves)
    peak = result["peak"]
    console.print(f"In simulation it reaches {peak['tilt_deg']:.0f} degrees and {peak['rate_deg_s']:.0f} deg/s.")
    console.print(f"{result['worst']}, the least certain after a gentle flight: {result['gain']:.1f} times narrower.")
    console.print(f"Manoeuvre: {result['manoeuvre_file']}", soft_wrap=True)
    if "report" in result:
        console.print(f"Report: {result['report']}", soft_wrap=True)


def percent(half: float) -> str:
    """A relative half-width for people."""
    return "unknown" if half > 2.0 else f"± {100.0 * half:.3g} %"


def amplitude(axis: str, value: float) -> str:
    """An amplitude for people."""
    return f"throttle {100.0 * value:.0f} %" if axis == "throttle" else f"{axis} {math.degrees(value):.1f}°"
