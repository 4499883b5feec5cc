"""MAVLink over UDP: the protocol of component 191, and bytes of any kind."""

import os
import random
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from quadid_node.mavlink_link import FRAMES_A_SECOND, MavlinkDecoder, MavlinkLink, Requests
from quadid_node.mavlink_wire import JUDGED, LinkError, SafeMavlink, VehicleSender, dialect, frames
from quadid_replay.tlog import read_frames
from quadid_replay.writers import mavlink_messages

from quadid.online.records import Event, OnlineDiagnosis, OnlineFinding
from tests.faults.evidence import Happened
from tests.node.mavlink_ends import KEY, Sender, accepted, decoded, free_port, samples
from tests.online.driving import flight
from tests.online.test_gate import TRUE
from tests.samples import flat

CHANNELS = ("gyro", "accel", "attitude", "rotor_speed", "attitude_reference")


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def link(port: int) -> Iterator[MavlinkLink]:
    made = MavlinkLink(f"udpin:127.0.0.1:{port}", 4)
    yield made
    made.close()


def test_the_first_autopilot_is_the_vehicle_and_is_asked_for_messages(link: MavlinkLink, port: int) -> None:
    station, vehicle = Sender(port, 255, 190), Sender(port, 7, 1)
    station.heartbeat(autopilot=8)
    samples(link, 0.1)
    assert link.vehicle_system == 0
    vehicle.heartbeat(autopilot=3)
    for k in range(20):
        vehicle.imu(10.0 + 0.01 * k)
        station.imu(10.0 + 0.01 * k, rate=99.0)
    got = samples(link, 1.2)
    assert link.vehicle_system == 7
    gyro = [s for s in got if s.channel == "gyro"]
    assert len(gyro) == 20
    assert [s.values[0] for s in gyro] == pytest.approx([0.1] * 20)
    assert abs(gyro[0].t - time.time()) < 3600.0, "absolute, not since boot"
    assert gyro[-1].t - gyro[0].t == pytest.approx(0.19, abs=1e-5)
    heard = vehicle.heard()
    asked = {int(m.param1) for m in heard if m.get_type() == "COMMAND_LONG" and m.command == 511}
    assert {105, 31, 36, 291} <= asked
    assert [m.type for m in heard if m.get_type() == "HEARTBEAT"][0] == 18
    assert {m.get_srcSystem() for m in heard if m.get_type() == "COMMAND_LONG"} == {7}
    assert any(m.get_type() == "PARAM_REQUEST_READ" and m.param_id == "SERVO1_FUNCTION" for m in heard)


def test_a_flight_over_the_wire_gives_every_channel(link: MavlinkLink, port: int) -> None:
    vehicle = Sender(port)
    got = []
    for _, message in mavlink_messages(flight(4.0).recording):
        vehicle.send(message)
        got += flat(link.receive())
    got += samples(link, 0.2)
    counts = {c: sum(s.channel == c for s in got) for c in CHANNELS}
    assert min(counts.values()) >= 199
    rotor = [s for s in got if s.channel == "rotor_speed"]
    assert rotor[50].values == pytest.approx(flight(4.0).window.rotor_speed[50], abs=0.06)


def test_parameters_are_listed_read_and_never_set(link: MavlinkLink, port: int) -> None:
    vehicle, station = Sender(port), Sender(port, 255, 190)
    vehicle.heartbeat()
    station.heartbeat(autopilot=8)
    samples(link, 0.6)
    station.heartbeat(autopilot=8)
    samples(link, 0.1)
    link.publish(accepted())
    station.heard(0.3)
    station.send(dialect.MAVLink_param_request_list_message(1, 191))
    samples(link, 0.1)
    told = {m.param_id: m for m in station.heard() if m.get_type() == "PARAM_VALUE"}
    assert told["QI_SEQ"].param_value == 3.0
    assert told["QI_B"].param_value == pytest.approx(TRUE["b"], rel=1e-6)
    assert told["QI_J_XX_SD"].param_value == pytest.approx(0.005 * TRUE["J_xx"], rel=1e-6)
    assert {m.param_count for m in told.values()} == {len(told)}
    station.send(dialect.MAVLink_param_request_read_message(1, 191, b"QI_J_ZZ", -1))
    samples(link, 0.1)
    assert [m.param_id for m in station.heard() if m.get_type() == "PARAM_VALUE"] == ["QI_J_ZZ"]
    station.send(dialect.MAVLink_param_set_message(1, 191, b"QI_B", 1.0, 9))
    station.send(dialect.MAVLink_param_set_message(1, 1, b"QI_B_NOT_OURS", 1.0, 9))
    samples(link, 0.1)
    heard = station.heard()
    (error,) = [m for m in heard if m.get_type() == "PARAM_ERROR"]
    assert (error.param_id, error.error) == ("QI_B", dialect.MAV_PARAM_ERROR_READ_ONLY)
    (value,) = [m for m in heard if m.get_type() == "PARAM_VALUE"]
    assert value.param_value == pytest.approx(TRUE["b"], rel=1e-6), "unchanged"


