"""Runs the diagnosis with each rule left out and each number halved and doubled, and says what changes.

QUADID_DATA=../shared/data python -m quadid_evaluation.studies.ablation --out docs/results
python -m quadid_evaluation.studies.ablation --house
"""

from __future__ import annotations

import argparse
import datetime
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from quadid_evaluation.studies.ablation.answers import Answer, read, run
from quadid_evaluation.studies.ablation.corpus import FLIGHTS, SCALED, flights
from quadid_evaluation.studies.ablation.house import measured
from quadid_evaluation.studies.ablation.variants import Variant, variants

REMOVED = Path(__file__).with_name("removed.md")
"""What went because of such runs, in words."""
IDLE = re.compile(r"\* [^:]+: ")
"""A row in which nothing changes."""
NAMES = re.compile(r"\*\*[−+]|: [−+]\w|: first |confident →")
"""What a row has in which a name or a verdict changes."""


def told(answer: Answer) -> None:
    """Prints one answer."""
    mark = {True: "right", False: "WRONG", None: "-"}[answer.right]
    print(f"{mark:5s} {answer.variant}: {answer.flight}: {answer.verdict} {list(answer.listed)}", flush=True)


def row(subject: str, chosen: Sequence[Variant], answers: Mapping[str, Sequence[Answer]]) -> str:
    """One line of the page: what changes under each change of one rule or number."""
    base = answers["base"]
    cells = {}
    for variant in (v for v in chosen if v.subject == subject):
        how = variant.name.removeprefix(subject).strip().removeprefix("without " + subject) or "out"
        cells[how] = _cell(base, answers[variant.name])
    scaled = [f"{how}: {cells[how]}" for how in ("× 0.5", "× 2") if cells.get(how)]
    return f"* {subject}: {'; '.join([cells['out'], *scaled] if cells.get('out') else scaled)}"


def _cell(base: Sequence[Answer], answers: Sequence[Answer]) -> str:
    known = {b.flight: b for b in base}
    base = [known[a.flight] for a in answers]
    pairs = [(b, a) for b, a in zip(base, answers, strict=True) if b.difference(a)]
    better = sum(a.right is True and b.right is False for b, a in pairs)
    worse = sum(a.right is False and b.right is True for b, a in pairs)
    fits = sum(a.fits for a in answers) / max(sum(b.fits for b in base), 1)
    signed = " ".join(f"{sign}{n}" for sign, n in (("+", better), ("−", worse)) if n)
    told = [f"**{signed}**"] if signed else []
    for b, a in sorted(pairs, key=_weight)[:1]:
        told.append(f"{b.flight}{f' (of {len(pairs)})' if len(pairs) > 1 else ''}: {b.difference(a)}")
    told += [f"fits ×{fits:.2f}"] if abs(fits - 1.0) > 0.03 else []
    return "; ".join(told)


def _weight(pair: tuple[Answer, Answer]) -> tuple[bool, bool]:
    base, other = pair
    return base.right == other.right, (base.verdict, set(base.listed)) == (other.verdict, set(other.listed))


def main() -> None:
    """Command line of the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--house", action="store_true", help="print files, lines, named numbers and layers, and end")
    parser.add_argument("--records", type=Path, default=Path("ablation.jsonl"), help="a stopped run goes on from them")
    parser.add_argument("--cache", type=Path, help="folder that keeps flights once flown")
    parser.add_argument("--flights", default=",".join(FLIGHTS), help="by commas: single 7000,cases case_012,iris …")
    parser.add_argument("--only", default="", help="variants whose name holds one of these words, by commas")
    parser.add_argument("--recorded", action="store_true", help="run nothing, use what the records hold")
    parser.add_argument("--out", type=Path, help="folder of the page")
    options = parser.parse_args()
    if options.house:
        print(measured())
        return
    todo = flights(options.flights.split(","))
    words = [w for w in options.only.split(",") if w]
    chosen = [v for v in variants() if v.name == "base" or not words or any(w in v.name for w in words)]
    answers: dict[str, list[Answer]] = {v.name: [] for v in chosen}
    recorded = {(a.flight, a.variant) for a in read(options.records)}
    for flight in todo:
        here = [v for v in chosen if not v.scaled or flight.name in SCALED]
        known = [v for v in here if not options.recorded or (flight.name, v.name) in recorded]
        for answer in run(flight, known, options.cache, options.records, told):
            answers[answer.variant].append(answer)
    rows = [row(s, chosen, answers) for s in dict.fromkeys(v.subject for v in chosen) if s != "base"]
    print("\n".join(rows))
    if options.out is not None:
        (options.out / "ablation.md").write_text(page(rows, answers["base"], options), encoding="utf-8")


def _sorted(rows: Sequence[str]) -> tuple[list[str], list[str], list[str]]:
    """Subjects of rows in which nothing changes, of rows without another name or verdict, and the other rows."""
    subject = {row: row.split(": ")[0].removeprefix("* ") for row in rows}
    moving = [row for row in rows if not IDLE.fullmatch(row)]
    telling = [row for row in moving if NAMES.search(row)]
    slight = [subject[row] for row in moving if row not in telling]
    return [subject[row] for row in rows if row not in moving], slight, telling


def page(rows: Sequence[str], base: Sequence[Answer], options: argparse.Namespace) -> str:
    """The result page: rows that change something, the others by name."""
    left_out = [name for name in FLIGHTS if name not in options.flights.split(",")]
    missing = f" without {', '.join(left_out)}" if left_out else ""
    missing += f" --only '{options.only}'" if options.only else ""
    sizes = str(measured()).splitlines()[:3]
    right = [a for a in base if a.right is not None]
    idle, slight, telling = _sorted(rows)
    scaled = len({a.flight for a in base} & set(SCALED))
    return (
        f"""# Diagnosis: ablation of rules and constants

{len(base)} flights, {datetime.date.today().isoformat()}, `make ablation`{missing}

Numbers of campaign cases are seeds. Unchanged, {sum(bool(a.right) for a in right)} of the {len(right)} with known
answer are right; of recorded flights: no identified number excludes what is known.
Size: {"; ".join(line.split(":")[0] for line in sizes)}.

{REMOVED.read_text(encoding="utf-8").strip()}

## Without each rule and constant
No change of: {", ".join(idle)}.

Only errors, intervals or effort change: {", ".join(slight)}.

+n −n: cases that become right or wrong; one difference is quoted: causes (− gone, + new), verdict, error (> 1 %). Fits:
linearisations (> 3 %). Halves and doubles: {scaled} flights.

"""
        + "\n".join(telling)
        + "\n"
    )


if __name__ == "__main__":
    main()
