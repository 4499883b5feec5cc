"""Causes by innovations beside today's diagnosis, on cases of the campaign in still and in rough air, or recorded.

python -m quadid_evaluation.studies.innovations --cases single:25,pair:10,look_alike:6,outside:24 [--rough]
python -m quadid_evaluation.studies.innovations --recorded "iris,crazyflie rpm" [--data DIR]

Recorded vehicles are those of `studies.flight_sets`; where they have one flight only, its first half is diagnosed.
Removed: share of the squared missing force and moment, on flights that were not diagnosed, that all causes take away.
"""

import argparse
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import quadid
from quadid.data.window import Window, without_copies
from quadid.diagnosis import diagnose
from quadid.estimate.missing import Vehicles, removed
from quadid.model.layout import with_reference_voltage
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import DATA, table
from quadid_evaluation.studies.campaign import GUSTS, Case, cases, flown
from quadid_evaluation.studies.flight_sets import SETS, FlightSet
from quadid_evaluation.studies.innovations import diagnosed


def listed(names: Collection[str]) -> str:
    """Names in a row, or that there is none."""
    return ", ".join(names) or "nothing"


def row(case: Case) -> list[str]:
    """One case: what is hidden, both answers, and what ours took."""
    train, _, vehicle = flown(case)
    begin = time.process_time()
    found = diagnosed([train], vehicle)
    seconds = time.process_time() - begin
    today, _ = diagnose([train], vehicle, seed=case.seed)
    named = tuple(f.effect for f in today.findings if f.confident)
    cells = [
        f"{'' if set(names) == set(case.expected) else '**wrong** '}{verdict}: {listed(names)}"
        for verdict, names in ((found.verdict, found.named), (today.verdict, named))
    ]
    hidden = listed(case.expected or case.outside)
    return [f"{case.group} {case.number}", hidden, cells[0], listed(found.doubted), cells[1], f"{seconds:.0f}"]


def flights(one: FlightSet, data: Path, vehicle: Vehicle) -> tuple[list[Window], list[Window]]:
    """Flights to diagnose and unseen ones; of a single flight, its halves."""
    train, unseen = (
        [w for log in part for w in quadid.load(str(data / log), vehicle).windows] for part in (one.train, one.unseen)
    )
    if not unseen:
        longest = max(train, key=len)
        middle = len(longest) // 2
        train, unseen = [longest.slice(0, middle)], [longest.slice(middle, len(longest))]
    return list(without_copies(train)), list(without_copies(unseen))


def recorded(name: str, data: Path) -> list[list[str]]:
    """One recorded vehicle, a row each for ours and today's."""
    one = SETS[name]
    vehicle = Vehicle.named(data / one.vehicle)
    train, unseen = flights(one, data, vehicle)
    vehicle = with_reference_voltage(vehicle, train)
    begin = time.process_time()
    found = diagnosed(train, vehicle)
    middle = time.process_time()
    today, search = diagnose(train, vehicle)
    end = time.process_time()
    judge = Vehicles(train, vehicle, search.nominal.theta)
    before = judge.missing(unseen, search.nominal.theta)
    answers: Mapping[str, tuple[str, Sequence[str], Collection[str], FloatArray, float]] = {
        "innovations": (found.verdict, found.named, found.doubted, found.search.model.theta, middle - begin),
        "today": (
            today.verdict,
            [f.effect for f in today.findings if f.confident],
            [f.effect for f in today.findings if not f.confident],
            search.model.theta,
            end - middle,
        ),
    }
    out = []
    for answer, (verdict, named, doubted, theta, seconds) in answers.items():
        known = [(n, theta[NOMINAL_NAMES.index(n)], *one.truth[n]) for n in one.truth]
        values = listed([f"{n} {value:.3g} ({low:.3g} to {high:.3g})" for n, value, low, high in known])
        less = f"{removed(before, judge.missing(unseen, theta)):.0%}"
        out.append([name, answer, verdict, listed(named), listed(doubted), values, less, f"{seconds:.0f}"])
    return out


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description="Causes by innovations beside today's diagnosis.")
    parser.add_argument("--cases", default="single:25,null:4", help="classes of the campaign and how many of each")
    parser.add_argument("--start", type=int, default=0, help="number of the first case of every class")
    parser.add_argument("--seconds", type=float, default=120.0, help="length of a flight")
    parser.add_argument("--rough", action="store_true", help="fly them in gusts")
    parser.add_argument("--recorded", help=f"these vehicles instead of cases: {', '.join(SETS)}")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the recorded flights")
    given = parser.parse_args(arguments)
    if given.recorded:
        heads = ("data", "by", "verdict", "confident", "listed", "values (truth)", "removed", "processor seconds")
        print("\n".join(table(heads, ())))
        for name in given.recorded.split(","):
            print("\n".join(table(heads, recorded(name, given.data))[2:]), flush=True)
        return
    heads = ("case", "hidden", "by innovations", "without confidence", "today", "processor seconds")
    print("\n".join(table(heads, ())))
    for group, count in (part.split(":") for part in given.cases.split(",")):
        for case in cases(group, int(count), given.start):
            flight = replace(case, seconds=given.seconds)
            print(table(heads, [row(replace(flight, outside=GUSTS) if given.rough else flight)])[2], flush=True)


if __name__ == "__main__":
    main()