def test_results_are_told_as_numbers_and_text(link: MavlinkLink, port: int) -> None:
    vehicle = Sender(port)
    vehicle.heartbeat()
    samples(link, 0.1)
    link.publish(accepted())
    finding = OnlineFinding("mass_change", {"time": 1.0, "fraction": 0.15}, {}, {}, 3.0, 1.0, 0.0, (), "seen")
    link.publish(OnlineDiagnosis(44.0, 40.0, 44.0, (finding,), "explained"))
    link.publish(Event(1.0, "error", "worker", "the fit process \x1b[31mdied\n" + "x" * 200))
    heard = vehicle.heard()
    values = {m.name: m.value for m in heard if m.get_type() == "NAMED_VALUE_FLOAT"}
    assert values["QI_B"] == pytest.approx(TRUE["b"], rel=1e-6)
    texts = [(m.severity, m.text) for m in heard if m.get_type() == "STATUSTEXT"]
    assert (6, "quadid: set 3 accepted") in texts
    assert (4, "quadid: mass_change fraction 0.15") in texts
    assert all(t.isprintable() and len(t) <= 50 for _, t in texts)


def test_half_a_frame_in_a_datagram_does_not_swallow_the_next(link: MavlinkLink, port: int) -> None:
    vehicle, mallory = Sender(port), Sender(port)
    vehicle.heartbeat()
    samples(link, 0.1)
    for k in range(20):
        mallory.socket.send(b"\xfd\xff\x00")
        vehicle.imu(1.0 + 0.01 * k)
    assert len([s for s in samples(link) if s.channel == "gyro"]) == 20


def test_a_flood_is_bounded_and_the_peer_list_does_not_grow(port: int, happened: Happened) -> None:
    """By the link's own clock, which stands still while a second's flood comes: a slow machine sees the same flood."""
    now = [1000.0]
    link, vehicle = MavlinkLink(f"udpin:127.0.0.1:{port}", 4, clock=lambda: now[0]), Sender(port)
    vehicle.heartbeat()
    samples(link, 0.1)
    payload = vehicle.imu(1.0) * 20
    crowd = [Sender(port) for _ in range(30)]
    for sender in crowd:
        sender.socket.send(os.urandom(200))
    seconds, decoded, sent, begin = 3, 0, 0, time.process_time()
    for _ in range(seconds):
        now[0] += 1.0
        for _ in range(20):
            for _ in range(40):
                vehicle.socket.send(payload)
                sent += 20
            decoded += len(flat(link.receive())) // 2
    spent = time.process_time() - begin
    assert sent > 3 * seconds * FRAMES_A_SECOND
    assert decoded <= 1.02 * seconds * FRAMES_A_SECOND
    assert link.traffic().dropped > 0
    assert len(link._wire._conn.clients) <= 2
    link.close()
    each = spent / seconds
    happened(
        14,
        f"{sent // seconds} frames a second: {decoded // seconds} a second decoded, the rest dropped, "
        f"{each:.2f} s of processor time for each second; {len(crowd)} strangers forgotten",
    )


@given(st.lists(st.binary(max_size=400), max_size=8), st.booleans())
def test_any_bytes_give_frames_or_nothing(chunks: list[bytes], whole: bool) -> None:
    buffer = bytearray()
    mav = SafeMavlink(1, 1)
    for chunk in chunks:
        buffer += chunk
        for frame in frames(buffer, whole):
            try:
                mav.decode(bytearray(frame))
            except dialect.MAVError:
                continue
        assert len(buffer) < 300 or not whole


