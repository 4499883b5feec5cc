"""Soak: a day of flight at accelerated time and an hour in real time; writes `soak.json` and `soak.md`.

python -m quadid_evaluation.studies.soak --out docs/results
python -m quadid_evaluation.studies.soak --only live --seconds 3600 --out docs/results
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

from quadid_evaluation.benchmarks.online.__main__ import machine
from quadid_evaluation.studies.judged import judged
from quadid_evaluation.studies.soak import accelerated, live
from quadid_evaluation.studies.soak.page import page


def main() -> None:
    """Runs what was asked for."""
    parser = argparse.ArgumentParser(prog="python -m quadid_evaluation.studies.soak", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/results"), help="folder of soak.md")
    parser.add_argument("--only", choices=("accelerated", "live"), help="one part, the other as it is on the page")
    parser.add_argument("--hours", type=float, default=24.0, help="flight time of the accelerated part [h]")
    parser.add_argument("--refit", type=float, default=10.0, help="time between its fits [s]")
    parser.add_argument("--diagnose", type=float, default=1800.0, help="time between its diagnoses [s]")
    parser.add_argument("--kept", type=int, default=2000, help="candidates and events that its history keeps")
    parser.add_argument("--limit", type=float, default=1e9, help="its longest wall time [s]")
    parser.add_argument("--seconds", type=float, default=3600.0, help="length of the part in real time [s]")
    given = parser.parse_args()

    def tell(line: str) -> None:
        print(line, flush=True)

    def run(name: str) -> object:
        if name == "live":
            return live.hour(given.seconds, tell)
        return accelerated.day(given.hours, given.refit, given.diagnose, tell, given.limit, given.kept)

    for name in [given.only] if given.only else ["accelerated", "live"]:
        load = os.getloadavg()[0]
        result = {
            "result": run(name),
            "measured": time.strftime("%Y-%m-%d"),
            "machine": f"{machine()}, {load:.1f} at the begin",
        }
        given.out.mkdir(parents=True, exist_ok=True)
        file = given.out / "soak.json"  # read again each time: the parts may run side by side
        results = json.loads(file.read_text()) if file.exists() else {}
        results[name] = result
        file.write_text(json.dumps(results, indent=1) + "\n")
        where = given.out / "soak.md"
        where.write_text(page(results) + judged(where))


if __name__ == "__main__":
    main()
