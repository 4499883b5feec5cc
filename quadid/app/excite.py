"""Next manoeuvre to fly, and its gain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from quadid.app.identify import check_seed, search
from quadid.app.logs import Given, Log, file_name, read, write_texts
from quadid.app.options import VEHICLE, Described, Seed, Typed
from quadid.app.outcome import LIBRARY, Advance, Reported, provenance, silent
from quadid.errors import ParameterError
from quadid.parameters import NOMINAL_NAMES
from quadid.report.manoeuvres import ManoeuvrePlan, check_form, half_width, written_as
from quadid.report.page import axis, figure, rows_of, section, trace
from quadid.report.tables import Cell, Column, TextTable
from quadid.report.verdict import Verdict
from quadid.rotation import euler
from quadid.types import FloatArray, Json
from quadid.vehicle import Vehicle

if TYPE_CHECKING:
    from quadid.experiment import Proposal
    from quadid.flight import Segment
    from quadid.identification.uncertainty import Uncertainty

MOST_SECONDS = 600.0
_HEIGHTS = "LOWEST:HIGHEST in m above take-off, 2 to 500"
ABORT = 1.4
"""Tilt beyond that of the simulation by which a script gives up: the vehicle is not the one that was simulated."""
ROOM = 2.0
"""Room around the start that a script allows, in that of the simulation, and at least `LEAST_ROOM`: wind blows."""
LEAST_ROOM = 10.0
LEAST_GAIN = 1.1
"""Narrower than after a gentle flight by less than this factor, an interval is not worth a manoeuvre."""
KINDS = ("now", "gentle_flight", "manoeuvre", "one_axis_at_a_time")
"""Half-widths of a parameter: now, and after each kind of flight."""
HOVER_THROTTLE = 0.35
"""Share of full throttle at hover where the vehicle file does not know: what ArduPilot begins with (MOT_THST_HOVER)."""


@dataclass(frozen=True, repr=False)
class Proposed(Reported):
    """A manoeuvre.

    Attributes:
        result: of the form ``quadid.excite/1``; ``manoeuvre_file`` is None until it is written.
        plan: what scripts and instructions are made from.
        hover_throttle: share of full throttle at hover.
        forms: what flies it is written in these as well (`quadid.report.manoeuvres.FORMS`).
    """

    endings = (".manoeuvre*", ".sticks.txt", ".sid_*.param")
    rows = "parameters"
    result: dict[str, Any]
    proposal: Proposal
    manoeuvre: str
    plan: ManoeuvrePlan
    hover_throttle: float
    forms: tuple[str, ...] = ()
    logs: tuple[Log, ...] = ()

    def write(self, folder: Path, kept: str | None = None) -> list[tuple[str, Path]]:
        """Writes the manoeuvre and what flies it."""
        first, *others = self.save(folder, self.forms)
        self.result["manoeuvre_file"], self.result["files"] = str(first), [str(path) for path in others]
        return [("Manoeuvre", first), *(("To fly it", path) for path in others)]

    @property
    def warnings(self) -> list[str]:
        """Faults of the logs."""
        return [text for log in self.logs for text in log.warnings]

    @property
    def verdict(self) -> Verdict:
        """Gain of the flight beside a gentle one, and whether it is worth flying."""
        gain, worst, seconds = self.result["gain"], self.result["worst"], self.result["seconds"]
        gained = f"makes the interval of {worst}, the least certain parameter, {gain:.3g} times narrower"
        if gain < LEAST_GAIN:
            step = "Allow more --seconds, --tilt or --rate-limit."
            return Verdict("fair", f"Hardly worth flying: {seconds:g} s {gained}.", (), (step,))
        step = "Fly it, then fit its log together with those before."
        return Verdict("good", f"Worth flying: {seconds:g} s {gained} than a gentle flight.", (), (step,))

    def tables(self) -> list[TextTable]:
        """Half-widths now, and after each kind of flight."""
        rows = tuple((p["name"], *(half_width(p[key]) for key in KINDS)) for p in self.result["parameters"])
        heads = (Column("parameter"), *(Column(key.replace("_", " "), right=True) for key in KINDS))
        title = f"Relative 95 % half-width (±) before and after {self.result['seconds']:g} s"
        return [TextTable(title, heads, rows)]

    @property
    def sentences(self) -> list[Cell]:
        """The movements, and where they may be flown."""
        from quadid.experiment import BLOCK

        peak, room, e = (self.result[key] for key in ("peak", "room", "envelope"))
        return [
            Cell(f"Manoeuvre: movements of {BLOCK:g} s, amplitudes rms"),
            *(Cell(f"  {times} × {name}: {size}") for name, times, size in grouped(self.result["movements"])),
            Cell(f"Half-widths are predicted by {self.plan.rests_on}."),
            Cell(
                f"In simulation it reaches {peak['tilt_deg']:.0f} degrees and {peak['rate_deg_s']:.0f} deg/s, and "
                f"needs {room['sideways_m']:.0f} m to each side, {room['up_m']:.1f} m upwards and "
                f"{room['down_m']:.1f} m downwards."
            ),
            Cell(
                f"Envelope: {e['lowest_m']:g} to {e['highest_m']:g} m above take-off, {e['radius_m']:g} m around the "
                f"start, {e['abort_tilt_deg']:.0f} degrees of tilt, {e['battery_percent']:g} % of the battery left."
            ),
        ]

    def page(self, command: str = LIBRARY) -> str:
        """The page: what it would gain, how it looks when flown, where it may be flown."""
        result, window = self.result, self.proposal.flight.window
        assert window.attitude is not None
        names = [p["name"] for p in result["parameters"]]
        bars = []
        for role, label, key in (
            ("measured", "now", "now"),
            ("before", "after a gentle flight", "gentle_flight"),
            ("after", "after the manoeuvre", "manoeuvre"),
        ):
            y = [100.0 * min(p[key], 2.0) for p in result["parameters"]]
            bars.append({"role": role, "name": label, "type": "bar", "x": names, "y": y})
        widths = {"yaxis": axis("half-width (%)", type="log"), "xaxis": {"type": "category"}}
        angles = np.degrees(np.unwrap(euler(window.attitude), axis=0))
        lines = [
            trace(role, label, window.t - window.t0, angles[:, i])
            for i, (role, label) in enumerate((("measured", "roll"), ("before", "pitch"), ("after", "yaw")))
        ]
        tilted = {"xaxis": axis("time (s)"), "yaxis": axis("angle (°)")}
        peak, room, e = (result[key] for key in ("peak", "room", "envelope"))
        height = f"{room['up_m'] + room['down_m']:.1f} m"
        limits = [
            ("height above take-off", height, f"{e['lowest_m']:g} to {e['highest_m']:g} m"),
            ("distance from the start", f"{room['sideways_m']:.0f} m", f"{e['radius_m']:g} m"),
            ("tilt", f"{peak['tilt_deg']:.0f}°", f"{e['abort_tilt_deg']:.0f}°"),
            ("battery", "–", f"{e['battery_percent']:g} % left"),
        ]
        promised = f"Relative half-width of the 95 % interval, predicted by {self.plan.rests_on}."
        widths_drawn, halves = figure("gain-bars", "Half-widths", bars, widths, 320), self.tables()[0].part()
        moved = "Stick movements one after the other, and the attitude that the simulation flies."
        flown, moves = figure("attitude", "Attitude", lines, tilted, 320), grouped(result["movements"])
        movements = rows_of(("movement", "times", "amplitude, rms"), moves)
        kept = "Scripts start only inside the envelope and stop outside it."
        needed = rows_of(("", "needed in simulation", "envelope"), limits)
        sections = [
            section("gain", "What it would gain", promised, [widths_drawn], [halves]),
            section("manoeuvre", "The manoeuvre", moved, [flown], [movements]),
            section("envelope", "Where it may be flown", kept, tables=[needed]),
        ]
        about = f"{result['seconds']:g} s, at most {peak['tilt_deg']:.0f}° of tilt and {peak['rate_deg_s']:.0f}°/s"
        return self.rendered(f"What to fly next: {result['vehicle']}", about, sections, provenance(self.logs, command))

    def save(self, folder: str | Path = ".", forms: Sequence[str] = ()) -> list[Path]:
        """Writes the manoeuvre, and what flies it in each of `forms` (`quadid.report.manoeuvres.FORMS`).

        Raises:
            ParameterError: an unknown form.
        """
        texts = {".manoeuvre.yaml": self.manoeuvre}
        for form in forms:
            texts |= written_as(self.plan, form, self.hover_throttle)
        name = file_name(self.plan.vehicle)
        return write_texts(folder, {f"{name}{end}": text for end, text in texts.items()})


def parse_height(text: str) -> tuple[float, float]:
    """Reads ``10:40``, the lowest and highest height above take-off [m]; raises ParameterError for anything else."""
    low, _, high = text.partition(":")
    try:
        return float(low), float(high)
    except ValueError as error:
        raise ParameterError(f"--height {text}", _HEIGHTS, "for example 10:40") from error


def check_limits(
    seconds: float, tilt: float, rate_limit: float, height: tuple[float, float], battery: float, forms: Sequence[str]
) -> None:
    """Raises ParameterError for a manoeuvre that cannot be flown, or a form that is not written."""
    for form in forms:
        check_form(form)
    if not 2.0 <= height[0] < height[1] <= 500.0:
        raise ParameterError(f"--height {height[0]:g}:{height[1]:g}", _HEIGHTS, "for example 10:40")
    for option, value, unit, low, high in (
        ("seconds", seconds, "", 6.5, MOST_SECONDS),
        ("tilt", tilt, " degrees", 2.0, 60.0),
        ("rate-limit", rate_limit, " deg/s", 10.0, 1000.0),
    ):
        if not low <= value <= high:
            raise ParameterError(f"--{option} {value:g}{unit}", f"{low:g} to {high:g}{unit or ' s'}")
    if not 0.0 <= battery < 100.0:
        raise ParameterError(f"--battery {battery:g} %", "0 to 99 per cent")


def halves_after(found: Uncertainty, before: Uncertainty | None) -> FloatArray:
    """Relative 95 % half-widths (6,) by a fit of real flights and a simulated one.

    Estimates of the simulated flight differ by what its model holds.  Those of the next real one, flown and logged as
    those before it were, differ by as many times what noise makes; at most by as much, as a livelier flight leaves less
    open.
    """
    from quadid.identification.uncertainty import halfwidths

    variance = found.from_noise**2
    if before is not None and before.grown is not None:
        variance = variance + (before.grown**2 - 1.0) * np.minimum(variance, before.from_noise**2)
    variance = np.maximum(np.diag(found.covariance), variance)
    grown = np.sqrt(variance / np.diag(found.covariance))
    return halfwidths(np.linalg.inv(found.covariance * np.outer(grown, grown)))


def propose(
    logs: Annotated[Given, Typed(list[str] | None, typer.Argument(metavar="LOG"), opened=True)] = (),
    *,
    vehicle: Annotated[Described, Typed(str, VEHICLE, "pelican", Vehicle.named)] = "pelican",
    seconds: Annotated[float, typer.Option(metavar="S")] = 60.0,
    tilt: Annotated[float, typer.Option(metavar="DEG")] = 25.0,
    rate_limit: Annotated[float, typer.Option(metavar="DEG/S")] = 150.0,
    height: Annotated[tuple[float, float], Typed(str, typer.Option(metavar="M:M"), "10:40", parse_height)] = (
        10.0,
        40.0,
    ),
    battery: Annotated[float, typer.Option(metavar="%")] = 40.0,
    forms: Annotated[Sequence[str], Typed(list[str] | None, typer.Option("--format", metavar="NAME"))] = (),
    seed: Seed = 1,
    advance: Advance = silent,
) -> Proposed:
    """Proposes the manoeuvre that shrinks the intervals most, within tilt and rate limits.

    Args:
        logs: flights so far, if any.
        vehicle: what is believed before them.
        seconds: length of the manoeuvre [s].
        tilt: largest tilt [degrees].
        rate_limit: largest body rate [degrees/s].
        height: lowest and highest height above take-off [m].
        battery: what must remain of the battery [%].
        forms: also write what flies it: ardupilot-lua, ardupilot-sid, px4, sticks.
        seed: of all random numbers.
        advance: called with the stage and the share done.

    Raises:
        ParameterError: limits that cannot be flown.
        NotIdentifiableError: no movement stays within the limits, or too little data.
    """
    from quadid.estimate.missing import Vehicles, random_forces
    from quadid.experiment import AsLogged, Limits, TrialFlights, design_manoeuvre, manoeuvre_file
    from quadid.identification.result import fitted_vehicle
    from quadid.model.layout import Layout
    from quadid.report.programs import Facts

    check_limits(seconds, tilt, rate_limit, height, battery, forms)
    check_seed(seed)
    limits = Limits(math.radians(tilt), math.radians(rate_limit))
    described = Vehicle.named(vehicle)
    given = read(logs, described)
    windows = [w for log in given for w in log.windows]
    # State of knowledge: that of the vehicle file (its sigma, else half of its bounds on the log scale), or the fit of
    # the logs, and the information (6, 6) of the log parameters.
    believed, before = described, None
    known = np.diag([1.0 / described.parameters[name].log_sigma ** 2 for name in NOMINAL_NAMES])
    if windows:
        before = search("pso_polish", windows, described, seed, advance)
        believed, known = fitted_vehicle(before), np.asarray(np.linalg.inv(before.uncertainty.covariance))
    simulator = TrialFlights(believed, None if before is None else before.noise, seed)
    proposal = design_manoeuvre(simulator, known, limits, seconds, advance)
    random, like = believed.random, given[-1] if given else None
    flier = simulator
    if before is not None:  # effects that the fit of a log found beside the parameters, and the random forces left
        real = believed.model_copy(update={"effects": {**before.beside, **believed.effects}})
        flier = TrialFlights(real, before.noise, seed)
        theta = Layout(real).initial(real)
        random = random_forces(Vehicles(windows, real, theta).missing(windows, theta))
    if random is not None:
        as_logged = AsLogged(flier, random, *(() if like is None else (like.recording, like.grid.rate)))

        def promised(segments: Sequence[Segment], profile: str = "scripted") -> FloatArray:
            flown = as_logged.windows(segments, proposal.seconds, profile)
            found = search("pso_polish", [*windows, *flown], described, seed, advance).uncertainty
            # What was known stays known, whatever noise the fit of one more flight finds.
            return np.minimum(proposal.now, halves_after(found, None if before is None else before.uncertainty))

        proposal = replace(
            proposal,
            pilot=promised((), "gentle"),
            after=promised(proposal.segments),
            swept=promised(proposal.sweeps) if proposal.sweeps else proposal.swept,
        )
    plan = made_into_plan(believed.name, proposal, tilt, height, battery, random is not None)
    halves, worst = (proposal.now, proposal.pilot, proposal.after, proposal.swept), int(np.argmax(proposal.pilot))
    result = {
        "schema": "quadid.excite/1",
        "vehicle": believed.name,
        "seconds": proposal.seconds,
        "limits": {"tilt_deg": tilt, "rate_deg_s": rate_limit},
        "peak": {"tilt_deg": math.degrees(proposal.peak.tilt), "rate_deg_s": math.degrees(proposal.peak.rate)},
        "movements": [
            {"name": m.name, "amplitudes": {s.axis: s.amplitude for s in m.segments}} for m in proposal.movements
        ],
        "room": dict(zip(("sideways_m", "up_m", "down_m"), proposal.room.tolist(), strict=True)),
        "parameters": [
            {"name": name, **dict(zip(KINDS, row, strict=True))}
            for name, row in zip(NOMINAL_NAMES, np.column_stack(halves).tolist(), strict=True)
        ],
        "worst": NOMINAL_NAMES[worst],
        "gain": float(np.log1p(proposal.pilot[worst]) / np.log1p(proposal.after[worst])),
        "envelope": dict(plan.envelope),
        "manoeuvre_file": None,
        "files": [],
        "logs": [str(log.path) for log in given],
    }
    hover = Facts(believed, believed.name).hover_thrust or HOVER_THROTTLE
    return Proposed(result, proposal, manoeuvre_file(believed.name, proposal), plan, hover, tuple(forms), tuple(given))


def made_into_plan(
    vehicle: str, proposal: Proposal, tilt: float, height: tuple[float, float], battery: float, disturbed: bool
) -> ManoeuvrePlan:
    """The manoeuvre with its envelope; raises ParameterError where it needs more height than there is."""
    sideways, up, down = proposal.room.tolist()
    if up + down > height[1] - height[0]:
        raise ParameterError(
            f"--height {height[0]:g}:{height[1]:g}",
            f"at least {up + down:.2g} m, which the manoeuvre needs",
            "a wider --height, or a smaller --tilt",
        )
    envelope = {
        "lowest_m": height[0],
        "highest_m": height[1],
        "radius_m": float(math.ceil(max(ROOM * sideways, LEAST_ROOM))),
        "tilt_deg": tilt,
        "abort_tilt_deg": round(ABORT * math.degrees(proposal.peak.tilt), 1),
        "battery_percent": battery,
    }
    flown, swept = (dict(zip(NOMINAL_NAMES, half.tolist(), strict=True)) for half in (proposal.after, proposal.swept))
    segments, sweeps = ([asdict(s) for s in part] for part in (proposal.segments, proposal.sweeps))
    return ManoeuvrePlan(vehicle, proposal.seconds, segments, sweeps, envelope, flown, swept, disturbed)


def grouped(movements: Sequence[Json]) -> list[tuple[str, str, str]]:
    """Movements that follow each other alike as one: name, how many times, amplitudes."""
    each = [(m["name"], ", ".join(f"{a} {_amplitude(a, v)}" for a, v in m["amplitudes"].items())) for m in movements]
    return [(name, str(len(list(same))), size) for (name, size), same in groupby(each)]


def _amplitude(axis: str, value: float) -> str:
    return f"{100.0 * value:.0f} %" if axis == "throttle" else f"{math.degrees(value):.1f}°"
