"""`make fuzz`: goes on with the campaign where the account says that it stopped."""

from __future__ import annotations

import argparse
import subprocess
import time
from datetime import UTC, datetime
from pathlib import Path

from tests.fuzz import book
from tests.fuzz.campaign import Outcome, input_of, run
from tests.fuzz.formats import FORMATS

BLOCK = 2000
"""Inputs between two entries in the account: what an interruption costs at most."""


def _revision() -> str:
    done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    return done.stdout.strip() or "unknown"


def _keep(kind: str, outcome: Outcome, folder: Path) -> None:
    for finding in outcome.findings:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{kind}-{finding.number}").write_bytes(input_of(kind, finding.number))
        (folder / f"{kind}-{finding.number}.txt").write_text(f"{finding.what}\n{finding.trace}")
        print(f"{kind} {finding.number}: {finding.what}", flush=True)


def main() -> None:
    """Takes the format that is furthest behind, block by block, until the goal or the time is reached."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--format", choices=FORMATS, action="append", help="only this one (may be repeated)")
    parser.add_argument("--goal", type=int, default=book.GOAL, help="inputs of each format in all")
    parser.add_argument("--minutes", type=float, default=60.0, help="stop after this time")
    parser.add_argument("--account", type=Path, default=Path("docs/results/fuzz.json"))
    parser.add_argument(
        "--findings", type=Path, default=Path("fuzz-out"), help="folder for inputs that break a promise"
    )
    given = parser.parse_args()
    end = time.monotonic() + 60.0 * given.minutes
    revision = _revision()
    while time.monotonic() < end:
        account = book.load(given.account)
        kinds = given.format or list(FORMATS)
        kind = min(kinds, key=lambda k: book.next_input(account.get(k, [])))
        first = book.next_input(account.get(kind, []))
        count = min(BLOCK, given.goal - first)
        if count <= 0:
            break
        outcome = run(kind, first, count)
        _keep(kind, outcome, given.findings)
        entry = {
            "start": first, "stop": first + count, "read": outcome.read, "refused": outcome.refused,
            "stopped": outcome.stopped, "findings": len(outcome.findings), "seconds": round(outcome.seconds, 1),
            "date": f"{datetime.now(UTC):%Y-%m-%d}", "revision": revision,
        }  # fmt: skip
        book.note(account.setdefault(kind, []), entry)
        book.save(given.account, account)
    print(book.page(book.load(given.account)))


if __name__ == "__main__":
    main()
