"""Numbers beside their truth: of the sets of `make foreign`, of RotorPy's flights and of the independent cases."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quadid.diagnosis import diagnose
from quadid.parameters import Parameter, Status
from quadid.vehicle import Vehicle
from quadid_evaluation.studies.cases import FOLDERS, windows
from quadid_evaluation.studies.foreign.sets import FlightSet
from quadid_evaluation.studies.rotorpy_flight import fly, hummingbird

ROTORPY_SECONDS = 30.0
ROTORPY_NAMES = {"b": "k_eta", "d": "k_m", "J_xx": "Ixx", "J_yy": "Iyy", "J_zz": "Izz"}


@dataclass(frozen=True)
class Number:
    """One parameter beside what it is.

    Attributes:
        data: set, flight or case; by: command.
        name: of the parameter; status: as the command gives it; value: its estimate.
        interval: 95 %; truth: interval in which the truth lies.
    """

    data: str
    by: str
    name: str
    status: str
    value: float
    interval: tuple[float, float]
    truth: tuple[float, float]

    @property
    def inside(self) -> bool:
        """Whether the interval holds the truth, or part of what is known of it."""
        return self.interval[0] <= self.truth[1] and self.truth[0] <= self.interval[1]

    @property
    def identified(self) -> bool:
        """Whether the number deserves its name, as the command says."""
        return self.status == Status.IDENTIFIED.value


def of_set(name: str, one: FlightSet, answers: Mapping[str, Mapping[str, Any] | None]) -> Iterator[Number]:
    """Numbers of one set whose truth is known; `answers` by command, as JSON results."""
    for by, answer in answers.items():
        found = {f["effect"] for f in (answer or {}).get("findings", [])}
        truth = one.truth | (one.beside_curve if "thrust_curve" in found else {})
        for p in (answer or {}).get("parameters", []):
            if p["name"] in truth:
                low, high = p["ci95"]
                yield Number(name, by, p["name"], p["status"], p["value"], (low, high), truth[p["name"]])


def of_rotorpy() -> Iterator[Number]:
    """RotorPy's Hummingbird with aerodynamics and 45 ms of lag, and without aerodynamics and 5 ms."""
    for name, truth, options in (
        ("RotorPy, aerodynamics, lag 45 ms", hummingbird(tau_m=0.045), {"seed": 1, "reach": 1.4}),
        ("RotorPy, no aerodynamics, lag 5 ms", hummingbird(tau_m=0.005), {"seed": 2, "aero": False}),
    ):
        flight = fly(truth, ROTORPY_SECONDS, **options)  # type: ignore[arg-type]
        found, _ = diagnose([flight.window], flight.vehicle)
        yield from _beside(name, found.parameters, {ours: truth[theirs] for ours, theirs in ROTORPY_NAMES.items()})


def of_cases(data: Path) -> Iterator[Number]:
    """Nominal parameters of the independent cases, diagnosed as `quadid_evaluation.studies.cases` does, the hidden
    effect not told."""
    for folder in FOLDERS:
        for answer in json.loads((data / folder / "answers.json").read_text(encoding="utf-8")):
            place = data / folder / answer["case"]
            vehicle = Vehicle.from_yaml((place / "vehicle.yaml").read_text(encoding="utf-8"))
            train, other = (windows(place / f"{flight}.csv", vehicle) for flight in ("train", "validate"))
            found, _ = diagnose(train, vehicle, other)
            yield from _beside(f"{folder} {answer['case']}", found.parameters, answer["nominal"])


def _beside(data: str, parameters: Iterable[Parameter], truth: Mapping[str, float]) -> Iterator[Number]:
    for p in parameters:
        if p.name in truth:
            both = (truth[p.name], truth[p.name])
            yield Number(data, "diagnose", p.name, p.status.value, p.value, (p.ci95[0], p.ci95[1]), both)


def table(numbers: Sequence[Number], short: Sequence[str] = ("cases", "RotorPy")) -> str:
    """Markdown: the share of identified numbers that hold their truth, by group, and those that do not.

    Data whose name begins with one of `short` are counted by it, all others as recorded vehicles.
    """
    named = [n for n in numbers if n.identified]
    if not named:
        return ""
    held = sum(n.inside for n in named)
    lines = [
        f"Of {len(named)} identified values with known truth, {held} have it inside the 95 % interval "
        f"({held / len(named):.0%}; wanted 90 %): "
        + ", ".join(f"{group} {sum(n.inside for n in mine)} of {len(mine)}" for group, mine in _groups(named, short))
        + ". All values: `foreign.json`.",
        "",
        "| outside | parameter | estimate [95 %] | truth |", "|---|---|---|---|",
    ]  # fmt: skip
    for n in named:
        if n.inside:
            continue
        low, high = n.truth
        truth = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
        off = n.value / min(max(n.value, low), high) - 1.0
        interval = f"{n.value:.3g} [{n.interval[0]:.3g}, {n.interval[1]:.3g}]"
        lines.append(f"| {n.data}, {n.by} | {n.name} | {interval} | {truth}, **{off:+.2%}** |")
    return "\n".join(lines)


def _groups(named: Sequence[Number], short: Sequence[str]) -> Iterator[tuple[str, list[Number]]]:
    """Numbers of the recorded vehicles, and those of each of `short`; empty groups are left out."""
    recorded = [n for n in named if not n.data.startswith(tuple(short))]
    for group, mine in (
        ("recorded vehicles", recorded),
        *((g, [n for n in named if n.data.startswith(g)]) for g in short),
    ):
        if mine:
            yield group, mine
