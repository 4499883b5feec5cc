"""Health: what changed in a vehicle since the baseline flights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from quadid_replay import open_log

from quadid.app.logs import Flight, Given, Log, check_conventions, listed, parse_part, vehicle_of
from quadid.app.options import LogNames, OfVehicle, Preset, Typed, Unchecked
from quadid.app.outcome import LIBRARY, NUMBER_COLUMNS, Reported, number_rows, provenance
from quadid.data.window import Recording
from quadid.errors import LogError, NotIdentifiableError
from quadid.report.page import axis, figure, rows_of, section, trace
from quadid.report.tables import Cell, TextTable, heads
from quadid.report.templating import render
from quadid.report.verdict import Verdict
from quadid.types import Json
from quadid.vehicle import Vehicle

if TYPE_CHECKING:
    from quadid.condition.changes import Health

LEAST_THRUST = 0.25
"""No vehicle flies on less of its baseline's thrust per command, whatever it dropped and however new its propellers."""


@dataclass(frozen=True, repr=False)
class HealthOutcome(Reported):
    """Changes.

    Attributes:
        result: of the form ``quadid.health/1``.
        recordings: the logs as read, those in question first.
    """

    title = "Health"
    columns = (*NUMBER_COLUMNS, "p_value")
    result: dict[str, Any]
    found: Health
    vehicle: Vehicle
    recordings: tuple[Recording, ...]

    @property
    def verdict(self) -> Verdict:
        """Healthy or changed, and what to do."""
        return health_verdict(self.result)

    def tables(self) -> list[TextTable]:
        """Changes, and each trim against the baseline."""
        rows: list[tuple[str | Cell, ...]] = []
        for c in self.result["changes"]:
            weak = f"weak rotor {_which(c)}" if c["effect"] == "weak_rotor" else c["effect"].replace("_", " ")
            rival = rival_words(c["alternatives"][0]) if c["alternatives"] else ""
            name, judged = Cell(weak, "poor" if c["confident"] else "fair"), (c["p_value"], c["probability"])
            for i, p in enumerate(p for p in c["parameters"] if p["name"] not in ("rotor", "or_rotor")):
                low, high = p["ci95"]
                row = (f"{p['name']} = {p['value']:.3g} {p['unit']}".rstrip(), f"{low:.3g} .. {high:.3g}")
                more = (f"{judged[0]:.1g}", f"{judged[1]:.2f}", rival) if i == 0 else ("", "", "")
                rows.append((name if i == 0 else "", *row, *more))
        columns = heads("change | value | 95 % interval | p >1 | probability >2 | rejected alternative <3")
        changes = TextTable("What changed since the baseline flights", columns, tuple(rows))
        return [*([changes] if rows else []), trim_table(self.result)]

    def records(self) -> list[dict[str, Any]]:
        """One row a number of a change."""
        return number_rows(self.result["changes"], self.columns)

    def page(self, command: str = LIBRARY) -> str:
        """The page: what changed, a picture of the airframe, how far each flight is from healthy ones."""
        from quadid.condition.changes import distance
        from quadid.condition.trim import AXES

        result, found, healthy = self.result, self.found, self.found.healthy
        now = np.mean([flight.shares for flight in found.flights], axis=0)
        marked = result["changes"] if found.verdict == "changed" else ()
        picture = airframe_picture(self.vehicle, now.tolist(), healthy.shares.tolist(), marked)
        caption = (
            "From above, nose up. Dashed: the command of each rotor in the baseline flights. Filled, with its change: "
            "now. Red: damaged; yellow: suspected."
        )
        rows = []
        for c in result["changes"]:
            found_by = c["evidence"] + ("" if c["confident"] else " Not certain.")
            rows.append((change_words(c), found_by, ", ".join(map(rival_words, c["alternatives"])) or "none"))
        changes = [rows_of(("Change", "Found", "Rejected alternatives (probability)"), rows)] if rows else []
        intro = _INTROS["lacking" if result["baseline_lacking"] or result["unfamiliar"] else result["verdict"]]
        # Every flight's trims in healthy spreads from the baseline's mean, those of one kind beside each other.
        flown, ticks = [], np.arange(len(AXES))
        for role, label, part in (("measured", "baseline", found.baseline), ("after", "now", found.flights)):
            far = [distance(one.mean - healthy.mean, healthy.predictive(1), healthy.freedom) for one in part]
            aside = 0.06 * (np.arange(len(part)) - 0.5 * (len(part) - 1))
            x, names = (ticks[:, None] + aside).ravel(), [one.name for one in part]
            flown.append(trace(role, label, x, np.array(far).T.ravel(), mode="markers", text=names * len(AXES)))
        axes = {"xaxis": {"tickvals": ticks.tolist(), "ticktext": list(AXES)}, "yaxis": axis("healthy spreads")}
        spread = figure("trims", "Every flight", flown, axes, 300, caption="distance from the baseline's mean")
        trims = trim_table(result)
        sections = [
            section("airframe", "Airframe", caption, picture=picture),
            section("changes", "What changed", intro, tables=changes),
            section("trim", "Trim", trims.title, [spread], [trims.part()]),
        ]
        origin = provenance([], command)
        origin += [{"name": r.name, "value": f"sha256 {r.sha256 or 'unknown'}"} for r in self.recordings]
        n, m = len(result["logs"]), len(result["baseline"])
        subtitle = f"{n} flight{'s' * (n != 1)} against {m} baseline flight{'s' * (m != 1)}"
        return self.rendered(f"Health of {result['vehicle']}", subtitle, sections, origin)


