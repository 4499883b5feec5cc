"""Lines and branches of quadid/ that the tests run, as `coverage.md`; less than the goal is an error.

python -m quadid_evaluation.studies.coverage --out docs/results        (after `coverage run` and `coverage combine`:
make coverage)
"""

import ast
import json
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import coverage

from quadid_evaluation.harness import judged, options, table

GOAL = 90.0
"""Share of statements and branches of quadid/ that the tests have to run [%]."""
COMPILED = ("nb.njit", "kernel", "_kernel")
"""Decorators of what numba compiles."""
Counts = Counter[str]


def main() -> None:
    """Writes the page of what was counted."""
    files = counted()
    where = options(__doc__).out / "coverage.md"
    where.write_text(page(files, compiled(Path("quadid"))) + judged(where), encoding="utf-8")
    share = percent(sum((Counter(f) for f in files.values()), Counter()))
    print(f"{share:.1f} % of statements and branches of quadid/; goal {GOAL:.0f} %: {where}")
    sys.exit(share < GOAL)


def counted() -> dict[str, Counts]:
    """Statements and branches, there and run, by file of quadid/."""
    data = coverage.Coverage()
    data.load()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "coverage.json"
        data.json_report(include=["quadid/*"], outfile=str(file))
        found: Mapping[str, Any] = json.loads(file.read_text(encoding="utf-8"))["files"]
    names = {
        "statements": "num_statements",
        "run": "covered_lines",
        "branches": "num_branches",
        "taken": "covered_branches",
    }
    return {f: Counter({n: found[f]["summary"][key] for n, key in names.items()}) for f in sorted(found)}


def percent(c: Counts) -> float:
    """Statements and branches that were run, of all [%]; 100 where there are none."""
    all_of_them = c["statements"] + c["branches"]
    return 100.0 * (c["run"] + c["taken"]) / all_of_them if all_of_them else 100.0


def compiled(folder: Path) -> int:
    """Statements inside functions that numba compiles, which nothing can count."""
    return sum(
        sum(isinstance(n, ast.stmt) for n in ast.walk(function)) - 1
        for file in folder.rglob("*.py")
        for function in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(function, ast.FunctionDef)
        and any(ast.unparse(d).split("(")[0] in COMPILED for d in function.decorator_list)
    )


def page(files: Mapping[str, Counts], machine_code: int) -> str:
    """Markdown: the total, rooms, and the files of which least is run."""
    rooms: dict[str, Counts] = defaultdict(Counter)
    for name, c in files.items():
        parts = name.split("/")
        rooms["/".join(parts[:2]) if len(parts) > 2 else "quadid/*.py"].update(c)
    rows = [
        (f"`{name}`", f"{c['run']}/{c['statements']}", f"{c['taken']}/{c['branches']}", f"**{percent(c):.1f} %**")
        for name, c in sorted(rooms.items())
    ]
    every = sum(files.values(), Counter())
    least = sorted(files, key=lambda n: percent(files[n]))[:5]
    lines = [
        "# Test coverage of `quadid/`",
        "",
        f"`make coverage`, {time.strftime('%Y-%m-%d')}, coverage {coverage.__version__}, tests of core, readers and "
        "command line with their processes.",
        "",
        f"**{percent(every):.1f} % of statements and branches** (goal {GOAL:.0f} %): {every['run']:,} of "
        f"{every['statements']:,} statements, {every['taken']:,} of {every['branches']:,} branches, without "
        f"{machine_code:,} statements in compiled functions.",
        "",
        *table(("package", "statements", "branches", "both"), rows),
        "",
        "Least covered: " + ", ".join(f"`{n}` {percent(files[n]):.0f} %" for n in least) + ".",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
