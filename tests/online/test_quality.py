"""Quality: flights of every kind pass; broken sensors, wrong units and anything but flight are named."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from quadid.checks import inspect
from quadid.checks.findings import CheckResult
from quadid.data.window import Window
from quadid.flight import draw_truth, fly
from quadid.model.layout import Layout, ThrustModel
from quadid.online.checks import Quality, judge, mistake
from quadid.online.fusion import Estimator
from quadid.online.grid_buffer import WindowCut
from quadid.vehicle import GRAVITY, Vehicle
from tests.faults.evidence import Happened
from tests.online.driving import flight
from tests.online.made_up import NOISE

PELICAN = Vehicle.shipped("pelican")
B = 2.33e-5


def thrust_of(b: float) -> ThrustModel:
    layout = Layout(PELICAN)
    theta = layout.initial(PELICAN)
    theta[0] = b
    return ThrustModel(layout, theta)


def verdict(window: Window, known: bool = True) -> Quality:
    return judge(WindowCut((window,), len(window) * window.dt, 0), PELICAN, thrust_of(B), known)


def changed(window: Window, name: str, values: np.ndarray) -> Window:
    return replace(window, **{name: values})  # type: ignore[arg-type]


@pytest.mark.parametrize("profile", ["excited", "gentle", "hover", "one_axis", "roll_pitch"])
@pytest.mark.parametrize("known", [True, False])
def test_flight_passes(profile: str, known: bool) -> None:
    window = flight(30.0, 3, profile).window
    for start in range(0, 1000, 250):
        assert verdict(window.slice(start, start + 500), known) == Quality()


def on_the_floor(speed: np.ndarray, shake: float = 0.2) -> Window:
    rng = np.random.default_rng(0)
    rows = len(speed)
    attitude = np.column_stack([np.ones(rows), 1e-3 * rng.normal(size=(rows, 3))])
    attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
    accel = shake * rng.normal(size=(rows, 3)) - [0.0, 0.0, GRAVITY]
    return Window(0.0, 0.02, np.repeat(speed[:, None], 4, axis=1), 0.02 * rng.normal(size=(rows, 3)), attitude, accel)


@pytest.mark.parametrize("known", [True, False])
def test_idling_and_taxiing_are_not_flight(known: bool, happened: Happened) -> None:
    hover = PELICAN.hover_speed(B)
    assert "ground" in verdict(on_the_floor(np.full(500, 0.2 * hover)), known).grounded
    spool = hover * (0.75 + 0.2 * np.sin(np.arange(500) * 0.05))
    assert verdict(on_the_floor(spool), known).grounded
    happened(18, f"idling and spooling on the floor (b {'known' if known else 'guessed'}): not flying, with the reason")


def test_carried_by_hand_is_not_flight(happened: Happened) -> None:
    window = flight(30.0, 3).window.slice(0, 500)
    off = changed(window, "rotor_speed", np.zeros_like(window.rotor_speed))
    assert "ground" in verdict(off).grounded
    idle = changed(window, "rotor_speed", 0.25 * window.rotor_speed)
    assert verdict(idle).grounded
    happened(18, "moved about with rotors off or idling (carried by hand): not flying")


def test_a_crash_is_named(happened: Happened) -> None:
    window = flight(30.0, 3).window.slice(0, 500)
    assert window.accel is not None
    knock = window.accel.copy()
    knock[300] = [90.0, 10.0, 60.0]
    assert "knock" in verdict(changed(window, "accel", knock)).grounded
    happened(18, "a knock of more than 8 g: 'landing or crash', the window is not used")


@pytest.mark.parametrize(
    ("name", "profile", "until"),
    [
        *((n, "excited", 280) for n in ("gyro", "accel", "attitude", "rotor_speed")),
        *((n, "gentle", 600) for n in ("gyro", "accel", "attitude")),
    ],
)
def test_a_stuck_sensor_is_named(name: str, profile: str, until: int, happened: Happened) -> None:
    window = flight(30.0, 3, profile).window.slice(0, 611)
    values = getattr(window, name).copy()
    values[200:until] = values[200]
    assert f"{name} is stuck" in verdict(changed(window, name, values)).fault
    happened(6, f"{name} stuck for {0.02 * (until - 200):g} s of {profile} flight: the window is refused, it is named")


def test_coarse_sensors_may_repeat_themselves_in_a_calm_hover() -> None:
    window = fly(PELICAN, seconds=11.0, seed=5, profile="hover", noise_scale=0.0).window
    steps = {"gyro": 0.005, "accel": 0.05, "rotor_speed": 5.0}
    for name, step in steps.items():
        window = changed(window, name, np.round(getattr(window, name) / step) * step)
        assert np.all(getattr(window, name)[100:160] == getattr(window, name)[100])
    assert verdict(window) == Quality()


@pytest.mark.parametrize(("profile", "axis", "step"), [("hover", 2, 0.2), ("hover", 0, -0.2), ("gentle", 0, 0.1)])
def test_a_step_of_the_gyros_bias_is_called_one(profile: str, axis: int, step: float) -> None:
    window = flight(30.0, 3, profile).window.slice(0, 511)
    assert window.gyro is not None
    gyro = window.gyro.copy()
    gyro[250:, axis] += step
    fault = verdict(changed(window, "gyro", gyro)).fault
    told = re.search(r"bias about ([xyz]) stepped by (\S+) rad/s", fault)
    assert told is not None, fault
    assert told[1] == "xyz"[axis]
    assert float(told[2]) == pytest.approx(step, rel=0.1)


def test_noise_of_an_attitude_is_no_wrong_frame() -> None:
    """Once the attitude read backwards stood just above the motion that is judged, and as given just below."""
    for seed, start in ((1, 4500), (6, 4500), (7, 500), (7, 750)):
        assert verdict(flight(120.0, seed, "gentle").window.slice(start, start + 511)) == Quality()


def test_a_saturated_gyro_is_named(happened: Happened) -> None:
    window = flight(30.0, 3).window.slice(0, 500)
    assert window.gyro is not None
    top = 0.6 * np.abs(window.gyro[:, 1]).max()
    assert "is saturated" in verdict(changed(window, "gyro", np.clip(window.gyro, -top, top))).fault
    happened(6, "gyro clipped at 60 % of its peak: the window is refused, axis and limit named")


def test_rotor_speeds_in_rpm_are_named() -> None:
    window = flight(30.0, 3).window.slice(0, 500)
    assert "rpm" in verdict(changed(window, "rotor_speed", window.rotor_speed * 30.0 / np.pi)).fault


@pytest.mark.parametrize(
    ("name", "factor", "word"),
    [
        ("accel", np.full(3, 1.0 / GRAVITY), "in g"),
        ("accel", np.array([1.0, -1.0, -1.0]), "z points up (FLU, as ROS has it)"),
        ("accel", np.array([1.0, 1.0, 0.0]), "gravity is missing"),
        ("gyro", np.full(3, 180.0 / np.pi), "deg/s"),
        ("gyro", np.array([1.0, -1.0, -1.0]), "gyro axes differ from the attitude's: x = x, y = -y, z = -z"),
        ("attitude", np.array([1.0, 1.0, -1.0, -1.0]), "gyro axes differ from the attitude's: x = x, y = -y, z = -z"),
    ],
)
def test_wrong_units_and_frames_are_named(name: str, factor: np.ndarray, word: str) -> None:
    window = flight(30.0, 3).window.slice(0, 500)
    wrong = changed(window, name, getattr(window, name) * factor)
    assert word in verdict(wrong).fault
    # Of a known vehicle by the fit, beside the session; by the session where it would call it no flight.
    cut, learner = WindowCut((wrong,), 10.0, 0), Estimator(PELICAN, 120.0, 10.0, 0)
    left = judge(cut, PELICAN, thrust_of(B), known=True, units=False)
    assert left == Quality() or word in left.fault
    learner.noise = NOISE
    assert word in learner.request(1, cut, 0.0, 10.0).answer().fault


def test_an_attitude_in_a_world_with_z_up_is_named() -> None:
    window = flight(30.0, 3).window.slice(0, 500)
    assert window.attitude is not None
    w, x, y, z = window.attitude.T
    in_enu = np.column_stack([-x - y, w + z, w - z, y - x]) / np.sqrt(2.0)  # half a turn about north-east before it
    fault = verdict(changed(window, "attitude", in_enu)).fault
    assert "its world has z up" in fault
    assert "PX4 has FRD and NED" in fault


def test_a_wrong_order_of_rotors_is_named_where_their_readings_are_quick_enough() -> None:
    """The rule is that of logs: slower readings miss the motion that orders are told apart by."""
    made = flight(30.0, 3)
    window = made.window.slice(0, 500)
    swapped = changed(window, "rotor_speed", window.rotor_speed[:, [1, 0, 2, 3]])
    for every in (1, 2):
        cut = WindowCut((swapped,), 10.0, 0, spacing=float(every))
        named = mistake(cut, PELICAN, known=False)
        assert named.startswith("motor order:") == (every == 1)
        rotors = made.recording.channels["rotor_speed"]
        slow = replace(rotors, t=rotors.t[::every], values=rotors.values[::every][:, [1, 0, 2, 3]])
        log = inspect(replace(made.recording, channels={**made.recording.channels, "rotor_speed": slow}), PELICAN)
        (check,) = [c for c in log.checks if c.name == "motor_order"]
        assert (check.verdict is CheckResult.ERROR) == (every == 1)
    assert mistake(WindowCut((swapped,), 10.0, 0), PELICAN, known=True) == ""


@pytest.mark.parametrize("seed", [0, 1])
def test_motors_that_lag_in_a_calm_hover_turn_as_the_file_says(seed: int) -> None:
    """Twelve and seventeen of fifty windows were refused: some pair of rotors "turned the other way"."""
    vehicle = Vehicle.shipped("hexacopter")
    window = fly(vehicle, draw_truth(vehicle, seed), 40.0, seed, "hover", effects={"motor_lag": {"tau": 0.05}}).window
    for first in range(0, len(window) - 500, 50):
        cut = WindowCut((window.slice(first, first + 500),), 10.0, 0)
        assert mistake(cut, vehicle, known=False) == ""


@pytest.mark.parametrize("which", [(0,), (4,), range(6)])
def test_spins_that_are_wrong_are_named_in_gusts(which: Sequence[int]) -> None:
    vehicle = Vehicle.shipped("hexacopter")
    gusts = {"gusts": {"push": 0.3, "turn": 0.4, "time": 0.6}}
    effects = {"motor_lag": {"tau": 0.035}}
    window = fly(vehicle, draw_truth(vehicle, 0), 15.0, 0, "excited", effects=effects, outside=gusts).window
    rotors = tuple(r.model_copy(update={"spin": -r.spin}) if k in which else r for k, r in enumerate(vehicle.rotors))
    named = mistake(
        WindowCut((window.slice(0, 500),), 10.0, 0), vehicle.model_copy(update={"rotors": rotors}), known=False
    )
    assert named.startswith("motor order:")
    assert ("negate the spins" if len(which) == 6 else f"rotor {which[0] + 1} turns") in named