@given(st.integers(0, 2**32), st.booleans())
def test_a_stream_in_pieces_gives_all_frames(seed: int, garbage: bool) -> None:
    rng, mav = random.Random(seed), dialect.MAVLink(None, 1, 1)
    parts = []
    for k in range(20):
        if garbage:
            parts.append(bytes(rng.choice(range(0xF0)) for _ in range(rng.randrange(5))))
        parts.append(bytes(dialect.MAVLink_heartbeat_message(2, 12, 0, k, 4, 3).pack(mav)))
    data = b"".join(parts)
    buffer, found = bytearray(), 0
    while data:
        size = rng.randrange(1, 50)
        buffer += data[:size]
        data = data[size:]
        found += len(list(frames(buffer, whole=False)))
    assert found == 20


def test_a_second_source_under_the_same_id_is_refused_and_said(
    link: MavlinkLink, port: int, happened: Happened
) -> None:
    vehicle, other = Sender(port), Sender(port)
    vehicle.heartbeat()
    samples(link, 0.1)
    for k in range(60):
        vehicle.imu(1.0 + 0.01 * k)
        other.imu(500.0 + 0.01 * k, rate=50.0)
    got = [s for s in samples(link, 0.3) if s.channel == "gyro"]
    assert [s.values[0] for s in got] == pytest.approx([0.1] * 60), "only the first one's, and all of them"
    assert "second source" in link.traffic().problems[0]
    happened(27, "60 frames of a second UDP source under the vehicle's ids: none taken, said")


@pytest.mark.parametrize("stall", [3.5, 60.0])
def test_a_stall_of_the_service_hands_the_vehicle_to_nobody(port: int, stall: float, happened: Happened) -> None:
    """By the link's own clock: all that was sent meanwhile waits in the sockets, the second sender's first."""
    now = [1000.0]
    link = MavlinkLink(f"udpin:127.0.0.1:{port}", 4, clock=lambda: now[0])
    vehicle, other = Sender(port), Sender(port)
    vehicle.heartbeat()
    samples(link, 0.1)

    def taken(frames: int) -> set[float]:
        """Rates of the samples taken of 5 frames of the other and one of the vehicle, ten times."""
        for k in range(frames):
            other.imu(500.0 + 0.01 * k, rate=50.0)
            if k % 5 == 4:
                vehicle.imu(1.0 + 0.01 * k)
        return {s.values[0] for s in flat(link.receive()) if s.channel == "gyro"}

    for _ in range(10):
        now[0] += 0.02
        assert len(taken(10)) == 1
    for _ in range(3):
        now[0] += stall
        assert max(taken(20)) < 1.0
    assert "second source" in link.traffic().problems[0]
    for _ in range(40):  # the vehicle falls silent, and comes from elsewhere
        now[0] += 0.1
        assert not flat(link.receive())
    other.imu(500.0, rate=50.0)
    got = [s.values[0] for s in flat(link.receive()) if s.channel == "gyro"]
    assert got == pytest.approx([50.0])
    link.close()
    happened(43, f"the service stalls for {stall:g} s while two send under the vehicle's ids: the vehicle stays")


@pytest.mark.parametrize("known", [True, False])
def test_a_flood_of_other_systems_costs_the_vehicle_no_frame(port: int, known: bool, happened: Happened) -> None:
    """More than the socket's buffer holds between two looks, by the link's own clock."""
    now = [1000.0]
    link = MavlinkLink(f"udpin:127.0.0.1:{port}", 4, clock=lambda: now[0])
    vehicle, others = Sender(port), [Sender(port, system=77 + k) for k in range(3)]
    vehicle.heartbeat()
    samples(link, 0.1)
    if known:
        for sender in others:
            sender.heartbeat(autopilot=8)
        samples(link, 0.7)
    sent = got = flood = 0
    for _ in range(50):
        now[0] += 0.02
        for k in range(600):
            others[k % 3].heartbeat(autopilot=8)
        flood += 600
        for _ in range(10):
            vehicle.imu(1.0 + 0.002 * sent)
            sent += 1
        got += sum(s.channel == "gyro" for s in flat(link.receive()))
    for _ in range(10):
        got += sum(s.channel == "gyro" for s in flat(link.receive()))
    assert got == sent
    assert any("flood" in problem for problem in link.traffic().problems)
    link.close()
    happened(
        43, f"{flood} valid heartbeats a second of other systems: {got} of the vehicle's {sent} frames taken, said"
    )


