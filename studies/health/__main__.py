"""Health of recorded and simulated vehicles, into a result page.

python -m studies.health --out docs/results [--parts recorded limits features simulated]
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from studies.health import features, limits, recorded, simulated
from studies.page import put_section

PARTS = ("recorded", "limits", "features", "simulated")
TITLE = "Health: what changed in this vehicle"


def main() -> None:
    """Measures, prints and writes the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/results"))
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--each", type=int, default=6, help="simulated cases of every kind")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("QUADID_DATA", "../shared/data")))
    chosen = parser.parse_args()
    page = chosen.out / "health.md"
    judged = recorded.judge(recorded.read(chosen.data / "crazypad")) if set(chosen.parts) - {"simulated"} else []
    makers: dict[str, Callable[[], str]] = {
        "recorded": lambda: _recorded(judged, chosen.out / "health-score.png"),
        "limits": lambda: f"## What the spread of healthy flights allows\n{limits.text(judged)}",
        "features": lambda: f"## What else the logs hold, and why it is not used\n{features.text(judged)}",
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


def _simulated(each: int) -> str:
    return (
        f"## Simulated flights\n`make health`, seed {simulated.SEED}; Pelican (plus and X frame) of "
        f"{simulated.SECONDS:.0f} s, {simulated.BASELINES} baseline flights each, in closed loop (`quadid.flight`) and "
        "by the balance of a hover. Between flights, rotor thrust varies by 1 %, the battery by 0.7 mm, the load by "
        f"1 % (1 sigma).\n\n{simulated.table(each)}\n\nA rotor that lost only thrust and a weight at its hub have "
        "the same trims; the likelier weight is named."
    )


if __name__ == "__main__":
    main()
