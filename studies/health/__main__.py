"""Health of recorded and simulated vehicles, into a result page.

python -m studies.health --out docs/results
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from studies.health import features, limits, recorded, simulated
from studies.page import put_section

TITLE = "Health: what changed in this vehicle"


def main() -> None:
    """Measures, prints and writes the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/results"))
    parser.add_argument("--each", type=int, default=12, help="simulated cases of every kind")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("QUADID_DATA", "../shared/data")))
    chosen = parser.parse_args()
    page = chosen.out / "health.md"
    judged = recorded.judge(recorded.read(chosen.data / "crazypad"))
    recorded.curve(judged, chosen.out / "health-score.png")
    parts = {
        "recorded": (
            f"## Recorded flights\n`make health`; {len(judged)} flights of two Crazyflies, each against the healthy "
            "flights of its airframe (5 of E9, 7 of E8, both kinds of log), itself left out.\n\n"
            f"{recorded.table(judged)}\n\n### Answers\n{recorded.confusion(judged)}\n\n"
            f"### Large damages that were not found\n{recorded.missed(judged)}\n\n"
            "### Score against size\n![Score against millimetres cut](health-score.png)"
        ),
        "limits": f"## What the spread of healthy flights allows\n{limits.text(judged)}",
        "features": f"## What else the logs hold\n{features.text([j.flown for j in judged])}",
        "simulated": (
            f"## Simulated flights\n`make health`, seed {simulated.SEED}; Pelican (plus and X frame) of "
            f"{simulated.SECONDS:.0f} s, {simulated.BASELINES} baseline flights each; in closed loop (`quadid.flight`) "
            "hovering, gentle and lively in turn, and by the balance of a hover (`studies/health/flights.py`). From "
            "flight to flight every rotor's thrust differs by 1 %, the battery sits 0.7 mm elsewhere, the load differs "
            f"by 1 % (1 sigma).\n\n{simulated.table(chosen.each)}"
        ),
    }  # fmt: skip
    for name, text in parts.items():
        put_section(page, TITLE, name, text)
    print(page.read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
