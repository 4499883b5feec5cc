"""Whole commands and services: identification, diagnosis, refits, logs, reports, start-up, scaling."""

import os
import pickle
import tempfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from quadid_replay import open_log

from quadid.data.window import Window
from quadid.diagnosis import diagnose
from quadid.flight import draw_truth, fly
from quadid.identification.fit import Fit, FitOptions, fit
from quadid.identification.particle_swarm import SwarmOptions
from quadid.identification.result import mse_score
from quadid.model.layout import Layout
from quadid.online.fusion import Estimator
from quadid.online.grid_buffer import WindowCut
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from quadid_evaluation.benchmarks.timing import child, command, interleaved

SEED = 2026


@lru_cache(maxsize=8)
def flight(seconds: float) -> Window:
    """Window of a flight of this length at 50 Hz."""
    vehicle = Vehicle.shipped("pelican")
    return fly(vehicle, draw_truth(vehicle, SEED), seconds, SEED).window


def logged(folder: Path, seconds: float, suffix: str) -> Path:
    """Log of a flight of this length, written by `quadid simulate`."""
    path = folder / f"flight{seconds:g}{suffix}"
    if not path.exists():
        command("simulate", str(path), "--vehicle", "pelican", "--seconds", f"{seconds:g}", "--seed", "3")
    return path


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
from functools import lru_cache
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
    """A 500 s set: 64 particles, 100 iterations, polish, noise and intervals; warm.  And of the standard search.

    Errors over one second on that set and on two that were not fitted, beside those of the true parameters.
    """
    vehicle, window = Vehicle.shipped("pelican"), flight(500.0)
    kept: dict[str, Fit] = {}

    def run(name: str, options: FitOptions) -> None:
        kept[name] = fit([window], vehicle, options)

    cases = {"64 x 100, polish, intervals": FULL, "standard search": FitOptions(seed=1)}
    times = interleaved({n: lambda n=n, o=o: run(n, o) for n, o in cases.items()}, rounds)  # type: ignore[misc]
    found, truth = kept["64 x 100, polish, intervals"], draw_truth(vehicle, SEED)
    exact = Layout(vehicle).initial(vehicle)
    exact[: len(NOMINAL_NAMES)] = list(truth.as_dict().values())
    sets = [window, *(fly(vehicle, truth, 500.0, SEED + k).window for k in (1, 2))]
    errors = [[mse_score([w], vehicle, x, found.noise).mse for x in (found.theta, exact)] for w in sets]
    return {"times": times, "evaluations": {n: f.evaluations for n, f in kept.items()}, "errors": errors}


def refits(rounds: int) -> dict[str, Any]:
    """A window of 10 s: from nothing (swarm, noise), and refitted from the last estimate."""
    vehicle, window = Vehicle.shipped("pelican"), flight(60.0).slice(500, 1000)
    estimator = Estimator(vehicle, 120.0, 10.0, 1)
    cold = estimator.request(1, WindowCut((window,), 10.0, 0), 10.0, 20.0)
    first = cold.answer()
    if first.theta is None:
        raise AssertionError(first.problem)
    estimator.take(cold, first)
    later = estimator.request(2, WindowCut((flight(60.0).slice(550, 1050),), 10.0, 0), 11.0, 21.0)
    cases = {"cold": cold.run, "warm, one second later": later.run}
    return {"times": interleaved(cases, rounds)}


def _mcap(path: Path) -> int:
    """Messages as bytes, by mcap's reader: nothing in them is decoded."""
    from mcap.reader import make_reader

    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file).iter_messages(log_time_order=False))


def _mcap_decoded(path: Path) -> int:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return sum(1 for _ in reader.iter_decoded_messages(log_time_order=False))


def _pymavlink(path: Path) -> int:
    """Messages of a telemetry log or of DataFlash, decoded; telemetry through its index."""
    from pymavlink import mavutil

    log, count = mavutil.mavlink_connection(str(path), dialect="ardupilotmega"), 0
    while log.recv_msg() is not None:
        count += 1
    return count


def _pyulog(path: Path) -> int:
    from pyulog import ULog

    return len(ULog(str(path)).data_list)


LIBRARIES: dict[str, dict[str, Callable[[Path], int]]] = {
    ".mcap": {"mcap, bytes only": _mcap, "mcap and mcap-ros2-support": _mcap_decoded},
    ".tlog": {"pymavlink": _pymavlink},
    ".bin": {"pymavlink": _pymavlink},
    ".ulg": {"pyulog": _pyulog},
}
"""By suffix and name."""


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
            {
                "import of the fit": lambda: child("import quadid.identification.fit\nprint('{}')"),
                "second start to first fit": lambda: child(
                    FIRST_FIT, str(path), environment={"NUMBA_CACHE_DIR": cache}
                ),
            },
            rounds,
        )
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


def memory(folder: Path) -> dict[str, Any]:
    """Peak memory of `quadid identify` of a 500 s log."""
    code = (
        "import contextlib, io, runpy, sys\nfrom pathlib import Path\n"
        "sys.argv = ['quadid', 'identify', sys.argv[1], '--vehicle', 'pelican', '--out', sys.argv[2]]\n"
        "with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):\n"
        "    runpy.run_path(str(Path(sys.executable).with_name('quadid')), run_name='__main__')\nprint('{}')"
    )
    return child(code, str(logged(folder, 500.0, ".mcap")), str(folder))
