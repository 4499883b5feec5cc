"""The paper's own size: three 500 s sets, the first fitted by 64 particles in 100 iterations; error, time and memory.

    python -m quadid_evaluation.studies.paper_scale --out docs/results

The flown vehicle has no hidden effect, so the fit has to reach the noise floor on all three sets.  Times are those of
one process after a first fit has loaded (or, at the very first start, compiled) the kernels.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from quadid.data.window import Window
from quadid.flight import draw_truth, fly
from quadid.identification.fit import Fit, FitOptions, fit
from quadid.identification.particle_swarm import SwarmOptions
from quadid.identification.score import mse_score
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from quadid_evaluation.studies.page import put_section
from quadid_evaluation.studies.truth import poor_guess

SECONDS, SETS, TRUTH_SEED = 500.0, 3, 2026
PARTICLES, ITERATIONS = 64, 100
OPTIONS = FitOptions(PARTICLES, ITERATIONS, SwarmOptions(tolerance=0.0, patience=None), seed=1)


@dataclass(frozen=True)
class Timed:
    """One fit: wall and processor seconds, and the processor seconds of each stage."""

    fit: Fit
    wall: float
    processor: float
    stages: dict[str, float]


def timed_fit(window: Window, vehicle: Vehicle) -> Timed:
    """Fits one set and takes the time of each stage."""
    marks: list[tuple[str, float]] = []
    wall, processor = time.perf_counter(), time.process_time()
    found = fit([window], vehicle, OPTIONS, progress=lambda stage, share: marks.append((stage, time.process_time())))
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    end = time.process_time()
    polish = next(t for stage, t in marks if stage == "polish")
    swarm = next(t for stage, t in marks if stage == "swarm")
    return Timed(
        found,
        wall,
        processor,
        {"swarm": polish - swarm, "polish, noise, intervals": end - polish},
    )


def accuracy(sets: list[Window], craft: Vehicle, found: Fit, truth: dict[str, float]) -> list[str]:
    """Tables of errors on all sets and of parameters beside the truth."""
    layout = Layout(craft)
    exact = layout.initial(craft)
    exact[: len(NOMINAL_NAMES)] = [truth[n] for n in NOMINAL_NAMES]
    start = layout.initial(found.vehicle)
    text = ["| set | role | initial guess | fitted | true parameters | fitted / true |", "|---" * 6 + "|"]
    for k, window in enumerate(sets):
        guess, fitted, floor = (mse_score([window], craft, x, found.noise).mse for x in (start, found.theta, exact))
        role = "train" if k == 0 else "validate"
        text.append(f"| {k + 1} | {role} | {guess:.1f} | {fitted:.4f} | {floor:.4f} | {fitted / floor:.4f} |")
    text += ["", "| parameter | truth | fitted | 95 % interval | status |", "|---" * 5 + "|"]
    for p in found.parameters:
        low, high = p.ci95
        text.append(f"| {p.name} | {truth[p.name]:.5g} | {p.value:.5g} | {low:.5g} … {high:.5g} | {p.status.value} |")
    return text


def speed(first: Timed, runs: list[Timed], before: float) -> list[str]:
    """Table of times and memory."""
    best = min(runs, key=lambda r: r.wall)
    load = os.getloadavg()[0]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    text = ["| what | seconds |", "|---|---|", f"| first fit of the process | {first.wall:.2f} |"]
    text.append(f"| warm, best of {len(runs)} | {best.wall:.2f} |")
    text.append(f"| warm, median of {len(runs)} | {np.median([r.wall for r in runs]):.2f} |")
    least = min(runs, key=lambda r: r.processor)
    text.append(f"| processor time, both cores together, least of {len(runs)} | {least.processor:.2f} |")
    text += [f"| … of it {stage} | {seconds:.2f} |" for stage, seconds in least.stages.items()]
    text += [
        "",
        f"{best.fit.evaluations} parameter vectors over the data; peak memory of the process {peak:.0f} MB "
        f"({before:.0f} MB before the first fit, flights included); {os.cpu_count()} cores, load {load:.1f} from this "
        "and other programs while it was measured.",
    ]
    return text


def main() -> None:
    """Command line of the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=7, help="warm fits to time")
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--out", default="")
    options = parser.parse_args()
    craft = Vehicle.shipped("pelican")
    truth = draw_truth(craft, TRUTH_SEED)
    sets = [fly(craft, truth, options.seconds, TRUTH_SEED + k).window for k in range(SETS)]
    vehicle = poor_guess(craft, truth.as_dict(), TRUTH_SEED)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    first = timed_fit(sets[0], vehicle)
    runs = [timed_fit(sets[0], vehicle) for _ in range(options.runs)]
    text = [
        "`python -m quadid_evaluation.studies.paper_scale --out docs/results`",
        "",
        __doc__.split("\n\n")[2].replace("  ", " "),
        "",
    ]
    text += ["## Error in noise variances over one second", "", *accuracy(sets, craft, first.fit, truth.as_dict()), ""]
    text += [f"## Time of the {options.seconds:g} s fit", "", *speed(first, runs, before)]
    print("\n".join(text))
    if options.out:
        put_section(Path(options.out) / "paper_scale.md", "Paper scale", "measured", "\n".join(text))


if __name__ == "__main__":
    main()
