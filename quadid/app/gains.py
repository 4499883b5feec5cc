"""Gains of rate and attitude loops for a vehicle as identified, with margins; nothing is sent to a vehicle."""

import itertools
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from quadid_replay import open_log

from quadid.app.export import UnprovenError
from quadid.app.logs import file_name, write_texts
from quadid.app.options import VEHICLE, Described, Typed
from quadid.app.outcome import LIBRARY, Reported, provenance
from quadid.chi_square import Z95
from quadid.errors import LogError, ParameterError, nearest
from quadid.files import read_regular
from quadid.model.rate_loop import AxisPlant, Loops, RateGains, design, slowed, with_rate
from quadid.parameters import INERTIAS, NOMINAL_UNITS
from quadid.report.autopilots import AUTOPILOTS, AXES, Autopilot, authority, hover, moments
from quadid.report.page import axis as axis_of
from quadid.report.page import figure, section, trace
from quadid.report.programs import Facts
from quadid.report.tables import TextTable, heads, number
from quadid.report.verdict import Verdict
from quadid.types import Json, JsonDict
from quadid.vehicle import Vehicle

PHASE_MARGIN = 55.0
"""Default [deg]: the rate overshoots by about a seventh."""
STEP, SHARE = 1.0, 0.5
"""A step of the rate by this much [rad/s] may take this share of the moment that the rotors have beside hover."""
UNSTATED = 0.2
"""Half-width of the interval of a delay or lag, relative: vehicle files hold none for effects."""
_SIZES = ("b", "d", *INERTIAS)
"""Parameters of a vehicle that set the gains."""
_LINE = re.compile(
    r"^\s*(?:set\s+|\d+\s+\d+\s+)?([A-Za-z_]\w*)\s*[\s,=]\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(?=[\s,]|$)",
    re.MULTILINE,
)
"""A line of a parameter file: of QGroundControl, of Mission Planner or MAVProxy, of Betaflight's `diff` and `dump`."""


_MARGINS = ("phase_margin", "gain_margin")
_FILES = {
    "px4": (".params", "1\t1\t{name}\t{value}\t9\n"),
    "ardupilot": (".param", "{name},{value}\n"),
    "betaflight": (".txt", "set {name} = {value:.0f}\n"),
}
"""Ending and line of a file of parameters."""


class Used(NamedTuple):
    """A number that the gains rest on, with its 95 % interval and where it comes from."""

    name: str
    unit: str
    value: float
    low: float
    high: float
    source: str


