"""Runs the diagnosis with each rule left out and each number halved and doubled, and says what changes.

QUADID_DATA=../shared/data python -m studies.ablation --out docs/results
python -m studies.ablation --house
"""

from __future__ import annotations

import argparse
import datetime
import os
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from studies.ablation.answers import Answer, run
from studies.ablation.corpus import CLASSES, START, flights
from studies.ablation.house import measured
from studies.ablation.variants import Variant, variants


def told(answer: Answer) -> None:
    """Prints one answer."""
    mark = {True: "right", False: "WRONG", None: "-"}[answer.right]
    print(f"{mark:5s} {answer.variant}: {answer.flight}: {answer.verdict} {list(answer.listed)}", flush=True)


def row(variant: Variant, base: Sequence[Answer], answers: Sequence[Answer]) -> str:
    """One line of the table: what is right, which answers differ from `base`, and how."""
    judged = [a for a in answers if a.right is not None]
    changed = [(b, a) for b, a in zip(base, answers, strict=True) if a.differs(b)]
    better = sum(bool(a.right) and not b.right for b, a in changed if a.right is not None)
    worse = sum(not a.right and bool(b.right) for b, a in changed if a.right is not None)
    named = "; ".join(_difference(b, a) for b, a in changed[:4]) + (" …" if len(changed) > 4 else "")
    seconds = sum(a.seconds for a in answers) / max(sum(a.seconds for a in base), 1e-9)
    return (
        f"| {variant.name} | {sum(bool(a.right) for a in judged)} of {len(judged)} | +{better} −{worse} "
        f"| {len(changed)} | {seconds:.2f} | {named or '–'} |"
    )


def _difference(base: Answer, other: Answer) -> str:
    gone, come = (sorted(set(x.listed) - set(y.listed)) for x, y in ((base, other), (other, base)))
    words = [*(f"−{n}" for n in gone), *(f"+{n}" for n in come)] or [f"{base.extended:.3g} → {other.extended:.3g}"]
    return f"{base.flight}: {', '.join(words)}"


def main() -> None:
    """Command line of the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--house", action="store_true", help="print files, lines, named numbers and layers, and end")
    parser.add_argument("--records", type=Path, default=Path("ablation.jsonl"), help="a stopped run goes on from them")
    parser.add_argument("--cache", type=Path, help="folder that keeps flights once flown")
    parser.add_argument("--kinds", default="campaign,cases,recorded")
    parser.add_argument("--classes", default="", help="name:count of campaign classes, by commas")
    parser.add_argument("--flights", default="", help="flights whose name is one of these, by commas")
    parser.add_argument("--only", default="", help="variants whose name holds one of these words, by commas")
    parser.add_argument("--out", type=Path, help="folder of the page")
    parser.add_argument("--start", type=int, default=START, help="number of the first case of each class")
    options = parser.parse_args()
    if options.house:
        print(measured())
        return
    given = [part.split(":") for part in options.classes.split(",") if part]
    classes = {name: int(count) for name, count in given} or CLASSES
    todo = flights(options.kinds.split(","), classes, options.start)
    named = [n for n in options.flights.split(",") if n]
    todo = [f for f in todo if not named or f.name in named]
    words = [w for w in options.only.split(",") if w]
    chosen = [v for v in variants() if v.name == "base" or not words or any(w in v.name for w in words)]
    rows: list[str] = []
    base: list[Answer] = []
    for variant in chosen:
        with variant.in_force():
            answers = run(todo, variant.name, options.cache, options.records, told)
        base = base or answers
        rows.append(row(variant, base, answers))
        print(rows[-1], flush=True)
    if options.out is not None:
        (options.out / "ablation.md").write_text(page(rows, base, options), encoding="utf-8")


def page(rows: Sequence[str], base: Sequence[Answer], options: argparse.Namespace) -> str:
    """The result page."""
    command = f"python -m studies.ablation --records FILE --kinds {options.kinds}"
    for name in ("classes", "flights", "only"):
        command += f" --{name} '{getattr(options, name)}'" if getattr(options, name) else ""
    return (
        f"""# Diagnosis: without each rule, with half and twice each number

{len(base)} flights, `{command}`, {datetime.date.today().isoformat()}. Class and number of a campaign case are its seed;
recorded flights have the seed 0. "Right" counts campaign and independent cases, as the campaign does; +n −n are cases
that become right or wrong. An answer differs when verdict or names do, or the error on unseen data by more than 1 %.
Time is that of all flights over that of the method as it is.

| changed | right | | answers that differ | time | which (− no longer, + newly listed) |
|---|---|---|---|---|---|
"""
        + "\n".join(rows)
        + "\n"
    )


if __name__ == "__main__":
    main()
