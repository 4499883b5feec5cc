"""The demonstration: a simulated Pelican is flown, logged, identified and diagnosed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quadid.app.diagnose import Diagnosed, diagnose
from quadid.app.identify import Identified, identify
from quadid.app.logs import Log, as_vehicle, load, write_recording
from quadid.app.outcome import LIBRARY, Advance, provenance, quality, told
from quadid.report.verdict import effects_words
from quadid.vehicle import Vehicle

VEHICLE = "pelican"
SECONDS, QUICK_SECONDS = 500.0, 60.0
HIDDEN = {"motor_lag": {"tau": 0.04}}
HIDDEN_SECONDS = 120.0
TRUE_SECTION = "The same three flights"
HIDDEN_SECTION = "A second vehicle, with something hidden in it"


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
    from quadid.flight import TruthParameters

    vehicle = as_vehicle(VEHICLE)
    truth = TruthParameters.of(vehicle).as_dict()
    flights = [
        fly_and_load(vehicle, folder / f"set{i + 1}.mcap", seconds, 10 * seed + i, {}, advance) for i in range(3)
    ]
    same, apart = (folder / name for name in ("diagnosis", "hidden_effect"))
    for made in (same, apart):
        made.mkdir(exist_ok=True)
    shorter = min(seconds, HIDDEN_SECONDS)
    other = [
        fly_and_load(vehicle, apart / f"flight{i + 1}.mcap", shorter, 10 * seed + 5 + i, HIDDEN, advance)
        for i in range(2)
    ]
    identified = identify(flights[:1], flights[1:], seed=seed, advance=_named("identify", advance))
    diagnosed = diagnose(flights[:1], flights[1:], seed=seed, advance=_named("diagnose", advance))
    hidden = diagnose(other[:1], other[1:], seed=seed, advance=_named("diagnose hidden effect", advance))
    for done, place in ((identified, folder), (diagnosed, same), (hidden, apart)):
        done.result["vehicle_file"] = str(done.vehicle.save(place / done.file_name))
    return Shown(identified, diagnosed, hidden, truth)


def _named(task: str, advance: Advance) -> Advance:
    return lambda stage, share: advance(f"{task}: {stage}", share)


def fly_and_load(
    vehicle: Vehicle, path: Path, seconds: float, seed: int, effects: Mapping[str, Mapping[str, float]],
    advance: Advance,
) -> Log:  # fmt: skip
    """Flies once, writes the log as MCAP, and reads it back as any other log."""
    from quadid.flight import fly

    advance(f"fly {path.stem}", 0.0)
    flight = fly(vehicle, seconds=seconds, seed=seed, effects=effects)
    write_recording(path, flight.recording)
    advance(f"fly {path.stem}", 1.0)
    return load(path, vehicle)


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


def html(shown: Shown, seed: int, command: str = LIBRARY) -> str:
    """The report: identification with the truth beside it, then both diagnoses."""
    from quadid.report.fit_pages import diagnosis_part, findings_section, identify_page
    from quadid.report.page import render

    done = shown.identified
    logs: Sequence[Log] = [*done.logs, *shown.hidden.logs]
    rows = [*provenance(logs, command), {"name": "seed", "value": str(seed)}]
    hidden = shown.hidden
    same = diagnosis_part(
        shown.diagnosed.result, shown.diagnosed.sets, "same", TRUE_SECTION,
        "Nothing was hidden in this vehicle, so nothing should be found.",
    )  # fmt: skip
    apart = diagnosis_part(
        hidden.result, hidden.sets[-1:], "hidden", HIDDEN_SECTION,
        f"This vehicle flew with {effects_words(HIDDEN)}, which the model lacks.", hidden.maps(),
        None if hidden.forces is None else hidden.forces.section(),
    )  # fmt: skip
    page = identify_page(
        done.result, done.sets, done.fit.noise, [quality(log) for log in logs], rows, shown.truth,
        more=[findings_section([same, apart])], excitation=told(done.fit, done.logs[:1]),
    )  # fmt: skip
    page["title"] = "Demonstration: a simulated Pelican"
    return render(page)
