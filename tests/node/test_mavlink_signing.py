"""MAVLink signing over UDP: with a key, nothing that is forged, replayed or unsigned changes anything."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from quadid_node.mavlink_link import MavlinkLink
from quadid_node.mavlink_wire import LinkError, dialect, memory_path, read_key

from tests.faults.evidence import Happened
from tests.node.mavlink_ends import KEY, Sender, free_port, samples


@pytest.fixture
def port() -> int:
    return free_port()


def signed_link(port: int) -> MavlinkLink:
    return MavlinkLink(f"udpin:127.0.0.1:{port}", 4, key=KEY)


def test_with_a_key_unsigned_forged_and_replayed_frames_change_nothing(port: int, happened: Happened) -> None:
    link = signed_link(port)
    vehicle, mallory, thief = Sender(port, key=KEY), Sender(port), Sender(port, key=bytes(32))
    try:
        mallory.heartbeat()
        thief.heartbeat()
        samples(link, 0.1)
        assert link.vehicle_system == 0, "neither an unsigned nor a wrongly signed vehicle is believed"
        first = vehicle.heartbeat()
        stolen = vehicle.imu(1.0)
        assert len([s for s in samples(link, 0.1) if s.channel == "gyro"]) == 1
        assert link.vehicle_system == 1
        for frame in (first, stolen, stolen):
            mallory.socket.send(frame)
        for k in range(50):
            mallory.imu(2.0 + k, rate=50.0)
            thief.imu(2.0 + k, rate=50.0)
        assert samples(link, 0.2) == []
        assert link.traffic().refused >= 103
        vehicle.imu(1.01)
        assert len([s for s in samples(link, 0.1) if s.channel == "gyro"]) == 1
        assert all(m.get_msgbuf()[2] & 1 for m in vehicle.heard()), "what we send is signed"
        happened(14, "103 unsigned, wrongly signed and replayed frames: none taken, all counted; vehicle heard")
    finally:
        link.close()


def test_a_vehicle_without_the_time_is_refused_and_the_reason_is_told(port: int) -> None:
    """Its clock is behind ours by more than a minute: to us its frames are as good as recorded ones."""
    link, vehicle = signed_link(port), Sender(port, key=KEY)
    try:
        vehicle.mav.signing.timestamp -= 200 * 100_000
        vehicle.heartbeat()
        samples(link, 0.1)
        assert link.vehicle_system == 0
        assert 190.0 < link.traffic().behind < 210.0
        vehicle.mav.signing.timestamp += 199 * 100_000
        vehicle.heartbeat()
        samples(link, 0.1)
        assert link.vehicle_system == 1
        assert link.traffic().behind == 0.0
    finally:
        link.close()


def test_a_forged_timestamp_from_the_far_future_does_not_lock_the_vehicle_out(port: int, happened: Happened) -> None:
    """pymavlink itself notes the timestamp before it checks the signature."""
    link, vehicle, mallory = signed_link(port), Sender(port, key=KEY), Sender(port, key=bytes(32))
    try:
        vehicle.heartbeat()
        samples(link, 0.1)
        mallory.mav.signing.timestamp = 2**48 - 100
        for _ in range(5):
            mallory.heartbeat()
        samples(link, 0.1)
        vehicle.imu(1.0)
        assert [s.channel for s in samples(link, 0.1)] == ["gyro", "accel"]
    finally:
        link.close()
    theirs = dialect.MAVLink(None)
    theirs.signing.secret_key = KEY
    frame = bytearray(mallory.heartbeat())
    with pytest.raises(dialect.MAVError):
        theirs.decode(frame)
    assert max(theirs.signing.stream_timestamps.values()) > 2**47, "the weakness is still there: keep our check"
    happened(14, "forged stamp from the far future: the vehicle is still heard (pymavlink alone locks it out)")


def test_old_signatures_of_a_new_stream_are_refused(port: int) -> None:
    link, vehicle = signed_link(port), Sender(port, key=KEY)
    try:
        vehicle.mav.signing.timestamp -= 3600 * 100_000
        vehicle.heartbeat()
        samples(link, 0.1)
        assert link.vehicle_system == 0
    finally:
        link.close()


def test_replays_are_refused_after_a_restart_and_with_the_clock_set_back(
    port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, happened: Happened
) -> None:
    memory = memory_path(tmp_path / "deep", KEY)
    vehicle, thief = Sender(port, key=KEY), Sender(port)
    link = MavlinkLink(f"udpin:127.0.0.1:{port}", 4, key=KEY, memory=memory)
    stolen = [vehicle.heartbeat(), *(vehicle.imu(1.0 + 0.01 * k) for k in range(20))]
    assert samples(link, 0.2)
    link.close()
    hour = 3600.0
    for clock_back in (0.0, hour):
        now = time.time
        monkeypatch.setattr(time, "time", lambda now=now, back=clock_back: now() - back)
        link = MavlinkLink(f"udpin:127.0.0.1:{port}", 4, key=KEY, memory=memory)
        monkeypatch.undo()
        try:
            for frame in stolen:
                thief.socket.send(frame)
            assert samples(link, 0.2) == []
            assert link.vehicle_system == 0
            assert link.traffic().refused == len(stolen)
        finally:
            link.close()
    link = MavlinkLink(f"udpin:127.0.0.1:{port}", 4, key=KEY, memory=memory)
    try:
        vehicle.mav.signing.timestamp += 3 * 100_000  # it went on meanwhile
        vehicle.heartbeat()
        vehicle.imu(5.0)
        assert samples(link, 0.2), "the vehicle itself is heard again"
    finally:
        link.close()
    happened(14, f"{len(stolen)} recorded frames after a restart, and with our clock set back by an hour: all refused")


def test_replays_of_a_stream_behind_another_one_are_refused_after_a_restart(port: int, tmp_path: Path) -> None:
    memory = memory_path(tmp_path, KEY)
    vehicle, station, thief = Sender(port, key=KEY), Sender(port, 255, 190, key=KEY), Sender(port)
    station.mav.signing.timestamp += 30 * 100_000
    link = MavlinkLink(f"udpin:127.0.0.1:{port}", 4, key=KEY, memory=memory)
    vehicle.heartbeat()
    station.heartbeat(autopilot=8)
    samples(link, 0.1)
    vehicle.mav.signing.timestamp += 5 * 100_000  # time goes on; the station, 30 s ahead, says nothing more
    stolen = [vehicle.heartbeat(), *(vehicle.imu(6.0 + 0.01 * k) for k in range(5))]
    assert samples(link, 0.2)
    link.close()
    link = MavlinkLink(f"udpin:127.0.0.1:{port}", 4, key=KEY, memory=memory)
    try:
        for frame in stolen:
            thief.socket.send(frame)
        assert samples(link, 0.2) == []
        assert link.vehicle_system == 0
    finally:
        link.close()


@pytest.mark.parametrize("data", [b"", b"short", b"z" * 64])
def test_a_key_that_is_none_opens_no_link(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "key"
    path.write_bytes(data)
    with pytest.raises(LinkError):
        read_key(path)
    with pytest.raises(LinkError, match="cannot be read"):
        read_key(tmp_path / "none")
    path.write_text(KEY.hex() + "\n")
    assert read_key(path) == KEY
