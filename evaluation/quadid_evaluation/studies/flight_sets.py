"""The data sets: vehicle file, training and unseen flights, what is known of the truth; answers beside it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import quadid
from quadid.data.window import Window
from quadid.identification.predict import QUANTITIES, no_change, start_errors
from quadid.parameters import Status
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import DATA


@dataclass(frozen=True)
class FlightSet:
    """Flights of one vehicle.

    Attributes:
        vehicle: vehicle file, in the data folder, or a path of its own.
        train, unseen: logs, in the data folder; spans as ``log@start:stop``. `unseen` names other flights, never the
            tail of one that was fitted; without another flight it is empty.  (Iris: two halves of one flight.)
        truth: parameters known from elsewhere, each with the interval [low, high] in which the truth lies, in the units
            of the vehicle file: its mass, and rotor speeds as its command gives them.
        beside_curve: truth of those that mean something else beside a thrust curve.
    """

    vehicle: str
    train: tuple[str, ...]
    unseen: tuple[str, ...]
    truth: dict[str, tuple[float, float]] = field(default_factory=dict)
    source: str = ""
    beside_curve: dict[str, tuple[float, float]] = field(default_factory=dict)

    def windows(self, data: Path = DATA, rate: float | None = 50.0) -> tuple[Vehicle, list[Window], list[Window]]:
        """The vehicle, and windows of the training and of the unseen flights on a grid [Hz]."""
        vehicle = Vehicle.named(data / self.vehicle)
        train, unseen = (
            [w for log in part for w in quadid.load(data / log, vehicle, rate=rate).windows]
            for part in (self.train, self.unseen)
        )
        return vehicle, train, unseen


def _near(value: float, share: float = 0.0) -> tuple[float, float]:
    return value * (1.0 - share), value * (1.0 + share)


_VEHICLES = Path(__file__).parent / "vehicles"
_SQ = {"b": _near(1.983e-5), "J_xx": _near(0.018), "J_yy": _near(0.024), "J_zz": _near(0.036)}
_X = {"J_xx": _near(0.02297), "J_yy": _near(0.02297), "J_zz": _near(0.04594)}
_BRUSHED = {"b": _near(2.02e-8, 0.03), "J_xx": (1.5e-5, 2.3e-5), "J_yy": (1.5e-5, 2.3e-5)}
_NANO = {"b": _near(3.72e-8, 0.03), "J_xx": (2.3e-5, 2.6e-5), "J_yy": (2.3e-5, 2.9e-5)}

_IRIS_B, _IRIS_FULL, _IRIS_IDLE = 5.84e-6, 1.1, 100.0
"""The simulator's rotors turn at pwm - 900 rad/s, those of the vehicle file at 1.1 (pwm - 1000): 1.1 times
as fast less 110 rad/s.  Beside a curve with that dead speed b is 5.84e-6 / 1.21; without one the thrust in the flown
range counts."""
_IRIS_FLOWN = (1546.0, 1861.0)
"""PWM of the rotors, 1st and 99th percentile of both halves."""
_IRIS_MASS = 1.5 / 1.535
"""Mass of the vehicle file over that of the simulator: thrust and inertias scale with the mass that is believed."""


def _iris_secant(pwm: float) -> float:
    return _IRIS_B * ((pwm - 1000.0 + _IRIS_IDLE) / (_IRIS_FULL * (pwm - 1000.0))) ** 2


_IRIS = {
    "b": (_IRIS_MASS * _iris_secant(_IRIS_FLOWN[1]), _iris_secant(_IRIS_FLOWN[0])),
    **{n: (_IRIS_MASS * v, v) for n, v in (("J_xx", 0.029125), ("J_yy", 0.029125), ("J_zz", 0.055225))},
}
_IRIS_CURVE = {"b": (_IRIS_MASS * _IRIS_B / _IRIS_FULL**2, _IRIS_B / _IRIS_FULL**2)}

SETS: dict[str, FlightSet] = {
    "iris": FlightSet(
        "iris/vehicle.yaml", ("iris/sideways.csv",), ("iris/pitch_yaw.csv",), _IRIS, "the simulator's own file",
        _IRIS_CURVE,
    ),
    "iris pitch_yaw": FlightSet(
        "iris/vehicle.yaml", ("iris/pitch_yaw.csv",), ("iris/sideways.csv",), _IRIS, "the simulator's own file",
        _IRIS_CURVE,
    ),
    "ardupilot quad_sq": FlightSet(
        "ardupilot_sitl/quad_sq.yaml", ("ardupilot_sitl/quad_sq.bin",), (), _SQ, "ArduPilot's own physics",
    ),
    "ardupilot x": FlightSet(
        "ardupilot_sitl/sitl_x.yaml", ("ardupilot_sitl/x.bin",), (), _X, "ArduPilot's own physics",
        {"b": (2.15e-5, 3.19e-5)},  # of its curve about vertex and tangent
    ),
    "brushed rpm": FlightSet(
        "brushed/vehicle.yaml", ("brushed/jana00.csv",), ("brushed/jana02.csv",), _BRUSHED,
        "thrust stand; published inertias",
    ),
    "brushed PWM": FlightSet(
        "brushed/vehicle_pwm.yaml", ("brushed/jana00_pwm.csv",), ("brushed/jana02_pwm.csv",),
    ),
    "nanobench PWM": FlightSet(
        "nanobench/vehicle.yaml", ("nanobench/B2_circle_fast_rep1.csv",), ("nanobench/B9_trefoil_fast_rep10.csv",),
    ),
    "arpl": FlightSet(
        "arpl/vehicle.yaml", ("arpl/log15.csv",), (),
        {"J_xx": (1.0e-5, 1.8e-5), "J_yy": (1.0e-5, 1.8e-5)}, "authors' notebook and plain regression",
    ),
    "crazyflie rpm": FlightSet(
        "crazyflie_rpm/vehicle.yaml", tuple(f"crazyflie_rpm/figure8_{i}.csv" for i in (17, 20, 22, 27, 34)),
        tuple(f"crazyflie_rpm/figure8_{i}.csv" for i in (18, 21, 24, 30, 35)), {"b": _near(3.70e-8, 0.03)},
        "regression",
    ),
    "nano-drone": FlightSet(
        "nanodrone/vehicle.yaml",
        ("nanodrone/random_run1.csv", "nanodrone/random_run2.csv", "nanodrone/chirp_run1.csv"),
        ("nanodrone/random_run3.csv",), _NANO, "its authors; others on the same airframe",
    ),
    "ardupilot log171": FlightSet(
        f"{_VEHICLES}/log171.yaml", ("ardupilot/log171.bin@76:216",), (),
    ),
    "px4 ascend": FlightSet(f"{_VEHICLES}/ascend.yaml", ("px4/ascend_cubeorange_test.ulg",), ()),
}  # fmt: skip


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
        """Checks whether the interval holds the truth, or part of what is known of it."""
        return self.interval[0] <= self.truth[1] and self.truth[0] <= self.interval[1]

    @property
    def identified(self) -> bool:
        """Checks whether the command calls the value identified."""
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


def shares_of_no_change(windows: Sequence[Window], vehicle: Vehicle, seconds: float) -> dict[str, float]:
    """Mean error so long after every start, by quantity, as a share of that of no change; NaN if not measured."""
    samples = round(seconds / windows[0].dt)
    errors = np.concatenate(start_errors(windows, vehicle, [samples]))[:, 0]
    mean = np.ma.array(errors, mask=np.isnan(errors)).mean(axis=0).filled(np.nan).tolist()
    still = no_change(windows, vehicle, samples)
    return {name: miss / still[name] for name, miss in zip(QUANTITIES, mean, strict=True)}
