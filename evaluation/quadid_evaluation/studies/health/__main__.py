"""Health of recorded and simulated vehicles, into a result page.

python -m quadid_evaluation.studies.health --out docs/results [--parts recorded command fleet simulated]
"""

from functools import cache
from pathlib import Path

from quadid_evaluation.harness import study
from quadid_evaluation.studies.health import recorded, simulated

TITLE = "Health: what changed in this vehicle"


@cache
def flights(data: Path) -> list[recorded.Flown]:
    """All recorded flights, read once."""
    return recorded.read(data / "crazypad")


if __name__ == "__main__":
    study(
        __doc__,
        "health.md",
        TITLE,
        {
            "recorded": lambda g: recorded.recorded(
                recorded.judge(flights(g.data)), g.out and g.out / "health-score.png"
            ),
            "command": lambda g: recorded.command(flights(g.data), g.data / "crazypad"),
            "fleet": lambda g: recorded.fleet(flights(g.data), g.data / "crazypad"),
            "simulated": lambda g: simulated.text(g.each),
        },
        each=6,
    )
