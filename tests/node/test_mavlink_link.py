"""MAVLink over UDP: the protocol of component 191, and bytes of any kind."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from quadid_node.mavlink_decode import MavlinkDecoder
from quadid_node.mavlink_link import FRAMES_A_SECOND, MavlinkLink
from quadid_node.mavlink_wire import SafeMavlink, dialect, frames
from quadid_replay.tlog_writer import mavlink_messages

from quadid.online.records import Diagnosed, Event, OnlineFinding
from tests.faults.evidence import Happened
from tests.node.mavlink_ends import Sender, accepted, free_port, samples
from tests.online.driving import flight
from tests.online.test_gate import TRUE

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
    assert abs(gyro[0].t - time.time()) < 60.0, "absolute, not since boot"
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
        got += list(link.receive())
    got += samples(link, 0.2)
    counts = {c: sum(s.channel == c for s in got) for c in CHANNELS}
    assert min(counts.values()) >= 199
    rotor = [s for s in got if s.channel == "rotor_speed"]
    assert rotor[50].values == pytest.approx(flight(4.0).window.rotor_speed[50], abs=0.06)


def test_parameters_are_listed_read_and_never_set(link: MavlinkLink, port: int) -> None:
    vehicle, station = Sender(port), Sender(port, 255, 190)
    vehicle.heartbeat()
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
    link.publish(Diagnosed(44.0, 40.0, 44.0, (finding,), "explained"))
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
            decoded += len(list(link.receive())) // 2
    spent = time.process_time() - begin
    assert sent > 3 * seconds * FRAMES_A_SECOND
    assert decoded <= 1.02 * seconds * FRAMES_A_SECOND
    assert link.traffic().dropped > 0
    assert len(link._wire._conn.clients) <= 2
    link.close()
    each = spent / seconds
    happened(14, f"{sent // seconds} frames a second: {decoded // seconds} a second decoded, the rest dropped, "
                 f"{each:.2f} s of processor time for each second; {len(crowd)} strangers forgotten")  # fmt: skip


@given(st.lists(st.binary(max_size=400), max_size=8), st.booleans())
def test_any_bytes_give_frames_or_nothing(chunks: list[bytes], whole: bool) -> None:
    buffer = bytearray()
    mav = SafeMavlink(None)
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


def test_servo_outputs_follow_the_autopilots_motor_functions_and_unwrap() -> None:
    decoder = MavlinkDecoder(4, wall=lambda: 4300.0)
    decoder.autopilot = 3
    for output, motor in ((1, 36), (2, 35), (3, 34), (4, 33)):
        name = f"SERVO{output}_FUNCTION".encode()
        list(decoder.samples(decoded(dialect.MAVLink_param_value_message(name, float(motor), 9, 100, output)), 0.0))
    boot = 4300.0  # beyond 71.6 minutes: the 32 bits of the servo message have wrapped
    imu = dialect.MAVLink_highres_imu_message(int(boot * 1e6), 0, 0, -9.8, 0, 0, 0, *[0.0] * 7, 0x3F)
    out = list(decoder.samples(decoded(imu), 100.0))
    pulses = [1100, 1200, 1300, 1400] + [0] * 12
    servo = dialect.MAVLink_servo_output_raw_message(int(boot * 1e6 + 5000) % 2**32, 0, *pulses)
    for k in range(3):
        out += list(decoder.samples(decoded(servo), 100.0 + k))
        servo = dialect.MAVLink_servo_output_raw_message(int(boot * 1e6 + 1e6 * (k + 1)) % 2**32, 0, *pulses)
    motors = [s for s in out if s.channel == "motor_command"]
    assert motors[0].values == (1400.0, 1300.0, 1200.0, 1100.0)
    assert motors[0].t == pytest.approx(boot + 0.005)


def decoded(message: Any) -> Any:
    mav = dialect.MAVLink(None, 1, 1)
    return mav.decode(bytearray(message.pack(mav)))
