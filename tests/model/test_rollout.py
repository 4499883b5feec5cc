"""Segments, initial states, missing measurements and refusals of the rollout."""

import pickle
import subprocess
import sys
from dataclasses import replace

import numba as nb
import numpy as np
import pytest

from quadid.data.window import Window
from quadid.errors import VehicleError, WindowError
from quadid.model import layout as ix
from quadid.model.layout import Layout
from quadid.model.rollout import Rollout, Segments
from quadid.model.rollout_kernel import roll_segments
from quadid.model.simd import LANES
from quadid.vehicle import Vehicle
from tests.model.flights import fly, lively_input, values_of, vector
from tests.model.test_lanes import NOMINAL, VEHICLE, noisy_window


@pytest.mark.parametrize("tau", [0.0, 0.05])
def test_segments_are_pieces_of_one_flight(tau: float) -> None:
    """With true initial states every segment agrees, whether they touch, leave gaps or overlap: rotors turn through."""
    values = values_of(VEHICLE, {"motor_lag.tau": tau, "command_delay.delay": 0.013})
    flight = fly(VEHICLE, values, lively_input(VEHICLE, 0.6, 0.02))
    rollout, theta = Rollout(flight.window(), VEHICLE), vector(VEHICLE, values)
    for starts in ([3, 8, 13, 18], [2, 15, 22], [4, 5, 6, 7, 20, 21]):
        for lanes in ([theta], [theta, vector(VEHICLE, values_of(VEHICLE))]):  # rotors shared, or each lane its own
            segments = Segments(5, 3, np.array(starts))
            out, ends = rollout.roll(segments, np.array(lanes), flight.states(segments.starts - 2), n_pre=2)
            assert np.abs(out[0, ..., 0]).max() < 3e-5
            assert np.abs(ends[0, :, :, 0] - flight.states(segments.starts + 5)).max() < 3e-5


def test_cut_fills_the_window() -> None:
    cut = Segments.cut(100, 24, lead=3)
    assert list(cut.starts) == [3, 27, 51, 75]
    assert cut.starts[-1] + cut.length < 100
    with pytest.raises(WindowError, match="at least 28 rows"):
        Segments.cut(27, 24, lead=3)


def test_tangent_offsets_move_the_initial_state() -> None:
    """Attitude as a body rotation vector, then rate, velocity, position; seen in the first scored sample."""
    window = noisy_window()
    rollout = Rollout(window, VEHICLE)
    segments = Segments(3, 1, np.array([1]))
    h = 1e-6
    dx = np.concatenate([np.zeros((1, 12)), h * np.eye(12)])
    out, _ = rollout.roll(segments, np.tile(NOMINAL, (13, 1)), rollout.initial_states(segments), dx)
    slope = (out[0, 0, 0, :, 1:13] - out[0, 0, 0, :, :1]) / h
    order = [3, 4, 5, 0, 1, 2, 9, 10, 11, 12, 13, 14]
    assert np.abs(slope[order] - np.eye(12)).max() < 0.25, "one step later each offset has hardly changed"


def test_results_can_be_written_into_earlier_ones() -> None:
    window = noisy_window()
    rollout = Rollout(window, VEHICLE)
    segments = Segments.cut(len(window), 20)
    x0 = rollout.initial_states(segments)
    first = rollout.roll(segments, NOMINAL[None], x0)
    kept = first[0].copy()
    first[0][:] = np.nan
    again = rollout.roll(segments, NOMINAL[None], x0, out=first)
    assert again[0] is first[0]
    assert np.array_equal(again[0], kept)
    with pytest.raises(ValueError, match="out of shape"):
        rollout.roll(segments, np.tile(NOMINAL, (LANES + 1, 1)), x0, out=first)


def test_missing_measurements_leave_zeros() -> None:
    full = noisy_window()
    assert full.gyro is not None
    assert full.attitude is not None
    gyro, attitude = np.array(full.gyro), np.array(full.attitude)
    gyro[10:14] = np.nan
    attitude[30] = np.nan
    window = Window(0.0, full.dt, full.rotor_speed, gyro, attitude, None, None, full.position)
    rollout = Rollout(window, VEHICLE)
    assert rollout.channels == 15
    expected = np.ones((len(window), 15), dtype=bool)
    expected[10:14, :3] = expected[30, 3:6] = expected[:, 6:12] = False
    assert np.array_equal(rollout.valid, expected)
    segments = Segments.cut(len(window), 20)
    out, _ = rollout.roll(segments, NOMINAL[None], rollout.initial_states(segments))
    rows = segments.starts[:, None] + np.arange(20)
    assert np.all(out[0, ..., 0][~expected[rows]] == 0.0)
    assert np.all(out[0, ..., 0][expected[rows]] != 0.0)


def test_initial_states_come_from_the_nearest_measurement() -> None:
    full = noisy_window()
    assert full.gyro is not None
    gyro = np.array(full.gyro)
    gyro[[0, 20]] = np.nan
    window = Window(0.0, full.dt, full.rotor_speed, gyro, None, None, full.velocity)
    rollout = Rollout(window, VEHICLE)
    x0 = rollout.initial_states(Segments.cut(len(window), 20))
    assert full.velocity is not None
    assert np.array_equal(x0[:, :4], np.tile([1.0, 0.0, 0.0, 0.0], (len(x0), 1)))
    assert np.array_equal(x0[0, 4:7], gyro[1])
    assert np.array_equal(x0[0, 7:10], full.velocity[0])


