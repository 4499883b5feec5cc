"""Whole commands and services: identification, diagnosis, refits, logs, reports, start-up, scaling."""

from __future__ import annotations

import json
import os
import pickle
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from quadid_replay import open_log

from quadid.diagnosis import diagnose
from quadid.flight import draw_truth, fly
from quadid.identification.fit import Fit, FitOptions, fit
from quadid.identification.noise_fit import flexible_names
from quadid.identification.particle_swarm import SwarmOptions
from quadid.identification.problem import Shooting
from quadid.identification.search import SWARM_SECONDS, Projected
from quadid.model.layout import Layout
from quadid.online.fit_job import FitRequest
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from quadid_evaluation.benchmarks.speed.flights import SEED, flight, logged
from quadid_evaluation.benchmarks.speed.log_libraries import LIBRARIES
from quadid_evaluation.benchmarks.speed.timing import child, command, interleaved

FULL = FitOptions(64, 100, SwarmOptions(tolerance=0.0, patience=None), seed=1)
"""Every one of 64 x 100 evaluations, polish, noise, intervals."""

FIRST_FIT = """
import pickle, sys, json
from quadid.identification.fit import FitOptions, fit
from quadid.vehicle import Vehicle
found = fit([pickle.load(open(sys.argv[1], "rb"))], Vehicle.shipped("pelican"), FitOptions(seed=1))
print(json.dumps({"evaluations": found.evaluations}))
"""
LONG_FIT = """
import pickle, sys, json, time, numpy as np
from dataclasses import replace
from quadid.identification.fit import FitOptions, fit
from quadid.vehicle import Vehicle
window = pickle.load(open(sys.argv[1], "rb"))
times = int(sys.argv[2])
def piece(i):
    channels = {n: v.copy() for n, v in vars(window).items() if isinstance(v, np.ndarray)}
    return replace(window, t0=400.0 * i, log_span=(400.0 * i, 400.0 * i + 360.0), **channels)
windows = [piece(i) for i in range(times)]
begin, spent = time.perf_counter(), time.process_time()
found = fit(windows, Vehicle.shipped("pelican"), FitOptions(seed=1))
print(json.dumps({"fit": time.perf_counter() - begin, "fit_processor": time.process_time() - spent,
                  "rows": sum(map(len, windows))}))
"""


def identification(rounds: int) -> dict[str, Any]:
    """A 500 s set: 64 particles, 100 iterations, polish, noise and intervals; warm.  And of the standard search."""
    vehicle, window = Vehicle.shipped("pelican"), flight(500.0)
    kept: dict[str, Fit] = {}

    def run(name: str, options: FitOptions) -> None:
        kept[name] = fit([window], vehicle, options)

    cases = {"64 x 100, polish, intervals": FULL, "standard search": FitOptions(seed=1)}
    times = interleaved({n: lambda n=n, o=o: run(n, o) for n, o in cases.items()}, rounds)  # type: ignore[misc]
    return {"times": times, "evaluations": {n: f.evaluations for n, f in kept.items()}}


def refits(rounds: int) -> dict[str, Any]:
    """A window of 10 s: from nothing (swarm, noise), and refitted from the last estimate."""
    vehicle, window = Vehicle.shipped("pelican"), flight(60.0).slice(500, 1000)
    start = Layout(vehicle).initial(vehicle)
    cold = FitRequest(1, vehicle, (window,), 10.0, 20.0, start, None, True, 1)
    first = cold.answer()
    if first.theta is None:
        raise AssertionError(first.problem)
    warm = replace(cold, theta=first.theta, noise=first.noise, search=False)
    later = replace(warm, windows=(flight(60.0).slice(550, 1050),))
    cases = {"cold": cold.run, "warm, one second later": later.run}
    return {"times": interleaved(cases, rounds)}


def logs(rounds: int, folder: Path) -> dict[str, Any]:
    """Reading of logs by format, beside the libraries of others on the same file."""

    paths = [logged(folder, 500.0, suffix) for suffix in (".mcap", ".tlog", ".csv")]
    recorded = Path(os.environ.get("QUADID_DATA", ""))
    for pattern in ("ardupilot/**/*.bin", "px4/**/*.ulg"):
        paths += sorted(recorded.glob(pattern), key=lambda p: p.stat().st_size)[-1:]
    cases: dict[str, Any] = {}
    for path in paths:
        cases[f"{path.suffix}, quadid"] = lambda p=path: open_log(p)
        for name, read in LIBRARIES.get(path.suffix, {}).items():
            cases[f"{path.suffix}, {name}"] = lambda p=path, read=read: read(p)
    times = interleaved(cases, rounds)
    sizes = {path.suffix: path.stat().st_size / 1e6 for path in paths}
    for name, t in times.items():
        size = sizes[name.split(",")[0]]
        t |= {"megabytes": size, "ms_per_mb": 1e3 * t["processor"] / size}
    return {"times": times}


def commands(rounds: int, folder: Path) -> dict[str, Any]:
    """Commands as a user calls them, each in a process of its own."""
    flown, short = logged(folder, 500.0, ".mcap"), logged(folder, 120.0, ".mcap")
    out = str(folder)
    model = ("--vehicle", "pelican", "--out", out)
    cases = {
        "quadid identify, 60 s MCAP": ("identify", str(logged(folder, 60.0, ".mcap")), *model),
        "quadid identify, 500 s MCAP": ("identify", str(flown), *model),
        "... with --report": ("identify", str(flown), *model, "--report", str(folder / "report.html")),
        "quadid diagnose, 120 s MCAP": ("diagnose", str(short), *model),
    }
    times = interleaved({n: lambda a=a: command(*a) for n, a in cases.items()}, rounds)  # type: ignore[misc]
    return {"times": times, "megabytes": {n: Path(a[1]).stat().st_size / 1e6 for n, a in cases.items()}}


