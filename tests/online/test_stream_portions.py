"""A stream in any portions gives the same rows bit for bit; no channel's stamps judge another's samples."""

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quadid.data.window import Block
from quadid.flight import fly
from quadid.online.grid_buffer import Rows
from quadid.online.stream import APART, BLOCK, CONFIRMATIONS, MOST_EARLY, ChannelBuffer, Resampler
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened
from tests.online.driving import EPOCH, flight, samples
from tests.online.test_resampler import run, same, taken

PELICAN = Vehicle.shipped("pelican")
FAST = fly(PELICAN, seconds=5.0, seed=3, log_rate=250.0, command_rate=250.0, extras=("velocity",)).recording
TOPICS = (("attitude",), ("rotor_speed",), ("velocity",), ("gyro", "accel"))
STEP = 0.05


def messages(damage: str = "", seed: int = 0) -> list[Block]:
    """The flight as a node takes it in: every `STEP` all messages of each topic, some of them odd."""
    rng, out = np.random.default_rng(seed), []
    for step in range(round(5.0 / STEP)):
        for names in TOPICS:
            t = FAST.channels[names[0]].t
            rows = np.floor(t / STEP + 1e-6) == step
            columns = [(n, FAST.channels[n].values[rows].copy()) for n in names]
            stamps = t[rows] + 1e5
            if damage and rng.random() < 0.2:
                k = int(rng.integers(len(stamps)))
                if damage == "stamps":
                    stamps[k:] += rng.choice([-9.0, -0.9, 0.3, 0.9, 29.0, 1e300])
                elif damage == "reboot" and step > 50:
                    stamps -= 5e4
                elif damage == "pause" and 40 < step < 60:
                    continue
                elif damage == "values":
                    columns[0][1][k] = rng.choice([np.nan, np.inf, 1e30, 1e-30])
                elif damage == "width":
                    columns[0] = (names[0], np.column_stack([columns[0][1]] * 2))
                elif damage == "order":
                    stamps, columns = stamps[::-1], [(n, v[::-1]) for n, v in columns]
            out.append(Block(stamps, tuple(columns)))
    return out


def split(stream: Sequence[Block], cuts: np.random.Generator) -> list[Block]:
    """The same messages in the same order, cut into other portions."""
    out = []
    for block in stream:
        edges = [0, *sorted(cuts.integers(0, len(block.t) + 1, int(cuts.integers(4))).tolist()), len(block.t)]
        out += [
            Block(block.t[a:b], tuple((n, v[a:b]) for n, v in block.columns))
            for a, b in zip(edges[:-1], edges[1:], strict=True)
            if b > a
        ]
    return out


def rows_of(stream: Sequence[Block], every: int = 1) -> tuple[list[Rows], Resampler]:
    """Rows of a stream that somebody asks for after every so many blocks."""
    resampler, out = Resampler(PELICAN), []
    for k, block in enumerate(stream):
        resampler.push(block)
        if k % every == 0:
            out += taken(resampler)
    return out + taken(resampler), resampler


@pytest.mark.parametrize("damage", ["", "stamps", "reboot", "pause", "values", "width", "order"])
@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 2**32), every=st.sampled_from([1, 3, 50, 10**6]))
def test_a_stream_in_any_portions_gives_the_same_rows(damage: str, seed: int, every: int) -> None:
    stream = messages(damage, seed % 7)
    one_by_one = [
        Block(b.t[k : k + 1], tuple((n, v[k : k + 1]) for n, v in b.columns)) for b in stream for k in range(len(b.t))
    ]
    a, whole = rows_of(stream, every)
    for other in (split(stream, np.random.default_rng(seed)), one_by_one):
        b, parts = rows_of(other)
        assert same(a, b)
        assert [(r.fresh, r.new_clock, r.problem, r.spacing) for r in a] == [
            (r.fresh, r.new_clock, r.problem, r.spacing) for r in b
        ]
        assert whole.faults == parts.faults
        assert whole.counts == parts.counts
        assert whole.last == parts.last
        assert whole.notices == parts.notices