@pytest.mark.parametrize("only", [0, 1])
@pytest.mark.parametrize("version", [1, 2])
def test_a_flood_before_the_vehicle_comes_or_comes_back_keeps_nobody_out(
    port: int, only: int, version: int, happened: Happened
) -> None:
    """By the link's own clock; the flood comes first in every look, and stands in the list of peers, too."""
    now = [1000.0]
    link = MavlinkLink(f"udpin:127.0.0.1:{port}", 4, only, clock=lambda: now[0])
    others = [Sender(port, system=77 + k) for k in range(40)]
    heartbeat = [dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3)]

    def imu(t: float) -> list[Any]:
        return [dialect.MAVLink_highres_imu_message(int(t * 1e6), 0.0, 0.0, -9.8, 0.1, *[0.0] * 9, 0x3F)]

    def looks(vehicle: Sender, count: int) -> int:
        """Samples of the vehicle's gyro, in looks of 20 ms with 10,000 heartbeats of others a second before it."""
        found = 0
        for k in range(count):
            now[0] += 0.02
            for j in range(200):
                others[j % 40].heartbeat(autopilot=3 if only else 8)
            for message in heartbeat[k % 50 :] + imu(now[0]):
                vehicle.socket.send(bytes(message.pack(vehicle.mav, force_mavlink1=version == 1)))
                vehicle.mav.seq = (vehicle.mav.seq + 1) % 256
            found += sum(s.channel == "gyro" for s in flat(link.receive()))
            link.step()
        return found

    vehicle = Sender(port)
    assert looks(vehicle, 60) == 60
    assert link.vehicle_system == 1
    assert any(m.get_type() == "COMMAND_LONG" for m in vehicle.heard(0.05)), "it is asked for its messages"
    for _ in range(40):
        now[0] += 0.1
        assert not flat(link.receive())
    again = Sender(port)
    assert looks(again, 60) == 60
    link.close()
    happened(
        43,
        "a flood of 10,000 frames a second before the vehicle is heard, and as it comes back from another "
        "address: its first frame is taken, and it is asked",
    )


def test_what_is_sent_has_a_budget(port: int, happened: Happened) -> None:
    now = [1000.0]
    link = MavlinkLink(f"udpin:127.0.0.1:{port}", 4, clock=lambda: now[0])
    vehicle, stations, stranger = Sender(port), [Sender(port, 200 + k, 190) for k in range(7)], Sender(port, 250)
    for _ in range(3):
        vehicle.heartbeat()
        for station in stations:
            station.heartbeat(autopilot=8)
        for _ in range(2):
            now[0] += 0.3
            flat(link.receive())
            now[0] += 0.3
            flat(link.receive())
    link.publish(accepted())
    for sender in (vehicle, *stations):
        sender.heard(0.05)
    asked, seconds = 0, 2
    kinds = (
        dialect.MAVLink_param_set_message(1, 191, b"QI_SEQ", 1.0, 9),
        dialect.MAVLink_param_request_read_message(1, 191, b"QI_SEQ", -1),
        dialect.MAVLink_param_set_message(1, 191, b"WHAT", 1.0, 9),
    )
    answers = 0
    for _ in range(20 * seconds):
        now[0] += 0.05
        for message in kinds * 10:
            stations[0].send(message)
            stranger.send(message)
            asked += 2
        flat(link.receive())
        link.step()
        answers += len([m for m in stations[0].heard(0.002) if m.get_type().startswith("PARAM")])
    others = [m for s in stations[1:] for m in s.heard(0.05) if m.get_type().startswith("PARAM")]
    assert 0 < answers <= 100 * seconds + 150
    assert others == [], "an answer goes to who asked"
    assert not stranger.heard(0.05)
    assert any("held back" in problem for problem in link.traffic().problems)
    link.publish(accepted())
    assert any(m.get_type() == "STATUSTEXT" for m in vehicle.heard()), "what we say by ourselves has room"
    link.close()
    happened(43, f"{asked} requests in {seconds} s: {answers} answers, all to who asked")