@dataclass(frozen=True, repr=False)
class Gains(Reported):
    """Proposed gains.

    Attributes:
        result: of the form ``quadid.gains/1``.
        loops: the loops with the proposed gains, by axis.
        before: those with the gains flown so far, where they are known.
    """

    endings = (".gains.*",)
    rows = "gains"
    result: dict[str, Any]
    loops: Mapping[str, Loops]
    before: Mapping[str, Loops]

    @property
    def values(self) -> dict[str, float]:
        """Parameters of the autopilot by name."""
        return {g["name"]: g["value"] for g in self.result["gains"]}

    @property
    def verdict(self) -> Verdict:
        """Promises over the intervals, and their limits."""
        axes = self.result["axes"]
        least = min(a["rate"]["phase_margin_least"] for a in axes)
        bands = ", ".join(f"{a['axis']} {a['rate']['bandwidth']:.2g} Hz" for a in axes)
        limits = ", ".join(f"{a['axis']} by {a['limited_by']} ({a['largest_bandwidth']:.2g} Hz)" for a in axes)
        step = "Propellers off: check signs. Then set the gains by hand, rates before attitude, and take off with care."
        return Verdict(
            "fair" if self.warnings else "good",
            f"Rate loops of {bands}, with at least {least:.0f} degrees of phase margin over the intervals",
            (f"The bandwidth is limited: {limits}.",),
            (step,),
        )

    def tables(self) -> list[TextTable]:
        """Gains, loops before and after, and what they rest on."""
        columns = heads("parameter | proposed > | now > | what <1")
        rows = tuple(
            (g["name"], number(g["value"], 4), number(g["current"], 4), f"{g['axis']} {g['term']}")
            for g in self.result["gains"]
        )
        chosen = TextTable(f"Gains for {self.result['program']}", columns, rows)
        # Promises of every loop, and the basis of the gains.
        loops = []
        for a in self.result["axes"]:
            for when, part in (("", a), (", now", a["before"])):
                for loop in ("rate", "attitude"):
                    if found := part and part[loop]:
                        top = found["overshoot"]
                        each = (f"{found[key]:.0f}, least {found[f'{key}_least']:.0f}" for key in _MARGINS)
                        loops.append(
                            (
                                f"{a['axis']} {loop}{when}",
                                number(found["bandwidth"], 3),
                                " .. ".join(number(v, 3) for v in found["bandwidth_range"]),
                                *each,
                                f"{100.0 * top:.0f} %" if math.isfinite(top) else "unstable",
                            )
                        )
        promised = heads(
            "loop | bandwidth [Hz] > | over the intervals >1 | phase margin [deg] > | gain margin [dB] >2 | overshoot >"
        )
        used = tuple(
            (u["name"], f"{number(u['value'])} {u['unit']}", " .. ".join(map(number, u["ci95"])), u["source"])
            for u in self.result["used"]
        )
        return [
            chosen,
            TextTable("Loops, and the least margins over the 95 % intervals", promised, tuple(loops)),
            TextTable("What they rest on", heads("number | value > | 95 % interval > | from <1"), used),
        ]

    def save(self, folder: str | Path = ".") -> Path:
        """Writes the proposed parameters in the autopilot's own form, into a folder or a file; returns the path."""
        ending, line = _FILES[self.result["format"]]
        text = "".join(line.format(**g) for g in self.result["gains"])
        return write_texts(folder, {f"{file_name(self.result['vehicle'])}.gains{ending}": text})[0]

    def write(self, folder: Path, kept: str | None = None) -> list[tuple[str, Path]]:
        """Writes the proposed parameters, as `save`."""
        path = self.save(folder)
        self.result["file"] = str(path)
        return [("Written", path)]

    def page(self, command: str = LIBRARY) -> str:
        """The page: gains, step responses with bands before and after, what limits the bandwidth."""
        result, (chosen, loops, used) = self.result, self.tables()
        steps = [self.step_figure(axis, angle) for axis in AXES for angle in (False, True)]
        taken = tuple(
            (a["axis"], number(a["at"], 3), *(f"{v:.0f}" for v in a["phase_taken"].values())) for a in result["axes"]
        )
        columns = heads(" | ".join(("axis", "at [Hz]", *result["axes"][0]["phase_taken"])))
        phases = TextTable("Phase that each part takes where the fastest loop crosses 0 dB [deg]", columns, taken)
        sections = [
            section("gains", "Gains", chosen.title, tables=[chosen.part()]),
            section("loops", "Loops", loops.title, steps, [loops.part()]),
            section("limits", "What limits the bandwidth", phases.title, tables=[phases.part()]),
            section("used", "What they rest on", "", tables=[used.part()]),
        ]
        subtitle = f"{result['program']}, phase margin {result['phase_margin']:g} degrees; nothing was sent"
        return self.rendered(f"Gains for {result['vehicle']}", subtitle, sections, provenance([], command))

    def step_figure(self, axis: str, angle: bool) -> JsonDict:
        """Response of an axis to a unit step of its rate or `angle`, with its band over the intervals."""
        data, what = [], "attitude" if angle else "rate"
        for role, label, known in (("before", "now", self.before), ("after", "proposed", self.loops)):
            loops = known.get(axis)
            if loops is not None and loops.stable and not (angle and loops.attitude == 0.0):
                t, y = loops.step(angle)
                for edge, values in (("", y[0]), (", least", y.min(axis=0)), (", most", y.max(axis=0))):
                    dash = {"line": {"dash": "dot"}} if edge else {}
                    data.append(trace(role, label + edge, np.asarray(t), np.asarray(values), **dash))
        layout = {"xaxis": axis_of("time (s)"), "yaxis": axis_of(f"{axis} {what} over what is asked for")}
        caption = "dotted: least and most over the 95 % intervals"
        return figure(f"step-{axis}-{what}", f"{axis.capitalize()} {what}", data, layout, 260, caption=caption)


