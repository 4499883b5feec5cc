"""Whole commands and services: identification, diagnosis, refits, logs, reports, start-up, scaling."""

import pickle
import tempfile
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from quadid_replay import open_log

from quadid.data.window import Window
from quadid.diagnosis import diagnose
from quadid.flight import draw_truth, fly
from quadid.identification.fit import FitOptions, fit
from quadid.identification.particle_swarm import SwarmOptions
from quadid.identification.result import mse_score
from quadid.model.layout import Layout
from quadid.online.fusion import Estimator
from quadid.online.grid_buffer import WindowCut
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from quadid_evaluation.benchmarks.timing import child, command, interleaved
from quadid_evaluation.harness import DATA

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
from functools import lru_cache, partial
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
    cases = {"64 x 100, polish, intervals": FULL, "standard search": FitOptions(seed=1)}
    times = interleaved({n: partial(fit, [window], vehicle, options) for n, options in cases.items()}, rounds)
    found, standard = (fit([window], vehicle, options) for options in cases.values())
    truth, exact = draw_truth(vehicle, SEED), Layout(vehicle).initial(vehicle)
    exact[: len(NOMINAL_NAMES)] = list(truth.as_dict().values())
    sets = [window, *(fly(vehicle, truth, 500.0, SEED + k).window for k in (1, 2))]
    errors = [[mse_score([w], vehicle, x, found.noise).mse for x in (found.theta, exact)] for w in sets]
    evaluations = dict(zip(cases, (found.evaluations, standard.evaluations), strict=True))
    return {"times": times, "evaluations": evaluations, "errors": errors}


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


def _mcap(path: Path, decoded: bool) -> int:
    """Messages by mcap's reader: as bytes, in which nothing is decoded, or decoded."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()] if decoded else [])
        read = reader.iter_decoded_messages if decoded else reader.iter_messages
        return sum(1 for _ in read(log_time_order=False))


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
    ".mcap": {
        "mcap, bytes only": partial(_mcap, decoded=False),
        "mcap and mcap-ros2-support": partial(_mcap, decoded=True),
    },
    ".tlog": {"pymavlink": _pymavlink},
    ".bin": {"pymavlink": _pymavlink},
    ".ulg": {"pyulog": _pyulog},
}
"""By suffix and name."""


def logs(rounds: int, folder: Path) -> dict[str, Any]:
    """Reading of logs by format, beside the libraries of others on the same file."""
    paths = [logged(folder, 500.0, suffix) for suffix in (".mcap", ".tlog", ".csv")]
    for pattern in ("ardupilot/**/*.bin", "px4/**/*.ulg"):
        paths += sorted(DATA.glob(pattern), key=lambda p: p.stat().st_size)[-1:]
    cases: dict[str, Callable[[], object]] = {}
    for path in paths:
        for name, read in ({"quadid": open_log} | LIBRARIES.get(path.suffix, {})).items():
            cases[f"{path.suffix}, {name}"] = partial(read, path)
    times = interleaved(cases, rounds)
    sizes = {path.suffix: path.stat().st_size / 1e6 for path in paths}
    for name, t in times.items():
        size = sizes[name.split(",")[0]]
        t |= {"megabytes": size, "ms_per_mb": 1e3 * t["processor"] / size}
    return {"times": times}


def commands(rounds: int, folder: Path) -> dict[str, Any]:
    """Commands as a user calls them, each in a process of its own."""
    short, longer, whole = (logged(folder, seconds, ".mcap") for seconds in (60.0, 120.0, 500.0))
    cases = {
        "quadid identify, 60 s MCAP": ("identify", short),
        "quadid identify, 500 s MCAP": ("identify", whole),
        "... with --report": ("identify", whole, "--report", folder / "report.html"),
        "quadid diagnose, 120 s MCAP": ("diagnose", longer),
    }
    model = ("--vehicle", "pelican", "--out", folder)
    times = interleaved({n: partial(command, *map(str, (*a, *model))) for n, a in cases.items()}, rounds)
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
    named = {n: [f.effect for f in diagnose([w], vehicle)[0].findings] for n, w in flights.items()}
    return {
        "times": interleaved({n: partial(diagnose, [w], vehicle) for n, w in flights.items()}, rounds),
        "found": named,
    }


def sayings(rounds: int) -> dict[str, Any]:
    """Commands that only say something."""
    words = ("--help", "--version", "identify --help")
    return {"times": interleaved({f"quadid {w}": partial(command, *w.split()) for w in words}, rounds)}


def starts(rounds: int, folder: Path) -> dict[str, Any]:
    """First start (kernels are compiled) and later ones (read from disk) up to the end of a first fit of 10 s.

    And `quadid identify` of 60 s where nothing is compiled, which compiles in processes side by side.
    """
    path, flown = folder / "window.pkl", str(logged(folder, 60.0, ".mcap"))
    path.write_bytes(pickle.dumps(flight(60.0).slice(500, 1000)))

    def identified() -> None:
        with tempfile.TemporaryDirectory() as cache:
            words = ("identify", flown, "--vehicle", "pelican", "--out", str(folder))
            command(*words, environment={"NUMBA_CACHE_DIR": cache})

    with tempfile.TemporaryDirectory() as cache:
        started = partial(child, FIRST_FIT, str(path), environment={"NUMBA_CACHE_DIR": cache})
        first = started()
        imported = partial(child, "import quadid.identification.fit\nprint('{}')")
        times = interleaved({"import of the fit": imported, "second start to first fit": started}, rounds)
    return {"first": first, "times": times | interleaved({"first quadid identify, 60 s MCAP": identified}, 1)}


def scaling(folder: Path, longest: int) -> dict[str, Any]:
    """Time and memory of a fit against length of the log, each in a process of its own."""
    path = folder / "base.pkl"
    path.write_bytes(pickle.dumps(flight(360.0)))
    child(FIRST_FIT, str(path))  # kernels are on disk afterwards
    rows = [child(LONG_FIT, str(path), str(n)) for n in (1, 3, 10, 30, 100) if n <= longest]
    length = np.log([r["rows"] for r in rows])
    exponents = {n: float(np.polyfit(length, np.log([r[n] for r in rows]), 1)[0]) for n in ("fit_processor", "peak_mb")}
    return {"hours": [r["rows"] / 50.0 / 3600.0 for r in rows], "runs": rows, "exponents": exponents}


def memory(folder: Path) -> dict[str, Any]:
    """Peak memory of `quadid identify` of a 500 s log."""
    code = (
        "import contextlib, io, runpy, sys\nfrom pathlib import Path\n"
        "sys.argv = ['quadid', 'identify', sys.argv[1], '--vehicle', 'pelican', '--out', sys.argv[2]]\n"
        "with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):\n"
        "    runpy.run_path(str(Path(sys.executable).with_name('quadid')), run_name='__main__')\nprint('{}')"
    )
    return child(code, str(logged(folder, 500.0, ".mcap")), str(folder))
