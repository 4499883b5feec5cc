"""The nominal six of the independent cases when the hidden effect is known, and the feedback that each flight shows.

    QUADID_DATA=../shared/data python -m quadid_evaluation.studies.case_parameters --out docs/results

Nominal parameters of each flight by itself, with the hidden effects known.  `quadid.data.intersample` finds the inner
loop of the flight controller that acted within the log's samples; the rotor speeds then run on as it says.

The table that is printed has errors in stated standard deviations; its last column is that inner loop, in 1/s^2 on the
angle and 1/s on the rate.
"""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from quadid.data.intersample import find_feedback
from quadid.data.window import Window
from quadid.effects import EFFECTS
from quadid.identification.fit import FitOptions, fit
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.studies.cases import windows
from quadid_evaluation.studies.page import put_section

INSIDE = 1.96
"""Standard deviations to either side that hold the truth in 95 of 100 cases."""


def names_of(answer: dict[str, Any]) -> list[str]:
    """Entries that the hidden effects of a case free."""
    out = []
    for effect in answer["effects"]:
        if effect == "weak_rotor":
            out.append(f"weak_rotor.loss_{answer['truth'][effect]['rotor']}")
        else:
            out += EFFECTS[effect].entries
    return out


class Errors(NamedTuple):
    """Errors of the nominal six in standard deviations, shape (6,).

    Attributes:
        flat: with rotor speeds that stay the same within a sample.
        sloped: with what feedback makes of them; None where none was found.
    """

    flat: FloatArray
    sloped: FloatArray | None


def row(folder: Path, flight: str, answer: dict[str, Any]) -> tuple[str, Errors]:
    """Table row of one flight, and its errors."""
    vehicle = Vehicle.from_yaml((folder / "vehicle.yaml").read_text(encoding="utf-8"))
    flown = windows(folder / f"{flight}.csv", vehicle)
    errors = Errors(_errors([replace(w, rotor_slope=None) for w in flown], vehicle, answer), None)
    feedback = find_feedback(flown)
    if feedback is not None:
        errors = errors._replace(sloped=_errors(flown, vehicle, answer))
    shown = errors.flat if errors.sloped is None else errors.sloped
    loop = "–" if feedback is None else f"{feedback.proportional:.0f}, {feedback.derivative:.0f}"
    cells = " | ".join([*(f"{z:+.1f}" for z in shown), loop])
    return f"| {answer['case']} {flight} | {', '.join(answer['effects']) or '–'} | {cells} |", errors


def _errors(flown: list[Window], vehicle: Vehicle, answer: dict[str, Any]) -> FloatArray:
    found = fit(flown, vehicle, FitOptions(iterations=0), names=[*NOMINAL_NAMES, *names_of(answer)])
    truth = np.log([answer["nominal"][name] for name in NOMINAL_NAMES])
    return np.asarray((np.log(found.theta[: len(truth)]) - truth) / found.uncertainty.sigma[: len(truth)])


def _summary(what: str, errors: list[FloatArray]) -> str:
    z = np.array(errors)
    mean = ", ".join(f"{m:+.1f}" for m in z.mean(axis=0))
    inside = np.count_nonzero(np.abs(z) <= INSIDE)
    return f"| {what} | {inside} of {z.size} | {mean} |"


def main() -> None:
    """Command line of the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="", help="folder of cases.md")
    options = parser.parse_args()
    data = Path(os.environ.get("QUADID_DATA", "../shared/data")) / "cases"
    answers = json.loads((data / "answers.json").read_text(encoding="utf-8"))
    known = [a for a in answers if "unknown" not in a["effects"]]
    text = [
        "`python -m quadid_evaluation.studies.case_parameters --out docs/results`: nominal parameters of each "
        "flight, with the hidden "
        "effects known.", "",
        "| flights | 95 % intervals that contain the truth | mean error in sigma: " + ", ".join(NOMINAL_NAMES) + " |",
        "|---|---|---|",
    ]  # fmt: skip
    print(f"| flight | hidden, known here | {' | '.join(NOMINAL_NAMES)} | feedback |")
    errors = []
    for answer in known:
        for flight in ("train", "validate"):
            line, found = row(data / answer["case"], flight, answer)
            errors.append(found)
            print(line, flush=True)
    fed = [(e.sloped, e.flat) for e in errors if e.sloped is not None]
    summaries = [
        _summary(f"{len(fed)} with feedback within samples, modelled", [sloped for sloped, _ in fed]),
        _summary("the same, speeds held", [flat for _, flat in fed]),
        _summary(f"{len(errors) - len(fed)} without", [e.flat for e in errors if e.sloped is None]),
    ]
    text += summaries
    print("\n".join(summaries))
    if options.out:
        put_section(Path(options.out) / "cases.md", "Independent cases", "parameters", "\n".join(text))


if __name__ == "__main__":
    main()
