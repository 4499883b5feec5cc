"""Recordings on grids: bits kept, gaps kept apart, no lag between channels, held and instant kept distinct."""

from dataclasses import replace

import numpy as np
import pytest

from quadid.data.grid import bridged, grid_recording, to_windows
from quadid.data.window import Channel, Recording
from quadid.errors import LogError, NotIdentifiableError
from quadid.types import FloatArray, IndexArray
from tests.replay.synthetic import PELICAN, Flight, with_command

FLIGHT = Flight()
INSTANT = with_command(PELICAN, sampling="instant")


def without_rows(recording: Recording, gone: IndexArray) -> Recording:
    channels = {
        n: replace(c, t=np.delete(c.t, gone), values=np.delete(c.values, gone, axis=0))
        for n, c in recording.channels.items()
    }
    return replace(recording, channels=channels)


def shift_between(a: FloatArray, b: FloatArray, dt: float) -> float:
    """Delay of `b` against `a` [s], from the phase of their cross spectrum below 5 Hz."""
    window = np.hanning(len(a))
    fa, fb = (np.fft.rfft((x - x.mean()) * window) for x in (a, b))
    f = np.fft.rfftfreq(len(a), dt)
    use = (f > 0.2) & (f < 5.0)
    cross = fa[use] * np.conj(fb[use])
    weight = np.abs(cross)
    return float(np.sum(weight * np.angle(cross) * f[use]) / np.sum(weight * f[use] ** 2) / (2 * np.pi))


@pytest.mark.parametrize("rate", [None, 50.0])
@pytest.mark.parametrize("sampling", ["held", "instant"])
def test_uniform_rows_pass_bit_for_bit(rate: float | None, sampling: str) -> None:
    recording = FLIGHT.recording()
    (window,) = to_windows(recording, with_command(PELICAN, sampling=sampling), rate)
    assert window.sampling == sampling
    assert window.dt == 0.02
    for name, channel in recording.channels.items():
        np.testing.assert_array_equal(getattr(window, name), channel.values)
    np.testing.assert_array_equal(window.t, recording.channels["gyro"].t[0] + 0.02 * np.arange(len(window)))


def test_times_rounded_to_microseconds_still_pass() -> None:
    recording = FLIGHT.recording(rate=49.0)
    channels = {n: replace(c, t=np.round(c.t, 6)) for n, c in recording.channels.items()}
    (window,) = to_windows(replace(recording, channels=channels), PELICAN, None)
    np.testing.assert_array_equal(window.gyro, recording.channels["gyro"].values)


@pytest.mark.parametrize("kind", ["csv", "mcap"])
def test_a_gap_is_more_than_three_and_a_half_steps_in_every_format(kind: str) -> None:
    whole = FLIGHT.recording(seconds=6.0, kind=kind)
    cut = without_rows(whole, np.array([100, 101, 102]))  # three rows lost: a step of 4
    report = grid_recording(cut, PELICAN, 50.0)
    assert [len(w) for w in report.windows] == [100, 197]
    assert report.windows[1].t0 == pytest.approx(2.06)
    assert (report.report.gaps, report.report.bridged) == (1, 0)
    assert report.report.seconds_used == pytest.approx(99 * 0.02 + 196 * 0.02)
    np.testing.assert_array_equal(report.windows[1].gyro, whole.channels["gyro"].values[103:])


@pytest.mark.parametrize("kind", ["csv", "mcap"])
def test_single_lost_rows_end_no_window_and_are_no_measurement(kind: str) -> None:
    whole = FLIGHT.recording(seconds=6.0, kind=kind)
    gridded = grid_recording(without_rows(whole, np.array([50, 100, 101])), PELICAN, 50.0)
    (window,) = gridded.windows
    assert (gridded.report.gaps, gridded.report.bridged) == (0, 6)  # two holes in each of three channels
    assert window.gyro is not None
    lost = np.isin(np.arange(len(window)), [50, 100, 101])
    assert np.isnan(window.gyro[lost]).all(), "a value between neighbours is as good as none, and no measurement"
    np.testing.assert_allclose(window.gyro[~lost], whole.channels["gyro"].values[~lost], rtol=1e-9)
    np.testing.assert_allclose(bridged(window.gyro)[50], 0.5 * (window.gyro[49] + window.gyro[51]))
    assert np.isnan(bridged(np.where(np.arange(10)[:, None] % 2, window.gyro[:10], np.nan))).any(), "a slow channel"
    held = whole.channels["rotor_speed"].values
    np.testing.assert_allclose(window.rotor_speed[51:100], held[51:100], rtol=1e-9)
    np.testing.assert_allclose(window.rotor_speed[100:102], held[[99, 99]], rtol=1e-9)  # a held value goes on acting


