"""Findings of `mutmut run`, as `mutation.md`: every mutant that no test noticed, with a person's judgement of it.

python -m quadid_evaluation.studies.mutation --out docs/results        (after `mutmut run`, from the root of the
checkout: make mutation)

Judgements stand in `judged.yaml` beside this file, by function and changed line, so that they outlive the next run.
"""

import json
import re
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import yaml
from mutmut.mutation.diff_apply import get_diff_for_mutant
from mutmut.stats import status_by_exit_code

from quadid_evaluation.harness import judged as by_hand
from quadid_evaluation.harness import options, table

MUTATED = ("gate", "session")
"""Modules of quadid/online that are spoilt (`[tool.mutmut]` in pyproject.toml)."""
UNNOTICED = ("survived", "no tests")


class Survivor(NamedTuple):
    """A mutant that no test noticed: function, line before and after, and what a person says of it."""

    function: str
    before: str
    after: str
    judgement: str


def main() -> None:
    """Writes the page."""
    judged = yaml.safe_load(Path(__file__).with_name("judged.yaml").read_text(encoding="utf-8")) or {}
    counts, left = {}, {}
    for module in MUTATED:
        verdicts = outcome(module)
        counts[module] = Counter(verdicts.values())
        left[module] = [survivor(module, name, judged) for name, verdict in verdicts.items() if verdict in UNNOTICED]
    where = options(__doc__).out / "mutation.md"
    where.write_text(page(counts, left) + by_hand(where), encoding="utf-8")
    open_ = sum(not s.judgement for found in left.values() for s in found)
    print(f"{sum(len(found) for found in left.values())} unnoticed, {open_} of them not judged yet")


def outcome(module: str) -> dict[str, str]:
    """Verdict of every mutant of a module of quadid/online; none where it was not spoilt."""
    file = Path(f"mutants/quadid/online/{module}.py.meta")
    if not file.exists():
        return {}
    told = json.loads(file.read_text(encoding="utf-8"))
    return {name: status_by_exit_code[code] for name, code in told["exit_code_by_key"].items()}


def survivor(module: str, name: str, judged: Mapping[str, Mapping[str, str]]) -> Survivor:
    """The change of a mutant, and a person's judgement of it."""
    difference = get_diff_for_mutant(name, path=f"quadid/online/{module}.py").splitlines()[2:]
    before, after = (" ".join(line[1:].strip() for line in difference if line.startswith(sign)) for sign in ("-", "+"))
    function = name.rpartition(".")[2].rpartition("__mutmut_")[0].removeprefix("x").replace("ǁ", ".").strip("_.")
    return Survivor(function, before, after, judged.get(function, {}).get(after, ""))


def page(counts: Mapping[str, Counter[str]], left: Mapping[str, Sequence[Survivor]]) -> str:
    """Markdown: counts, then survivors by module."""
    rows: list[tuple[object, ...]] = []
    for module, c in counts.items():
        unnoticed, waiting = sum(c[v] for v in UNNOTICED), c["not checked"]
        noticed = c.total() - unnoticed - waiting
        share = f"{100.0 * noticed / max(noticed + unnoticed, 1):.1f} %"
        told = (
            (c.total(), noticed, c["timeout"], unnoticed, waiting, share) if c else (*["–"] * 4, "**not run yet**", "–")
        )
        rows.append((f"`online/{module}.py`", *told))
    heads = ("module", "mutants", "detected", "by time limit", "undetected", "not run", "detected of those run")
    counted = Counter(_kind(s) for found in left.values() for s in found)
    lines = [
        "# Mutation tests of gate, active set and session",
        "",
        f"`make mutation`, {time.strftime('%Y-%m-%d')}, mutmut {version('mutmut')}. A mutant is detected if a test of "
        "`[tool.mutmut]` fails or exceeds its time limit. Undetected ones are judged in "
        "`evaluation/quadid_evaluation/studies/mutation/judged.yaml`.",
        "",
        *table(heads, rows),
        "",
        "Undetected: " + "; ".join(f"{count} {what}" for what, count in counted.most_common()) + ".",
    ]
    return "\n".join(lines) + "\n"


def _kind(s: Survivor) -> str:
    """Judgement up to its first comma or colon; the whole change where nobody judged it."""
    if s.judgement:
        return re.split("[:,;]", s.judgement)[0]
    return f"**not judged**: in `{s.function}` {_code(s.before)} became {_code(s.after)}"


def _code(text: str) -> str:
    return f"`{text}`".replace("|", "\\|") if text else "nothing"


if __name__ == "__main__":
    main()