HIDDEN: dict[str, dict[str, dict[str, float]]] = {
    "nothing hidden": {},
    "motor lag": {"motor_lag": {"tau": 0.03}},
    "rotor drag and motor lag": {"rotor_drag": {"k_x": 0.3, "k_y": 0.3}, "motor_lag": {"tau": 0.03}},
}


def diagnoses(rounds: int) -> dict[str, Any]:
    """Diagnosis of 120 s over the whole catalogue in a process whose kernels are warm."""
    vehicle = Vehicle.shipped("pelican")
    flights = {n: fly(vehicle, draw_truth(vehicle, SEED), 120.0, SEED, effects=e).window for n, e in HIDDEN.items()}
    found = {n: diagnose([w], vehicle)[0] for n, w in flights.items()}
    cases: dict[str, Any] = {n: lambda w=w: diagnose([w], vehicle) for n, w in flights.items()}
    named = {n: [f.effect for f in d.findings] for n, d in found.items()}
    return {"times": interleaved(cases, rounds), "found": named}


def sayings(rounds: int) -> dict[str, Any]:
    """Commands that only say something."""
    cases = {
        "quadid --help": ("--help",),
        "quadid --version": ("--version",),
        "quadid identify --help": ("identify", "--help"),
    }
    return {"times": interleaved({n: lambda a=a: command(*a) for n, a in cases.items()}, rounds)}  # type: ignore[misc]


def starts(rounds: int, folder: Path) -> dict[str, Any]:
    """First start (kernels are compiled) and later ones (read from disk) up to the end of a first fit of 10 s.

    And `quadid identify` of 60 s where nothing is compiled, which compiles in processes side by side.
    """

    flown = str(logged(folder, 60.0, ".mcap"))

    def identified() -> None:
        with tempfile.TemporaryDirectory() as cache:
            command(
                "identify", flown, "--vehicle", "pelican", "--out", str(folder), environment={"NUMBA_CACHE_DIR": cache}
            )

    path = folder / "window.pkl"
    path.write_bytes(pickle.dumps(flight(60.0).slice(500, 1000)))
    with tempfile.TemporaryDirectory() as cache:
        first = child(FIRST_FIT, str(path), environment={"NUMBA_CACHE_DIR": cache})
        times = interleaved(
            {"import of the fit": lambda: child("import quadid.identification.fit\nprint('{}')"),
             "second start to first fit": lambda: child(FIRST_FIT, str(path), environment={"NUMBA_CACHE_DIR": cache})},
            rounds,
        )  # fmt: skip
    return {"first": first, "times": times | interleaved({"first quadid identify, 60 s MCAP": identified}, 1)}


def scaling(folder: Path, longest: int) -> dict[str, Any]:
    """Time and memory of a fit against length of the log, each in a process of its own."""

    path = folder / "base.pkl"
    path.write_bytes(pickle.dumps(flight(360.0)))
    child(FIRST_FIT, str(path))  # kernels are on disk afterwards
    rows = [child(LONG_FIT, str(path), str(n)) for n in (1, 3, 10, 30, 100) if n <= longest]
    hours = [r["rows"] / 50.0 / 3600.0 for r in rows]
    return {"hours": hours, "runs": rows, "exponents": _exponents(rows)}


def _exponents(rows: list[dict[str, Any]]) -> dict[str, float]:
    length = np.log([r["rows"] for r in rows])
    return {
        name: float(np.polyfit(length, np.log([r[name] for r in rows]), 1)[0]) for name in ("fit_processor", "peak_mb")
    }


def particles_and_parameters(rounds: int) -> dict[str, Any]:
    """The swarm's cost against particles, the linearisation against free parameters and against windows."""

    vehicle, window = Vehicle.shipped("pelican"), flight(120.0)
    shooting = Shooting.cut([window], vehicle, SWARM_SECONDS)
    theta, free = shooting.layout.initial(vehicle), shooting.free(NOMINAL_NAMES)
    cost = Projected(shooting, theta, free, shooting.count).costs
    names = list(dict.fromkeys([*NOMINAL_NAMES, *flexible_names(shooting.layout, shooting)]))
    pieces = {n: [window.slice(i * len(window) // n, (i + 1) * len(window) // n) for i in range(n)] for n in (1, 4, 16)}
    split = {n: Shooting.cut(parts, vehicle, SWARM_SECONDS) for n, parts in pieces.items()}
    cases: dict[str, Any] = {}
    for m in (16, 64, 256, 1024):
        cases[f"cost, {m} particles"] = lambda m=m: cost(np.repeat(theta[None], m, axis=0))
    for p in (2, 6, 20, len(names)):
        cases[f"linearisation, {p} parameters"] = lambda p=p: shooting.linearise(theta, shooting.free(names[:p]))
    for n, problem in split.items():
        cases[f"linearisation, {n} windows"] = lambda s=problem: s.linearise(theta, s.free(NOMINAL_NAMES))
    return {"seconds": 120.0, "times": interleaved(cases, rounds)}


def memory(folder: Path) -> dict[str, Any]:
    """Peak memory of `quadid identify` of a 500 s log."""
    code = (
        "import contextlib, io, runpy, sys\nfrom pathlib import Path\n"
        "sys.argv = ['quadid', 'identify', sys.argv[1], '--vehicle', 'pelican', '--out', sys.argv[2]]\n"
        "with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):\n"
        "    runpy.run_path(str(Path(sys.executable).with_name('quadid')), run_name='__main__')\nprint('{}')"
    )
    return child(code, str(logged(folder, 500.0, ".mcap")), str(folder))


def written(value: object) -> str:
    """JSON text."""
    return json.dumps(value, indent=1) + "\n"
