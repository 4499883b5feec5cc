"""Command line of the campaign."""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from quadid_evaluation.studies.campaign import GROUPS, Case, Graded, cases, pages, right, run
from quadid_evaluation.studies.campaign.grading import line


def run_many(todo: Sequence[Case], processes: int, records: Path | None) -> list[Graded]:
    """Runs cases, in worker processes if more than one is asked for, in order; every answer is printed and kept."""
    out = []
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        for graded in pool.imap(run, todo, chunksize=1):
            print("   ", line(graded), flush=True)
            out.append(graded)
            if records is not None:
                with records.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(asdict(graded), default=float) + "\n")
    return out


def kept(records: Path) -> list[Graded]:
    """Answers of an earlier run of the same code, the latest to each case."""
    out = {}
    for text in records.read_text(encoding="utf-8").splitlines():
        data = json.loads(text)
        case = Case(**{**data.pop("case")})
        data["intervals"] = {e: {n: tuple(v) for n, v in p.items()} for e, p in data["intervals"].items()}
        case = Case(**{**asdict(case), "expected": tuple(case.expected)})
        graded = Graded(case, **{**data, "named": tuple(data["named"]), "listed": tuple(data["listed"])})
        out[case.group, case.number] = graded
    return list(out.values())


def main() -> None:
    """Runs the classes asked for and writes the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--groups", default=",".join(GROUPS), help="classes, by commas; name:count for fewer cases")
    parser.add_argument("--count", type=int, default=0, help="cases a class (default: the full campaign)")
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--records", default="", help="file of answers: goes on where it stopped")
    parser.add_argument("--out", default="", help="folder of the page")
    options = parser.parse_args()
    records = Path(options.records) if options.records else None
    done = kept(records) if records is not None and records.exists() else []
    everything = list(done)
    for group in options.groups.split(","):
        name, _, count = group.partition(":")
        wanted = cases(name, int(count or options.count or GROUPS[name]), options.start)
        have = {(g.case.group, g.case.number) for g in everything}
        graded = run_many([c for c in wanted if (c.group, c.number) not in have], options.processes, records)
        everything += graded
        mine = [g for g in everything if g.case.group == name]
        print(f"{name}: {sum(right(g) for g in mine)} of {len(mine)} right", flush=True)
    if options.out:
        print(pages.write(everything, Path(options.out)))


if __name__ == "__main__":
    main()
