"""A manoeuvre as parameters, in words and as a Lua script against a stand-in of ArduPilot's scripting interface."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from lupa import lua53

from quadid.app.excite import propose
from quadid.errors import ParameterError
from quadid.flight import Segment
from quadid.flight.pilot import AXES, PILOT_STEP, scripted
from quadid.report.manoeuvres import FORMS, ManoeuvrePlan, written_as
from tests.report.manoeuvre_plan import PLAN, SECONDS, SEGMENTS

# --- A manoeuvre as parameters and in words: what they ask for is what was simulated, and the envelope stands in each


def parameters(text: str) -> dict[str, float]:
    """Name and value of every line that is no comment."""
    lines = [line.split(",") for line in text.splitlines() if not line.startswith("#")]
    return {name: float(value) for name, value in lines}


@pytest.mark.parametrize("form", list(FORMS))
def test_every_form_says_envelope_and_promise(form: str) -> None:
    for text in written_as(PLAN, form, 0.3).values():
        head = " ".join(text.splitlines()[:5])
        assert "10 to 40 m above take-off" in head
        assert "tilt 33 deg" in head
        assert "40 % of the battery" in head
        assert ("J_r unknown" if form == "ardupilot-sid" else "J_r ± 2 %") in head
        assert "@" not in text


def test_system_id_has_one_file_an_axis_in_its_units() -> None:
    files = written_as(PLAN, "ardupilot-sid", 0.3)
    assert list(files) == [".sid_1_roll.param", ".sid_2_throttle.param"]
    roll, throttle = (parameters(text) for text in files.values())
    assert (roll["SID_AXIS"], throttle["SID_AXIS"]) == (1, 13)
    assert roll["SID_MAGNITUDE"] == pytest.approx(math.degrees(0.2), rel=1e-5)
    assert throttle["SID_MAGNITUDE"] == pytest.approx(0.3 * 0.1)
    assert (roll["SID_F_START_HZ"], roll["SID_F_STOP_HZ"], roll["SID_T_REC"]) == (0.5, 3.5, 14.5)
    assert (roll["FENCE_ALT_MIN"], roll["FENCE_ALT_MAX"], roll["ANGLE_MAX"]) == (10, 40, 3300)
    # The mode refuses sweeps shorter than two swings of the lowest frequency.
    assert roll["SID_T_REC"] > 2.0 / roll["SID_F_START_HZ"]


def test_a_sweep_runs_from_its_lowest_to_its_highest_frequency() -> None:
    segments = [Segment(axis, "sweep", 0.0, 20.0, 0.2, 0.5, 4.0) for axis in ("roll", "yaw")]
    sticks = scripted(segments, 1, 1100)
    roll, yaw = (sticks[:, AXES.index(axis)] for axis in ("roll", "yaw"))
    np.testing.assert_allclose(sticks[1000:], 0.0, atol=1e-12)
    assert np.abs(roll[100:900]).max() == pytest.approx(0.2, rel=0.02)
    crossings = PILOT_STEP * np.flatnonzero(np.diff(np.sign(roll[25:950])))
    swings = 0.5 / np.diff(crossings)
    assert swings[:3] == pytest.approx(0.5, rel=0.1)
    assert swings[-3:] == pytest.approx(3.6, rel=0.15)
    # On yaw the rate sweeps: the same curve, and an angle that shrinks as it quickens.
    np.testing.assert_allclose(np.diff(yaw[:1000]) / PILOT_STEP, roll[1:1000], atol=1e-9)


def test_sticks_are_told_in_degrees_and_alike_blocks_once() -> None:
    (text,) = written_as(PLAN, "sticks", 0.3).values()
    assert "1. 6 s of swinging to and fro, from 0.8 to 2 times a second" in text
    assert f"roll {math.degrees(0.2 * math.sqrt(2.0)):.0f} degrees to each side" in text
    assert "throttle 14 % about hover" in text
    assert "2. 6 s" in text


def test_an_unknown_form_names_the_nearest() -> None:
    with pytest.raises(ParameterError, match="ardupilot-lua"):
        written_as(PLAN, "ardupilot-luo", 0.3)


# --- The Lua script of a manoeuvre, run by a Lua interpreter against a stand-in of ArduPilot's scripting interface


LOITER, GUIDED, ALT_HOLD = 5, 4, 2
GRAVITY = 9.81


@dataclass
class Autopilot:
    """View of a script on a vehicle that hovers at 20 m, nose to the south-west, and what it asks of it."""

    now: float = 100.0
    mode: int = LOITER
    switch: int = 0
    armed: bool = True
    roll: float = 0.0
    height: float = 20.0
    north: float = 3.0
    battery: float | None = 90.0
    yaw: float = -2.2
    old: bool = False
    refuses: bool = False
    plan: ManoeuvrePlan = PLAN
    pitch: float = 0.0
    east: float = 0.0
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    asked: list[tuple[float, ...]] = field(default_factory=list)
    said: list[str] = field(default_factory=list)
    turning: float = 0.0
    spin_up: float = math.radians(270.0)
    times: float = 1.0
    lift: float = 0.0
    push: tuple[float, float] = (0.0, 0.0)

    def set_mode(self, mode: int) -> bool:
        self.mode = int(mode)
        return True

    def ask(self, values: tuple[Any, ...]) -> bool:
        """Roll, pitch, yaw [deg], climb [m/s], whether yaw is a rate, its rate [deg/s]: nobody reads the last two."""
        self.asked.append((self.now, *values[:4]))
        assert values[4] is False
        return not self.refuses

    def fly(self, step: float = 0.02) -> None:
        """ArduCopter's Guided mode: thrust follows in 0.1 s, yaw with limited acceleration as it closes its error.

        The climb rate is limited in size, acceleration and jerk; 4.7 takes a hundred `times` what a script asks for.
        """
        _, roll, pitch, yaw, climb = self.asked[-1] if self.asked else (0.0, 0.0, 0.0, math.degrees(self.yaw), 0.0)
        off = math.remainder(math.radians(yaw) - self.yaw, 2.0 * math.pi)
        most = self.spin_up * step
        self.turning += max(-most, min(most, off / 0.15 - self.turning))
        c, s = math.cos(self.yaw + off), math.sin(self.yaw + off)
        ahead, aside = -GRAVITY * math.tan(math.radians(pitch)), GRAVITY * math.tan(math.radians(roll))
        near, (push_north, push_east) = step / 0.1, self.push
        push_north += near * (c * ahead - s * aside - push_north)
        push_east += near * (s * ahead + c * aside - push_east)
        self.push, self.yaw = (push_north, push_east), self.yaw + self.turning * step
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        self.pitch = -math.atan((c * push_north + s * push_east) / GRAVITY)
        self.roll = math.atan((c * push_east - s * push_north) / GRAVITY)
        north, east, down = self.velocity
        north += (push_north - 0.25 * north) * step
        east += (push_east - 0.25 * east) * step
        missing = max(-1.5, min(2.5, self.times * climb)) + down
        wanted = max(-1.0, min(1.0, missing / 0.2))
        self.lift += max(-5.0 * step, min(5.0 * step, wanted - self.lift))
        down -= self.lift * step
        self.velocity = (north, east, down)
        self.north, self.east, self.height = (
            self.north + north * step,
            self.east + east * step,
            self.height - down * step,
        )

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

        rad = "" if self.old else "_rad"
        names = {
            "ahrs": {
                "get_relative_position_NED_home": lambda _: vector(self.north, self.east, -self.height),
                "get_velocity_NED": lambda _: vector(*self.velocity),
                f"get_roll{rad}": lambda _: self.roll,
                f"get_pitch{rad}": lambda _: self.pitch,
                f"get_yaw{rad}": lambda _: self.yaw,
            },
            "battery": {"capacity_remaining_pct": lambda _, which: self.battery},
            "arming": {"is_armed": lambda _: self.armed},
            "rc": {"get_aux_cached": lambda _, which: self.switch},
            "gcs": {"send_text": lambda _, severity, text: self.said.append(text)},
            "vehicle": {
                "get_mode": lambda _: self.mode,
                "set_mode": lambda _, mode: self.set_mode(mode),
                "get_likely_flying": lambda _: self.height > 1.0,
                "set_target_angle_and_climbrate": lambda _, *values: self.ask(values),
            },
        }
        for name, functions in names.items():
            lua.globals()[name] = lua.table_from(functions)
        lua.globals()["millis"] = lambda: lua.table_from({"tofloat": lambda _: 1e3 * self.now})
        (script,) = written_as(self.plan, "ardupilot-lua", 0.3).values()
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
    # This vehicle never turns: the heading runs ahead by the rate, and by what is still missing of it within a second.
    rate = np.interp(t, grid, np.gradient(wanted[:, AXES.index("yaw")], PILOT_STEP))
    missing = np.remainder(at("yaw") + np.pi, 2.0 * np.pi) - np.pi
    inner = np.abs(t[:, None] - edges).min(axis=1) > 2.0 * PILOT_STEP
    ahead = np.clip(0.15 * (rate + missing), -0.5, 0.5)
    np.testing.assert_allclose(np.radians(yaw)[inner] - autopilot.yaw, ahead[inner], atol=0.03)
    # The throttle's share of g is the rate of change of the climb rate, all of which is missing here.
    inside = (t > 0.1) & (t < 5.8)
    np.testing.assert_allclose(np.gradient(climb, t)[inside], 2.0 * GRAVITY * at("throttle")[inside], atol=0.2)


@pytest.mark.parametrize(
    ("name", "value", "why"),
    [
        ("height", 9.0, "height 9.0 m"),
        ("height", 41.0, "height 41.0 m"),
        ("roll", 0.7, "tilt 40 deg"),
        ("battery", 39.0, "battery 39 %"),
        ("battery", None, "no battery level"),
        ("north", 60.0, "too far away"),
    ],
)
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


def test_the_calls_of_older_autopilots_do_as_well() -> None:
    autopilot = Autopilot(old=True).load()
    autopilot.switch = 0
    autopilot.run(0.5)
    autopilot.switch = 2
    autopilot.run(1.0)
    assert (autopilot.mode, autopilot.said[-1]) == (GUIDED, "manoeuvre: begun")


def test_an_attitude_that_is_refused_ends_it_with_its_reason(autopilot: Autopilot) -> None:
    autopilot.run(0.5)
    autopilot.switch, autopilot.refuses = 2, True
    autopilot.run(1.0)
    assert (autopilot.mode, autopilot.said[-1]) == (LOITER, "manoeuvre: ended, the autopilot refused an attitude")


SHIPPED_PLANS = [("pelican", 25.0), ("pelican", 40.0), ("hexacopter", 15.0), ("crazyflie_brushless", 30.0)]


@pytest.mark.parametrize(("name", "tilt"), SHIPPED_PLANS)
def test_what_is_exported_stays_inside_its_own_envelope(name: str, tilt: float) -> None:
    plan = propose([], vehicle=name, seconds=30.0, tilt=tilt, rate_limit=200.0, height=(10.0, 60.0), seed=1).plan
    # ArduCopter's default, and yaw that follows at once: in step it drifts; climb rates of 4.6, and of 4.7.
    for spin_up, times in ((math.radians(270.0), 1.0), (1e6, 1.0), (math.radians(270.0), 100.0)):
        stays_inside(plan, spin_up, times)


def stays_inside(plan: ManoeuvrePlan, spin_up: float, times: float) -> None:
    autopilot = Autopilot(plan=plan, height=30.0, spin_up=spin_up, times=times).load()
    autopilot.run(0.5)
    autopilot.switch = 2
    far, tilts, heights, turned = [], [], [], []

    def each(a: Autopilot) -> None:
        a.fly()
        far.append(math.hypot(a.north - 3.0, a.east))
        tilts.append(math.degrees(math.acos(math.cos(a.roll) * math.cos(a.pitch))))
        heights.append(a.height)
        turned.append(a.turning)

    autopilot.run(plan.seconds + 2.0, each)
    assert autopilot.said[-1] == "manoeuvre: done", (max(far), max(tilts))
    assert max(far) < 0.8 * plan.envelope["radius_m"]
    assert max(tilts) < 0.9 * plan.envelope["abort_tilt_deg"]
    assert max(abs(h - 30.0) for h in heights) < 1.0
    asked = [s for s in plan.segments if s["axis"] == "yaw"]
    if asked:
        assert np.std(turned) > 0.1