OTHERS = ("accel", "attitude", "attitude_reference", "rotor_speed")


@lru_cache(maxsize=8)
def plainly(without: str = "") -> list[Rows]:
    """Rows of eight seconds of an undisturbed flight, or of one without a channel."""
    return run([s for s in samples(flight(8.0).recording, EPOCH) if s.channel != without])[0]


@pytest.mark.parametrize("channel", ["gyro", *OTHERS])
@pytest.mark.parametrize("ahead", [0.6, 1.5, 3.0, 29.0, 31.0, -3.0, 1e9])
def test_one_odd_stamp_costs_no_more_than_itself(channel: str, ahead: float, happened: Happened) -> None:
    stream = samples(flight(8.0).recording, EPOCH)
    places = [k for k, s in enumerate(stream) if s.channel == channel][60::90]
    odd = {k: type(s)(s.t + ahead, s.channel, s.values) for k in places for s in [stream[k]]}
    plain = plainly()
    rows, buffer = run([odd.get(k, s) for k, s in enumerate(stream)])
    assert sum(buffer.faults.values()) <= len(places)
    assert [r.fresh for r in rows] == [r.fresh for r in plain]
    for name in {c for r in plain for c in r.columns} - {channel}:
        for a, b in zip(plain, rows, strict=True):
            assert a.columns[name].tobytes() == b.columns[name].tobytes()
    happened(
        42,
        f"{len(places)} stamps of {channel} {ahead:g} s ahead: {sum(buffer.faults.values())} samples lost, "
        "all other channels bit for bit",
    )


@pytest.mark.parametrize("channel", OTHERS)
@pytest.mark.parametrize("ahead", [1.5, 40.0, -2.5, -3600.0])
def test_a_channel_whose_clock_is_another_is_left_out_and_said(channel: str, ahead: float, happened: Happened) -> None:
    stream = samples(flight(8.0).recording, EPOCH)
    plain = plainly(channel)
    rows, buffer = run([type(s)(s.t + ahead * (s.channel == channel), s.channel, s.values) for s in stream])
    (notice,) = buffer.notices
    assert notice[0] == channel
    assert f"{channel} is {abs(ahead):.1f} s {'ahead of' if ahead > 0.0 else 'behind'} the gyro" in notice[1]
    if channel != "rotor_speed":
        assert same(plain[1:], rows[1:]), "the first rows know of it, and measure nothing by it"
    happened(42, f"the clock of {channel} {ahead:+g} s, all the time: '{notice[1]}'")


def test_a_gyro_that_stops_is_said_and_its_return_goes_on() -> None:
    stream = samples(flight(12.0).recording, EPOCH)
    silent = [s for s in stream if s.channel != "gyro" or not 4.0 < s.t - EPOCH < 9.0]
    rows, buffer = run(silent)
    assert [text.split(" for")[0] for _, text in buffer.notices] == ["no gyro"]
    assert [r.new_clock for r in rows if r.fresh] == [True, False]
    t = np.concatenate([r.t for r in rows])
    assert t[-1] > (EPOCH + 11.0) % 86400
    assert np.diff(t).max() > 4.0, "no rows where there is nothing"
    first = next(r for r in rows[1:] if r.fresh)
    plain, _ = run(stream)
    place = next(r for r in plain if r.t[0] <= first.t[-1] <= r.t[-1])
    at = int(np.argmin(np.abs(place.t - first.t[-1])))
    assert np.isclose(first.columns["gyro"][-1], place.columns["gyro"][at]).all()


