"""Diagnoses the cases of two independent simulators and prints what was found beside what was hidden.

QUADID_DATA=../shared/data python -m quadid_evaluation.studies.cases
"""

import json
from pathlib import Path
from typing import Any

from quadid_replay import open_log

from quadid.data.grid import to_windows
from quadid.data.window import Window
from quadid.diagnosis import Diagnosis, diagnose
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import options


def windows(path: Path, vehicle: Vehicle) -> list[Window]:
    """Windows of one CSV on the 50 Hz grid."""
    return list(to_windows(open_log(path), vehicle))


FOLDERS = ("cases", "cases_hub")
"""Rotors whose air acts at the centre of gravity, and at each hub."""


def right(found: Diagnosis, answer: dict[str, Any]) -> bool:
    """Checks whether verdict and names agree with the answer sheet; amid clutter the large effect must come first."""
    hidden, named = answer["effects"], [f.effect for f in found.findings if f.confident]
    if hidden == ["unknown"]:
        return found.verdict.value == "unknown"
    if answer["kind"] == "clutter":
        return named[:1] == hidden and set(named) <= set(answer["truth"])
    return set(named) == set(hidden)


def row(folder: Path, answer: dict[str, Any]) -> tuple[bool, str]:
    """Diagnoses one case; returns whether it is right and its table row."""
    vehicle = Vehicle.from_yaml((folder / "vehicle.yaml").read_text(encoding="utf-8"))
    train, held = (windows(folder / f"{flight}.csv", vehicle) for flight in ("train", "validate"))
    found, _ = diagnose(train, vehicle, held)
    truth = {name: answer["truth"].get(name, {}) for name in answer["effects"]}
    named = ", ".join(
        " ".join([f.effect, *(f"{values[k]:.4g}" for k in truth.get(f.effect, {}) if k in values)])
        for f in found.findings
        for values in [{p.name: p.value for p in f.parameters}]
    )
    hidden = ", ".join(" ".join([name, *(f"{k} {v:.4g}" for k, v in truth[name].items())]) for name in truth)
    good = right(found, answer)
    figures = f"{found.validation.nominal:.3g} → {found.validation.extended:.3g}"
    verdict = "" if found.verdict.value in ("explained", "nothing_found") else f"{found.verdict.value}: "
    verdict = verdict if good else f"**wrong**, {found.verdict.value}: "
    case = f"{folder.parent.name}/{answer['case']}"
    return good, f"| {case} | {hidden or '–'} | {verdict}{named or '–'} | {figures} |"


if __name__ == "__main__":
    given, results = options(__doc__), list[bool]()
    print("| case | hidden | found | error on the unseen flight |\n|---|---|---|---|")
    for folder in FOLDERS:
        for answer in json.loads((given.data / folder / "answers.json").read_text(encoding="utf-8")):
            good, text = row(given.data / folder / answer["case"], answer)
            results.append(good)
            print(text, flush=True)
    print(f"\n{sum(results)} of {len(results)} right")
