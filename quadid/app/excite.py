"""Which manoeuvre to fly next, and what it would gain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quadid.app.identify import check_seed, search
from quadid.app.logs import Given, as_vehicle, file_name, read, write_text
from quadid.app.outcome import Advance, silent
from quadid.data.window import Window
from quadid.errors import ParameterError
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

if TYPE_CHECKING:
    from quadid.experiment import Proposal
    from quadid.flight import Segment
    from quadid.identification.fit import Fit
    from quadid.report.manoeuvres import Plan

MOST_SECONDS = 600.0
_HEIGHTS = "LOWEST:HIGHEST in m above take-off, 2 to 500"
ABORT = 1.4
"""Tilt beyond that of the simulation by which a script gives up: the vehicle is not the one that was simulated."""
ROOM = 2.0
"""Room around the start that a script allows, in that of the simulation, and at least `LEAST_ROOM`: wind blows."""
LEAST_ROOM = 10.0
HOVER_THROTTLE = 0.35
"""Share of full throttle at hover where the vehicle file does not know: what ArduPilot begins with (MOT_THST_HOVER)."""


@dataclass(frozen=True)
class Proposed:
    """A manoeuvre.

    Attributes:
        result: of the form ``quadid.excite/1``; ``manoeuvre_file`` is None until it is written.
        proposal: the manoeuvre itself.
        text: of its file.
        plan: what scripts and instructions are made from.
        hover_throttle: share of full throttle at hover.
    """

    result: dict[str, Any]
    proposal: Proposal
    text: str
    plan: Plan
    hover_throttle: float

    def save(self, folder: str | Path = ".", forms: Sequence[str] = ()) -> list[Path]:
        """Writes the manoeuvre, and what flies it in each of `forms` (`quadid.report.manoeuvres.FORMS`).

        Raises:
            ParameterError: an unknown form.
        """
        from quadid.report.manoeuvres import written_as

        texts = {".manoeuvre.yaml": self.text}
        for form in forms:
            texts |= written_as(self.plan, form, self.hover_throttle)
        name = file_name(self.plan.vehicle)
        return [write_text(Path(folder) / f"{name}{end}", text) for end, text in texts.items()]


def check_forms(forms: Sequence[str]) -> None:
    """Raises ParameterError for a form that is not written."""
    from quadid.report.manoeuvres import check_form

    for form in forms:
        check_form(form)


def parse_height(text: str) -> tuple[float, float]:
    """Reads ``10:40``, the lowest and highest height above take-off [m]; raises ParameterError for anything else."""
    low, _, high = text.partition(":")
    try:
        return float(low), float(high)
    except ValueError as error:
        raise ParameterError(f"--height {text}", _HEIGHTS, "for example 10:40") from error


def check_limits(seconds: float, tilt: float, rate_limit: float, height: tuple[float, float], battery: float) -> None:
    """Raises ParameterError for a manoeuvre that nobody can fly."""
    if not 2.0 <= height[0] < height[1] <= 500.0:
        raise ParameterError(f"--height {height[0]:g}:{height[1]:g}", _HEIGHTS, "for example 10:40")
    if not 6.5 <= seconds <= MOST_SECONDS:
        raise ParameterError(f"--seconds {seconds:g}", f"6.5 to {MOST_SECONDS:g} s")
    if not 2.0 <= tilt <= 60.0:
        raise ParameterError(f"--tilt {tilt:g} degrees", "2 to 60 degrees")
    if not 10.0 <= rate_limit <= 1000.0:
        raise ParameterError(f"--rate-limit {rate_limit:g} deg/s", "10 to 1000 deg/s")
    if not 0.0 <= battery < 100.0:
        raise ParameterError(f"--battery {battery:g} %", "0 to 99 per cent")


def knowledge(
    vehicle: Vehicle, windows: Sequence[Window], seed: int, advance: Advance
) -> tuple[Vehicle, FloatArray, Fit | None]:
    """State of knowledge: vehicle with believed values, information (6, 6) of the log parameters, fit of the logs.

    Without logs that is the vehicle file: its sigma, else half of its bounds on the log scale.
    """
    from quadid.identification.result import fitted_vehicle

    if windows:
        fit = search("pso_polish", windows, vehicle, seed, advance)
        return fitted_vehicle(fit), np.asarray(np.linalg.inv(fit.uncertainty.covariance), dtype=np.float64), fit
    sigma = np.array([vehicle.parameters[name].log_sigma for name in NOMINAL_NAMES])
    return vehicle, np.diag(1.0 / sigma**2), None


def propose(
    logs: Given = (), *, vehicle: str | Path | Vehicle = "pelican", seconds: float = 60.0, tilt: float = 25.0,
    rate_limit: float = 150.0, height: tuple[float, float] = (10.0, 40.0), battery: float = 40.0, seed: int = 1,
    advance: Advance = silent,
) -> Proposed:  # fmt: skip
    """Proposes the manoeuvre that shrinks the intervals most, within tilt and rate limits.

    Args:
        logs: flights so far, as paths or from `load`.
        vehicle: what is believed before them.
        seconds: length of the manoeuvre [s].
        tilt: largest tilt [degrees].
        rate_limit: largest body rate [degrees/s].
        height: lowest and highest above take-off [m].
        battery: what must remain [per cent].
        seed: of all random numbers.
        advance: told how far it is.

    Raises:
        ParameterError: limits that nobody can fly.
        NotIdentifiableError: no movement stays within the limits, or too little data.
    """
    from quadid.experiment import AsLogged, Limits, TrialFlights, design_manoeuvre, manoeuvre_file
    from quadid.identification.excitation import halfwidths
    from quadid.report.programs import Facts

    check_limits(seconds, tilt, rate_limit, height, battery)
    check_seed(seed)
    limits = Limits(math.radians(tilt), math.radians(rate_limit))
    described = as_vehicle(vehicle)
    given = read(logs, described)
    windows = [w for log in given for w in log.windows]
    believed, known, before = knowledge(described, windows, seed, advance)
    simulator = TrialFlights(believed, None if before is None else before.noise, seed)
    proposal = design_manoeuvre(simulator, known, limits, seconds, advance)
    if before is not None:
        as_logged = AsLogged(simulator, given[-1].recording, given[-1].grid.rate, windows, before.theta)

        def promised(segments: Sequence[Segment], profile: str = "scripted") -> FloatArray:
            flown = as_logged.windows(segments, proposal.seconds, profile)
            covariance = search("pso_polish", [*windows, *flown], described, seed, advance).uncertainty.covariance
            # What was known stays known, whatever noise the fit of one more flight finds.
            return np.minimum(proposal.now, halfwidths(np.asarray(np.linalg.inv(covariance), dtype=np.float64)))

        proposal = replace(
            proposal, pilot=promised((), "gentle"), after=promised(proposal.segments),
            swept=promised(proposal.sweeps) if proposal.sweeps else proposal.swept,
        )  # fmt: skip
    plan = made_into_plan(believed.name, proposal, tilt, height, battery)
    result = {
        **_result(believed.name, proposal, tilt, rate_limit),
        "envelope": dict(plan.envelope),
        "manoeuvre_file": None,
        "files": [],
        "logs": [str(log.path) for log in given],
    }
    hover = Facts(believed, believed.name).hover_thrust or HOVER_THROTTLE
    return Proposed(result, proposal, manoeuvre_file(believed.name, proposal), plan, hover)


def made_into_plan(vehicle: str, proposal: Proposal, tilt: float, height: tuple[float, float], battery: float) -> Plan:
    """The manoeuvre with its envelope; raises ParameterError where it needs more height than there is."""
    from quadid.report.manoeuvres import Plan

    sideways, up, down = proposal.room.tolist()
    if up + down > height[1] - height[0]:
        raise ParameterError(
            f"--height {height[0]:g}:{height[1]:g}", f"at least {up + down:.2g} m, which the manoeuvre needs",
            "a wider --height, or a smaller --tilt",
        )  # fmt: skip
    envelope = {
        "lowest_m": height[0], "highest_m": height[1], "radius_m": float(math.ceil(max(ROOM * sideways, LEAST_ROOM))),
        "tilt_deg": tilt, "abort_tilt_deg": round(ABORT * math.degrees(proposal.peak.tilt), 1),
        "battery_percent": battery,
    }  # fmt: skip
    promises = (dict(zip(NOMINAL_NAMES, half.tolist(), strict=True)) for half in (proposal.after, proposal.swept))
    segments, sweeps = ([asdict(s) for s in part] for part in (proposal.segments, proposal.sweeps))
    return Plan(vehicle, proposal.seconds, segments, sweeps, envelope, *promises)


def _result(vehicle: str, proposal: Proposal, tilt: float, rate_limit: float) -> dict[str, Any]:

    rows = zip(NOMINAL_NAMES, proposal.now, proposal.pilot, proposal.after, proposal.swept, strict=True)
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
        "room": dict(zip(("sideways_m", "up_m", "down_m"), proposal.room.tolist(), strict=True)),
        "parameters": [
            {
                "name": n,
                "now": float(a),
                "gentle_flight": float(b),
                "manoeuvre": float(c),
                "one_axis_at_a_time": float(d),
            }
            for n, a, b, c, d in rows
        ],
        "worst": NOMINAL_NAMES[worst],
        "gain": float(np.log1p(proposal.pilot[worst]) / np.log1p(proposal.after[worst])),
    }
