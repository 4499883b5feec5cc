"""Blocks of messages: the same rows, counts and faults to the bit as their samples one by one."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from quadid.flight import fly
from quadid.online.channel_buffer import ChannelBuffer
from quadid.online.resampler import Resampler
from quadid.online.rows import Rows
from quadid.vehicle import Vehicle
from quadid.window import Block, Recording
from tests.online.test_resampler import next_rows, same

PELICAN = Vehicle.shipped("pelican")
STEP = 0.05


@pytest.fixture(scope="module")
def recording() -> Recording:
    return fly(PELICAN, seconds=4.0, seed=3, log_rate=500.0, command_rate=500.0).recording


def blocks(recording: Recording) -> Iterator[Block]:
    """What a node takes in every `STEP`: attitude, rotor speeds, then gyro and accelerometer together."""
    for step in range(round(4.0 / STEP)):
        for names in (("attitude",), ("rotor_speed",), ("gyro", "accel")):
            t = recording.channels[names[0]].t
            rows = np.floor(t / STEP + 1e-6) == step
            yield Block(t[rows] + 1e5, tuple((n, recording.channels[n].values[rows]) for n in names))


def both_ways(stream: list[Block]) -> tuple[list[Rows], list[Rows], Resampler, Resampler]:
    whole, single = Resampler(PELICAN), Resampler(PELICAN)
    a, b = [], []
    for block in stream:
        whole.push_block(block)
        for sample in block.samples():
            single.push(sample)
        while (rows := next_rows(whole)) is not None:
            a.append(rows)
        while (rows := next_rows(single)) is not None:
            b.append(rows)
    return a, b, whole, single


def test_a_stream_of_blocks(recording: Recording) -> None:
    a, b, whole, single = both_ways(list(blocks(recording)))
    assert sum(len(rows.t) for rows in a) > 100
    assert same(a, b)
    assert whole.counts == single.counts
    assert whole.last == single.last
    assert whole.faults == single.faults == {}


@pytest.mark.parametrize("damage", ["late", "wild time", "clock step", "not finite", "width", "unknown", "attitude"])
def test_blocks_with_faults(recording: Recording, damage: str) -> None:
    stream = list(blocks(recording))
    block = stream[100]
    t, (name, values) = block.t.copy(), block.columns[0]
    values = values.copy()
    if damage == "late":
        t[1:] -= 0.9
    elif damage == "wild time":
        t[2] = 1e300
    elif damage == "clock step":
        t[3:] += 5000.0
    elif damage == "not finite":
        values[2] = np.nan
    elif damage == "width":
        values = np.column_stack([values, values])
    elif damage == "unknown":
        name = "smell"
    else:
        name, values = "attitude", np.full((len(t), 4), 0.1)
    stream[100] = Block(t, ((name, values), *block.columns[1:]))
    a, b, whole, single = both_ways(stream)
    assert same(a, b)
    assert whole.counts == single.counts
    assert whole.faults == single.faults
    assert whole.time.steps == single.time.steps


def test_blocks_in_any_order_of_arrival(recording: Recording) -> None:
    rng = np.random.default_rng(5)
    stream = list(blocks(recording))
    for k in range(0, len(stream) - 6, 6):
        part = stream[k : k + 6]
        stream[k : k + 6] = [part[i] for i in rng.permutation(6)]
    a, b, whole, single = both_ways(stream)
    assert sum(len(rows.t) for rows in a) > 100
    assert same(a, b)
    assert whole.faults == single.faults


def test_a_line_takes_what_had_arrived_by_then_and_no_more() -> None:
    line = ChannelBuffer(1)
    line.extend(np.array([1.0, 2.0, 3.0]), np.array([[1.0], [2.0], [3.0]]))
    line.add(4.0, (4.0,))
    assert (line.arrived, line.waiting) == (4, 4)
    assert line.settle(0.0, 2) == (0, 0)
    assert line.t.tolist() == [1.0, 2.0]
    assert line.waiting == 2
    assert line.settle(3.5, 4) == (1, 0)
    assert line.values.ravel().tolist() == [1.0, 2.0, 4.0]
    assert line.waiting == 0
