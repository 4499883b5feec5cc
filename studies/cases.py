"""Diagnoses the cases of two independent simulators and prints what was found beside what was hidden.

QUADID_DATA=../shared/data python -m studies.cases
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from quadid_replay import open_log

from quadid.diagnose import Diagnosis, diagnose
from quadid.grid import to_windows
from quadid.vehicle import Vehicle
from quadid.window import Window


def windows(path: Path, vehicle: Vehicle) -> list[Window]:
    """Windows of one CSV on the 50 Hz grid."""
    return list(to_windows(open_log(path), vehicle))


FOLDERS = ("cases", "cases_hub")
"""Rotors whose air acts at the centre of gravity, and at each hub."""


def right(found: Diagnosis, answer: dict[str, Any]) -> bool:
    """Whether verdict and names agree with the answer sheet; amid clutter the large effect must come first."""
    hidden, named = answer["effects"], [f.effect for f in found.findings if f.confident]
    if hidden == ["unknown"]:
        return found.verdict.value == "unknown"
    if answer["kind"] == "clutter":
        return named[:1] == hidden and set(named) <= set(answer["truth"])
    return set(named) == set(hidden)


def row(folder: Path, answer: dict[str, Any]) -> tuple[bool, str]:
    """Diagnoses one case; returns whether it is right and its table row."""
    vehicle = Vehicle.from_yaml((folder / "vehicle.yaml").read_text(encoding="utf-8"))
    began = time.perf_counter()
    found, _ = diagnose(windows(folder / "train.csv", vehicle), vehicle, windows(folder / "validate.csv", vehicle))
    seconds = time.perf_counter() - began
    named = "; ".join(
        f"{f.effect} " + ", ".join(f"{p.name} {p.value:.4g}" for p in f.parameters) for f in found.findings
    )
    hidden = "; ".join(
        f"{name} " + ", ".join(f"{k} {v:.4g}" for k, v in answer["truth"].get(name, {}).items())
        for name in answer["effects"]
    )
    good = right(found, answer)
    figures = f"{found.validation.nominal:.3f} → {found.validation.extended:.3f} | {seconds:.1f}"
    case = f"{folder.parent.name} {answer['case']}"
    return good, f"| {case} | {hidden or '–'} | {found.verdict.value} | {named or '–'} | {figures} | {good} |"


def main() -> None:
    """Prints the table."""
    data = Path(os.environ.get("QUADID_DATA", "../shared/data"))
    print("| case | hidden | verdict | found | error on the unseen flight | s | right |\n|---|---|---|---|---|---|---|")
    results = []
    for folder in FOLDERS:
        for answer in json.loads((data / folder / "answers.json").read_text(encoding="utf-8")):
            good, text = row(data / folder / answer["case"], answer)
            results.append(good)
            print(text, flush=True)
    print(f"\n{sum(results)} of {len(results)} right")


if __name__ == "__main__":
    main()
