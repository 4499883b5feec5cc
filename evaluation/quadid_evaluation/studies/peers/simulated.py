"""Simulated flights with known truth, estimated by others and by us: errors, coverage, unseen flights, time."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from quadid.data.window import Window
from quadid.flight import SensorNoise, TruthParameters, draw_truth, fly
from quadid.identification.fit import FitOptions, fit
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import share, table
from quadid_evaluation.studies.flight_sets import shares_of_no_change
from quadid_evaluation.studies.peers import mujoco_sysid, output_error
from quadid_evaluation.studies.peers.mujoco_sysid import Answer
from quadid_evaluation.studies.truth import poor_guess, with_values

SECONDS = 60.0
AHEAD = 0.5
"""Horizon of the predictions of an unseen flight [s]."""
CASES: dict[str, tuple[SensorNoise, dict[str, dict[str, float]]]] = {
    "white noise": (SensorNoise(attitude_slow=0.0, gyro_shake=0.0, accel_shake=0.0), {}),
    "coloured noise": (SensorNoise(), {}),
    "unmodelled motor lag of 30 ms": (SensorNoise(), {"motor_lag": {"tau": 0.03}}),
}
"""Flights: the noise of the sensors, and effects that the fitted model lacks."""
Record = dict[str, Any]


def body(seed: int) -> TruthParameters:
    """A drawn Pelican whose J_zz is that of a body, which MuJoCo insists on."""
    truth = draw_truth(Vehicle.shipped("pelican"), seed)
    return replace(truth, J_zz=min(truth.J_zz, 0.9 * (truth.J_xx + truth.J_yy)))


def warm_up() -> None:
    """Loads the kernels, or compiles them, before anything is timed."""
    vehicle = Vehicle.shipped("pelican")
    fit([fly(vehicle, seconds=20.0, seed=1).window], vehicle, FitOptions(seed=1))


def ours(window: Window, vehicle: Vehicle) -> tuple[Answer, list[str]]:
    """`quadid identify`, without a word about the noise; and the statuses of its numbers."""
    begin = time.process_time()
    done = fit([window], vehicle, FitOptions(seed=1))
    seconds = time.process_time() - begin
    values = np.log(done.theta[: len(NOMINAL_NAMES)])
    return Answer(values, 1.96 * done.uncertainty.sigma, seconds), [p.status.value for p in done.parameters]


OURS = "quadid"
PROGRAMS: dict[str, Callable[[Window, Vehicle], tuple[Answer, list[str]]]] = {
    "mujoco.sysid": lambda window, vehicle: (mujoco_sysid.identify([window], vehicle), []),
    "output error": lambda window, vehicle: (output_error.identify(window, vehicle), []),
    OURS: ours,
}


def record(case: str, seed: int, program: str) -> Record:
    """One flight: errors and half-widths of the logarithms, statuses, seconds, error on an unseen flight."""
    vehicle, truth = Vehicle.shipped("pelican"), body(seed)
    numbers = truth.as_dict()
    noise, effects = CASES[case]
    window, unseen = (
        fly(vehicle, truth, SECONDS, s, noise=noise, effects=effects).window for s in (seed, 10**6 + seed)
    )
    answer, statuses = PROGRAMS[program](window, poor_guess(vehicle, numbers, seed))
    ahead = shares_of_no_change([unseen], with_values(vehicle, np.exp(answer.values)), AHEAD)["rate"]
    error = answer.values - np.log([numbers[n] for n in NOMINAL_NAMES])
    told = {"case": case, "seed": seed, "program": program, "error": rounded(error), "half": rounded(answer.half)}
    return told | {"seconds": round(answer.seconds, 3), "ahead": round(ahead, 5), "status": statuses}


def rounded(values: FloatArray) -> list[float]:
    """To five digits, for the file."""
    return [float(f"{v:.5g}") for v in values]


def errors_table(records: Sequence[Record]) -> list[str]:
    """Markdown: one row a case and program; white noise, which differs little, is in the records only."""
    heads = (
        "flights",
        "program",
        "seeds",
        "median error b, d, J_xx, J_yy, J_zz, J_r [%]",
        "95 % intervals contain the truth (exact binomial interval, parameters as if independent)",
        "of b, d, J_xx, J_yy, J_zz, J_r [%]",
        "rate error after 0.5 s",
        "processor [s]",
    )
    rows, told = [], ""
    for case, program in product(list(CASES)[1:], PROGRAMS):
        mine = [r for r in records if (r["case"], r["program"]) == (case, program)]
        if not mine:
            continue
        error, half = (np.array([r[k] for r in mine]) for k in ("error", "half"))
        median = ", ".join(f"{100.0 * v:.2g}" for v in np.median(np.abs(error), axis=0))
        hold = np.abs(error) <= half
        each = ", ".join(f"{100.0 * v:.0f}" for v in hold.mean(axis=0))
        ahead, seconds = (float(np.median([r[k] for r in mine])) for k in ("ahead", "seconds"))
        shares = (share(int(hold.sum()), hold.size), each, f"{ahead:.3f}", f"{seconds:.2f}")
        rows.append(("" if case == told else case, program, len(mine), median, *shares))
        told = case
    return table(heads, rows)


def said(records: Sequence[Record]) -> str:
    """Words of each program about a missing effect, and the width of our intervals then."""
    mine = [r for r in records if CASES[r["case"]][1] and r["program"] == OURS]
    statuses = [s for r in mine for s in r["status"]]
    counts = ", ".join(f"{statuses.count(s)} {s}" for s in dict.fromkeys(statuses))
    wrong = [(abs(e) > h, s) for r in mine for e, h, s in zip(r["error"], r["half"], r["status"], strict=True)]
    missed = sum(bool(out) for out, status in wrong if status == "identified")
    widths = ", ".join(f"{100.0 * v:.3g}" for v in np.median([r["half"] for r in mine], axis=0))
    return (
        "The motor lag is missing from all models. Only `quadid identify` reports it, by statuses: "
        f"{counts}; {missed} identified values lie outside their interval. Its intervals (half-widths {widths} %) "
        "allow for what a missing lag may do. `quadid diagnose` names the lag."
    )


def section(records: Sequence[Record]) -> list[str]:
    """The part of the page."""
    return [
        "## mujoco.sysid and output error on simulated flights",
        "",
        f"`python -m quadid_evaluation.studies.peers simulated`: {SECONDS:g} s of a simulated Pelican at 50 "
        f"Hz, the guess off "
        "by up to 35 %; rate errors on unseen flights, relative to no change. `mujoco.sysid` (MJCF, chunks of 1 s from "
        "the measured state) and output error (`nlgreyest`'s method on scipy) receive the true sensor noise; quadid "
        "estimates it.",
        "",
        *errors_table(records),
        "",
        said(records),
    ]