def test_nothing_is_joined_across_a_break() -> None:
    recording = replace(FLIGHT.recording(seconds=6.0), breaks=(2.995,))
    first, second = to_windows(recording, PELICAN)
    assert first.t[-1] < 2.995 < second.t0
    assert len(first) + len(second) == 300


@pytest.mark.parametrize("rate", [500.0, 333.0, 120.0])
def test_no_lag_between_channels_at_any_ratio(rate: float) -> None:
    """Gyro, rotor speed and attitude come at different rates and phases; on the grid all are in step."""
    times = {
        "gyro": np.arange(0.0, 20.0, 1.0 / rate),
        "rotor_speed": np.arange(0.0031, 20.0, 1.0 / (0.7 * rate)),
        "attitude": np.arange(0.0017, 20.0, 1.0 / 101.0),
    }
    gridded = grid_recording(FLIGHT.at(times), INSTANT, 50.0)
    (window,) = gridded.windows
    assert gridded.report.filtered
    assert window.sampling == "instant"
    for name in ("gyro", "rotor_speed"):
        truth, seen = getattr(FLIGHT, name)(window.t), getattr(window, name)
        for column in range(seen.shape[1]):
            assert abs(shift_between(truth[:, column], seen[:, column], window.dt)) < 1e-4, name
            assert np.std(seen[:, column]) == pytest.approx(np.std(truth[:, column]), rel=0.01)
    assert window.attitude is not None
    np.testing.assert_allclose(window.attitude, FLIGHT.attitude(window.t), atol=2e-3)


def test_a_chirp_keeps_phase_and_is_cut_above_the_cutoff() -> None:
    t = np.arange(0.0, 60.0, 0.002)
    phase = 2 * np.pi * (0.5 * t + 0.5 * (60.0 - 0.5) / 60.0 * t**2)  # 0.5 to 60 Hz
    chirp = np.sin(phase)
    recording = FLIGHT.at({"gyro": t, "rotor_speed": t})
    gyro = replace(recording.channels["gyro"], values=np.column_stack([chirp] * 3))
    rotor = replace(recording.channels["rotor_speed"], values=400.0 + 50.0 * np.column_stack([chirp] * 4))
    (window,) = to_windows(replace(recording, channels={"gyro": gyro, "rotor_speed": rotor}), INSTANT, 50.0)
    assert window.gyro is not None
    np.testing.assert_allclose(window.rotor_speed[:, 0], 400.0 + 50.0 * window.gyro[:, 0], atol=1e-9)
    hertz = 0.5 + (60.0 - 0.5) / 60.0 * window.t
    slow, fast = hertz < 10.0, hertz > 33.0
    np.testing.assert_allclose(window.gyro[slow, 0], np.interp(window.t, t, chirp)[slow], atol=0.06)
    assert np.abs(window.gyro[fast]).max() < 0.02


def test_down_sampled_commands_become_instants_at_the_right_place() -> None:
    """Commands held at 500 Hz: the staircase acts half a sample after its stamps, and that is what must be seen."""
    t = np.arange(0.0, 20.0, 0.002)
    recording = FLIGHT.at({"gyro": t, "rotor_speed": t})
    held, instant = (to_windows(recording, v, 50.0)[0] for v in (PELICAN, INSTANT))
    assert held.sampling == instant.sampling == "instant"
    for rotor in range(4):
        late = shift_between(FLIGHT.rotor_speed(held.t)[:, rotor], held.rotor_speed[:, rotor], held.dt)
        assert late == pytest.approx(0.001, abs=5e-5)
        late = shift_between(FLIGHT.rotor_speed(instant.t)[:, rotor], instant.rotor_speed[:, rotor], instant.dt)
        assert late == pytest.approx(0.0, abs=5e-5)


def test_commands_at_the_grid_rate_stay_held_and_are_averaged_over_each_step() -> None:
    t = np.arange(0.0, 10.0, 0.02)
    recording = FLIGHT.at({"gyro": t, "rotor_speed": t + 0.005})
    (window,) = to_windows(recording, PELICAN, 50.0)
    assert window.sampling == "held"
    speed = recording.channels["rotor_speed"].values
    np.testing.assert_allclose(window.rotor_speed[0], 0.25 * speed[0] + 0.75 * speed[1], rtol=1e-12)


