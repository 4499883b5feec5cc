"""Causes by innovations beside today's diagnosis, on cases of the campaign in still and in rough air.

python -m quadid_evaluation.studies.innovations --cases single:25,pair:10,look_alike:6,outside:24 [--rough]
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace

from quadid.diagnosis import diagnose
from quadid_evaluation.studies.campaign import GUSTS, Case, cases, flown
from quadid_evaluation.studies.innovations import diagnosed


def row(case: Case) -> str:
    """One case: what is hidden, both answers, and what ours took."""
    train, _, vehicle = flown(case)
    begin = time.process_time()
    found = diagnosed([train], vehicle)
    seconds = time.process_time() - begin
    today, _ = diagnose([train], vehicle, seed=case.seed)
    named = tuple(f.effect for f in today.findings if f.confident)
    hidden = ", ".join(case.expected or case.outside) or "nothing"
    cells = [
        f"{'' if set(names) == set(case.expected) else '**wrong** '}{verdict}: {', '.join(names) or 'nothing'}"
        for verdict, names in ((found.verdict, found.named), (today.verdict, named))
    ]
    listed = ", ".join(found.doubted) or "nothing"
    return f"| {case.group} {case.number} | {hidden} | {cells[0]} | {listed} | {cells[1]} | {seconds:.0f} |"


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description="Causes by innovations beside today's diagnosis.")
    parser.add_argument("--cases", default="single:25,null:4", help="classes of the campaign and how many of each")
    parser.add_argument("--start", type=int, default=0, help="number of the first case of every class")
    parser.add_argument("--seconds", type=float, default=120.0, help="length of a flight")
    parser.add_argument("--rough", action="store_true", help="fly them in gusts")
    given = parser.parse_args(arguments)
    print("| case | hidden | by innovations | without confidence | today | processor seconds |")
    print("|---|---|---|---|---|---|")
    for group, count in (part.split(":") for part in given.cases.split(",")):
        for case in cases(group, int(count), given.start):
            flight = replace(case, seconds=given.seconds)
            print(row(replace(flight, outside=GUSTS) if given.rough else flight), flush=True)


if __name__ == "__main__":
    main()
