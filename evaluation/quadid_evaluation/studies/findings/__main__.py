"""`make findings`: every input on which the product failed once: what it answers now, and whether that is right."""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

from quadid_evaluation.studies.findings.rows import FINDINGS, Finding
from quadid_evaluation.studies.findings.run import answer_of


def main() -> int:
    """Prints the table; the number of wrong rows is the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("QUADID_DATA", "../shared/data")))
    parser.add_argument("names", nargs="*", help="parts of folder names; all without")
    given = parser.parse_args()
    wrong = 0
    print("| input | meant | first line | numbers | |\n|---|---|---|---|---|")
    for finding in FINDINGS:
        if given.names and not any(name in finding.folder for name in given.names):
            continue
        right, line, numbers = judged(finding, given.data)
        wrong += not right
        shown = f"| {finding.folder} | {finding.what} | {line[:90]} | {numbers[:60]} |"
        print(f"{shown} {'right' if right else '**wrong**'} |", flush=True)
    return wrong


def judged(finding: Finding, data: Path) -> tuple[bool, str, str]:
    """Judgement of an answer, its first line that names what is wrong, and the numbers shown."""
    with tempfile.TemporaryDirectory() as folder:
        answer = answer_of(finding.call(data.absolute() / "findings" / finding.folder, Path(folder)))
    checks = answer[2].get("checks", ())
    first = next((c["message"] for c in checks if c["verdict"] == "error"), "")
    line = first or (answer[1].strip().splitlines() or [""])[0]
    try:
        return bool(finding.right(answer)), line.replace("|", "/"), finding.numbers(answer).replace("|", "/")
    except (KeyError, TypeError):  # the answer lacks what is looked for
        return False, line.replace("|", "/"), ""


if __name__ == "__main__":
    sys.exit(main())