def test_two_senders_mixed_into_one_stream_are_told_by_their_frame_numbers(happened: Happened) -> None:
    """As a router that merges links does: one address, or a serial line, which has none."""
    lossy, mixed, rng = VehicleSender(), VehicleSender(), random.Random(1)
    for k in range(400):
        assert lossy.take(None, 0.02 * k)
        if rng.random() < 0.5:
            lossy.count(None, k % 256, 0.02 * k)
    assert lossy.problem == ""
    took = 0
    for k in range(400):
        for start in (0, 97):
            mixed.count(None, (start + k) % 256, 0.02 * k)
            took += mixed.take(None, 0.02 * k)
    assert "two sources" in mixed.problem
    assert took <= JUDGED + 1
    for k in range(400):
        mixed.count(None, k % 256, 20.0 + 0.02 * k)
        mixed.take(None, 20.0 + 0.02 * k)
    assert mixed.problem == "", "when the other is gone it goes on"
    happened(27, f"two senders merged into one stream: {took} of 800 frames taken until seen; half lost: no alarm")


@pytest.mark.parametrize("ahead", [0, 1, -5, 40, 129])
def test_a_second_sender_that_follows_the_numbers_of_the_first_is_seen(ahead: int, happened: Happened) -> None:
    """From the vehicle's own address, one frame in ten: the steps of the numbers look like those of one sender."""
    source, address, taken = VehicleSender(), ("10.0.0.1", 14550), 0
    source.take(address, 0.0)
    for k in range(2000):
        now = 0.005 * k
        source.count(address, k % 256, now, b"true %d" % k)
        source.take(address, now)
        if k % 10 == 5:
            source.count(address, (k + ahead) % 256, now, b"false %d" % k)
            taken += source.take(address, now)
    assert taken <= 15
    assert "two sources" in source.problem
    happened(27, f"a second sender {ahead} numbers ahead from the same address: {taken} of 200 frames taken")


def test_frames_that_come_twice_late_or_not_at_all_are_those_of_one_sender() -> None:
    rng, address = random.Random(1), ("10.0.0.1", 14550)
    for lost in (0.0, 0.3, 0.7):
        source, late = VehicleSender(), -1
        source.take(address, 0.0)
        for k in range(4000):
            if rng.random() < lost:
                continue
            if late < 0 and rng.random() < 0.02:
                late = k  # comes after the next one
                continue
            for n in (k, late) if late >= 0 else (k,):
                for _ in range(rng.choice((1, 2))):
                    source.count(address, n % 256, 0.0025 * k + 5.0 * (k >= 2000), b"%d" % n)
            late = -1
        assert source.take(address, 15.0), (lost, source.problem)


def test_who_said_hello_once_is_not_answered(link: MavlinkLink, port: int, happened: Happened) -> None:
    vehicle = Sender(port)
    vehicle.heartbeat()
    once = [Sender(port, 200, 1 + k) for k in range(20)]
    for sender in once:
        sender.heartbeat(autopilot=8)
    samples(link, 1.3)
    assert vehicle.heard(0.3)
    assert not any(sender.heard(0.05) for sender in once)
    happened(27, "20 addresses that sent one heartbeat: none answered, the vehicle is")


def test_parameters_nobody_needs_take_no_memory() -> None:
    decoder = MavlinkDecoder(4)
    for k in range(1000):
        name = f"X{k}".encode()
        flat(decoder.blocks(decoded(dialect.MAVLink_param_value_message(name, 1.0, 9, 100, 0)), 0.0))
    assert decoder.order._parameters == {}


@pytest.mark.parametrize("rotors", [4, 6, 8])
def test_speeds_of_rotors_that_are_not_there_are_left_out(rotors: int, happened: Happened) -> None:
    """ESC_STATUS says itself which rotor it begins with: 7 of 6 was an IndexError."""
    for index in range(256):
        decoder = MavlinkDecoder(rotors)
        for first in (0, index, 0, 4):
            message = dialect.MAVLink_esc_status_message(first, 10**6, [6000] * 4, [1.0] * 4, [1.0] * 4)
            assert all(len(s.values) == rotors for s in flat(decoder.blocks(decoded(message), 1.0)))
    happened(15, f"ESC_STATUS from rotor 0 to 255 of a vehicle with {rotors}: nothing but its own rotors")