def health(
    logs: LogNames,
    baseline: Annotated[Given, Typed(list[str], typer.Option(metavar="LOG"), ...)],
    *,
    vehicle: OfVehicle = None,
    preset: Preset = "auto",
    unchecked: Unchecked = False,
) -> HealthOutcome:
    """Compares flights with healthy flights of the same vehicle: which rotor, mass, centre of gravity, thrust.

    Works on gentle flights: hover for 5 s or more between take-off and landing.  All baseline flights share one healthy
    vehicle, all `logs` one that may have changed; how far healthy flights differ is estimated from the baseline.

    Args:
        logs: a flight or several in question, as paths or from `load`.
        baseline: a healthy flight of this vehicle or, much better, several.
        vehicle: a shipped name, a YAML file or a `Vehicle`; geometry counts, its parameters may be poorly known;
            default that of the first loaded log.
        preset: topic names of ROS logs.
        unchecked: use logs even when their units, frames or motors look wrong.

    Raises:
        LogError: no log, one that cannot be read, or a flight that is given twice.
        NotIdentifiableError: too little steady flight.
    """
    from quadid.condition.changes import assess
    from quadid.condition.trim import flight_trim

    tested, healthy = listed(logs), listed(baseline)
    if not tested or not healthy:
        missing = "flight in question" if not tested else "baseline flight"
        raise LogError(f"no {missing}", "one log or more of each", "name healthy flights with --baseline")
    described = vehicle_of([*tested, *healthy], vehicle)
    warnings: list[str] = []
    opened = [[_open(one, described, preset, unchecked, warnings) for one in part] for part in (tested, healthy)]
    _distinct(*opened)
    trims = [[flight_trim(recording, described) for recording in part] for part in opened]
    usual = sum(one.mean[-1] for one in trims[1]) / len(trims[1])
    for trim in trims[0]:
        if (share := math.exp(trim.mean[-1] - usual)) < LEAST_THRUST:
            raise NotIdentifiableError(
                f"{trim.name}: the rotors give {100.0 * share:.0f} % of the thrust of the baseline flights: "
                "not a flight",
                "flights",
                "use a flight; a hover is enough",
            )
    found = assess(trims[0], trims[1], described)
    if len(trims[1]) < 3:
        warnings.append(
            f"{len(trims[1])} baseline flight{'s' * (len(trims[1]) > 1)}: the spread of healthy flights is mostly "
            "assumed; use five or more, with several batteries"
        )
    result = found.to_dict()
    result["vehicle"] = described.name
    result["logs"], result["baseline"] = ([recording.name for recording in part] for part in opened)
    result["warnings"] = warnings
    return HealthOutcome(result, found, described, tuple(opened[0] + opened[1]))


def _open(given: Flight, vehicle: Vehicle, preset: str, unchecked: bool, warnings: list[str]) -> Recording:
    """The recording, cut to the part that is used; adds what looks wrong to `warnings`."""
    if isinstance(given, Log):
        recording, cut = given.recording, given.cut
    else:
        cut = parse_part(str(given))
        recording = open_log(cut.path, preset, vehicle.columns)
    doubts = () if unchecked or not cut.checked else check_conventions(recording, vehicle, cut).doubts
    warnings += [f"{recording.name}: {text}" for text in (*recording.warnings, *doubts)]
    return cut.of(recording)


def _distinct(tested: Sequence[Recording], healthy: Sequence[Recording]) -> None:
    """Raises LogError where a flight counts twice: it would be compared with itself, or narrow the spread."""
    placed = [("in question", one) for one in tested] + [("in the baseline", one) for one in healthy]
    for (before, other), (place, one) in combinations(placed, 2):
        shared = one.span[0] < other.span[1] and other.span[0] < one.span[1]  # parts of a log may be apart
        if one.sha256 and one.sha256 == other.sha256 and shared:
            copy = "is" if one.name == other.name else f"holds the bytes of {other.name}: the flight is"
            where = f"twice {place}" if place == before else f"{before} and {place}"
            raise LogError(f"{one.name} {copy} {where}", "each flight once", "leave one of the two out")