def gains(
    vehicle: Annotated[Described, Typed(str, VEHICLE, ..., Vehicle.named)],
    format: Annotated[str, typer.Option("--format", metavar="F")] = "px4",
    *,
    bandwidth: Annotated[float | None, typer.Option("--bandwidth", metavar="HZ")] = None,
    phase_margin: Annotated[float, typer.Option("--phase-margin", metavar="DEG")] = PHASE_MARGIN,
    derivative: Annotated[bool, typer.Option("--derivative/--no-derivative")] = True,
    motor_lag: Annotated[float | None, typer.Option("--motor-lag", metavar="S")] = None,
    delay: Annotated[float | None, typer.Option("--delay", metavar="S")] = None,
    current: Annotated[
        str | Path | Mapping[str, float] | None, Typed(Path | None, typer.Option("--from", metavar="LOG|PARAMS"))
    ] = None,
    anyway: Annotated[bool, typer.Option("--anyway")] = False,
) -> Gains:
    """Proposes rate and attitude gains from the identified vehicle; nothing is sent to a vehicle.

    The loops keep their margins for every combination of the ends of the 95 % intervals.

    Args:
        vehicle: a fitted file, a shipped name or a `Vehicle`; with `command.max_speed`.
        format: the autopilot whose parameters are proposed: px4, ardupilot or betaflight.
        bandwidth: of the roll and pitch rate loops [Hz], at -3 dB; default the largest that keeps the margin.
        phase_margin: smallest phase margin of the rate loops [deg], 20 to 80.
        derivative: use the D term, which compensates motor lag.
        motor_lag: time constant [s] where the file has none, because the log showed no commands.
        delay: time from command to rotor [s] where the file has none.
        current: log, parameter file or parameters of the autopilot, for its filters, rates and present gains.
        anyway: use guesses of the file as if they had been identified.

    Raises:
        ParameterError: a format, margin, bandwidth or lag that cannot be, or a vehicle that the autopilot cannot fly.
        UnprovenError: thrust, drag or inertia are guesses, or neither lag nor delay is known.
        LogError: `current` holds no parameters of this autopilot.
    """
    if format not in AUTOPILOTS:
        raise ParameterError(f"unknown format '{format}'", ", ".join(AUTOPILOTS), nearest(format, AUTOPILOTS))
    if not 20.0 <= phase_margin <= 80.0:
        raise ParameterError(f"a phase margin of {phase_margin:g} deg", "20 to 80 deg")
    if bandwidth is not None and not 0.0 < bandwidth < math.inf:
        raise ParameterError(f"a bandwidth of {bandwidth:g} Hz", "more than 0 Hz")
    # What the gains rest on: the vehicle, the autopilot's filters and rates, and how late the rotors answer.
    described, autopilot = Vehicle.named(vehicle), AUTOPILOTS[format]
    facts, known = Facts(described, ""), _told(current, autopilot)
    warnings = _check_identified(described, anyway)
    late = _lateness(described, motor_lag, delay)
    at = hover(facts)
    turning = moments(at, autopilot.outputs(facts, known, at))
    inertia = np.diag(facts.inertia)
    most = SHARE * authority(at) / inertia / STEP
    fixed = _on_board(autopilot, known, described)
    sizes = [Used(n, NOMINAL_UNITS[n], facts.value(n), *facts.interval(n), facts.origin(n)) for n in _SIZES]
    used = [*sizes, *late, *fixed.values()]
    # Axis by axis: the fastest loop that keeps its margins, slower where that is wanted, in the autopilot's parameters.
    designed, gain = list[Loops](), dict[str, float]()
    cutoff, per = fixed["derivative filter"].value, turning / inertia  # angular acceleration of one unit of output
    for k, axis in enumerate(AXES):
        plant = _plant(facts, k, late, fixed)
        try:
            best = design(plant, phase_margin, float(most[k]), cutoff, derivative, autopilot.on_error)
            wanted = bandwidth if k < 2 or bandwidth is None else min(bandwidth, float(best.bandwidth()[0]))
            found = best if wanted is None else slowed(best, wanted, phase_margin, derivative)
        except ParameterError as error:
            # Remedies for a loop that is too slow
            hz = 1.0 / (2.0 * math.pi * max(float(plant.delay[0] + plant.lag[0]), 1e-3))
            phases = plant.phases(hz, with_rate(plant, 1.0, math.inf, False))
            largest = max(("delay", "motor lag", "gyro filter"), key=lambda name: phases[name])
            raise ParameterError(
                f"{axis}: {error.found}",
                error.allowed,
                f"ask for less, for a smaller margin than {phase_margin:g} deg, or for less {largest}",
            ) from error
        designed.append(best)
        for name, value in zip(autopilot.names[k], _parameters(found, per[k], autopilot), strict=True):
            gain[name] = min(gain.get(name, math.inf), value)  # one that axes share is that of the slowest
    gain[""] = 0.0  # there is no such loop
    loops, before, axes, chosen = {}, {}, [], dict[str, JsonDict]()
    for k, (axis, names, best) in enumerate(zip(AXES, autopilot.names, designed, strict=True)):
        loops[axis] = _loops(best.plant, [gain[name] for name in names], per[k], autopilot, cutoff)
        now = [known.get(name) for name in names]
        if None not in now[:3]:
            before[axis] = _loops(best.plant, [v or 0.0 for v in now], per[k], autopilot, cutoff)
        crossover = float(best.margins().crossover[0])
        phases = best.plant.phases(crossover, best.rate)
        held = bool(best.rate.p >= 0.999 * most[k])
        axes.append(
            {
                "axis": axis,
                **_promises(loops[axis]),
                "before": _promises(before[axis]) if axis in before else None,
                "largest_bandwidth": float(best.bandwidth()[0]),
                "limited_by": "moment of the rotors" if held else max(phases, key=lambda name: phases[name]),
                "phase_taken": phases,
                "at": crossover,
            }
        )
        for term, n, old in zip(("P", "I", "D", "attitude"), names, now, strict=True):
            if n:
                chosen.setdefault(n, {"name": n, "axis": axis, "term": term, "value": gain[n], "current": old})
    result = {
        "schema": "quadid.gains/1",
        "vehicle": described.name,
        "format": format,
        "program": autopilot.program,
        "phase_margin": phase_margin,
        "bandwidth": bandwidth,
        "axes": axes,
        "file": None,
        "gains": list(chosen.values()),
        "used": [
            {"name": name, "unit": unit, "value": value, "ci95": [low, high], "source": source}
            for name, unit, value, low, high, source in used
        ],
        "warnings": warnings + [f"{a}: the present gains are unstable" for a, b in before.items() if not b.stable],
    }
    return Gains(result, loops, before)


