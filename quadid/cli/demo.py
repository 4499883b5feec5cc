"""`quadid demo` and `quadid reproduce`: flights simulated, fitted, and written up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import typer
from quadid_evaluation.paper import protocol
from quadid_evaluation.paper.figures import FIGURES, draw, interactive
from quadid_evaluation.paper.objective import PaperScore
from quadid_evaluation.paper.page import all_tables, paper_markdown, paper_sections

from quadid.app.diagnose import Diagnosed, diagnose
from quadid.app.identify import Identified, identify
from quadid.app.kernels import FIT, prepare
from quadid.app.logs import Log, check_folder, load, write_recording, write_text, written_whole
from quadid.app.options import JsonTarget, OutFolder, Seed
from quadid.app.outcome import Advance, provenance
from quadid.cli import terminal
from quadid.report.fit_pages import diagnosis_part, findings_section
from quadid.report.page import render
from quadid.report.verdict import effects_words
from quadid.types import JsonDict
from quadid.vehicle import Vehicle

VEHICLE = "pelican"
SECONDS, QUICK_SECONDS = 500.0, 60.0
HIDDEN = {"motor_lag": {"tau": 0.04}}
HIDDEN_SECONDS = 120.0
FOLDERS = "diagnosis", "hidden_effect"
WRITTEN = "set?.mcap", "flight?.mcap", f"{VEHICLE}*.yaml", "report.html", "result.json"
TRUE_SECTION = "The same three flights"
HIDDEN_SECTION = "A second vehicle, with something hidden in it"


def demo(
    quick: Annotated[bool, typer.Option("--quick", help="Flights of 60 s instead of 500 s.")] = False,
    seed: Seed = 1,
    json: JsonTarget = None,
    out: OutFolder = Path(),
) -> None:
    """Fly three Pelican flights, identify on the first, validate on the others, diagnose; write logs and a report."""
    terminal.check_file(json, "--json")
    folder = check_folder(out, "--out", *WRITTEN)
    for name in FOLDERS:
        check_folder(folder / name, "--out", *WRITTEN)
    with terminal.progress() as advance:
        prepare((*FIT, "flight"), advance)
        shown = run(QUICK_SECONDS if quick else SECONDS, seed, folder, advance)
        advance("writing the report", 1.0)
        page = write_text(folder / "report.html", html(shown, seed, terminal.command_line()))
    result = summary(shown, str(page))
    terminal.write_json(result, str(folder / "result.json"))
    terminal.write_json(result, json)
    show(shown, page, quiet=json == "-")


def show(shown: Shown, page: Path, quiet: bool) -> None:
    """Prints both results beside the truth, and where the files are."""
    console = terminal.console(quiet)
    terminal.print_tables(console, shown.identified.tables(shown.truth))
    terminal.print_verdict(console, shown.identified.verdict)
    for title, part in ((TRUE_SECTION, shown.diagnosed), (HIDDEN_SECTION, shown.hidden)):
        console.print(f"\n{title}")
        terminal.print_tables(console, part.tables())
        terminal.print_verdict(console, part.verdict)
    console.print(f"\nLogs and vehicle files: {page.parent}", soft_wrap=True)
    console.print(f"Report: {page}", soft_wrap=True)


@dataclass(frozen=True)
class Shown:
    """Results of the demonstration.

    Attributes:
        identified: from the first flights.
        diagnosed: of the same flights, which the model describes fully.
        hidden: of flights with a hidden effect.
        truth: true parameters of the simulated vehicle.
    """

    identified: Identified
    diagnosed: Diagnosed
    hidden: Diagnosed
    truth: Mapping[str, float]


def run(seconds: float, seed: int, folder: Path, advance: Advance) -> Shown:
    """Flies, logs, identifies and diagnoses.

    Args:
        seconds: length of each of the three flights.
    """
    from quadid.flight import TruthParameters, fly

    vehicle = Vehicle.named(VEHICLE)

    def flown(path: Path, seconds: float, seed: int, effects: Mapping[str, Mapping[str, float]]) -> Log:
        """Flies once, writes the log as MCAP, and reads it back as any other log."""
        advance(f"fly {path.stem}", 0.0)
        write_recording(path, fly(vehicle, seconds=seconds, seed=seed, effects=effects).recording)
        advance(f"fly {path.stem}", 1.0)
        return load(path, vehicle)

    def named(task: str) -> Advance:
        return lambda stage, share: advance(f"{task}: {stage}", share)

    same, apart = (folder / name for name in FOLDERS)
    flights = [flown(folder / f"set{i + 1}.mcap", seconds, 10 * seed + i, {}) for i in range(3)]
    shorter = min(seconds, HIDDEN_SECONDS)
    other = [flown(apart / f"flight{i + 1}.mcap", shorter, 10 * seed + 5 + i, HIDDEN) for i in range(2)]
    identified = identify(flights[:1], flights[1:], seed=seed, advance=named("identify"))
    diagnosed = diagnose(flights[:1], flights[1:], seed=seed, advance=named("diagnose"))
    hidden = diagnose(other[:1], other[1:], seed=seed, advance=named("diagnose hidden effect"))
    for done, place in ((identified, folder), (diagnosed, same), (hidden, apart)):
        done.write(place)
    return Shown(identified, diagnosed, hidden, TruthParameters.of(vehicle).as_dict())


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


def html(shown: Shown, seed: int, command: str) -> str:
    """The report: identification with the truth beside it, then both diagnoses."""
    done = shown.identified
    logs: Sequence[Log] = [*done.logs, *shown.hidden.logs]
    rows = provenance(logs, command, {"seed": seed})
    hidden = shown.hidden
    same = diagnosis_part(
        shown.diagnosed.result,
        shown.diagnosed.sets,
        "same",
        TRUE_SECTION,
        "Nothing was hidden in this vehicle, so nothing should be found.",
    )
    same["kind"] = "folded"
    apart = diagnosis_part(
        hidden.result,
        hidden.sets[-1:],
        "hidden",
        HIDDEN_SECTION,
        f"This vehicle flew with {effects_words(HIDDEN)}, which the model lacks.",
        hidden.maps(),
        None if hidden.forces is None else hidden.forces.section(),
    )
    more = [findings_section([same, apart])]
    return done.written_up("Demonstration: a simulated Pelican", None, more, logs, rows, shown.truth)


# --- `quadid reproduce`: the paper's protocol, its tables and figures, and what they lack


_FIGURES = "paper"
"""Folder of the pictures in the output folder."""


def reproduce(
    quick: Annotated[bool, typer.Option("--quick", help="Flights of 60 s instead of 500 s, a smaller swarm.")] = False,
    seed: Seed = 1,
    json: JsonTarget = None,
    out: OutFolder = Path(),
) -> None:
    """Fly the paper's three sets, fit as it does and better; write Tables 1 and 2, Figures 3 to 8, and one page."""
    terminal.check_file(json, "--json")
    folder = check_folder(out, "--out", "paper.json", "paper.html", "paper.md")
    check_folder(folder / _FIGURES, "--out", "figure-*")
    flights = check_folder(folder / "flights", "--out", "set?.mcap", "pelican.yaml")
    plan = protocol.QUICK if quick else protocol.Plan()
    with terminal.progress() as advance:
        prepare(FIT, advance)
        command = f"quadid reproduce{' --quick' if quick else ''} --seed {seed}"
        result, scores = protocol.reproduce(flights, plan, seed, advance, command)
        advance("draw", 0.0)
        result["files"] = write(result, scores, folder)
    terminal.write_json(result, str(folder / "paper.json"))
    terminal.write_json(result, json)
    console = terminal.console(json == "-")
    terminal.print_tables(console, all_tables(result))
    for path in result["files"][-2:]:
        console.print(path, soft_wrap=True)


def write(result: JsonDict, scores: Mapping[str, Sequence[PaperScore]], folder: Path) -> list[str]:
    """Writes pictures, Markdown and HTML; returns their absolute paths."""
    from matplotlib import rc_context, rcParamsDefault

    pictures, files = check_folder(folder / _FIGURES, "--out"), []
    for figure, kind in product(FIGURES, ("png", "pdf")):
        path = pictures / f"figure-{figure.number}.{kind}"
        # Without the settings of a matplotlibrc in this folder, which can have LaTeX run on what they hold.
        with rc_context(rcParamsDefault), written_whole(path) as part:
            draw(figure, scores).savefig(part, dpi=110)
        files.append(str(path))
    page = render(paper_sections(result, [interactive(figure, scores) for figure in FIGURES]))
    files.append(str(write_text(folder / "paper.html", page)))
    files.append(str(write_text(folder / "paper.md", paper_markdown(result, _FIGURES))))
    return files