@pytest.mark.parametrize("channel", ["gyro", "attitude", "battery"])
@pytest.mark.parametrize("step", [0.4, 0.6, 2.0, 29.0, 29.0 * 4, -29.0])
def test_work_and_memory_are_in_proportion_to_what_came(channel: str, step: float, happened: Happened) -> None:
    """Before, 2,000 samples whose stamps rise by 29 s each were 145,000 blocks of rows, each with a note of its own."""
    stream = samples(flight(4.0).recording, EPOCH)
    _, buffer = run(stream)
    values, count = {"gyro": (0.0,) * 3, "attitude": (1.0, 0.0, 0.0, 0.0), "battery": (12.0,)}[channel], 2000
    t = EPOCH + 4.0 + step * np.repeat(np.arange(count // 4), 4) + 0.01 * np.tile(np.arange(4), count // 4)
    for part in np.array_split(t, 40):
        buffer.push(Block(part, ((channel, np.tile(values, (len(part), 1))),)))
    blocks = len(taken(buffer))
    assert blocks <= count * 0.5 / 0.02 / BLOCK + 10
    held = sum(len(b.t) + b.waiting for b in buffer._buffers.values())
    assert held <= count + 1000
    assert len(buffer._stretches) <= count
    happened(42, f"{count} samples of {channel} whose stamps rise by {step:g} s: {blocks} blocks, {held} samples held")


def test_without_a_gyro_nothing_grows() -> None:
    buffer = Resampler(PELICAN)
    for k in range(20):
        buffer.push(Block(np.arange(1000.0) + k, (("attitude", np.tile([1.0, 0.0, 0.0, 0.0], (1000, 1))),)))
    assert len(buffer._early) == MOST_EARLY
    assert [channel for channel, _ in buffer.notices] == ["gyro"]
    assert buffer.next_rows() is None


@pytest.mark.parametrize(
    ("stamp", "stands"),
    [
        (lambda t: min(t, EPOCH + 4.0), True),
        (lambda t: np.floor(t), True),
        (lambda t: np.floor(10.0 * t) / 10.0, True),
        (lambda t: 1e9 * t, True),
        (lambda t: np.nan, True),
        (lambda t: np.floor(25.0 * t) / 25.0, False),  # each message over two ways
        (lambda t: t + 100.0 * (round(50.0 * t) % 2), False),
    ],
)
def test_a_clock_that_stands_is_named(stamp: Callable[[float], float], stands: bool) -> None:
    """Nothing was said of it; the status stayed as it was before."""
    stream = [type(s)(stamp(s.t), s.channel, s.values) for s in samples(flight(8.0).recording, EPOCH)]
    _, buffer = run(stream)
    assert [channel for channel, text in buffer.notices if text.startswith("time stands still")] == ["gyro"] * stands


def test_a_message_of_stamps_that_are_no_times_is_refused_as_a_whole() -> None:
    """It once ended in a RecursionError, from a thousand stamps on."""
    buffer = Resampler(PELICAN)
    buffer.push(Block(np.append(np.full(3000, np.nan), EPOCH), (("gyro", np.zeros((3001, 3))),)))
    assert buffer.faults["gyro: unconfirmed time"] == 3000
    assert buffer.counts["gyro"] == 1


def test_a_few_odd_samples_are_no_notice() -> None:
    assert CONFIRMATIONS < APART
    stream = samples(flight(8.0).recording, EPOCH)
    late = [
        type(s)(s.t + 5.0 * (s.channel == "attitude" and k % 7 == 0), s.channel, s.values) for k, s in enumerate(stream)
    ]
    _, buffer = run(late)
    assert not buffer.notices


def test_a_buffer_takes_what_had_arrived_by_then_and_no_more() -> None:
    line = ChannelBuffer(1)
    line.add(np.array([0.0, 1.0, 2.0]), np.array([1.0, 2.0, 3.0]), np.array([[1.0], [2.0], [3.0]]))
    line.add(np.array([3.0]), np.array([4.0]), np.array([[4.0]]))
    assert line.waiting == 4
    assert line.settle(0.0, 1.5) == (0, 0)
    assert line.t.tolist() == [1.0, 2.0]
    assert (line.waiting, line.taken) == (2, 2)
    assert line.settle(3.5, 9.0) == (1, 0)
    assert line.values.ravel().tolist() == [1.0, 2.0, 4.0]
    assert line.waiting == 0