def _check_identified(vehicle: Vehicle, anyway: bool) -> list[str]:
    """Raises UnprovenError where a parameter that sets a gain was not identified; with `anyway` warns."""
    guessed = [n for n in _SIZES if vehicle.parameters[n].sigma is None]
    lacking = f"{', '.join(guessed)}: not identified, guesses of the vehicle file without a sigma" if guessed else ""
    if vehicle.proof is not None and vehicle.proof.lacking:
        lacking = "; ".join(filter(None, (lacking, f"not proven: {vehicle.proof.lacking}")))
    if lacking and not anyway:
        raise UnprovenError(
            f"{vehicle.name}: {lacking}",
            "a fitted vehicle file that predicts an unseen flight",
            "`quadid diagnose LOG --validate OTHER`; insist with --anyway",
        )
    return [lacking] if lacking else []


def _lateness(vehicle: Vehicle, motor_lag: float | None, delay: float | None) -> list[Used]:
    """Motor lag and delay of the command; raises UnprovenError where nothing is known of either."""
    lag, wait = vehicle.effects.get("motor_lag", {}), vehicle.effects.get("command_delay", {})
    if not lag and not wait and motor_lag is None and delay is None:
        why = " (rotor columns are readings, which show no command)" * (vehicle.command.sampling == "instant")
        raise UnprovenError(
            f"{vehicle.name}: neither motor_lag nor command_delay is in the file: not identified{why}",
            "one of them: they limit every loop",
            "`quadid diagnose` on a log with motor commands, or give --motor-lag and --delay",
        )
    tau = max(lag.get("tau", 0.0), lag.get("tau_down", 0.0))
    out = []
    for name, given, held, stated in (
        ("motor lag", motor_lag, tau, bool(lag)),
        ("command delay", delay, wait.get("delay", 0.0), bool(wait)),
    ):
        value = held if given is None else given
        if not 0.0 <= value <= 1.0:
            raise ParameterError(f"{name} {value:g} s", "0 to 1 s")
        source = "given" if given is not None else "vehicle file" if stated else "not found beside the other"
        spread = f"; the file holds no interval, {UNSTATED:.0%} each way assumed" if stated and given is None else ""
        out.append(Used(name, "s", value, value * (1.0 - UNSTATED), value * (1.0 + UNSTATED), source + spread))
    return out