# --- Health for people: verdict, tables, and the page with a picture of the airframe


_WORDS = {
    "mass_change": "mass",
    "cg_offset": "centre of gravity",
    "thrust_drop": "thrust of all rotors",
    "weak_rotor": "rotor",
}
_LARGE = 0.2
"""Change of effort (log of command per force) from which the flights may be of two vehicles."""
_ONE_VEHICLE = "Check that all flights are of one vehicle, and their motors logged in one way."
_INTROS = {
    "changed": "",
    "unknown": "Nothing that has a name.",
    "lacking": "Not known. If anything:",
    "unchanged": "Nothing beyond what healthy flights differ by. If anything:",
}
_STEPS = {
    "weak_rotor": "Look at the propeller (cuts, tape, loose on its shaft) and the motor of rotor {rotor}; "
    "exchange the propeller and fly again.",
    "mass_change": "Look for what was added or removed; if it is meant to be there, make new baseline flights.",
    "cg_offset": "Check that the battery sits where it did, and what hangs on the arms.",
    "thrust_drop": "Check the battery (age, charge) and all propellers.",
}


def _which(change: Json) -> str:
    """The weak rotor, and the one on its axis where the data do not tell which: ``2 or 6``."""
    return " or ".join(str(int(p["value"])) for p in change["parameters"] if p["name"] in ("rotor", "or_rotor"))


def change_words(change: Json) -> str:
    """A change in a few words: ``rotor 3: 21 % less thrust``."""
    effect = change["effect"]
    if effect == "weak_rotor":
        return f"rotor {_which(change)}: {100.0 * change_value(change, 'loss'):.0f} % less thrust"
    if effect == "cg_offset":
        x, y = (1e3 * change_value(change, axis) for axis in "xy")
        along, across = "forward" if x > 0.0 else "backward", "right" if y > 0.0 else "left"
        return f"centre of gravity moved {abs(x):.1f} mm {along} and {abs(y):.1f} mm to the {across}"
    fraction = 100.0 * change_value(change, "fraction")
    return (
        f"{_WORDS[effect]}: {fraction:+.0f} %" if effect == "mass_change" else f"{_WORDS[effect]}: {-fraction:+.0f} %"
    )


def has_changed(result: Json) -> bool:
    """Checks whether a result of the form ``quadid.health/1`` shows a change, be it one without a name."""
    return result["verdict"] != "unchanged" and not result["baseline_lacking"] and not result["unfamiliar"]


def rival_words(rival: Json) -> str:
    """An explanation that lost, with its probability: ``rotor 3 and 4 (0.08)``."""
    names = " and ".join(_WORDS[effect] for effect in (rival["effect"], *rival.get("with", ())))
    rotors = " and ".join(map(str, rival.get("rotors", ())))
    return f"{names} {rotors}".rstrip() + f" ({rival['probability']:.2f})"


def health_verdict(result: Json) -> Verdict:
    """Judges a result of the form ``quadid.health/1``."""
    from quadid.condition.changes import LEAST_CHANCE

    verdict, changes = result["verdict"], result["changes"]
    n = len(result["baseline"])
    against = f"{n} baseline flight{'s' * (n != 1)}, score {result['score']:.1f}"
    # At the least chance the bound that 95 % of draws without one keep to (rule of three).
    p_value, once = result["p_value"], f"less than once in {1.0 / (3.0 * LEAST_CHANCE):,.0f} flights"
    if p_value > LEAST_CHANCE:
        once = f"about once in {float(f'{1.0 / p_value:.2g}'):,.0f} flights" if p_value < 0.5 else "in most flights"
    details = [f"A healthy flight would look this different {once} ({against})."]
    suspects = ", ".join(change_words(c) for c in changes)
    if reason := result["unfamiliar"]:
        likely = [f"If anything, {suspects}."] if suspects else []
        headline = "Not known: no baseline flight is of this kind."
        step = "Compare a hover with hovers, or record healthy flights of this kind for the baseline."
        return Verdict("fair", headline, (f"{reason[:1].upper()}{reason[1:]}.", *likely, *details), (step,))
    if more := result["baseline_lacking"]:
        flights = "baseline flight does" if n == 1 else "baseline flights do"
        headline = f"{n} {flights} not show whether the vehicle has changed."
        details += [f"With {more} more, spread like these, it would be a change{f': {suspects}' if suspects else ''}."]
        step = f"Record {more} healthy flight{'s' * (more != 1)} or more, and compare again."
        return Verdict("fair", headline, tuple(details), (*_first(result), step))
    if verdict == "unchanged":
        details += [f"If anything, {suspects}; that is within the spread of healthy flights."] if suspects else []
        return Verdict("good", "The vehicle flies as it did in the baseline flights.", tuple(details), ())
    if verdict == "unknown":
        checks = (_ONE_VEHICLE, "Look the vehicle over; compare with `quadid diagnose`, which fits the motion.")
        return Verdict("poor", "The vehicle has changed, by nothing that has a name here.", tuple(details), checks)
    sure = [c for c in changes if c["confident"]] or changes[:1]
    rest = [c for c in changes if c not in sure]
    headline = f"The vehicle has changed: {'; '.join(change_words(c) for c in sure)}."
    if not changes[0]["confident"]:
        details.append("Other explanations are nearly as probable, see below.")
    details += [f"Less certain: {'; '.join(change_words(c) for c in rest)}."] if rest else []
    steps = dict.fromkeys([*_first(result), *(_STEPS[c["effect"]].format(rotor=_which(c)) for c in sure)])
    return Verdict("poor", headline, tuple(details), tuple(steps))


