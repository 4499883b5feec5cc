"""`quadid demo`: flies, logs, identifies and diagnoses a simulated Pelican, and writes a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from quadid_cli import diagnose as diagnosing
from quadid_cli import identify as identifying
from quadid_cli.options import JsonTarget, OutFolder, Seed

if TYPE_CHECKING:
    from quadid.vehicle import Vehicle
    from quadid_cli.loading import Log
    from quadid_cli.terminal import Advance

VEHICLE = "pelican"
SECONDS, QUICK_SECONDS = 500.0, 60.0
HIDDEN = {"motor_lag": {"tau": 0.04}}
HIDDEN_SECONDS = 120.0
_TRUE_SECTION = "The same three flights"
_HIDDEN_SECTION = "A second vehicle, with something hidden in it"


@dataclass(frozen=True)
class Shown:
    """What the demonstration produced.

    Attributes:
        identified: from the first flights.
        diagnosed: of the same flights, which the model describes fully.
        hidden: of flights with a hidden effect.
        truth: true parameters of the simulated vehicle.
    """

    identified: identifying.Identified
    diagnosed: diagnosing.Diagnosed
    hidden: diagnosing.Diagnosed
    truth: Mapping[str, float]


def demo(
    quick: Annotated[bool, typer.Option("--quick", help="Flights of 60 s instead of 500 s.")] = False,
    seed: Seed = 1,
    json: JsonTarget = None,
    out: OutFolder = Path(),
) -> None:
    """Fly three Pelican flights, identify on the first, validate on the others, diagnose; write logs and a report."""
    from quadid_cli import output, terminal

    output.check_file(json, "--json")
    folder = output.out_folder(out)
    with terminal.progress() as advance:
        shown = run(QUICK_SECONDS if quick else SECONDS, seed, folder, advance)
    page = folder / "report.html"
    result = summary(shown, str(page))
    output.write_text(page, html(shown, seed))
    output.write_json(result, str(folder / "result.json"))
    output.write_json(result, json)
    show(shown, page, quiet=json == "-")


def run(seconds: float, seed: int, folder: Path, advance: Advance) -> Shown:
    """Flies, logs, identifies and diagnoses.

    Args:
        seconds: length of each of the three flights.
        seed: of flights and searches.
        folder: for logs and vehicle files.
        advance: told how far it is.
    """
    from multiprocessing import get_context

    from quadid.flight import TruthParameters
    from quadid.online.window_fit import warm_up
    from quadid_cli.loading import load_vehicle
    from quadid_cli.output import out_folder

    vehicle = load_vehicle(VEHICLE)
    # A first start compiles for a minute: the other core begins with the fit while this one flies.
    warming = get_context("spawn").Process(target=warm_up, args=(vehicle,), daemon=True)
    warming.start()
    truth = TruthParameters.of(vehicle).as_dict()
    flights = [
        fly_and_load(vehicle, folder / f"set{i + 1}.mcap", seconds, 10 * seed + i, {}, advance) for i in range(3)
    ]
    same, apart = (out_folder(folder / name) for name in ("diagnosis", "hidden_effect"))
    shorter = min(seconds, HIDDEN_SECONDS)
    other = [
        fly_and_load(vehicle, apart / f"flight{i + 1}.mcap", shorter, 10 * seed + 5 + i, HIDDEN, advance)
        for i in range(2)
    ]
    advance("compile, at a first start", 0.0)
    warming.join()
    advance("compile, at a first start", 1.0)
    target = folder / f"{identifying.file_name(vehicle.name)}.fitted.yaml"
    identified = identifying.run(
        vehicle, flights[:1], flights[1:], "pso_polish", seed, target, _named("identify", advance)
    )
    diagnosed = diagnosing.run(vehicle, flights[:1], flights[1:], seed, same, "", _named("diagnose", advance))
    hidden = diagnosing.run(vehicle, other[:1], other[1:], seed, apart, "", _named("diagnose hidden effect", advance))
    return Shown(identified, diagnosed, hidden, truth)


def _named(task: str, advance: Advance) -> Advance:
    return lambda stage, share: advance(f"{task}: {stage}", share)


def fly_and_load(
    vehicle: Vehicle, path: Path, seconds: float, seed: int, effects: Mapping[str, Mapping[str, float]],
    advance: Advance,
) -> Log:  # fmt: skip
    """Flies once, writes the log as MCAP, and reads it back as any other log."""
    from quadid_replay import write_mcap

    from quadid.flight import fly
    from quadid_cli.loading import load_log

    advance(f"fly {path.stem}", 0.0)
    flight = fly(vehicle, seconds=seconds, seed=seed, effects=effects)
    write_mcap(path, flight.recording)
    advance(f"fly {path.stem}", 1.0)
    return load_log(str(path), vehicle, identifying.GRID)


def summary(shown: Shown, page: str) -> dict[str, Any]:
    """The demonstration as JSON: both results as their commands give them, beside the truth."""
    return {
        "schema": "quadid.demo/1",
        "truth": {"parameters": shown.truth, "hidden_effect": HIDDEN},
        "identify": shown.identified.result,
        "diagnose": shown.diagnosed.result,
        "diagnose_hidden": shown.hidden.result,
        "logs": [str(log.path) for log in (*shown.identified.logs, *shown.hidden.logs)],
        "report": page,
    }


def html(shown: Shown, seed: int) -> str:
    """The report: identification with the truth beside it, then both diagnoses."""
    from quadid.report.diagnose_page import diagnosis_part
    from quadid.report.identify_page import identify_page
    from quadid.report.page import render
    from quadid_cli.reporting import provenance, quality, told

    done = shown.identified
    logs: Sequence[Log] = [*done.logs, *shown.hidden.logs]
    rows = [*provenance(logs), {"name": "seed", "value": str(seed)}]
    page = identify_page(done.result, done.sets, done.fit.noise, [quality(log) for log in logs], rows, shown.truth)
    page["title"] = "Demonstration: a simulated Pelican"
    page["excitation"] = told(done.fit, done.logs[:1])
    page["diagnoses"] = [
        diagnosis_part(
            shown.diagnosed.result, shown.diagnosed.sets, "same", _TRUE_SECTION,
            "Nothing was hidden in this vehicle, so nothing should be found.",
        ),
        diagnosis_part(
            shown.hidden.result, shown.hidden.sets[-1:], "hidden", _HIDDEN_SECTION,
            f"This vehicle flew with {_hidden_words()}, which the model does not know of.",
            shown.hidden.maps(),
        ),
    ]  # fmt: skip
    return render(page)


def _hidden_words() -> str:
    from quadid.effects import EFFECTS

    return ", ".join(
        f"{effect.replace('_', ' ')} ({key} = {value:g} {EFFECTS[effect].parameter(key).unit})"
        for effect, values in HIDDEN.items()
        for key, value in values.items()
    )


def show(shown: Shown, page: Path, quiet: bool) -> None:
    """Prints both results beside the truth, and where the files are."""
    from quadid.report.diagnose_page import diagnose_verdict
    from quadid.report.verdict import identify_verdict
    from quadid_cli import tables, terminal

    console = terminal.console(quiet)
    result = shown.identified.result
    tables.print_parameters(console, result["parameters"], shown.truth)
    tables.print_sets(console, result["sets"])
    tables.print_verdict(console, identify_verdict(result))
    for title, part in ((_TRUE_SECTION, shown.diagnosed), (_HIDDEN_SECTION, shown.hidden)):
        console.print(f"\n{title}")
        if part.result["findings"]:
            tables.print_findings(console, part.result["findings"])
        tables.print_verdict(console, diagnose_verdict(part.result))
    console.print(f"\nLogs and vehicle files: {page.parent}", soft_wrap=True)
    console.print(f"Report: {page}", soft_wrap=True)
