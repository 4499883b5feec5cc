"""The data sets: vehicle file, training and unseen flights, and what is known of the truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class FlightSet:
    """Flights of one vehicle.

    Attributes:
        vehicle: vehicle file, in the data folder, or a path of its own.
        train, unseen: logs, in the data folder; spans as ``log@start:stop``.
        truth: parameters known from elsewhere, each with the interval [low, high] in which the truth lies.
        source: where the truth comes from.
    """

    vehicle: str
    train: tuple[str, ...]
    unseen: tuple[str, ...]
    truth: dict[str, tuple[float, float]] = field(default_factory=dict)
    source: str = ""


def _near(value: float, share: float = 0.0) -> tuple[float, float]:
    return value * (1.0 - share), value * (1.0 + share)


_VEHICLES = Path(__file__).parents[1] / "vehicles"
_SQ = {"b": _near(1.983e-5), "J_xx": _near(0.018), "J_yy": _near(0.024), "J_zz": _near(0.036)}
_X = {"J_xx": _near(0.02297), "J_yy": _near(0.02297), "J_zz": _near(0.04594)}
_BRUSHED = {"b": _near(2.02e-8, 0.03), "J_xx": (1.5e-5, 2.3e-5), "J_yy": (1.5e-5, 2.3e-5)}
_NANO = {"b": _near(3.72e-8, 0.03), "J_xx": (2.3e-5, 2.6e-5), "J_yy": (2.3e-5, 2.9e-5)}

SETS: dict[str, FlightSet] = {
    "iris": FlightSet(
        "iris/vehicle.yaml", ("iris/sideways.csv",), ("iris/pitch_yaw.csv",),
        {"b": _near(5.84e-6, 0.01), "J_xx": _near(0.029125), "J_yy": _near(0.029125), "J_zz": _near(0.055225)},
        "the simulator's own file",
    ),
    "ardupilot quad_sq": FlightSet(
        "ardupilot_sitl/quad_sq.yaml", ("ardupilot_sitl/quad_sq.bin",), (), _SQ, "ArduPilot's own physics",
    ),
    "ardupilot x": FlightSet(
        "ardupilot_sitl/sitl_x.yaml", ("ardupilot_sitl/x.bin",), (), _X, "ArduPilot's own physics",
    ),
    "brushed rpm": FlightSet(
        "brushed/vehicle.yaml", ("brushed/jana00.csv@:6", "brushed/jana02.csv@:5"),
        ("brushed/jana00.csv@6:", "brushed/jana02.csv@5:"), _BRUSHED, "thrust stand; published inertias",
    ),
    "brushed PWM": FlightSet(
        "brushed/vehicle_pwm.yaml", ("brushed/jana00_pwm.csv@:6", "brushed/jana02_pwm.csv@:5"),
        ("brushed/jana00_pwm.csv@6:", "brushed/jana02_pwm.csv@5:"), {}, "",
    ),
    "nanobench PWM": FlightSet(
        "nanobench/vehicle.yaml", ("nanobench/B2_circle_fast_rep1.csv@:10", "nanobench/B9_trefoil_fast_rep10.csv@:8"),
        ("nanobench/B2_circle_fast_rep1.csv@10:", "nanobench/B9_trefoil_fast_rep10.csv@8:"),
    ),
    "arpl": FlightSet(
        "arpl/vehicle.yaml", ("arpl/log15.csv@:18",), ("arpl/log15.csv@18:",),
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
        f"{_VEHICLES}/log171.yaml", ("ardupilot/log171.bin@76:146",), ("ardupilot/log171.bin@146:216",),
    ),
    "px4 ascend": FlightSet(f"{_VEHICLES}/ascend.yaml", ("px4/ascend_cubeorange_test.ulg",), ()),
}  # fmt: skip
