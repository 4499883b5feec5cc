"""Sensors against each other: what contradicts stops learning and publishing, what agrees delays nothing."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from quadid_evaluation.studies.poisoning import Poison
from quadid_replay import open_log
from scipy.signal import butter, sosfiltfilt

from quadid.checks.motion import ALLOWED, AXES, Factor
from quadid.data.window import Recording
from quadid.online import Phase, Session
from quadid.online.checks import LEAD, Consistency
from quadid.online.gate import GateSettings, decide
from quadid.online.grid_buffer import GridBuffer
from quadid.online.records import SetState
from quadid.online.stream import Resampler
from quadid.vehicle import ParameterPrior, Vehicle
from tests.faults.evidence import Happened
from tests.online.driving import flight, published, samples
from tests.online.made_up import GATE, PELICAN, QUICK, between, light_flight, tells, works
from tests.online.test_gate import TRUE, good
from tests.samples import gathered

FLIGHT = light_flight(60.0)


def factors_of(recording: Recording, vehicle: Vehicle = PELICAN) -> tuple[Factor, ...]:
    """Factors at the end of a flight, as a session finds them."""
    return consistency_of(recording, vehicle).factors()


def consistency_of(recording: Recording, vehicle: Vehicle = PELICAN) -> Consistency:
    """Knowledge of a session about the sensors at the end of a flight."""
    resampler, store, found = Resampler(vehicle, 50.0), GridBuffer(50.0, 20.0), Consistency()
    tick = 1.0
    for block in gathered(sample.block for sample in samples(recording)):
        resampler.push(block)
        while (rows := resampler.next_rows()) is not None:
            store.add(rows)
            while rows.t[-1] >= tick:
                found.add(store.span(tick - 1.0 - LEAD, tick), 1.0)
                tick += 1.0
    return found


@pytest.mark.parametrize(
    "effect",
    [
        (),
        (("attitude_delay", "delay", 0.05),),
        (("imu_lag", "cutoff", 8.0),),
        (("ahrs_acceleration_error", "k", 0.5),),
        (("accel_bias", "z", 0.2),),
        (("gyro_bias", "x", 0.05),),
    ],
)
def test_what_healthy_sensors_do_is_no_contradiction(effect: tuple[tuple[str, str, float], ...]) -> None:
    """Delays, the pull of an attitude filter, and biases leave the factors at 1."""
    found = factors_of(flight(40.0, 5, effects=effect).recording)
    assert len(found) == 10, "three sizes, two leaks into each axis, and gravity"
    for factor in found:
        assert not factor.disagrees, str(factor)
        assert factor.known or "gyro's yaw" in factor.what
        assert abs(factor.off) < ALLOWED + 2.0 * factor.sigma, str(factor)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_gyro_axis_is_measured_against_the_attitude(axis: int) -> None:
    found = factors_of(Poison("gyro", axis, 1.25, 0.0, 0.0).spoil(flight(40.0, 5).recording))
    (wrong,) = [f for f in found if f.disagrees]
    assert wrong.what.startswith(AXES[axis])
    assert wrong.value == pytest.approx(1.0 / 1.25, abs=4.0 * wrong.sigma)


@pytest.mark.parametrize(("axis", "into"), [(0, 1), (1, 0), (2, 0)])
def test_a_gyro_axis_that_leaks_into_another_is_named(axis: int, into: int) -> None:
    """q + 0.15 p moved an inertia by 7 %, and every turn had the size of its own axis."""
    made = flight(40.0, 5).recording
    gyro = made.channels["gyro"]
    mixed = gyro.values.copy()
    mixed[:, into] += 0.15 * gyro.values[:, axis]
    found = factors_of(replace(made, channels={**made.channels, "gyro": replace(gyro, values=mixed)}))
    (wrong,) = [f for f in found if f.disagrees]
    assert wrong.what == f"part of the gyro's {AXES[axis]} in the attitude's {AXES[into]}"
    assert wrong.value == pytest.approx(-0.15, abs=0.02 + 2.0 * wrong.sigma)


def test_a_small_leak_adds_to_what_the_sensors_may_be_off_by() -> None:
    """q + 0.03 p under a support and a hidden scale of 4 % each, all within their limits: inertias were 6 % off."""
    made = flight(40.0, 5).recording
    gyro = made.channels["gyro"]
    mixed = gyro.values + 0.03 * gyro.values[:, [0]] * [0.0, 1.0, 0.0]
    spoilt = consistency_of(replace(made, channels={**made.channels, "gyro": replace(gyro, values=mixed)}))
    assert not spoilt.fault
    plain, leaky = consistency_of(made).doubts(), spoilt.doubts()
    far = [abs(now.off) - abs(before.off) for before, now in zip(plain, leaky, strict=True)]
    assert far == pytest.approx([0.0, 0.0, 0.03 * np.ptp(gyro.values[:, 0]) / np.ptp(gyro.values[:, 1])], abs=0.01)


def test_a_gyro_that_was_smoothed_without_delay_is_seen_where_inertias_are() -> None:
    """3 Hz, forwards and backwards: turns of a second had the right size, and the inertias were 9 % off."""
    made = flight(40.0, 5).recording
    gyro = made.channels["gyro"]
    smooth = sosfiltfilt(butter(2, 3.0, fs=50.0, output="sos"), gyro.values, axis=0)
    _, roll, pitch = consistency_of(
        replace(made, channels={**made.channels, "gyro": replace(gyro, values=smooth)})
    ).doubts()
    assert min(roll.off, pitch.off) > 0.02
    case = good(doubts=(roll, pitch))
    assert decide(case, GateSettings()).state is not SetState.ACCEPTED


def test_what_two_channels_may_be_off_by_together_is_told() -> None:
    """An accelerometer 4 % and a gyro 3 % off are each within their limit; the inertias were 7 % off."""
    made = Poison("accel", None, 1.04, 0.0, 0.0).spoil(flight(40.0, 5).recording)
    for axis in range(3):
        made = Poison("gyro", axis, 0.97, 0.0, 0.0).spoil(made)
    force, roll, pitch = consistency_of(made).doubts()
    assert force.off == pytest.approx(0.04, abs=2.0 * force.sigma)
    assert roll.off == pytest.approx(1.04 / 0.97 - 1.0, abs=2.0 * roll.sigma)
    assert pitch.off == pytest.approx(1.04 / 0.97 - 1.0, abs=2.0 * pitch.sigma)


def test_what_was_not_compared_yet_is_in_doubt() -> None:
    hardly, nothing = consistency_of(flight(30.0, 3, "hover").recording), Consistency()
    assert [f.sigma for f in hardly.doubts()[1:]] == [math.inf, math.inf]
    assert nothing.doubts() == ()


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_an_accelerometer_is_measured_against_gravity_and_an_attitude_against_the_gyro(factor: float) -> None:
    made = flight(40.0, 5).recording
    found = factors_of(Poison("accel", None, factor, 0.0, 0.0).spoil(made))
    (wrong,) = [f for f in found if f.disagrees]
    assert "gravity" in wrong.what
    assert wrong.value == pytest.approx(factor, abs=2.0 * wrong.sigma)
    tilted = factors_of(Poison("attitude", None, factor, 0.0, 0.0).spoil(made))
    assert {f.what.split()[0] for f in tilted if f.disagrees} >= {"roll", "pitch"}


def test_an_axis_that_hardly_turns_tells_nothing() -> None:
    found = factors_of(flight(30.0, 3, "hover").recording)
    assert ["gravity" in f.what for f in found] == [True]


SPOILT = [("gyro", 0, 1.1), ("gyro", 1, 0.8), ("accel", None, 1.2), ("attitude", None, 0.9)]


@pytest.mark.parametrize(("channel", "column", "factor"), SPOILT)
@pytest.mark.parametrize("begin", [0.0, 25.0])
def test_while_sensors_contradict_each_other_nothing_is_learned_or_published(
    channel: str, column: int | None, factor: float, begin: float, happened: Happened
) -> None:
    stream = []
    for s in FLIGHT:
        values = np.array(s.values)
        if s.channel == channel and s.t >= begin:
            if channel == "attitude":
                half = values[1:] * factor
                values = np.array([np.sqrt(1.0 - half @ half), *half])
            else:
                values[slice(None) if column is None else column] *= factor
        stream.append(s._replace(values=tuple(values.tolist())))
    session = Session(PELICAN, QUICK)
    early = works(session, between(stream, 0.0, begin + 12.0), tells())
    late = works(session, between(stream, begin + 12.0, begin + 30.0), tells(b=1.03))
    assert not published(late)
    if begin == 0.0:
        assert not published(early)
    status = session.status()
    assert status.phase is Phase.BLOCKED
    assert "sensors disagree" in status.reason
    assert "until they agree" in status.reason
    happened(28, f"{channel} × {factor:g} from {begin:g} s on: nothing published; '{status.reason[:90]}'")


@pytest.mark.parametrize(("channel", "factor"), [("gyro", 180.0 / np.pi), ("accel", 1000.0)])
def test_a_fault_that_is_over_is_forgotten_however_wild_it_was(channel: str, factor: float, happened: Happened) -> None:
    """Five seconds in another unit: what came before and after is right, and alone decides in the end."""
    stream = [
        s._replace(values=tuple(factor * v for v in s.values)) if s.channel == channel and 15.0 <= s.t < 20.0 else s
        for s in light_flight(100.0)
    ]
    session = Session(PELICAN, QUICK)
    works(session, between(stream, 0.0, 25.0), tells())
    assert session.status().phase is Phase.BLOCKED
    assert "sensors disagree" in session.status().reason
    sets = published(works(session, between(stream, 25.0, 100.0), tells()))
    assert session.status().phase is not Phase.BLOCKED
    assert sets
    assert all(s.start > 20.0 for s in sets)
    happened(28, f"{channel} × {factor:.0f} for 5 s: blocked, and {sets[0].stop - 20.0:.0f} s later a set again")


def test_a_vehicle_file_that_knows_b_limits_the_first_set(happened: Happened) -> None:
    """All rotor speeds wrong by one factor look like another b: only what was known before tells."""
    knows = PELICAN.parameters | {"b": ParameterPrior(initial=TRUE["b"] * 1.2, sigma=TRUE["b"] * 0.02)}
    session = Session(PELICAN.model_copy(update={"parameters": knows}), QUICK)
    actions = works(session, between(FLIGHT, 0.0, 12.0), tells())
    assert not published(actions)
    waits = session.active_set.pending
    assert waits is not None
    assert (waits.state, waits.check) == (SetState.PENDING, "reference")
    assert "rotor speeds wrong by a factor" in waits.reason
    happened(28, f"all rotor speeds × 1.1, b known to 2 %: '{waits.reason[:90]}'")


def test_in_flight_rotor_speeds_cannot_walk_away_from_the_first_set(happened: Happened) -> None:
    session = Session(PELICAN, QUICK.model_copy(update={"gate": GATE}))
    sets = published(works(session, between(FLIGHT, 0.0, 12.0), tells()))
    for k in range(12):
        piece = between(FLIGHT, 12.0 + 4.0 * k, 16.0 + 4.0 * k)
        sets += published(works(session, piece, tells(b=1.01**k)))
    furthest = max(abs(s.parameters["b"].value / TRUE["b"] - 1.0) for s in sets)
    assert 0.01 < furthest < 0.06
    happened(28, f"all rotor speeds drifting, b by 1 % in 4 s up to 12 %: published up to {furthest:+.1%}")


def test_sticks_in_step_with_the_readings_are_no_contradiction(data_dir: Path) -> None:
    """ArduCopter's rates swing at half the rate of telemetry: wherever turns are cut, the factors are 1."""
    folder = data_dir / "ardupilot_sitl"
    log, vehicle = open_log(folder / "x.tlog"), Vehicle.named(folder / "sitl_x.yaml")
    for shift in np.arange(0.0, 1.0, 0.14):
        channels = {}
        for name in ("gyro", "accel", "attitude", "rotor_speed"):
            channel = log.channels[name]
            inside = (channel.t > 66.0) & (channel.t < 76.0)
            channels[name] = replace(channel, t=channel.t[inside] - 66.0 + shift, values=channel.values[inside])
        found = factors_of(Recording("x", "tlog", channels), vehicle)
        turns = [f for f in found if f.what.split()[0] in ("roll", "pitch")]
        assert len(turns) == 2
        assert all(f.known and abs(f.value - 1.0) < 0.02 for f in turns), [str(f) for f in turns]
