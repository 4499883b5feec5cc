"""The flights an ablation runs on: hidden effects of the campaign, independent cases, recorded and foreign flights."""

from __future__ import annotations

import json
import os
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import quadid
from quadid.app.logs import load_vehicle
from quadid.data.window import Window
from quadid.vehicle import Vehicle
from quadid_evaluation.studies.campaign import Case, cases, flown
from quadid_evaluation.studies.foreign.sets import SETS, FlightSet

DATA = Path(os.environ.get("QUADID_DATA", "../shared/data"))
SCALED = (
    "single 7000", "single 7006", "single 7008", "single 7009", "null 7000", "pair 7001", "look_alike 7000",
    "look_alike 7003", "outside 7000",
)  # fmt: skip
"""Flights on which numbers are halved and doubled too: one of each kind, which compute fast."""
FLIGHTS = (
    *SCALED, "outside 7002", "outside 7003", "outside 7007", "outside 7012", "outside 7021", "single 1055",
    "single 1083", "single 8005", "look_alike 15", "outside 1029", "clutter 2005", "clutter 2019", "cases case_012",
    "cases_hub case_002", "cases_hub case_006", "iris", "arpl", "sitl square", "brushed rpm", "crazyflie",
)  # fmt: skip
"""What a run takes where nothing else is asked for: besides those, flights that rules were once made for."""
Given = tuple[list[Window], list[Window], Vehicle]
"""Windows to diagnose, windows to measure the gain on, and the vehicle."""


@dataclass(frozen=True)
class Flight:
    """One diagnosis to make.

    Attributes:
        name: of the case or the vehicle.
        case: of the campaign.
        train, held: logs below the data folder, each with `@from:to` where cut; vehicle: its file there.
        hidden: what a case hides; None where nobody knows.
        clutter: what may be named beside it, after it.
        known: what is known of a recorded vehicle.
    """

    name: str
    case: Case | None = None
    train: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    vehicle: str = ""
    hidden: tuple[str, ...] | None = None
    clutter: tuple[str, ...] = ()
    known: FlightSet | None = None


_RECORDED = (
    ("iris", "iris/vehicle.yaml", "pitch_yaw.csv", "sideways.csv"),
    ("sitl square", "ardupilot_sitl/quad_sq.yaml", "quad_sq.bin@20:70", "quad_sq.bin@100:140"),
    ("sitl x", "ardupilot_sitl/sitl_x.yaml", "x.bin@20:100", "x.bin@100:160"),
    ("brushed rpm", "brushed/vehicle.yaml", "jana00.csv", "jana02.csv"),
    ("brushed pwm", "brushed/vehicle_pwm.yaml", "jana00_pwm.csv", "jana02_pwm.csv"),
    ("arpl", "arpl/vehicle.yaml", "log15.csv", ""),
    ("nanobench", "nanobench/vehicle.yaml", "B2_circle_fast_rep1.csv", "B9_trefoil_fast_rep10.csv"),
    ("crazyflie", "crazyflie_rpm/vehicle.yaml", "figure8_22.csv figure8_34.csv", "figure8_30.csv"),
    ("nano-drone", "nanodrone/vehicle.yaml", "random_run1.csv square_run1.csv", "random_run3.csv"),
)
"""Name, vehicle file, logs to diagnose, logs to measure on, in the folder of the vehicle file."""


def _recorded() -> list[Flight]:
    out = []
    for name, vehicle, train, held in _RECORDED:
        folder = vehicle.split("/")[0]
        logs = [tuple(f"{folder}/{log}" for log in names.split()) for names in (train, held)]
        known = next((s for s in SETS.values() if s.vehicle == vehicle and s.truth), None)
        out.append(Flight(name, None, logs[0], logs[1], vehicle, known=known))
    return out


def flights(names: Sequence[str] = FLIGHTS) -> list[Flight]:
    """Flights by name: ``single 7000`` (class and number of the campaign), ``cases case_012``, ``iris``."""
    known = {f.name: f for f in (*_independent("cases"), *_independent("cases_hub"), *_recorded())}
    return [known[name] if name in known else _hidden(name) for name in names]


def _hidden(name: str) -> Flight:
    """A case of the campaign."""
    group, number = name.split()
    (case,) = cases(group, 1, int(number))
    clutter = tuple(case.hidden) if group == "clutter" else ()
    return Flight(name, case, hidden=case.expected, clutter=clutter)


def _independent(folder: str) -> list[Flight]:
    """The cases of an independent simulator in one folder."""
    answers = json.loads((DATA / folder / "answers.json").read_text(encoding="utf-8"))
    return [
        Flight(
            f"{folder} {a['case']}", None, (f"{folder}/{a['case']}/train.csv",),
            (f"{folder}/{a['case']}/validate.csv",), f"{folder}/{a['case']}/vehicle.yaml", tuple(a["effects"]),
            tuple(a["truth"]) if a["kind"] == "clutter" else (),
        )
        for a in answers
    ]  # fmt: skip


def load(flight: Flight, cache: Path | None = None) -> Given:
    """Windows to diagnose, windows to measure the gain on, and the vehicle as guessed.

    Args:
        flight: which.
        cache: folder that keeps flights once flown or read; they do not depend on the diagnosis.
    """
    kept = None if cache is None else cache / f"{flight.name.replace(' ', '-').replace('/', '-')}.pickle"
    if kept is not None and kept.exists():
        train, held, text = pickle.loads(kept.read_bytes())
        return train, held, Vehicle.from_yaml(text)
    if flight.case is not None:
        one, other, vehicle = flown(flight.case)
        train, held = [one], [other]
    else:
        vehicle = load_vehicle(str(DATA / flight.vehicle))
        train, held = _windows(flight.train, vehicle), _windows(flight.held, vehicle)
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_bytes(pickle.dumps((train, held, vehicle.to_yaml())))
    return train, held, vehicle


def _windows(names: Sequence[str], vehicle: Vehicle) -> list[Window]:
    return [w for n in names for w in quadid.load(DATA / n, vehicle).windows]
