"""When is a particle swarm worth it?  Every optimiser on smooth and non-smooth problems, narrow and wide bounds.

    python -m quadid_evaluation.studies.optimisers --seeds 30 --out docs/results

Each seed is a new individual Pelican, a new flight of 10 s (non-smooth: 5 s), and a start drawn in the box; all
optimisers of a seed get the same.  Smooth: the paper's six parameters.  Non-smooth: the vehicle's commands come late
and its rotors saturate; the simulation can be late by whole samples only, as simulations with a fixed step are, and
clips at a speed to be found: two more parameters, of which one has no gradient and the other has one only where the
rotors saturate.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from quadid_evaluation.studies.optimisers.problem import (
    BOUNDS,
    BUDGET,
    DELAY,
    KNEE,
    METHODS,
    OFF_CENTRE,
    SECONDS,
    SEGMENT,
    SUCCESS,
    Outcome,
    run,
)  # fmt: skip

GAIN = 0.1
"""Share of runs that makes a swarm worth its evaluations."""


def table(results: dict[tuple[str, str], list[dict[str, Outcome]]]) -> list[str]:
    """Markdown: a row a method, a column a problem."""
    heads = [f"{kind}, {bounds} bounds" for kind, bounds in results]
    rows = ["| method | " + " | ".join(heads) + " |", "|---" * (len(heads) + 1) + "|"]
    for name in METHODS:
        cells = []
        for outcomes in results.values():
            reached, evaluations = successes(outcomes, name)
            middle, worst = (f([o[name].ratio for o in outcomes]) for f in (np.median, np.max))
            cells.append(f"{reached}, {f'{evaluations:.0f}' if reached else '–'}, {middle:.4g}, {worst:.4g}")
        rows.append(f"| {name} | " + " | ".join(cells) + " |")
    return rows


def kept_or_run(keep: Path | None, kind: str, bounds: str, seed: int, budget: int) -> dict[str, Outcome]:
    """The outcome of one seed, from the file of an interrupted run if it is there."""
    key = f"{kind} {bounds} {seed} {budget}"
    known = json.loads(keep.read_text(encoding="utf-8")) if keep is not None and keep.exists() else {}
    if key not in known:
        known[key] = {name: list(vars(o).values()) for name, o in run(kind, bounds, seed, budget).items()}
        if keep is not None:
            keep.write_text(json.dumps(known), encoding="utf-8")
    return {name: Outcome(*values) for name, values in known[key].items()}


def finished(keep: Path, kind: str, bounds: str) -> int:
    """Number of seeds of one problem that an interrupted run has finished."""
    return sum(key.startswith(f"{kind} {bounds} ") for key in json.loads(keep.read_text(encoding="utf-8")))


def main() -> None:
    """Command line of the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--keep", type=Path, default=None, help="file that an interrupted run goes on from")
    parser.add_argument("--finished", action="store_true", help="run nothing, show what is in the file")
    parser.add_argument("--out", type=Path, default=None)
    options = parser.parse_args()
    results: dict[tuple[str, str], list[dict[str, Outcome]]] = {}
    for kind in ("smooth", "non-smooth"):
        for bounds in BOUNDS:
            seeds = range(options.seeds)
            if options.finished:
                seeds = range(finished(options.keep, kind, bounds))
            results[kind, bounds] = [kept_or_run(options.keep, kind, bounds, seed, BUDGET[kind]) for seed in seeds]
            print(*table(results), sep="\n", flush=True)
    if options.out is not None:
        text = page(results, options.seeds)
        (options.out / "optimisers.md").write_text(text, encoding="utf-8")


def successes(outcomes: list[dict[str, Outcome]], name: str) -> tuple[int, float]:
    """Number of successes, and the median of evaluations to them (infinite without any)."""
    reached = [o[name].reached for o in outcomes if o[name].reached is not None]
    return len(reached), float(np.median([n for n in reached if n is not None])) if reached else np.inf


def best(outcomes: list[dict[str, Outcome]]) -> list[str]:
    """Methods by successes, then by evaluations."""
    return sorted(METHODS, key=lambda name: (-successes(outcomes, name)[0], successes(outcomes, name)[1]))


def answer(results: dict[tuple[str, str], list[dict[str, Outcome]]]) -> list[str]:
    """What the tables say about the swarm."""
    worth, alone = [], []
    for (kind, bounds), outcomes in results.items():
        first = best(outcomes)[0]
        gain = successes(outcomes, "pso_polish")[0] - successes(outcomes, "least_squares")[0]
        if gain >= GAIN * len(outcomes):
            worth.append(f"{kind}, {bounds} bounds (+{gain} successes)")
        if first in ("pso", "pso_algorithm_1") and successes(outcomes, first)[0]:
            alone.append(f"{kind}, {bounds} bounds")
    return [
        f"A swarm before least squares gains at least {GAIN:.0%} of the runs on: "
        + (f"{'; '.join(worth)}." if worth else "none of these problems."), "",
        f"A swarm without polish is best on: {'; '.join(alone) if alone else 'none of them'}.",
    ]  # fmt: skip


def page(results: dict[tuple[str, str], list[dict[str, Outcome]]], seeds: int) -> str:
    """The result as Markdown."""
    lines = [
        "# When is a particle swarm worth it?", "",
        f"`python -m quadid_evaluation.studies.optimisers --seeds {seeds} --out docs/results`", "",
        "Each seed is a new Pelican, flight and random start, the same for all methods. Success: cost within "
        f"{SUCCESS - 1.0:.0%} of the lowest of any method, or of least squares from the truth.", "",
        f"* Smooth: the six parameters, flights of {SECONDS['smooth']:g} s, segments of {SEGMENT:g} s, "
        f"{BUDGET['smooth']} evaluations.",
        f"* Non-smooth: flights of {SECONDS['non-smooth']:g} s with a command delay of {1e3 * DELAY:g} ms and rotors "
        f"that saturate at {KNEE:g} hover speeds. Delay (whole samples, no gradient) and saturation speed are fitted "
        f"too; {BUDGET['non-smooth']} evaluations.",
        "* Bounds: " + ", ".join(f"{name} a factor of {factor:g} each way" for name, factor in BOUNDS.items())
        + f", off centre by up to a factor of {np.exp(OFF_CENTRE):.2f}.", "",
        *answer(results), "",
    ]  # fmt: skip
    lines += [
        "Successes, median evaluations to success, median and largest cost over the optimum:", "", *table(results),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