def test_another_component_of_the_vehicle_elsewhere_is_answered_no_sooner_than_others(
    link: MavlinkLink, port: int, happened: Happened
) -> None:
    vehicle = Sender(port)
    vehicle.heartbeat()
    samples(link, 0.1)
    strangers = [Sender(port, system=1, component=2 + k) for k in range(5)]
    for sender in strangers:
        sender.heartbeat(autopilot=12)
    samples(link, 0.1)
    link.publish(accepted())
    assert vehicle.heard(0.3)
    assert not any(sender.heard(0.2) for sender in strangers)
    happened(27, f"{len(strangers)} addresses, one heartbeat each as another component of the vehicle: none answered")


def test_requests_for_all_parameters_are_answered_once_a_second(
    link: MavlinkLink, port: int, happened: Happened
) -> None:
    vehicle = Sender(port)
    for _ in range(2):
        vehicle.heartbeat()
        samples(link, 0.6)
    link.publish(accepted())
    vehicle.heard(0.3)
    for _ in range(10):
        for _ in range(100):
            vehicle.send(dialect.MAVLink_param_request_list_message(0, 0))
        samples(link, 0.01)
    told = sum(m.get_type() == "PARAM_VALUE" for m in vehicle.heard(0.3))
    assert 0 < told < 100, "before, seventeen frames each"
    happened(15, f"1000 requests for all parameters in a moment: answered with {told} frames, no longer 17,000")


def test_a_long_text_comes_in_pieces_and_whole(link: MavlinkLink, port: int) -> None:
    vehicle = Sender(port)
    vehicle.heartbeat()
    samples(link, 0.1)
    vehicle.heard(0.3)
    texts = ["mass_change: " + "x" * 100, "y" * 92]  # the second fills its two pieces
    for text in texts:
        link.publish(Event(1.0, "warning", "finding", text))
    pieces = [m for m in vehicle.heard() if m.get_type() == "STATUSTEXT"]
    whole: dict[int, str] = {}
    for m in pieces:
        assert m.id > 0
        whole[m.id] = whole.get(m.id, "") + m.text
    assert list(whole.values()) == [f"quadid: {text}" for text in texts]
    assert len(pieces[-1].text) < 50, "a short piece ends it"


def test_a_refused_message_is_named_and_asked_for_no_more() -> None:
    requests, names = Requests(), ["HIGHRES_IMU", "ESC_STATUS"]
    assert requests.due(names, 0.0) == names
    requests.answered("MAV_RESULT_DENIED")
    assert not requests.denied, "at first all are asked for at once: nobody can say which was refused"
    asked = []
    for k in range(1, 2000):
        for name in requests.due(names, 0.1 * k):
            asked.append(name)
            requests.answered("MAV_RESULT_DENIED" if name == "ESC_STATUS" else "")
    assert requests.denied == ("ESC_STATUS (MAV_RESULT_DENIED)",)
    assert asked.count("ESC_STATUS") == 1
    assert 1 < asked.count("HIGHRES_IMU") < 5, "not for ever"


@pytest.mark.parametrize(
    "url", ["udpin:127.0.0.1:99999", "udpout:127.0.0.1:port", "tcp:127.0.0.1:99999", "/dev/no_such_port,921600"]
)
def test_a_link_that_cannot_be_opened_is_one_line(url: str) -> None:
    with pytest.raises(LinkError) as refused:
        MavlinkLink(url, 4)
    assert "\n" not in str(refused.value)


def test_a_signed_link_without_a_key_is_said(port: int) -> None:
    link, vehicle = MavlinkLink(f"udpin:127.0.0.1:{port}", 4), Sender(port, key=KEY)
    try:
        vehicle.heartbeat()
        samples(link, 0.1)
        assert any("there is no key to check them" in problem for problem in link.traffic().problems)
    finally:
        link.close()