def _first(result: Json) -> tuple[str, ...]:
    """First checks where the change is as large as between two vehicles."""
    (effort,) = (t["value"] - t["baseline"] for t in result["trim"] if t["name"] == "effort")
    return (_ONE_VEHICLE,) if abs(effort) > _LARGE else ()


def trim_table(result: Json) -> TextTable:
    """Each trim of the flights in question against the baseline."""
    columns = heads("trim | now > | baseline > | spread >1 | distance >")
    rows = tuple(
        (
            t["name"],
            f"{t['value']:.4f}",
            f"{t['baseline']:.4f}",
            f"{t['spread']:.4f}",
            Cell(f"{t['distance']:+.1f}", "poor" if abs(t["distance"]) > 3.0 else ""),
        )
        for t in result["trim"]
    )
    title = (
        "Trim, how the rotors share the work in steady flight: roll (left more than right), pitch (front more than "
        "back) and yaw (one direction of spin more than the other) as parts of all command; effort, the logarithm of "
        "command per force, from the baseline; distance in spreads (standard deviations) of healthy flights"
    )
    return TextTable(title, columns, rows)


# --- The airframe from above as inline SVG: every rotor with its load against the baseline, damage and shift marked


_SIZE, _MARGIN = 420, 92
_DISC, _LARGEST = 44, 30
"""Radius of a rotor's disc, and how far it may grow and shrink with its load [pixels]."""
_SHIFT = 6.0
"""A shift of the CG is drawn this many times its size."""


def airframe_picture(
    vehicle: Vehicle, load: Sequence[float], baseline: Sequence[float], changes: Sequence[Json]
) -> str:
    """SVG of the airframe, nose up.

    Args:
        load: each rotor's share of the commanded load in the flights in question.
        baseline: the same of healthy flights.
        changes: entries of ``quadid.health/1``.
    """
    scale = (0.5 * _SIZE - _MARGIN) / max(abs(c) for r in vehicle.rotors for c in r.position[:2])

    def place(ahead: float, right: float) -> dict[str, Any]:
        return {"x": round(0.5 * _SIZE + scale * right), "y": round(0.5 * _SIZE - scale * ahead)}

    weak = {int(change_value(c, "rotor")) - 1: c for c in changes if c["effect"] == "weak_rotor"}
    rotors = []
    for j, rotor in enumerate(vehicle.rotors):
        at, more = place(*rotor.position[:2]), 100.0 * (load[j] / baseline[j] - 1.0)
        at |= {"kind": "", "radius": _DISC + round(max(-_LARGEST, min(_LARGEST, more)), 1), "loss": ""}
        at["load"] = f"{more:+.1f} %".replace("-", "−")
        if (found := weak.get(j)) is not None:
            low, high = next(p["ci95"] for p in found["parameters"] if p["name"] == "loss")
            words = f"loss {100.0 * change_value(found, 'loss'):.0f} % ({100.0 * low:.0f} … {100.0 * high:.0f})"
            at |= {"kind": " damaged" if found["confident"] else " suspect", "loss": words.replace("-", "−")}
            at["below"] = at["y"] + (_DISC + _LARGEST + 12 if at["y"] > _SIZE / 2 else -_DISC - _LARGEST - 2)
        rotors.append(at)
    shift: dict[str, Any] = {}
    for change in changes:
        if change["effect"] == "cg_offset":
            ahead, right = (change_value(change, axis) for axis in "xy")
            shift = {**place(_SHIFT * ahead, _SHIFT * right), "words": f"CG {1e3 * math.hypot(ahead, right):.1f} mm"}
    return render("airframe.svg", {"size": _SIZE, "disc": _DISC, "rotors": rotors, "shift": shift})


def change_value(change: Json, name: str) -> float:
    """A number of a change."""
    return float(next(p["value"] for p in change["parameters"] if p["name"] == name))
