"""Vehicles of others: `mujoco.sysid` and we on the same logs, beside the truth that came with them."""

import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import quadid
from quadid.app.logs import Log
from quadid.data.window import Window
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from quadid_evaluation.studies import rotorpy_flight
from quadid_evaluation.studies.ahead import shares_of_no_change
from quadid_evaluation.studies.flight_sets import SETS
from quadid_evaluation.studies.peers import mujoco_sysid
from quadid_evaluation.studies.truth import with_values

SECONDS = 60.0
"""Length of a flight of RotorPy."""
LAG = 0.045
"""Time constant of its motors [s]."""
CHUNKS = (1.0, 0.2)
"""Lengths of the pieces that `mujoco.sysid` simulates [s]; short ones where the model lacks much."""
HEADER = "t,w1,w2,w3,w4,p,q,r,qw,qx,qy,qz,ax,ay,az,vx,vy,vz"
AHEAD = 0.5
"""Horizon of the predictions [s]."""
ROTORPY, RECORDED = "RotorPy Hummingbird, air and lag", ("iris", "brushed rpm")


@dataclass(frozen=True)
class Flights:
    """Flights of one vehicle: fitted and unseen ones, and the interval in which each known parameter lies."""

    vehicle: Vehicle
    train: list[Log]
    unseen: list[Log]
    truth: Mapping[str, tuple[float, float]]


def rotorpy() -> Flights:
    """RotorPy's own Hummingbird, flown by RotorPy, through CSV files."""
    truth = rotorpy_flight.hummingbird(tau_m=LAG)
    flown = [rotorpy_flight.fly(truth, SECONDS, seed, reach=1.4) for seed in (1, 2)]
    vehicle = flown[0].vehicle
    with tempfile.TemporaryDirectory() as folder:
        first, second = (
            quadid.load(_written(f.window, Path(folder) / f"{k}.csv"), vehicle) for k, f in enumerate(flown)
        )
    names = {"b": "k_eta", "d": "k_m", "J_xx": "Ixx", "J_yy": "Iyy", "J_zz": "Izz"}
    return Flights(vehicle, [first], [second], {n: (truth[k],) * 2 for n, k in names.items()})


def _written(window: Window, path: Path) -> Path:
    """A log in our own CSV form (contract §5)."""
    t = window.t0 + window.dt * np.arange(len(window))
    columns = (t, window.rotor_speed, window.gyro, window.attitude, window.accel, window.velocity)
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=HEADER, comments="")  # type: ignore[arg-type]
    return path


def recorded(name: str, data: Path) -> Flights:
    """A set of `quadid_evaluation.studies.foreign`."""
    one = SETS[name]
    vehicle = Vehicle.named(data / one.vehicle)
    train, unseen = ([quadid.load(str(data / log), vehicle) for log in part] for part in (one.train, one.unseen))
    return Flights(vehicle, train, unseen, one.truth)


def section(data: Path) -> list[str]:
    """The part of the page."""
    rows = [
        "| flights | program | error of parameters with known truth [%] | 95 % intervals contain it | "
        "rate error after 0.5 s | processor [s] |",
        "|---|---|---|---|---|---|",
    ]
    for name in (ROTORPY, *RECORDED):
        rows += _rows(name, rotorpy() if name == ROTORPY else recorded(name, data))
    return [
        "## mujoco.sysid on vehicles of others",
        "",
        "`python -m quadid_evaluation.studies.peers recorded`: nominal model in `mujoco.sysid`, chunks of "
        f"{' and '.join(f'{c:g}' for c in CHUNKS)} s from the measured state, noise as quadid estimates it. RotorPy's "
        f"Hummingbird has its aerodynamics and motors that lag {1000 * LAG:g} ms. The rate error after 0.5 s is a "
        "benchmark column, which may get worse: the logged inputs of a closed loop already answer the disturbances to "
        "come, and whoever takes torque for less than it is predicts better.",
        "",
        *rows,
    ]


def _rows(name: str, flights: Flights) -> list[str]:
    vehicle = flights.vehicle
    identified, seconds = _timed(lambda: quadid.identify(flights.train))
    diagnosed, longer = _timed(lambda: quadid.diagnose(flights.train))
    sigma = np.sqrt(identified.fit.noise.variance)
    noise = float(sigma[:3].mean()), float(sigma[6:9].mean()), float(sigma[3:6].mean()) / 2.0  # half an angle
    windows = [w for log in flights.train for w in log.windows]
    rows = []
    for chunk in CHUNKS:
        theirs = mujoco_sysid.identify(windows, vehicle, noise, chunk=chunk)
        low, value, high = (np.exp(theirs.values + k * theirs.half) for k in (-1.0, 0.0, 1.0))
        told = {n: (value[k], low[k], high[k], "") for k, n in enumerate(NOMINAL_NAMES)}
        program = f"mujoco.sysid, {chunk:g} s"
        rows.append(_row("" if rows else name, program, told, with_values(vehicle, value), flights, theirs.seconds))
    for program, answer, spent in (("identify", identified, seconds), ("diagnose", diagnosed, longer)):
        told = {p["name"]: (p["value"], *p["ci95"], p["status"]) for p in answer.result["parameters"]}
        rows.append(_row("", f"quadid {program}", told, answer.vehicle, flights, spent))
    return rows


def _timed(call: Callable[[], Any]) -> tuple[Any, float]:
    begin = time.process_time()
    return call(), time.process_time() - begin


_Told = Mapping[str, tuple[float, float, float, str]]
"""Value, interval and status by parameter."""


def _row(name: str, program: str, told: _Told, model: Vehicle, flights: Flights, seconds: float) -> str:
    cells, held = [], 0
    known = [n for n in NOMINAL_NAMES if n in flights.truth]
    for n in known:
        (low, high), (value, least, most, status) = flights.truth[n], told[n]
        off = 100.0 * (value / np.clip(value, low, high) - 1.0)
        cells.append(f"{n} {off:+.1f}" + (f" ({status})" if status not in ("", "identified") else ""))
        held += bool(least <= high and low <= most)
    ahead = shares_of_no_change([w for log in flights.unseen for w in log.windows], model, AHEAD)["rate"]
    row = [name, program, ", ".join(cells), f"{held} of {len(known)}", f"{ahead:.2f}", f"{seconds:.1f}"]
    return f"| {' | '.join(row)} |".replace("|  |", "| |")