def test_a_window_of_another_vehicle_is_refused() -> None:
    with pytest.raises(WindowError, match="4 rotor columns"):
        Rollout(noisy_window(), Vehicle.shipped("hexacopter"))


def test_impossible_calls_are_refused() -> None:
    window = noisy_window()
    rollout = Rollout(window, VEHICLE)
    segments = Segments.cut(len(window), 20, lead=2)
    x0 = rollout.initial_states(segments)
    with pytest.raises(ValueError, match="n_pre = 3; allowed: 1 to the segments' lead, 2"):
        rollout.roll(segments, NOMINAL[None], x0, n_pre=3)
    with pytest.raises(ValueError, match="rising starts"):
        rollout.roll(segments.at(np.arange(len(segments.starts))[::-1]), NOMINAL[None], x0)
    with pytest.raises(ValueError, match=r"theta\[0, 0\] = nan"):
        rollout.roll(segments, Layout(VEHICLE).neutral()[None], x0)


def test_layout_reads_and_writes_vehicle_files() -> None:
    layout = Layout(VEHICLE)
    effects = {
        "imu_lag": {"cutoff": 8.0},
        "weak_rotor": {"rotor": 3.0, "loss": 0.1},
        "wind": {"north": 2.0, "east": -1.0},
        "mass_change": {"time": 12.0, "fraction": 0.2},
    }
    theta = layout.neutral()
    layout.write_effects(theta, effects)
    assert theta[ix.IMU_PERIOD] == pytest.approx(0.125)
    for name, numbers in effects.items():
        assert layout.read_effect(theta, name) == pytest.approx(numbers)
    assert layout.read_effect(layout.neutral(), "imu_lag") == {"cutoff": np.inf}


def test_several_weak_rotors_are_kept() -> None:
    layout = Layout(VEHICLE)
    losses = {"loss_2": 0.05, "loss_3": -0.02}
    theta = layout.neutral()
    layout.write_effects(theta, {"weak_rotor": losses})
    assert theta[[ix.LOSS, ix.LOSS + 1, ix.LOSS + 2, ix.LOSS + 3]].tolist() == [0.0, 0.05, -0.02, 0.0]
    assert layout.read_effect(theta, "weak_rotor") == losses
    file = VEHICLE.model_copy(update={"effects": {"weak_rotor": losses}}).to_yaml()
    assert np.array_equal(layout.initial(Vehicle.from_yaml(file))[ix.LOSS :][:4], theta[ix.LOSS :][:4])


@pytest.mark.parametrize(
    ("numbers", "reason"),
    [
        ({"rotor": 5, "loss": 0.1}, "rotor 5; allowed: a whole number from 1 to 4"),
        ({"rotor": 1.5, "loss": 0.1}, "rotor 1.5"),
        ({"loss": 0.1}, "loss 0.1 of no rotor"),
        ({"loss_5": 0.1}, "loss_5"),
        ({"rotor": 2, "loss": 0.1, "loss_3": 0.1}, "rotor 2 beside loss_3"),
        ({"loss_x": 0.1}, "no parameter 'loss_x'"),
    ],
)
def test_weak_rotors_that_are_not_there_are_refused(numbers: dict[str, float], reason: str) -> None:
    text = VEHICLE.model_copy(update={"effects": {"weak_rotor": numbers}}).to_yaml()
    with pytest.raises(VehicleError, match=reason):
        Vehicle.from_yaml(text)


def test_a_second_start_compiles_nothing() -> None:
    """The kernels are kept on disk; by now this test's neighbours have put them there."""
    script = (
        "from tests.model.test_rollout import test_results_can_be_written_into_earlier_ones as run\n"
        "from quadid.model import rollout as k\n"
        "run()\n"
        "for kernel in (k.roll_segments, k.rotor_table):\n"
        "    assert not kernel.stats.cache_misses, kernel\n"
    )
    test_results_can_be_written_into_earlier_ones()
    subprocess.run([sys.executable, "-c", script], check=True, timeout=900)


def test_running_speeds_pickled_windows_and_read_only_states_need_no_kernel_of_their_own() -> None:
    """numba compiles one for every type, half a minute each, that `quadid warmup` does not know of."""
    window = noisy_window(60)
    running = replace(window, rotor_slope=np.zeros(window.rotor_speed.shape), sampling="held")
    windows = (window, running, pickle.loads(pickle.dumps(window)))
    kinds = {nb.typeof(Rollout(w, VEHICLE).drive) for w in windows}  # type: ignore[no-untyped-call]
    assert len(kinds) == 1
    rollout, segments = Rollout(window, VEHICLE), Segments.cut(60, 20)
    x0 = rollout.initial_states(segments)
    theta = Layout(VEHICLE).initial(VEHICLE)[None]
    rollout.roll(segments, theta, x0)
    known = len(roll_segments.signatures)
    x0.setflags(write=False)
    rollout.roll(segments, theta, x0)
    assert len(roll_segments.signatures) == known
