"""The flights, what is known of them, and what a session that flew one of them is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

SITL = "ardupilot_sitl"
X = {"b": 4.24e-5, "J_xx": 0.02297, "J_yy": 0.02297, "J_zz": 0.04594}
"""Truth of ArduPilot's default frame; b is the secant of its thrust curve at hover."""
X_PWM = {**X, "b": 3.69e-5}
"""The same where the vehicle file takes 1000 to 2000 us for 0 to 754 rad/s: the pulse that hovers stands for 446."""
SQUARE = {"b": 1.983e-5, "J_xx": 0.018, "J_yy": 0.024, "J_zz": 0.036}


@dataclass(frozen=True)
class Flown:
    """One flight.

    Attributes:
        log, vehicle: below the data folder; a vehicle that begins with ``studies`` is one of the repository.
        truth: of the parameters that are known.
        interval: the log as a live link would bring it, with rotor readings so far apart [s]; 0: as it is.
        pulses: such a link brings motor outputs, not rotor speeds.
    """

    log: str
    vehicle: str
    truth: Mapping[str, float] = field(default_factory=dict)
    interval: float = 0.0
    pulses: bool = False

    @property
    def name(self) -> str:
        """Log and vehicle file."""
        told = "motor outputs" if self.pulses else "rotors"
        thinned = f", {told} every {self.interval * 1e3:g} ms" if self.interval else ""
        return f"{self.log} with {self.vehicle.rsplit('/', 1)[-1]}{thinned}"


ARDUCOPTER = (
    Flown(f"{SITL}/quad_sq.bin", f"{SITL}/quad_sq.yaml", SQUARE),
    Flown(f"{SITL}/x.bin", f"{SITL}/sitl_x.yaml", X),
    Flown(f"{SITL}/quad_sq.tlog", f"{SITL}/quad_sq.yaml", SQUARE),
    Flown(f"{SITL}/x.tlog", f"{SITL}/sitl_x.yaml", X),
    Flown(f"{SITL}/quad_sq_pwm.tlog", f"{SITL}/quad_sq_pwm.yaml", SQUARE),
    Flown(f"{SITL}/quad_sq.tlog", f"{SITL}/quad_sq_pwm.yaml", SQUARE),
    Flown(f"{SITL}/x.tlog", f"{SITL}/sitl_x_pwm.yaml", X_PWM),
    Flown(f"{SITL}/x_zero_rpm.tlog", f"{SITL}/sitl_x_pwm.yaml", X_PWM),
    *(Flown(f"{SITL}/x.bin", f"{SITL}/sitl_x.yaml", X, interval) for interval in (0.02, 0.0125)),
    *(Flown(f"{SITL}/quad_sq.bin", f"{SITL}/quad_sq.yaml", SQUARE, interval) for interval in (0.02, 0.0125)),
    Flown(f"{SITL}/x.bin", f"{SITL}/sitl_x_pwm.yaml", X_PWM, 0.0125, True),
    Flown(f"{SITL}/quad_sq.bin", f"{SITL}/quad_sq_pwm.yaml", SQUARE, 0.0125, True),
)
"""A real autopilot in a simulator of others: the truth is known, and nothing changes in flight."""
OTHERS = (
    Flown("ardupilot/log171.bin", "evaluation/quadid_evaluation/studies/vehicles/log171.yaml"),
    Flown("px4/ascend_cubeorange_test.ulg", "evaluation/quadid_evaluation/studies/vehicles/ascend.yaml"),
    *(Flown(f"crazyflie_rpm/figure8_{n}.csv", "crazyflie_rpm/vehicle.yaml") for n in (17, 22, 27, 35)),
    *(Flown(f"nanodrone/{k}_run1.csv", "nanodrone/vehicle.yaml") for k in ("chirp", "random", "square")),
)
"""Real flights without change: every alarm is false."""


@dataclass(frozen=True)
class Outcome:
    """What a session made of a flight.

    Attributes:
        published, candidates: sets as JSON, in order.
        events: kind and text, with time.
        status: the last one, phase and reason.
        seconds: wall time.
    """

    published: list[dict[str, Any]]
    candidates: list[dict[str, Any]]
    events: list[dict[str, Any]]
    status: str
    seconds: float

    @property
    def alarms(self) -> list[str]:
        """What was said to have changed."""
        return [f"{e['t'] - self.begin:.0f} s: {e['text']}" for e in self.events if e["kind"] == "change"]

    @property
    def models(self) -> list[str]:
        """What the model took in."""
        return [f"{e['t'] - self.begin:.0f} s: {e['text']}" for e in self.events if e["kind"] == "model"]

    @property
    def begin(self) -> float:
        """Beginning of the excited flight: the first data learned from; before any, that of the stream [s]."""
        times = [s["start"] for s in (*self.candidates, *self.published) if s.get("start")]
        return min(times, default=min((e["t"] for e in self.events if e["t"] is not None), default=0.0))

    @property
    def first(self) -> float | None:
        """Excited flight before the first set [s]; None: nothing was published."""
        return self.published[0]["stop"] - self.begin if self.published else None


def errors_of(item: Mapping[str, Any], truth: Mapping[str, float]) -> list[str]:
    """Error of each identified parameter whose truth is known; bold where it is wrong.

    Wrong is: more than 3 % and outside its interval, or more than 10 %.
    """
    out = []
    for p in item["parameters"]:
        if p["name"] in truth and p["status"] == "identified":
            off = p["value"] / truth[p["name"]] - 1.0
            outside = not p["ci95"][0] <= truth[p["name"]] <= p["ci95"][1]
            wrong = abs(off) > 0.10 or (outside and abs(off) > 0.03)
            text = f"{p['name']} {off:+.1%}"
            out.append(f"**{text}**" if wrong else text)
    return out
