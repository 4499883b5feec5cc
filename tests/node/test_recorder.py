"""A node's own recording: what it begins with comes back exactly, and messages come back in the order of arrival."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from quadid_node.history import Restored
from quadid_node.inputs import source
from quadid_node.recording import RECORD, Beginning, Recorder, arrivals, read_beginning, stream
from quadid_replay import TopicWriter, open_log, write_mcap
from quadid_replay.mcap_file import McapFile, read_metadata

from quadid.condition.trim import FlightTrim, flight_to_dict
from quadid.errors import LogError
from quadid.online import SessionSettings
from quadid.vehicle import Vehicle
from tests.online.driving import flight
from tests.online.test_gate import TRUE, online_set

PELICAN = Vehicle.shipped("pelican")
INPUTS = source("canonical").inputs
EPOCH_NS = 1_700_000_000 * 10**9


def beginning() -> Beginning:
    last = replace(online_set(TRUE), sequence=4)
    trim = np.array([0.1, -0.2, 0.3, 1.0 / 3.0])
    healthy = FlightTrim("one", trim, np.array([trim, trim]), np.full(4, 0.25), 0.1 * trim, 60.0, "accelerometer")
    restored = Restored(last, 5, last, healthy=(healthy,))
    return Beginning(PELICAN, SessionSettings(window=5.0, seed=7), "canonical", restored)


def messages(path: Path) -> list[tuple[str, str, bytes]]:
    file = McapFile(path)
    topics = file.topics
    return [(topics[n].name, topics[n].type, data) for n, _, data in file.messages(topics.keys())]


def test_what_a_session_began_with_comes_back_exactly(tmp_path: Path) -> None:
    path, written = tmp_path / "r.mcap", beginning()
    Recorder(path, written, INPUTS).close()
    found = read_beginning(path)
    assert found is not None
    assert (found.vehicle, found.settings, found.source) == (written.vehicle, written.settings, written.source)
    assert found.restored.next_sequence == 5
    assert found.restored.item is not None
    assert written.restored.item is not None
    assert [p.value for p in found.restored.item.parameters] == [p.value for p in written.restored.item.parameters]
    assert np.array_equal(found.restored.item.parameters.covariance, written.restored.item.parameters.covariance), (
        "to the last bit"
    )
    (healthy,) = found.restored.healthy
    assert flight_to_dict(healthy) == flight_to_dict(written.restored.healthy[0]), "health is judged as it was"


def test_messages_come_back_in_the_order_of_arrival(tmp_path: Path) -> None:
    log, path = tmp_path / "log.mcap", tmp_path / "r.mcap"
    write_mcap(log, flight(4.0).recording, EPOCH_NS)
    rng = np.random.default_rng(1)
    given = messages(log)
    shuffled = [given[i] for i in np.argsort(np.arange(len(given)) + rng.uniform(0.0, 60.0, len(given)))]
    recorder = Recorder(path, beginning(), INPUTS)
    for topic, kind, data in shuffled:
        recorder.take(topic, kind, data)
    recorder.close()
    assert messages(path) == shuffled
    got = list(arrivals(path, "canonical", 4))
    sorted_ones = list(stream(open_log(str(log))))
    assert sorted(got, key=lambda s: (s.channel, s.t)) == sorted(sorted_ones, key=lambda s: (s.channel, s.t))
    assert got != sorted(got, key=lambda s: s.t)


def test_other_files_have_no_beginning_and_damage_is_told(tmp_path: Path) -> None:
    path = tmp_path / "plain.mcap"
    write_mcap(path, flight(4.0).recording)
    assert read_beginning(path) is None
    assert read_metadata(path) == {}
    (tmp_path / "no.mcap").write_bytes(b"no MCAP")
    assert read_beginning(tmp_path / "no.mcap") is None
    with TopicWriter(path, {RECORD: {"vehicle": "x"}}):
        pass
    with pytest.raises(LogError, match="cannot be read"):
        read_beginning(path)
    for restored in ("[" * 100_000, '{"item": null, "next_sequence": 1e999, "baseline": null}', '"x"', "[]"):
        told = {"vehicle": PELICAN.to_yaml(), "settings": "{}", "source": "canonical", "restored": restored}
        with TopicWriter(path, {RECORD: told}):
            pass
        with pytest.raises(LogError, match="cannot be read"):
            read_beginning(path)
    os.mkfifo(tmp_path / "pipe.mcap")
    assert read_beginning(tmp_path / "pipe.mcap") is None