def test_slow_held_commands_beside_a_fast_gyro() -> None:
    times = {"gyro": np.arange(0.0, 20.0, 0.0025), "rotor_speed": np.arange(0.0, 20.0, 0.1)}
    gridded = grid_recording(FLIGHT.at(times), PELICAN, 50.0)
    (window,) = gridded.windows
    assert window.sampling == "instant"
    assert gridded.report.rotor_rate == pytest.approx(10.0)
    assert any("slower than the grid" in note for note in gridded.report.notes)
    speed = gridded.windows[0].rotor_speed
    middle = np.argmin(np.abs(window.t - 5.05))  # in the middle of a step of the staircase
    np.testing.assert_allclose(speed[middle], FLIGHT.rotor_speed(np.array([5.0]))[0], rtol=0.01)


def test_slow_channels_are_absent_between_their_samples() -> None:
    t = np.arange(0.0, 10.0, 0.02)
    times = {"gyro": t, "rotor_speed": t, "attitude": np.arange(0.003, 10.0, 0.1), "velocity": np.arange(0.0, 10, 0.2)}
    (window,) = to_windows(FLIGHT.at(times, kind="dataflash"), PELICAN, 50.0)
    assert window.attitude is not None
    measured = np.flatnonzero(np.isfinite(window.attitude[:, 0]))
    assert len(measured) == 99
    np.testing.assert_allclose(window.t[measured], np.arange(0.1, 9.95, 0.1), atol=1e-9)
    # straight lines between samples 0.1 s apart, read 3 ms from a sample: nearly the truth at the grid's instant
    np.testing.assert_allclose(window.attitude[measured], FLIGHT.attitude(window.t[measured]), atol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(window.attitude[measured], axis=1), 1.0, atol=1e-12)


def test_a_channel_that_ends_early_is_absent_afterwards() -> None:
    t = np.arange(0.0, 10.0, 0.02)
    recording = FLIGHT.at({"gyro": t, "rotor_speed": t, "attitude": t[:300]})
    (window,) = to_windows(recording, PELICAN)
    assert window.attitude is not None
    assert np.isfinite(window.attitude[:300]).all()
    assert np.isnan(window.attitude[300:]).all()


def test_jittered_stamps_are_read_on_a_uniform_grid() -> None:
    rng = np.random.default_rng(5)
    t = np.sort(np.arange(0.0, 10.0, 0.001976) + rng.normal(0.0, 5.5e-5, 5061))
    recording = FLIGHT.at({"gyro": t, "rotor_speed": t, "accel": t}, kind="csv")
    (window,) = to_windows(recording, INSTANT, None)
    assert len(window) == pytest.approx(len(t), abs=2)
    assert window.gyro is not None
    np.testing.assert_allclose(window.gyro, FLIGHT.gyro(window.t), atol=1e-4)


def test_readings_repeated_by_the_log_are_not_half_a_step_late() -> None:
    t = np.arange(0.0, 20.0, 0.002)
    recording = FLIGHT.at({"gyro": t, "rotor_speed": t, "attitude": t}, kind="csv")
    stairs = replace(recording.channels["attitude"], values=FLIGHT.attitude(t[::5]).repeat(5, axis=0))
    (window,) = to_windows(replace(recording, channels={**recording.channels, "attitude": stairs}), INSTANT, 50.0)
    assert window.attitude is not None
    np.testing.assert_allclose(window.attitude, FLIGHT.attitude(window.t), atol=2e-3)


def test_yaw_reference_wraps_without_a_swing() -> None:
    t = np.arange(0.0, 10.0, 0.01)
    yaw = np.remainder(3.0 + 0.1 * t + np.pi, 2 * np.pi) - np.pi
    reference = Channel("attitude_reference", t, np.column_stack([0 * t, 0 * t, yaw, 0 * t + 0.5]))
    recording = FLIGHT.at({"gyro": t, "rotor_speed": t})
    (window,) = to_windows(
        replace(recording, channels={**recording.channels, "attitude_reference": reference}), PELICAN
    )
    assert window.attitude_reference is not None
    turned = np.angle(np.exp(1j * (window.attitude_reference[:, 2] - 3.0 - 0.1 * window.t)))
    assert np.abs(turned).max() < 1e-6


