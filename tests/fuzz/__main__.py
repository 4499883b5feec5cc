"""`make fuzz`: goes on with the campaign where its account says that it stopped.

The account is JSON: which inputs were tried when, with how many findings; a page beside it shows it.
"""

import argparse
import json
import subprocess
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from quadid_evaluation.harness import judged

from tests.fuzz.campaign import Outcome, input_of, run
from tests.fuzz.formats import FORMATS

BLOCK = 2000
"""Inputs between two entries in the account: what an interruption costs at most."""


GOAL = 1_000_000
"""Inputs of each format that are wanted."""
Run = dict[str, Any]
COUNTED = ("read", "refused", "stopped", "findings", "seconds")


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
    parser.add_argument("--goal", type=int, default=GOAL, help="inputs of each format in all")
    parser.add_argument("--minutes", type=float, default=60.0, help="stop after this time")
    parser.add_argument("--account", type=Path, default=Path("docs/results/fuzz.json"))
    parser.add_argument(
        "--findings", type=Path, default=Path("fuzz-out"), help="folder for inputs that break a promise"
    )
    given = parser.parse_args()
    end = time.monotonic() + 60.0 * given.minutes
    done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    revision = done.stdout.strip() or "unknown"
    path: Path = given.account
    account: dict[str, list[Run]] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    while time.monotonic() < end:
        begun = {kind: max((r["stop"] for r in account.get(kind, [])), default=0) for kind in given.format or FORMATS}
        kind = min(begun, key=begun.__getitem__)
        first, count = begun[kind], min(BLOCK, given.goal - begun[kind])
        if count <= 0:
            break
        outcome = run(kind, first, count)
        _keep(kind, outcome, given.findings)
        counts = (outcome.read, outcome.refused, outcome.stopped, len(outcome.findings), round(outcome.seconds, 1))
        entry = {
            "start": first,
            "stop": first + count,
            **dict(zip(COUNTED, counts, strict=True)),
            "date": f"{datetime.now(UTC):%Y-%m-%d}",
            "revision": revision,
        }
        runs = account.setdefault(kind, [])
        last = runs[-1] if runs else {}
        if all(
            last.get(key) == entry[of] for key, of in (("stop", "start"), ("date", "date"), ("revision", "revision"))
        ):
            runs[-1] = {**last, "stop": entry["stop"], **{key: last.get(key, 0) + entry[key] for key in COUNTED}}
        else:
            runs.append(entry)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(account, indent=1) + "\n", encoding="utf-8")
        shown = path.with_suffix(".md")
        shown.write_text(page(account) + judged(shown), encoding="utf-8")
    print(page(account))


def page(account: Mapping[str, Sequence[Run]]) -> str:
    """Markdown: counts by format, then every run."""
    lines = [
        "# Fuzzing of the binary readers",
        "",
        "`make fuzz`: small logs are mutated with knowledge of their format and read within 0.5 s of processor time "
        "and 1 GiB. Anything but a recording of finite values and rising times, one line of a documented error, or an "
        "end by limits, as the process that reads logs has them, is a finding; findings become tests "
        f"(`tests/fuzz/test_campaign.py`). Runs and notes: `fuzz.json`. Goal: {GOAL:,} inputs per format.",
        "",
        "| format | inputs | read | refused | stopped | findings | inputs/s |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind in FORMATS:
        runs = account.get(kind, [])
        ends = ("read", "refused", "stopped", "findings")
        read, refused, stopped, findings = (sum(int(run.get(k, 0)) for run in runs) for k in ends)
        tried, seconds = sum(run["stop"] - run["start"] for run in runs), sum(run["seconds"] for run in runs)
        rate = f"{tried / seconds:.0f}" if seconds else ""
        lines.append(f"| {kind} | {tried:,} | {read:,} | {refused:,} | {stopped} | {findings} | {rate} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
