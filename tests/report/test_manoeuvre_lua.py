"""The Lua script of a manoeuvre, run by a Lua interpreter against a stand-in of ArduPilot's scripting interface."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from lupa import lua53

from quadid.flight.pilot import AXES, PILOT_STEP, scripted
from quadid.report.manoeuvres import written_as
from tests.report.manoeuvre_plan import PLAN, SECONDS, SEGMENTS

LOITER, GUIDED, ALT_HOLD = 5, 4, 2
GRAVITY = 9.81


@dataclass
class Autopilot:
    """What a script sees of a vehicle that hovers at 20 m, nose to the south-west, and what it asks of it."""

    now: float = 100.0
    mode: int = LOITER
    switch: int = 0
    armed: bool = True
    roll: float = 0.0
    height: float = 20.0
    north: float = 3.0
    battery: float | None = 90.0
    yaw: float = -2.2
    asked: list[tuple[float, ...]] = field(default_factory=list)
    said: list[str] = field(default_factory=list)

    def set_mode(self, mode: int) -> bool:
        self.mode = int(mode)
        return True

    def run(self, seconds: float, each: Callable[[Autopilot], None] = lambda a: None) -> None:
        """Calls the script as the scheduler does, for some seconds."""
        end = self.now + seconds
        while self.now < end:
            each(self)
            _, delay = self.update()
            self.now += 1e-3 * float(delay)

    def load(self) -> Autopilot:
        lua = lua53.LuaRuntime(unpack_returned_tuples=True)

        def vector(x: float, y: float, z: float) -> Any:
            return lua.table_from({"x": lambda _: x, "y": lambda _: y, "z": lambda _: z})

        names = {
            "ahrs": {
                "get_relative_position_NED_home": lambda _: vector(self.north, 0.0, -self.height),
                "get_velocity_NED": lambda _: vector(0.0, 0.0, 0.0),
                "get_roll": lambda _: self.roll, "get_pitch": lambda _: 0.0, "get_yaw": lambda _: self.yaw,
            },
            "battery": {"capacity_remaining_pct": lambda _, which: self.battery},
            "arming": {"is_armed": lambda _: self.armed},
            "rc": {"get_aux_cached": lambda _, which: self.switch},
            "gcs": {"send_text": lambda _, severity, text: self.said.append(text)},
            "vehicle": {
                "get_mode": lambda _: self.mode, "set_mode": lambda _, mode: self.set_mode(mode),
                "get_likely_flying": lambda _: self.height > 1.0,
                "set_target_angle_and_climbrate": lambda _, *values: self.asked.append((self.now, *values[:4])),
            },
        }  # fmt: skip
        for name, functions in names.items():
            lua.globals()[name] = lua.table_from(functions)
        lua.globals()["millis"] = lambda: lua.table_from({"tofloat": lambda _: 1e3 * self.now})
        (script,) = written_as(PLAN, "ardupilot-lua", 0.3).values()
        self.update, _ = lua.execute(script)
        return self


@pytest.fixture
def autopilot() -> Autopilot:
    return Autopilot().load()


def test_it_asks_for_the_manoeuvre_and_ends_in_loiter(autopilot: Autopilot) -> None:
    autopilot.run(2.0)
    assert (autopilot.mode, autopilot.asked) == (LOITER, [])
    autopilot.switch = 2
    autopilot.run(SECONDS + 3.0)
    assert autopilot.mode == LOITER
    assert autopilot.said[-2:] == ["manoeuvre: begun", "manoeuvre: done"]
    t, roll, pitch, yaw, climb = np.array(autopilot.asked).T
    wanted = scripted(SEGMENTS, 1, round(SECONDS / PILOT_STEP) + 1)
    grid = PILOT_STEP * np.arange(len(wanted))
    t = t - t[0] + PILOT_STEP  # the first one is asked for a step after it began
    edges = np.array([s.start for s in SEGMENTS] + [s.start + s.duration for s in SEGMENTS])
    clear = np.abs(t[:, None] - edges).min(axis=1) > 0.5 * PILOT_STEP
    t, roll, pitch, yaw, climb = (values[clear] for values in (t, roll, pitch, yaw, climb))

    def at(axis: str) -> Any:
        return np.interp(t, grid, wanted[:, AXES.index(axis)])

    np.testing.assert_allclose(roll, np.degrees(at("roll")), atol=0.3)
    np.testing.assert_allclose(pitch, np.degrees(at("pitch")), atol=0.3)
    turned = np.remainder(np.radians(yaw) - autopilot.yaw + np.pi, 2.0 * np.pi) - np.pi
    np.testing.assert_allclose(turned, at("yaw"), atol=0.01)
    # The throttle's share of g is the rate of change of the climb rate.
    inside = (t > 0.1) & (t < 5.8)
    np.testing.assert_allclose(np.gradient(climb, t)[inside], GRAVITY * at("throttle")[inside], atol=0.1)


@pytest.mark.parametrize(
    ("name", "value", "why"),
    [
        ("height", 9.0, "height 9.0 m"), ("height", 41.0, "height 41.0 m"), ("roll", 0.7, "tilt 40 deg"),
        ("battery", 39.0, "battery 39 %"), ("battery", None, "no battery level"), ("north", 60.0, "too far away"),
    ],
)  # fmt: skip
def test_leaving_the_envelope_ends_it_at_once(autopilot: Autopilot, name: str, value: float | None, why: str) -> None:
    autopilot.run(0.5)
    autopilot.switch = 2
    autopilot.run(1.0)
    assert autopilot.mode == GUIDED
    setattr(autopilot, name, value)
    asked = len(autopilot.asked)
    autopilot.run(5.0)
    assert autopilot.mode == LOITER
    assert len(autopilot.asked) == asked
    assert autopilot.said[-1].startswith(f"manoeuvre: ended, {why}")


def test_outside_the_envelope_it_does_not_begin(autopilot: Autopilot) -> None:
    autopilot.run(0.5)
    autopilot.switch, autopilot.battery = 2, 20.0
    autopilot.run(3.0)
    assert (autopilot.mode, autopilot.asked) == (LOITER, [])
    assert autopilot.said[-1] == "manoeuvre: not begun, battery 20 %"


def test_the_pilot_has_the_last_word(autopilot: Autopilot) -> None:
    autopilot.run(0.5)
    autopilot.switch = 2
    autopilot.run(1.0)
    autopilot.mode = ALT_HOLD
    autopilot.run(1.0)
    assert autopilot.mode == ALT_HOLD
    assert autopilot.said[-1] == "manoeuvre: ended by another mode"
    # The switch is still up: it begins again only after the switch was down.
    autopilot.mode = LOITER
    autopilot.run(3.0)
    assert autopilot.mode == LOITER
    autopilot.switch = 0
    autopilot.run(1.0)
    autopilot.switch = 2
    autopilot.run(1.0)
    assert autopilot.mode == GUIDED
    autopilot.switch = 0
    autopilot.run(1.0)
    assert (autopilot.mode, autopilot.said[-1]) == (LOITER, "manoeuvre: ended by the switch")


def test_switched_on_since_start_up_it_waits(autopilot: Autopilot) -> None:
    """A switch that was up all the time is no command: on the ground it has said so, in the air nothing happens."""
    autopilot.switch, autopilot.height, autopilot.armed = 2, 0.0, False
    autopilot.run(2.0)
    autopilot.height, autopilot.armed = 20.0, True
    autopilot.run(2.0)
    assert (autopilot.mode, autopilot.asked) == (LOITER, [])
    assert math.isclose(autopilot.yaw, -2.2)
