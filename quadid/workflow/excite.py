"""Which manoeuvre to fly next, and what it would gain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from quadid.errors import ParameterError
from quadid.workflow.loading import as_vehicle
from quadid.workflow.logs import Given, listed
from quadid.workflow.progress import Advance, silent

if TYPE_CHECKING:
    from pathlib import Path

    from quadid.experiment import Proposal
    from quadid.identify.noise_model import NoiseModel
    from quadid.types import FloatArray
    from quadid.vehicle import Vehicle
    from quadid.window import Window

MOST_SECONDS = 600.0


@dataclass(frozen=True)
class Proposed:
    """A manoeuvre.

    Attributes:
        result: of the form ``quadid.excite/1``; ``manoeuvre_file`` is None until it is written.
        proposal: the manoeuvre itself.
        text: of its file.
    """

    result: dict[str, Any]
    proposal: Proposal
    text: str


def check_limits(seconds: float, tilt: float, rate_limit: float) -> None:
    """Raises ParameterError for a manoeuvre that nobody can fly."""
    if not 6.5 <= seconds <= MOST_SECONDS:
        raise ParameterError(f"--seconds {seconds:g}", f"6.5 to {MOST_SECONDS:g} s")
    if not 2.0 <= tilt <= 60.0:
        raise ParameterError(f"--tilt {tilt:g} degrees", "2 to 60 degrees")
    if not 10.0 <= rate_limit <= 1000.0:
        raise ParameterError(f"--rate-limit {rate_limit:g} deg/s", "10 to 1000 deg/s")


def knowledge(
    vehicle: Vehicle, windows: Sequence[Window], seed: int, advance: Advance
) -> tuple[Vehicle, FloatArray, NoiseModel | None]:
    """What is known so far: vehicle with believed values, information (6, 6) of the log parameters, sensor noise.

    Without logs that is the vehicle file: its sigma, else half of its bounds on the log scale.
    """
    from quadid.identify.result import fitted_vehicle
    from quadid.parameters import NOMINAL_NAMES
    from quadid.workflow.searching import search

    if windows:
        fit = search("pso_polish", windows, vehicle, seed, advance)
        return fitted_vehicle(fit), np.asarray(np.linalg.inv(fit.uncertainty.covariance), dtype=np.float64), fit.noise
    sigma = np.array([vehicle.parameters[name].log_sigma for name in NOMINAL_NAMES])
    return vehicle, np.diag(1.0 / sigma**2), None


def propose(
    logs: Given = (), *, vehicle: str | Path | Vehicle = "pelican", seconds: float = 60.0, tilt: float = 25.0,
    rate_limit: float = 150.0, seed: int = 1, advance: Advance = silent,
) -> Proposed:  # fmt: skip
    """Proposes the manoeuvre that shrinks the intervals most, within tilt and rate limits.

    Args:
        logs: flights so far, from `load`.
        vehicle: what is believed before them.
        seconds: length of the manoeuvre [s].
        tilt: largest tilt [degrees].
        rate_limit: largest body rate [degrees/s].
        seed: of all random numbers.
        advance: told how far it is.

    Raises:
        ParameterError: limits that nobody can fly.
        NotIdentifiableError: no movement stays within the limits, or too little data.
    """
    from quadid.experiment import Limits, Simulator, manoeuvre_file
    from quadid.experiment import propose as chosen

    check_limits(seconds, tilt, rate_limit)
    limits = Limits(math.radians(tilt), math.radians(rate_limit))
    given = [log.of(vehicle) for log in listed(logs)]
    windows = [w for log in given for w in log.windows]
    believed, known, noise = knowledge(as_vehicle(vehicle), windows, seed, advance)
    proposal = chosen(Simulator(believed, noise, seed), known, limits, seconds, advance)
    result = {
        **_result(believed.name, proposal, tilt, rate_limit),
        "manoeuvre_file": None,
        "logs": [str(log.path) for log in given],
    }
    return Proposed(result, proposal, manoeuvre_file(believed.name, proposal))


def _result(vehicle: str, proposal: Proposal, tilt: float, rate_limit: float) -> dict[str, Any]:
    from quadid.parameters import NOMINAL_NAMES

    rows = zip(NOMINAL_NAMES, proposal.now, proposal.pilot, proposal.after, strict=True)
    worst = int(np.argmax(proposal.pilot))
    return {
        "schema": "quadid.excite/1",
        "vehicle": vehicle,
        "seconds": proposal.seconds,
        "limits": {"tilt_deg": tilt, "rate_deg_s": rate_limit},
        "peak": {"tilt_deg": math.degrees(proposal.peak.tilt), "rate_deg_s": math.degrees(proposal.peak.rate)},
        "movements": [
            {"name": m.name, "amplitudes": {s.axis: s.amplitude for s in m.segments}} for m in proposal.movements
        ],
        "parameters": [
            {"name": n, "now": float(a), "gentle_flight": float(b), "manoeuvre": float(c)} for n, a, b, c in rows
        ],
        "worst": NOMINAL_NAMES[worst],
        "gain": float(np.log1p(proposal.pilot[worst]) / np.log1p(proposal.after[worst])),
    }
