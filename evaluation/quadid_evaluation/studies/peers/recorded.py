"""Vehicles of others: `mujoco.sysid` and we on the same logs, beside the truth that came with them."""

import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import quadid
from quadid.app.logs import Log
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import table
from quadid_evaluation.studies import rotorpy_flight
from quadid_evaluation.studies.flight_sets import SETS, shares_of_no_change
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


class Flights(NamedTuple):
    """Flights of one vehicle: fitted and unseen ones, and the interval in which each known parameter lies."""

    vehicle: Vehicle
    train: list[Log]
    unseen: list[Log]
    truth: Mapping[str, tuple[float, float]]


def rotorpy() -> Flights:
    """RotorPy's own Hummingbird, flown by RotorPy, through CSV files (contract §5)."""
    truth = rotorpy_flight.hummingbird(tau_m=LAG)
    logs = []
    for seed in (1, 2):
        flown = rotorpy_flight.fly(truth, SECONDS, seed, reach=1.4)
        vehicle, w = flown.vehicle, flown.window
        columns = (w.t, w.rotor_speed, w.gyro, w.attitude, w.accel, w.velocity)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"{seed}.csv"
            np.savetxt(path, np.column_stack(columns), delimiter=",", header=HEADER, comments="")  # type: ignore[arg-type]
            logs.append(quadid.load(path, vehicle))
    known = {n: (truth[k],) * 2 for n, k in rotorpy_flight.NAMES.items()}
    return Flights(vehicle, logs[:1], logs[1:], known)


def recorded(name: str, data: Path) -> Flights:
    """A set of `quadid_evaluation.studies.foreign`."""
    one = SETS[name]
    vehicle = Vehicle.named(data / one.vehicle)
    train, unseen = ([quadid.load(str(data / log), vehicle) for log in part] for part in (one.train, one.unseen))
    return Flights(vehicle, train, unseen, one.truth)


def rows(name: str, flights: Flights) -> Iterator[tuple[str, ...]]:
    """A row a program: errors, intervals, prediction of unseen flights, processor time."""
    vehicle, known = flights.vehicle, [n for n in NOMINAL_NAMES if n in flights.truth]
    ours: dict[str, tuple[Any, float]] = {}
    for command in (quadid.identify, quadid.diagnose):
        begin = time.process_time()
        ours[command.__name__] = command(flights.train), time.process_time() - begin

    # Value, interval and status by parameter, the file and the time of every program.
    answers: dict[str, tuple[Mapping[str, tuple[Any, ...]], Vehicle, float]] = {}
    sigma = np.sqrt(ours["identify"][0].fit.noise.variance)
    noise = float(sigma[:3].mean()), float(sigma[6:9].mean()), float(sigma[3:6].mean()) / 2.0  # half an angle
    windows = [w for log in flights.train for w in log.windows]
    for chunk in CHUNKS:
        theirs = mujoco_sysid.identify(windows, vehicle, noise, chunk=chunk)
        low, value, high = (np.exp(theirs.values + k * theirs.half) for k in (-1.0, 0.0, 1.0))
        told = {n: (value[k], low[k], high[k], "") for k, n in enumerate(NOMINAL_NAMES)}
        answers[f"mujoco.sysid, {chunk:g} s"] = told, with_values(vehicle, value), theirs.seconds
    for program, (answer, seconds) in ours.items():
        told = {p["name"]: (p["value"], *p["ci95"], p["status"]) for p in answer.result["parameters"]}
        answers[f"quadid {program}"] = told, answer.vehicle, seconds

    seen = [w for log in flights.unseen for w in log.windows]
    for program, (found, model, seconds) in answers.items():
        cells, held = [], 0
        for n in known:
            (least, most), (value, low, high, status) = flights.truth[n], found[n]
            off = 100.0 * (value / np.clip(value, least, most) - 1.0)
            cells.append(f"{n} {off:+.1f}" + (f" ({status})" if status not in ("", "identified") else ""))
            held += bool(low <= most and least <= high)
        ahead = shares_of_no_change(seen, model, AHEAD)["rate"]
        yield name, program, ", ".join(cells), f"{held} of {len(known)}", f"{ahead:.2f}", f"{seconds:.1f}"
        name = ""


def section(data: Path) -> list[str]:
    """The part of the page."""
    heads = (
        "flights",
        "program",
        "error of parameters with known truth [%]",
        "95 % intervals contain it",
        "rate error after 0.5 s",
        "processor [s]",
    )
    flights = [(ROTORPY, rotorpy()), *((name, recorded(name, data)) for name in RECORDED)]
    return [
        "## mujoco.sysid on vehicles of others",
        "",
        "`python -m quadid_evaluation.studies.peers recorded`: nominal model in `mujoco.sysid`, chunks of "
        f"{' and '.join(f'{c:g}' for c in CHUNKS)} s from the measured state, noise as quadid estimates it. RotorPy's "
        f"Hummingbird has its aerodynamics and motors that lag {1000 * LAG:g} ms. The rate error after 0.5 s is a "
        "benchmark column, which may get worse: the logged inputs of a closed loop already answer the disturbances to "
        "come, and whoever takes torque for less than it is predicts better.",
        "",
        *table(heads, (row for name, flown in flights for row in rows(name, flown))),
    ]
