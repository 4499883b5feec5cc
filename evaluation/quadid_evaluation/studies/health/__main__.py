"""Health of recorded and simulated vehicles, into a result page.

python -m quadid_evaluation.studies.health --out docs/results [--parts recorded command few limits kinds features fleet
simulated]
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

from quadid_evaluation.studies.health import command, features, few, fleet, kinds, limits, recorded, simulated
from quadid_evaluation.studies.page import put_section

PARTS = ("recorded", "command", "few", "limits", "kinds", "features", "fleet", "simulated")
TITLE = "Health: what changed in this vehicle"


def main() -> None:
    """Measures, prints and writes the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/results"))
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--each", type=int, default=6, help="simulated cases of every kind")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("QUADID_DATA", "../shared/data")))
    parser.add_argument("--report", type=Path, help="where to keep the fleet's page")
    chosen = parser.parse_args()
    page = chosen.out / "health.md"
    flights = cache(lambda: recorded.read(chosen.data / "crazypad"))
    judged = cache(lambda: recorded.judge(flights()))
    makers: dict[str, Callable[[], str]] = {
        "recorded": lambda: _recorded(judged(), chosen.out / "health-score.png"),
        "command": lambda: _command(flights(), chosen.data / "crazypad"),
        "few": lambda: _few(flights()),
        "limits": lambda: f"## What the spread of healthy flights allows\n{limits.text(judged())}",
        "kinds": lambda: f"## Propeller or weight\n{kinds.text(judged())}",
        "features": lambda: f"## What else the logs hold, and why it is not used\n{features.text(judged())}",
        "fleet": lambda: _fleet(flights(), chosen.data / "crazypad", chosen.report),
        "simulated": lambda: _simulated(chosen.each),
    }
    for part in chosen.parts:
        text = makers[part]()
        print(text)
        put_section(page, TITLE, part, text)


def _recorded(judged: Sequence[recorded.Judged], picture: Path) -> str:
    recorded.curve(judged, picture)
    print(recorded.confusion(judged))
    healthy = [j.flown.airframe for j in judged if j.flown.condition == "healthy"]
    each = " and ".join(f"{healthy.count(name)} of {name}" for name in sorted(set(healthy)))
    return (
        f"## Recorded flights\n`make health`; {len(judged)} flights of two Crazyflies, each against the other healthy "
        f"flights of its airframe ({each}). Brackets: exact binomial 95 % intervals.\n\n"
        f"{recorded.table(judged)}\n\n"
        f"![Score against millimetres cut]({picture.name})"
    )


def _command(flights: Sequence[recorded.Flown], folder: Path) -> str:
    return (
        f"## The command, three baseline flights\n`quadid health` with the shipped vehicle and {command.BASELINES} "
        "healthy flights of the airframe, drawn once; all other flights are in question. The comparison's priors were "
        "chosen with both airframes at hand: neither row is of an airframe that nobody had seen.\n\n"
        + command.text(flights, folder)
    )


def _few(flights: Sequence[recorded.Flown]) -> str:
    return (
        "## Few baseline flights\nVehicle and number of baseline flights, ten choices of them: which share of other "
        "healthy flights, and of damage from 3 mm on, is changed, unknown, unchanged. Unknown was unchanged before.\n\n"
        + few.text(flights)
    )


def _fleet(flights: Sequence[recorded.Flown], data: Path, report: Path | None) -> str:
    return (
        "## Trend of a fleet\n`quadid fleet`, called by `make health`: the first five flights are the baseline, the "
        "others follow by millimetres cut; order: Spearman correlation of score and cut.\n\n"
        + fleet.text(flights, data, report)
    )


def _simulated(each: int) -> str:
    return (
        f"## Simulated flights\n`make health`, seed {simulated.SEED}; Pelican (plus and X frame) of "
        f"{simulated.SECONDS:.0f} s, {simulated.BASELINES} baseline flights each, in closed loop (`quadid.flight`) and "
        "by the balance of a hover. Between flights, rotor thrust varies by 1 %, the battery by 0.7 mm, the load by "
        f"1 % (1 sigma).\n\n{simulated.table(each)}\n\nA rotor that lost only thrust and a weight at its hub have "
        "the same trims; the likelier weight is named. Drag torque alone moves the yaw trim alone, as much for every "
        "rotor: the change is found, the rotor is a guess (one right in four)."
    )


if __name__ == "__main__":
    main()