def _on_board(autopilot: Autopilot, known: Mapping[str, float], vehicle: Vehicle) -> dict[str, Used]:
    """Filters and period of the autopilot's loop: as given, as the vehicle file has it, or its defaults."""
    out = dict[str, Used]()
    parts = {
        "gyro filter": autopilot.gyro,
        "derivative filter": autopilot.derivative,
        "loop rate": autopilot.rate,
        "yaw error filter": autopilot.yaw_error,
        "target filter": autopilot.target,
    }
    held = vehicle.effects.get("imu_lag", {}).get("cutoff")
    for name, (parameter, default) in parts.items():
        value, source = known.get(parameter, default), parameter if parameter in known else f"default of {parameter}"
        if name == "gyro filter" and held is not None and parameter not in known:
            value, source = held, "imu_lag of the vehicle file"
        value = value if value > 0.0 else math.inf  # 0 turns a filter off
        out |= {name: Used(name, "Hz", value, value, value, source)} if parameter else {}
    return out


def _plant(facts: Facts, axis: int, late: list[Used], fixed: Mapping[str, Used]) -> AxisPlant:
    """The axis as identified, and with every combination of the ends of the intervals.

    About hover b (w_h - w_0) is the root of b times the load, so thrust goes with the root of b, drag torque with
    d over that root; errors of the parameters are taken as independent.
    """
    relative = {n: (facts.vehicle.parameters[n].sigma or 0.0) / facts.value(n) for n in _SIZES}
    spread = math.hypot(0.5 * relative["b"], relative[INERTIAS[axis]], relative["d"] * (axis == 2))
    ends = (math.exp(-Z95 * spread), math.exp(Z95 * spread))
    corners = [*itertools.product(ends, *((u.low, u.high) for u in late))]
    gain, lag, wait = np.array([(1.0, late[0].value, late[1].value), *corners]).T
    held = 0.5 / fixed["loop rate"].value
    lead = 0.0
    if axis == 2 and "rotor_spin_up" in facts.vehicle.effects:
        lead = facts.effect("rotor_spin_up", "J") / (2.0 * facts.value("d") * facts.hover_speed)
    error = fixed["yaw error filter"].value if axis == 2 and "yaw error filter" in fixed else math.inf
    target = fixed["target filter"].value if "target filter" in fixed else math.inf
    # Drag of hubs as they turn with the vehicle, and damping beside it, as far as the file has them.
    x, y, _ = np.square(facts.arms.T).mean(axis=1)
    drag, inflow = (facts.effect("rotor_drag", k) for k in ("k_x", "k_y")), facts.effect("axial_inflow", "k_z")
    hubs = (y * inflow, x * inflow, float(np.dot((y, x), (*drag,))))[axis]
    damping = facts.vehicle.mass * hubs / facts.inertia[axis][axis]
    damping += facts.effect("rate_damping", ("l_p", "m_q", "n_r")[axis])
    return AxisPlant(gain, lag, wait + held, lead, fixed["gyro filter"].value, error, target, damping)


