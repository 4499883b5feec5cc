"""Health of recorded and simulated vehicles, into a result page.

python -m quadid_evaluation.studies.health --out docs/results [--parts recorded command fleet simulated]
"""

from quadid_evaluation.harness import study
from quadid_evaluation.studies.health import recorded, simulated

TITLE = "Health: what changed in this vehicle"

if __name__ == "__main__":
    study(
        __doc__,
        "health.md",
        TITLE,
        {
            "recorded": lambda g: recorded.recorded(g.data / "crazypad", g.out and g.out / "health-score.png"),
            "command": lambda g: recorded.command(g.data / "crazypad"),
            "fleet": lambda g: recorded.fleet(g.data / "crazypad"),
            "simulated": lambda g: simulated.text(g.each),
        },
        each=6,
    )
