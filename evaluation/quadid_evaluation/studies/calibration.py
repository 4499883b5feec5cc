"""How often a diagnosis cries wolf, and whether its intervals hold: many flights without effects and with one.

    python -m quadid_evaluation.studies.calibration --nulls 80 --singles 75 --records FILE --page
    docs/results/calibration.md

Every flight is decided by its number alone; numbers begin where the blinded campaign never goes.  A run that is
stopped goes on from its records.
"""

from __future__ import annotations

import argparse
import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy import stats

from quadid.chi_square import Z95
from quadid.diagnosis import Diagnosis, Search, diagnose
from quadid.diagnosis import evidence as rule
from quadid.diagnosis.evidence import Everything
from quadid.diagnosis.hypotheses import Candidate, Gain, Model, candidates, extend, paired_gain
from quadid.diagnosis.residual_tests import ALARM
from quadid.diagnosis.result import FoundParameter
from quadid.errors import QuadidError
from quadid.flight import FlightError
from quadid.identification.problem import Shooting
from quadid_evaluation.studies.campaign import Case, cases, flown
from quadid_evaluation.studies.page import put_section

FIRST = 50_000
"""Number of the first flight: beyond every number the campaign flies."""
Record = dict[str, Any]


def study(case: Case) -> Record:
    """Flies and diagnoses one case without a validation flight; plain numbers about the answer."""
    key = {"group": case.group, "number": case.number, "effects": list(case.expected)}
    try:
        window, _, vehicle = flown(case)
        found, search = diagnose([window], vehicle, seed=case.seed)
    except (FlightError, QuadidError) as error:
        return key | {"verdict": "failed", "note": str(error)}
    key |= {"verdict": found.verdict.value, "named": [f.effect for f in found.findings if f.confident]}
    return key | _errors(case, found) | ({} if case.expected else {"gates": _gates(found, search)})


def _gates(found: Diagnosis, search: Search) -> dict[str, Any]:
    """What the parts of the rule say of the selected model: of a null flight, of nothing at all.

    A null rarely has a cause worth a refit, so the best three of the screening are refitted here whatever they promise.
    """
    decisive, model = search.shooting, search.model
    listed = candidates(decisive.layout, decisive.has_velocity, decisive.channels >= 15)
    scores = [s for s in Everything.of(decisive, model, listed).scores() if s.candidate.timed is None]
    trials = [_refit(decisive, model, s.candidate, len(scores)) for s in scores[:3]]
    left = found.remainder
    return {
        "screened": [float(stats.chi2.sf(s.drop, len(s.candidate.names))) for s in scores],
        "gain": sum(t.gain.total > rule.RELEVANT * model.rows for t in trials),
        "chance": sum(t.likely for t in trials),
        "largest_gain": max((t.gain.total / model.rows for t in trials), default=0.0),
        "power": max((s.errors for s in left.channels), default=0.0),
        "follows": len(left.followed),
    }


@dataclass(frozen=True)
class Refit:
    """One candidate refitted: its gain on blocks not fitted, and whether its evidence is beyond chance."""

    gain: Gain
    likely: bool


def _refit(shooting: Shooting, model: Model, candidate: Candidate, tests: int) -> Refit:
    """Refits one candidate as the selection does it."""
    extended = extend(shooting, model, candidate, tried=float(tests))
    return Refit(paired_gain(model.held_out, extended.held_out), rule.advantage(extended, model) > 0.0)


def _errors(case: Case, found: Diagnosis) -> dict[str, dict[str, float]]:
    """Errors of the numbers of hidden effects that were found: in standard deviations, and as shares of the truth."""
    scaled, share = {}, {}
    for finding in found.findings:
        truth = case.hidden.get(finding.effect)
        for p in finding.parameters:
            if (
                truth is None
                or p.name not in truth
                or p.name == "rotor"
                or (finding.effect == "weak_rotor" and _other(finding, truth))
            ):
                continue
            name = f"{finding.effect}.{p.name}"
            scaled[name] = _standardised(p, truth[p.name])
            share[name] = abs(p.value / truth[p.name] - 1.0)
    return {"scaled": scaled, "share": share}


def _other(finding: Any, truth: dict[str, float]) -> bool:
    """Whether another rotor was blamed."""
    return bool(next(p.value for p in finding.parameters if p.name == "rotor") != truth["rotor"])


def _standardised(p: FoundParameter, truth: float) -> float:
    """Error in standard deviations of the stated interval; beyond 1.96 the interval does not hold the truth."""
    low, high = p.ci95
    value = p.value
    if p.unit == "Hz":  # its interval is symmetric in the period
        low, high, value, truth = (1.0 / x if x else math.inf for x in (high, low, p.value, truth))
    return Z95 * (value - truth) / (0.5 * (high - low))


def run(todo: Sequence[Case], records: Path) -> list[Record]:
    """Runs what `records` lacks and returns the records of all of `todo`."""
    done = {}
    if records.exists():
        for line in records.read_text(encoding="utf-8").splitlines():
            record = json.loads(line)
            done[record["group"], record["number"]] = record
    for case in todo:
        if (case.group, case.number) not in done:
            record = done[case.group, case.number] = study(case)
            with records.open("a", encoding="utf-8") as file:
                file.write(json.dumps(record) + "\n")
            print(case.group, case.number, case.expected, record["verdict"], record.get("named"), flush=True)
    return [done[c.group, c.number] for c in todo if (c.group, c.number) in done]


def proportion(count: int, of: int) -> str:
    """Share in per cent with its exact binomial 95 % interval."""
    if not of:
        return "–"
    low, high = stats.binomtest(count, of).proportion_ci(method="exact")
    return f"{count} of {of} ({100.0 * count / of:.1f} %, {100.0 * low:.1f}–{100.0 * high:.1f} %)"