def test_servo_outputs_follow_the_autopilots_motor_functions_and_unwrap() -> None:
    decoder = MavlinkDecoder(4, wall=lambda: 4300.0)
    decoder.order.ardupilot = True
    for output, motor in ((1, 36), (2, 35), (3, 34), (4, 33)):
        name = f"SERVO{output}_FUNCTION".encode()
        flat(decoder.blocks(decoded(dialect.MAVLink_param_value_message(name, float(motor), 9, 100, output)), 0.0))
    boot = 4300.0  # beyond 71.6 minutes: the 32 bits of the servo message have wrapped
    imu = dialect.MAVLink_highres_imu_message(int(boot * 1e6), 0, 0, -9.8, 0, 0, 0, *[0.0] * 7, 0x3F)
    out = flat(decoder.blocks(decoded(imu), 100.0))
    pulses = [1100, 1200, 1300, 1400] + [0] * 12
    servo = dialect.MAVLink_servo_output_raw_message(int(boot * 1e6 + 5000) % 2**32, 0, *pulses)
    for k in range(3):
        out += flat(decoder.blocks(decoded(servo), 100.0 + k))
        servo = dialect.MAVLink_servo_output_raw_message(int(boot * 1e6 + 1e6 * (k + 1)) % 2**32, 0, *pulses)
    motors = [s for s in out if s.channel == "motor_command"]
    assert motors[0].values == (1400.0, 1300.0, 1200.0, 1100.0)
    assert motors[0].t == pytest.approx(boot + 0.005)


