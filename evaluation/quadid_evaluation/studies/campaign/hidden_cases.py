"""The cases: what is hidden, and how it is flown.

Every case is decided by its class and number alone.  The diagnosis gets windows and a vehicle file with a poor guess;
what was hidden never reaches it.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from quadid.data.window import Window
from quadid.effects import EFFECTS
from quadid.flight import OUTSIDE, draw_effect, draw_outside, draw_truth, fly
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Command, ParameterPrior, Vehicle

GUESS = 0.2
"""Standard deviation of the logarithm of the initial guess against the truth."""
LATER = (
    "translational_lift", "supply_voltage", "rotor_telemetry_delay", "drag_torque_curve", "no_gyroscopic_coupling",
    "velocity_scale",
)  # fmt: skip
"""Effects that joined the catalogue when the numbers of the cases below were in use; a class of their own."""
SINGLES = tuple(name for name in EFFECTS if name not in LATER)
PAIRS = (
    ("motor_lag", "rotor_drag"), ("cg_offset", "gyro_bias"), ("weak_rotor", "battery_sag"), ("motor_lag", "cg_offset"),
    ("command_delay", "imu_lever_arm"), ("mass_change", "rotor_drag"), ("accel_bias", "thrust_curve"),
    ("imu_misalignment", "motor_lag"), ("rate_damping", "cg_offset"), ("product_of_inertia", "attitude_delay"),
)  # fmt: skip
LOOK_ALIKES = (
    ("motor_lag", "command_delay"), ("weak_rotor", "cg_offset"), ("rotor_drag", "accel_bias"),
    ("mass_change", "battery_sag"), ("imu_lag", "motor_lag"), ("attitude_delay", "gyro_scale"),
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One blinded case: what is hidden and how it is flown."""

    group: str
    number: int
    hidden: dict[str, dict[str, float]]
    expected: tuple[str, ...]
    outside: dict[str, dict[str, float]] = field(default_factory=dict)
    vehicle: str = "pelican"
    seconds: float = 120.0
    noise_scale: float = 1.0
    profile: str = "excited"
    scale: float = 1.0

    @property
    def seed(self) -> int:
        """Seed of the flight."""
        return zlib.crc32(f"{self.group}/{self.number}".encode()) % 2**31


def cases(group: str, count: int, start: int = 0) -> list[Case]:
    """Returns cases `start` to `start + count` of one class."""
    return [_case(group, n) for n in range(start, start + count)]


def _case(group: str, n: int) -> Case:
    vehicle = "pelican_x" if n % 3 == 2 else "pelican"
    craft = Vehicle.shipped(vehicle)

    def draw(name: str, scale: float = 1.0, seconds: float = 120.0) -> dict[str, dict[str, float]]:
        return draw_effect(name, n, scale, craft, seconds)

    blank = Case(group, n, {}, (), vehicle=vehicle)
    hidden: dict[str, dict[str, float]]
    if group == "null":
        return blank
    if group in ("single", "noisy", "short", "weak"):
        name = SINGLES[n % len(SINGLES)]
        hidden = draw(name, seconds=60.0 if group == "short" else 120.0)
        changed: dict[str, dict[str, Any]] = {
            "noisy": {"noise_scale": 3.0},
            "short": {"seconds": 60.0},
            "weak": {"profile": "gentle"},
        }
        return replace(blank, hidden=hidden, expected=tuple(hidden), **changed.get(group, {}))
    if group.startswith("size_"):
        name = SINGLES[n % len(SINGLES)]
        scale = float(group.split("_")[1])
        hidden = draw(name, scale)
        return replace(blank, hidden=hidden, expected=tuple(hidden), scale=scale)
    if group == "later":
        hidden = draw(LATER[n % len(LATER)])
        return replace(blank, hidden=hidden, expected=tuple(hidden))
    if group in ("pair", "look_alike"):
        pool = PAIRS if group == "pair" else LOOK_ALIKES
        hidden = {k: v for name in pool[n % len(pool)] for k, v in draw(name).items()}
        return replace(blank, hidden=hidden, expected=tuple(hidden))
    if group == "outside":
        name = sorted(OUTSIDE)[n % len(OUTSIDE)]
        return replace(blank, outside={name: draw_outside(name, n)})
    if group == "clutter":
        large = SINGLES[n % len(SINGLES)]
        hidden = {}
        for i, name in enumerate(SINGLES):
            if name not in ("mass_change", "thrust_drop", "ground_effect", "wind"):
                hidden.update({k: v for k, v in draw_effect(name, n + 1000 * i, 0.05, craft).items() if k == name})
        # What is invisible without a companion is drawn with it, both at full size.
        hidden.update(draw(large))
        return replace(blank, hidden=hidden, expected=tuple(draw(large)))
    raise ValueError(f"unknown class '{group}'")


GROUPS = {
    "single": 100, "null": 100, "pair": 30, "look_alike": 24, "outside": 48, "clutter": 50, "noisy": 25, "short": 25,
    "weak": 25, "size_0.3": 25, "size_0.1": 25, "size_0.03": 25,
}  # fmt: skip


def guessed_vehicle(case: Case, truth: dict[str, float]) -> Vehicle:
    """The vehicle file handed to the diagnosis: geometry and mass right, parameters a poor guess."""
    rng = np.random.default_rng([case.seed, 77])
    priors = {
        n: ParameterPrior(initial=float(f"{truth[n] * np.exp(GUESS * rng.uniform(-1.7, 1.7)):.3e}"))
        for n in NOMINAL_NAMES
    }
    return shipped(case).model_copy(update={"parameters": priors})


def needs(case: Case) -> set[str]:
    """What must be logged for the case's effects to be seen; who logs position logs velocity."""
    found = {need for name in case.hidden for need in EFFECTS[name].needs}
    return found | ({"velocity"} if "position" in found else set())


def shipped(case: Case) -> Vehicle:
    """The vehicle of a case, with rotor speeds read back where an effect needs readings."""
    craft = Vehicle.shipped(case.vehicle)
    return craft.model_copy(update={"command": Command(sampling="instant")}) if "readings" in needs(case) else craft


def flown(case: Case) -> tuple[Window, Window, Vehicle]:
    """Flies the training and the validation flight of a case."""
    craft = shipped(case)
    truth = draw_truth(craft, case.seed)
    extras = tuple(sorted(needs(case) & {"velocity", "position", "battery"}))
    windows = []
    for k in range(2):
        flight = fly(
            craft, truth, case.seconds, case.seed + 7919 * k, case.profile, effects=case.hidden, outside=case.outside,
            noise_scale=case.noise_scale, extras=extras,
        )  # fmt: skip
        windows.append(flight.window)
    return windows[0], windows[1], guessed_vehicle(case, truth.as_dict())