def null_page(records: list[Record], seconds: float) -> str:
    """False alarms as Markdown."""
    good = [r for r in records if r["verdict"] != "failed"]
    gates = [r["gates"] for r in good]
    n = len(good)
    rows = [
        ("a cause named", sum(bool(r["named"]) for r in good)),
        ("verdict `unknown`", sum(r["verdict"] == "unknown" for r in good)),
        ("a trial gains the least share", sum(g["gain"] > 0 for g in gates)),
        ("a trial is beyond chance, all trials counted", sum(g["chance"] > 0 for g in gates)),
        ("remainder: power above the noise", sum(g["power"] > ALARM for g in gates)),
        ("remainder: follows a signal on unseen blocks", sum(g["follows"] > 0 for g in gates)),
    ]
    table = "\n".join(f"| {what} | {proportion(count, n)} |" for what, count in rows)
    largest = np.quantile([g["largest_gain"] for g in gates], [0.5, 0.95, 1.0])
    screened = np.array([p for g in gates for p in g["screened"]])
    tails = ", ".join(f"{100 * a:g} %: {proportion(int(np.sum(screened < a)), len(screened))}" for a in (0.05, 0.01))
    return (
        f"{n} flights of {seconds:.0f} s without any effect ({len(records) - n} failed); 95 % intervals of\n"
        "the binomial law, exact. The best three causes of each screening were refitted whatever they promised;\n"
        "rows three and four say what each part of the rule alone would have let through. The selection\n"
        "asks for both.\n\n"
        f"| flights in which | share |\n|---|---|\n{table}\n\n"
        f"Largest gain on unseen blocks of any of these trials, as a share of the noise: median {largest[0]:.5f},\n"
        f"95 % quantile {largest[1]:.5f}, largest {largest[2]:.5f}; the rule asks for {rule.RELEVANT}.\n\n"
        f"Score tests of all causes with p below {tails}.\n"
        "Causes of one flight share its noise, so these intervals are too narrow."
    )


def coverage_page(records: list[Record], seconds: float) -> str:
    """Right answers and coverage of the effects' numbers as Markdown."""
    good = [r for r in records if r["verdict"] != "failed"]
    exact = sum(set(r["effects"]) == set(r["named"]) for r in good)
    numbers = [[z for k, z in r["scaled"].items() if not k.endswith(".time")] for r in good]
    held = [sum(abs(z) <= Z95 for z in zs) for zs in numbers]
    total = sum(len(zs) for zs in numbers)
    covered = sum(held) / max(total, 1)
    # Numbers of one flight share its noise: the error of the share is that between flights.
    spread = math.sqrt(sum((h - covered * len(zs)) ** 2 for h, zs in zip(held, numbers, strict=True))) / max(total, 1)
    alike = sorted(abs(z) for zs in numbers for z in zs)
    times = [z for r in good for k, z in r["scaled"].items() if k.endswith(".time")]
    by_effect: dict[str, list[tuple[float, float]]] = {}
    for r in good:
        for k, z in r["scaled"].items():
            if not k.endswith(".time"):
                by_effect.setdefault(k.split(".")[0], []).append((z, r["share"][k]))
    rows = "\n".join(
        f"| {k} | {sum(abs(z) <= Z95 for z, _ in v)} of {len(v)} | {np.sqrt(np.mean([z * z for z, _ in v])):.2f} "
        f"| {100.0 * np.median([s for _, s in v]):.2f} |"
        for k, v in sorted(by_effect.items())
    )
    wrong = "\n".join(
        f"| {', '.join(r['effects'])} | {r['verdict']} | {', '.join(r['named']) or '–'} |"
        for r in good
        if set(r["effects"]) != set(r["named"])
    )
    middle = float(np.median(alike)) if alike else math.nan
    return (
        f"{len(good)} flights of {seconds:.0f} s, one effect of realistic size each, every effect in turn "
        f"({len(records) - len(good)} failed).\n"
        f"Named exactly what was hidden: {proportion(exact, len(good))}.\n\n"
        f"Numbers of found effects inside their 95 % interval: {proportion(sum(held), total)}; standard error between "
        f"flights {100.0 * spread:.1f} %. Median error {middle:.2f} standard deviations (0.67 for honest ones).\n"
        f"Onset times, whose deviation is set: {proportion(sum(abs(z) <= Z95 for z in times), len(times))}.\n\n"
        "| effect | numbers inside | RMS error in standard deviations | median error % |\n"
        f"|---|---|---|---|\n{rows}\n\n"
        f"Silent, or named something else:\n\n| hidden | verdict | named |\n|---|---|---|\n{wrong}"
    )


def main() -> None:
    """Command line of the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nulls", type=int, default=100)
    parser.add_argument("--singles", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--records", type=Path, required=True, help="JSON lines; a stopped run goes on from them")
    parser.add_argument("--page", type=Path, help="Markdown page to put the tables into")
    options = parser.parse_args()
    singles = [replace(c, seconds=options.seconds) for c in cases("short", options.singles, FIRST)]
    nulls = [replace(c, seconds=options.seconds) for c in cases("null", options.nulls, FIRST)]
    pages = {
        "false alarms": null_page(run(nulls, options.records), options.seconds),
        "coverage": coverage_page(run(singles, options.records), options.seconds),
    }
    for name, text in pages.items():
        print(f"\n## {name}\n\n{text}")
        if options.page:
            put_section(options.page, "Diagnosis: false alarms and coverage", name, text)


if __name__ == "__main__":
    main()