ROUND_OF: tuple[Callable[[int], Any], ...] = (
    lambda us: dialect.MAVLink_highres_imu_message(us, 0, 0, -9.8, 0, 0, 0, *[0.0] * 7, 0x3F),
    lambda us: dialect.MAVLink_attitude_quaternion_message(us // 1000, 1, 0, 0, 0, 0, 0, 0),
    lambda us: dialect.MAVLink_attitude_target_message(us // 1000, 0, [1, 0, 0, 0], 0, 0, 0, 0.5),
)
"""Stamped messages of a moment, the gyro first; rotor speeds without stamp follow."""


@pytest.mark.parametrize("place", range(len(ROUND_OF)))
@pytest.mark.parametrize(("ahead", "every"), [(2.0, 1), (20.0, 1), (-20.0, 1), (29.0, 100), (-29.0, 100), (1e6, 100)])
def test_stamps_of_one_message_cost_those_of_others_nothing(
    place: int, ahead: float, every: int, happened: Happened
) -> None:
    """All others' had come as late as they were read, and rotor speeds were lost, each with its round."""
    if place == 0 and every == 1:
        return  # the gyro leads the clock: the others are apart from it
    now, rng, off = 0.0, np.random.default_rng(1), defaultdict(list)
    decoder = MavlinkDecoder(4, wall=lambda: 1e9 + now)
    escs = dialect.MAVLink_esc_telemetry_1_to_4_message([30] * 4, [1000] * 4, [0] * 4, [100] * 4, [5000] * 4, [1] * 4)
    for k in range(1000):
        t = 100.0 + 0.02 * k
        now = t + rng.uniform(0.0, 0.03)
        stamps = np.full(len(ROUND_OF), t)
        stamps[place] += ahead if k % every == every // 2 else 0.0
        messages = [*(made(int(max(s, 0.0) * 1e6)) for made, s in zip(ROUND_OF, stamps, strict=True)), escs]
        for sample in flat(block for m in messages for block in decoder.blocks(decoded(m), now)):
            if k >= 150:  # which source is best is known by then
                off[sample.channel].append(sample.t - t - 1e9)
    usual = np.median(off["gyro"])
    apart = {name: sum(abs(x - usual) > 0.04 for x in values) for name, values in off.items()}
    lost = {0: {"gyro", "accel"}, 1: {"attitude"}, 2: {"attitude_reference"}}[place]
    assert len(off["rotor_speed"]) == 850
    assert {name for name, count in apart.items() if count} == lost
    assert max(apart.values()) <= 1000 // every
    assert np.ptp([x for x in off["gyro"] if abs(x - usual) < 1.0]) < 1e-5
    happened(
        42, f"MAVLink, message {place + 1} of a round {ahead:+g} s: {max(apart.values())} of its own lost, no other"
    )


def test_a_reboot_sets_the_clock_anew() -> None:
    wall, off = 1e9, []
    decoder = MavlinkDecoder(4, wall=lambda: wall)
    for k in range(200):
        wall = 1e9 + 0.02 * k + (10.0 if k >= 100 else 0.0)
        imu = ROUND_OF[0](int(1e6 * (100.0 + 0.02 * k if k < 100 else 1.0 + 0.02 * (k - 100))))
        off += [s.t - wall for s in flat(decoder.blocks(imu, wall)) if s.channel == "gyro"]
    np.testing.assert_allclose(np.delete(off, slice(100, 103)), 0.0, atol=1e-5)


def test_a_motor_beyond_the_outputs_that_come_is_said_and_ends_nothing(
    link: MavlinkLink, port: int, happened: Happened
) -> None:
    """One parameter with the value of a motor on output 17 was an IndexError in the service."""
    vehicle = Sender(port)
    vehicle.heartbeat()
    samples(link, 0.1)
    for motor, output in enumerate((1, 2, 3, 17)):
        name = f"SERVO{output}_FUNCTION".encode()
        vehicle.send(dialect.MAVLink_param_value_message(name, 33.0 + motor, 9, 900, output))
    for k in range(20):
        vehicle.imu(10.0 + 0.01 * k)
        vehicle.send(dialect.MAVLink_servo_output_raw_message(10_000_000 + 10_000 * k, 0, *[1500] * 16))
    got = samples(link, 0.3)
    assert {s.channel for s in got} == {"gyro", "accel"}
    (said,) = link.traffic().problems
    assert "motor 4 on output 17" in said
    happened(15, f"the vehicle says that a motor is on output 17 of 16: '{said[:60]}', all else is heard")


# --- A service that reads its link late, as beside other jobs: rotor speeds without a stamp stay in their round


ROUND = 0.02
"""Between two rounds of messages [s]."""


def speeds(rpm: int) -> Any:
    return dialect.MAVLink_esc_telemetry_1_to_4_message([20] * 4, [0] * 4, [0] * 4, [0] * 4, [rpm] * 4, [0] * 4)


def test_what_came_while_nobody_looked_is_of_the_moment_before() -> None:
    port, now = free_port(), [100.0]
    link = MavlinkLink(f"udpin:127.0.0.1:{port}", 4, clock=lambda: now[0])
    vehicle, got = Sender(port), []
    vehicle.heartbeat(autopilot=3)
    for k in range(4):
        vehicle.send(dialect.MAVLink_param_value_message(f"SERVO{k + 1}_FUNCTION".encode(), 33 + k, 4, 4, k))
    flat(link.receive())
    for k in range(100):
        vehicle.imu(10.0 + ROUND * k)
        got += flat(link.receive())
        vehicle.send(speeds(4000 + k))
        now[0] += ROUND  # busy with something else
        got += flat(link.receive())
    link.close()
    gyro, rotors = ([s.t for s in got if s.channel == channel] for channel in ("gyro", "rotor_speed"))
    assert len(rotors) == 99
    np.testing.assert_allclose(rotors, gyro[:99], rtol=0.0, atol=1e-4)


@pytest.mark.parametrize("every", [0.026, 0.2])
def test_a_flight_whose_bytes_are_read_late_keeps_its_rounds(every: float, data_dir: Path) -> None:
    """ArduCopter sends rotor speeds in rounds of 20 ms; looked for more rarely, they still come evenly."""
    frames = read_frames(data_dir / "ardupilot_sitl" / "x.tlog")
    came = frames.received - frames.received[0]
    decoder, coder, times = MavlinkDecoder(4, wall=lambda: 0.0), dialect.MAVLink(None), []
    decoder.order.ardupilot = True
    for k in range(4):
        decoder.order.tell(f"SERVO{k + 1}_FUNCTION", 33.0 + k)
    for k in np.flatnonzero((came > 50.0) & (came < 60.0) & (frames.system == 1)).tolist():
        message, read = coder.decode(bytearray(frames.frame(k))), every * np.ceil(came[k] / every)
        times += [s.t for s in flat(decoder.blocks(message, read, read - every)) if s.channel == "rotor_speed"]
    assert len(times) > 490
    np.testing.assert_allclose(np.diff(times), ROUND, rtol=0.0, atol=2e-3)