def _parameters(loops: Loops, per: float, autopilot: Autopilot) -> list[float]:
    """P, I, D and attitude gain in the autopilot's unit, as it stores them or to three digits."""
    wanted = (*(g / per for g in loops.rate[:3]), loops.attitude)
    scaled = [value / unit for value, unit in zip(wanted, autopilot.units, strict=True)]
    if autopilot.digits is not None:
        return [round(v, autopilot.digits) for v in scaled]
    return [float(f"{v:.3g}") for v in scaled]


def _loops(plant: AxisPlant, values: list[float], per: float, autopilot: Autopilot, cutoff: float) -> Loops:
    """The loops that these parameters of the autopilot make."""
    p, i, d = (v * unit * per for v, unit in zip(values[:3], autopilot.units[:3], strict=True))
    return Loops(plant, RateGains(p, i, d, cutoff), values[3] * autopilot.units[3], autopilot.on_error)


def _promises(loops: Loops) -> Json:
    """Bandwidth, margins and overshoot of the rate loop and of the attitude loop."""
    out: dict[str, Any] = {}
    for name, angle in (("rate", False), ("attitude", True)):
        if angle and loops.attitude == 0.0:
            out[name] = None
            continue
        m, band = loops.margins(angle), loops.bandwidth(angle)
        top = loops.step(angle)[1].max(axis=1) - 1.0 if loops.stable else np.full(len(band), np.inf)
        out[name] = {
            "bandwidth": float(band[0]),
            "bandwidth_range": [float(band.min()), float(band.max())],
            "phase_margin": float(m.phase[0]),
            "phase_margin_least": float(m.phase.min()),
            "gain_margin": float(m.gain[0]),
            "gain_margin_least": float(m.gain.min()),
            "overshoot": max(float(top[0]), 0.0),
            "overshoot_most": max(float(top.max()), 0.0),
        }
    return out


def _told(current: str | Path | Mapping[str, float] | None, autopilot: Autopilot) -> dict[str, float]:
    """Parameters of an autopilot, from a log, a parameter file or as given; raises LogError where none is its."""
    if current is None:
        return {}
    if isinstance(current, Mapping):
        return dict(current)
    path = Path(current)
    wanted = {name for names in autopilot.names for name in names if name}
    head = read_regular(path, 1 << 22) if path.is_file() and path.stat().st_size < 1 << 22 else b""
    found = {}
    if b"\0" not in head:
        text = head.decode("utf-8", "replace")
        found = {m[1]: float(m[2]) for m in _LINE.finditer(text)}
    if not wanted & set(found):
        found = dict(open_log(path).autopilot)
    if not wanted & set(found):
        raise LogError(
            f"{path.name}: no rate gains of {autopilot.program}",
            f"parameters such as {autopilot.names[0][0]}",
            "a log or parameter file of this autopilot, or leave --from out",
        )
    return found
