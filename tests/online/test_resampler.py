"""The buffer: a log on the grid passes bit for bit, order of arrival changes nothing, faults are counted."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quadid.data.grid import to_windows
from quadid.data.window import Block
from quadid.flight import fly
from quadid.online.grid_buffer import GridBuffer, Rows
from quadid.online.stream import BLOCK, SETTLE, Resampler
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened
from tests.online.driving import EPOCH, flight, samples
from tests.samples import Sample

PELICAN = Vehicle.shipped("pelican")


def run(stream: Sequence[Sample], buffer: Resampler | None = None) -> tuple[list[Rows], Resampler]:
    buffer = buffer or Resampler(PELICAN)
    rows = []
    for sample in stream:
        buffer.push(sample.block)
        while (block := buffer.next_rows()) is not None:
            rows.append(block)
    return rows, buffer


def stacked(rows: Sequence[Rows], name: str) -> np.ndarray:
    return np.concatenate([r.columns[name] for r in rows])


def same(a: Sequence[Rows], b: Sequence[Rows]) -> bool:
    return len(a) == len(b) and all(
        x.t.tobytes() == y.t.tobytes()
        and x.columns.keys() == y.columns.keys()
        and all(x.columns[n].tobytes() == y.columns[n].tobytes() for n in x.columns)
        for x, y in zip(a, b, strict=True)
    )


@pytest.mark.parametrize("epoch", [0.0, EPOCH])
def test_a_log_on_the_grid_passes_bit_for_bit(epoch: float) -> None:
    window = flight(8.0).window
    rows, buffer = run(samples(flight(8.0).recording, epoch))
    assert not buffer.faults
    assert len(rows) >= (8.0 - SETTLE) * 50 / BLOCK - 1
    for name in ("gyro", "accel", "attitude", "rotor_speed"):
        got = stacked(rows, name)
        assert got.tobytes() == getattr(window, name)[: len(got)].tobytes()


def test_a_fast_log_comes_out_as_it_does_offline() -> None:
    fast = fly(PELICAN, seconds=6.0, seed=2, log_rate=500.0, command_rate=500.0)
    (offline,) = to_windows(fast.recording, PELICAN)
    rows, _ = run(samples(fast.recording))
    at = np.concatenate([r.t for r in rows])
    assert {r.sampling for r in rows} == {"smooth"}
    first = round((offline.t0 - at[0]) / 0.02)
    for name in ("gyro", "accel", "rotor_speed"):
        online = stacked(rows, name)[first:]
        assert np.abs(online - getattr(offline, name)[: len(online)]).max() < 1e-6 * np.abs(online).max()


@settings(max_examples=8)
@given(seed=st.integers(0, 2**32 - 1), delay=st.floats(0.0, 0.35))
def test_order_of_arrival_changes_nothing(seed: int, delay: float) -> None:
    stream = samples(flight(4.0).recording, EPOCH)
    rng = np.random.default_rng(seed)
    late = {name: rng.uniform(0.0, delay) for name in ("gyro", "accel", "attitude", "rotor_speed")}
    shuffled = sorted(stream, key=lambda s: s.t + late.get(s.channel, 0.0))
    plain, _ = run(stream)
    other, buffer = run(shuffled)
    assert same(plain[: len(other)], other)
    assert not buffer.faults


@given(st.integers(0, 2**32), st.sampled_from([1, 7, 50, 10_000]))
@settings(max_examples=12, deadline=None)
def test_when_rows_are_asked_for_changes_nothing_not_even_for_late_samples_and_a_reboot(seed: int, every: int) -> None:
    rng = np.random.default_rng(seed)
    first = samples(flight(4.0).recording, 100.0)
    delay = {name: rng.uniform(0.0, 1.2) for name in ("attitude", "rotor_speed", "accel")}  # beyond SETTLE as well
    arrived = sorted(first, key=lambda s: s.t + delay.get(s.channel, 0.0) + rng.exponential(0.05))
    arrived += samples(flight(4.0).recording, 3.0)
    prompt, seen = run(arrived)
    lazy = Resampler(PELICAN)
    rows: list[Rows] = []
    for k, sample in enumerate(arrived):
        lazy.push(sample.block)
        if k % every == 0:
            rows += taken(lazy)
    rows += taken(lazy)
    assert same(rows, prompt)
    assert lazy.faults == seen.faults
    assert any(r.fresh for r in rows[1:])


def taken(buffer: Resampler) -> list[Rows]:
    return list(iter(buffer.next_rows, None))


def test_duplicates_are_dropped_and_counted(happened: Happened) -> None:
    stream = samples(flight(4.0).recording)
    doubled = [s for sample in stream for s in (sample, sample)]
    plain, _ = run(stream)
    rows, buffer = run(doubled)
    assert same(plain, rows)
    assert buffer.faults["gyro: duplicate"] > 100
    happened(
        8, f"every sample twice: rows bit for bit the same, {buffer.faults['gyro: duplicate']} gyro duplicates counted"
    )


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), float("-inf")])
def test_values_that_are_no_numbers_never_reach_a_row(bad: float, happened: Happened) -> None:
    stream = samples(flight(4.0).recording)
    broken = [
        Sample(s.t, s.channel, (bad, *s.values[1:])) if s.channel == "accel" and i % 7 == 0 else s
        for i, s in enumerate(stream)
    ]
    rows, buffer = run(broken)
    assert buffer.faults["accel: not finite"] > 0
    assert np.isfinite(stacked(rows, "gyro")).all()
    assert not np.isinf(stacked(rows, "accel")).any()
    happened(
        6,
        f"{bad} in every seventh accelerometer sample online: {buffer.faults['accel: not finite']} dropped and counted",
    )


def test_wrong_width_unknown_channel_and_zero_quaternion_are_counted() -> None:
    buffer = Resampler(PELICAN)
    buffer.push(Block.one(0.0, "gyro", (1.0, 2.0)))
    buffer.push(Block.one(0.0, "altitude", (1.0,)))
    buffer.push(Block.one(0.0, "attitude", (0.0, 0.0, 0.0, 0.0)))
    assert sum(buffer.faults.values()) == 3


def test_a_gap_is_not_bridged() -> None:
    stream = [s for s in samples(flight(12.0).recording) if not 5.0 < s.t < 6.0]
    rows, _ = run(stream)
    store = GridBuffer(50.0, 30.0)
    for block in rows:
        store.add(block)
    cut = store.cut(0.0, 11.0)
    assert len(cut.windows) == 2
    assert cut.windows[0].t[-1] <= 5.0 + 1e-9
    assert cut.windows[1].t0 >= 6.0 - 1e-9


def test_a_third_of_lost_packets_leaves_usable_rows(happened: Happened) -> None:
    dense = fly(PELICAN, seconds=6.0, seed=3, log_rate=250.0, command_rate=250.0)
    rng = np.random.default_rng(0)
    rows, _ = run([s for s in samples(dense.recording) if rng.random() > 0.3])
    gyro = stacked(rows, "gyro")
    truth = dense.truth.rates
    at = np.concatenate([r.t for r in rows])
    good = np.isfinite(gyro).all(axis=1)
    assert good.mean() > 0.9
    error = gyro[good] - np.column_stack([np.interp(at[good], dense.truth.t, c) for c in truth.T])
    assert np.sqrt(np.mean(error**2)) < 0.05
    happened(
        8, f"30 % of packets lost at 250 Hz: {good.mean():.1%} of 50 Hz rows usable, gyro within 0.05 rad/s of truth"
    )


def test_too_many_rotors_are_told_as_a_fault() -> None:
    stream = [
        Sample(s.t, s.channel, (*s.values, 1.0)) if s.channel == "rotor_speed" else s
        for s in samples(flight(4.0).recording)
    ]
    rows, buffer = run(stream)
    assert any("5 values instead of 4" in reason for reason in buffer.faults)
    assert "5 values instead of 4; allowed: 4, the rotors of 'pelican'" in rows[-1].problem


@settings(max_examples=40)
@given(
    st.lists(
        st.builds(
            Sample,
            st.floats(),
            st.sampled_from(["gyro", "accel", "attitude", "rotor_speed", "motor_command", "position", "?"]),
            st.lists(st.floats(), max_size=5).map(tuple),
        ),
        max_size=60,
    )
)
def test_anything_may_be_pushed(stream: list[Sample]) -> None:
    run(stream)
