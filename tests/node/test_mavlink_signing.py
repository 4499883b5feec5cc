"""MAVLink signing over UDP: with a key, nothing that is forged, replayed or unsigned changes anything."""

from __future__ import annotations

import base64
import contextlib
import subprocess
import sys
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


# --- A key never leaves: not in what is sent, said, or written, whatever is asked of the service


COMMAND = "import sys; from quadid.cli.main import app_main; sys.exit(app_main())"
SECRET = bytes(range(32, 64)).translate(bytes(reversed(range(256))))


def forms(key: bytes) -> list[bytes]:
    """The key as programs write such things, whole and its halves."""
    parts = (key, key[:16], key[16:])
    plain = [p for part in parts for p in (part, part.hex().encode(), part.hex().upper().encode(), repr(part).encode())]
    return [*plain, base64.b64encode(key), base64.b64encode(key)[:20], str(list(key))[1:-1].encode()]


def test_a_key_is_in_nothing_that_a_service_sends_says_or_writes(tmp_path: Path, happened: Happened) -> None:
    key, port = tmp_path / "secret", free_port()
    key.write_bytes(SECRET)
    kept = tmp_path / "kept"
    arguments = ["serve", "--vehicle", "pelican", "--mavlink", f"udpin:127.0.0.1:{port}", "--key", str(key)]
    arguments += ["--history", str(kept / "h.sqlite"), "--seconds", "60", "--json", str(kept / "result.json")]
    kept.mkdir()
    command = [sys.executable, "-c", COMMAND, *arguments]
    served = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    vehicle, sent, deadline = Sender(port, key=SECRET), b"", time.monotonic() + 60.0
    try:
        while sent.count(b"\xfd") < 60 and time.monotonic() < deadline:
            with contextlib.suppress(OSError):  # nobody listens yet
                vehicle.heartbeat()
                vehicle.imu(time.monotonic())
                vehicle.send(dialect.MAVLink_param_request_list_message(0, 0))
                vehicle.send(dialect.MAVLink_param_request_read_message(0, 191, b"QI_KEY", -1))
                vehicle.send(dialect.MAVLink_setup_signing_message(0, 191, bytes(32), 0))
                while True:
                    sent += vehicle.socket.recv(4096)
            time.sleep(0.1)
    finally:
        served.terminate()
        said = served.communicate(timeout=900)[0]
    written = b"".join(p.read_bytes() for p in kept.rglob("*") if p.is_file())
    assert len(sent) > 1000
    assert b"quadid.serve/1" in written
    assert said
    found = [form for form in forms(SECRET) for place in (sent, said, written) if form in place]
    assert found == []
    assert any(form in key.read_bytes() for form in forms(SECRET)), "the forms are those of the key"
    count = f"{len(sent)} bytes sent, {len(said)} said and {len(written)} written"
    happened(14, f"a service asked for all it has by a vehicle that has the key: the key is in none of {count}")