def test_pulse_widths_become_rotor_speeds() -> None:
    vehicle = with_command(PELICAN, kind="pwm", max_speed=800.0, range=(1100.0, 1900.0))
    base = FLIGHT.recording()
    pulses = 1100.0 + base.channels["rotor_speed"].values
    channels = {
        "gyro": base.channels["gyro"],
        "motor_command": Channel("motor_command", base.channels["gyro"].t, pulses),
    }
    (window,) = to_windows(replace(base, channels=channels), vehicle)
    np.testing.assert_allclose(window.rotor_speed, base.channels["rotor_speed"].values, rtol=1e-12)


def test_measured_speeds_go_before_commands_unless_too_slow() -> None:
    vehicle = with_command(PELICAN, kind="normalized", max_speed=800.0)
    t = np.arange(0.0, 10.0, 0.02)
    base = FLIGHT.at({"gyro": t, "rotor_speed": t})
    command = Channel("motor_command", t, np.full((len(t), 4), 0.5), "commands")
    both = replace(base, channels={**base.channels, "motor_command": command})
    gridded = grid_recording(both, vehicle)
    assert gridded.windows[0].sampling == "instant"
    assert gridded.report.rotor_source == "made-up"
    slow = FLIGHT.at({"gyro": t, "rotor_speed": t[::10]})
    both = replace(slow, channels={**slow.channels, "motor_command": command})
    assert grid_recording(both, vehicle).report.rotor_source == "commands"


def test_start_and_stop_cut_in_recording_time() -> None:
    recording = FLIGHT.recording(seconds=10.0, start=100.0)
    (window,) = to_windows(recording, PELICAN, start=103.0, stop=105.0)
    assert window.t0 == pytest.approx(103.0)
    assert window.t[-1] == pytest.approx(105.0)
    np.testing.assert_allclose(window.log_span, (100.0, 109.98))
    with pytest.raises(LogError, match="between 400"):
        to_windows(recording, PELICAN, start=500.0)


def test_short_windows_are_dropped_and_counted() -> None:
    whole = FLIGHT.recording(seconds=6.0)
    cut = without_rows(whole, np.array([20, 21, 22]))
    gridded = grid_recording(cut, PELICAN)
    assert len(gridded.windows) == gridded.report.windows == 1
    assert gridded.report.dropped == 1
    assert gridded.report.seconds_dropped == pytest.approx(0.38)
    assert len(to_windows(cut, PELICAN, None)) == 2


def test_absent_slow_or_wrong_rotor_columns_are_named() -> None:
    t = np.arange(0.0, 10.0, 0.02)
    with pytest.raises(LogError, match="no rotor speeds") as none:
        to_windows(FLIGHT.at({"gyro": t}), PELICAN)
    assert "SDLOG_PROFILE" in none.value.fix
    with pytest.raises(NotIdentifiableError, match="too slow"):
        to_windows(FLIGHT.at({"gyro": t, "rotor_speed": t[::17]}), PELICAN)
    six = Channel("rotor_speed", t, np.full((len(t), 6), 300.0))
    with pytest.raises(LogError, match="6 rotor columns.*allowed: 4"):
        to_windows(Recording("hexa", "csv", {"rotor_speed": six}), PELICAN)


def test_units_of_commands_must_fit_the_vehicle_file() -> None:
    t = np.arange(0.0, 10.0, 0.02)
    pulses = Recording("log", "csv", {"motor_command": Channel("motor_command", t, np.full((len(t), 4), 1500.0))})
    with pytest.raises(LogError, match="expects rotor speeds.*kind: pwm"):
        to_windows(pulses, PELICAN)
    with pytest.raises(LogError, match="not 'normalized'.*'pwm'"):
        to_windows(pulses, with_command(PELICAN, kind="normalized", max_speed=800.0))


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), 1e6])
def test_impossible_rates_are_refused(rate: float) -> None:
    with pytest.raises(LogError, match="1 to 2000 Hz"):
        to_windows(FLIGHT.recording(), PELICAN, rate)


def test_signals_that_never_overlap_give_no_window() -> None:
    recording = FLIGHT.at({"gyro": np.arange(0.0, 5.0, 0.02), "rotor_speed": np.arange(6.0, 9.0, 0.02)})
    with pytest.raises(NotIdentifiableError, match="without gaps"):
        to_windows(recording, PELICAN)
