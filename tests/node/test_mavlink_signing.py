"""MAVLink over UDP: signing, peers written by others, and the order of motors of a live vehicle."""

import base64
import contextlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink import mavutil
from quadid_node.history import read_history
from quadid_node.mavlink_link import ASKED, MOST_ROUNDS, PATIENCE, MavlinkDecoder, MavlinkLink, MotorOrder
from quadid_node.mavlink_wire import LinkError, dialect, memory_path, read_key
from quadid_replay.motors import RPM

from tests.faults.evidence import Happened
from tests.node.mavlink_ends import KEY, Sender, accepted, decoded, free_port, samples
from tests.node.peers import LIMIT, Process
from tests.online.test_gate import TRUE
from tests.samples import flat

# --- MAVLink signing over UDP: with a key, nothing that is forged, replayed or unsigned changes anything


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
    arguments += ["--history", str(kept / "h.sqlite"), "--seconds", str(LIMIT), "--json", str(kept / "result.json")]
    kept.mkdir()
    command = [sys.executable, "-c", COMMAND, *arguments]
    served = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    vehicle, sent, deadline = Sender(port, key=SECRET), b"", time.monotonic() + LIMIT
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
        said = served.communicate(timeout=LIMIT)[0]
    written = b"".join(p.read_bytes() for p in kept.rglob("*") if p.is_file())
    assert len(sent) > 1000
    assert b"quadid.serve/1" in written
    assert said
    found = [form for form in forms(SECRET) for place in (sent, said, written) if form in place]
    assert found == []
    assert any(form in key.read_bytes() for form in forms(SECRET)), "the forms are those of the key"
    count = f"{len(sent)} bytes sent, {len(said)} said and {len(written)} written"
    happened(14, f"a service asked for all it has by a vehicle that has the key: the key is in none of {count}")


# --- MAVLink peers written by others, and the whole service, each a process of its own, over UDP


@pytest.fixture
def crowd(port: int) -> Iterator[tuple[MavlinkLink, Sender, int]]:
    """Our link as a client of a ground station's port, with a vehicle that speaks to the same port."""
    link = MavlinkLink(f"udpout:127.0.0.1:{port}", 4, system=1)
    vehicle = Sender(port)
    yield link, vehicle, port
    link.close()


def keep_talking(link: MavlinkLink, vehicle: Sender, going: Callable[[], bool], silent: float, most: float) -> None:
    """The vehicle's heartbeats and our results, as long as `going` says, `most` [s] at most."""
    begin = told = time.monotonic()
    while going() and time.monotonic() - begin < most:
        if time.monotonic() - told > 0.5:
            told = time.monotonic()
            with contextlib.suppress(ConnectionRefusedError):  # nobody listens there yet
                vehicle.heartbeat()
            if told - begin > silent:
                link.publish(accepted())
        flat(link.receive())
        link.step()
        time.sleep(0.01)


def test_mavsdk_finds_component_191_reads_its_parameters_and_cannot_write_them(
    crowd: tuple[MavlinkLink, Sender, int],
) -> None:
    """MAVSDK as ground station: it discovers the component by its heartbeat, and reads its text and parameters."""
    link, vehicle, port = crowd
    with Process(sys.executable, str(Path(__file__).with_name("mavsdk_station.py")), str(port)) as station:
        station.wait_for("listening")
        keep_talking(link, vehicle, lambda: station.child.poll() is None, 3.0, LIMIT)
        assert station.code() == 0, station.text
        said = station.text
    assert "component 191 of system 1" in said
    assert "text quadid: set 3 accepted" in said
    listed = station.wait_for("listed").split()[1:]
    assert {"QI_SEQ", *(f"QI_{n.upper()}" for n in TRUE), *(f"QI_{n.upper()}_SD" for n in TRUE)} <= set(listed)
    assert float(station.wait_for("read QI_B").split()[-1]) == pytest.approx(TRUE["b"], rel=1e-6)
    assert "set refused: READ_ONLY" in said
    assert float(station.wait_for("still QI_B").split()[-1]) == pytest.approx(TRUE["b"], rel=1e-6)


def test_mavproxy_sees_the_parameters(crowd: tuple[MavlinkLink, Sender, int], tmp_path: Path) -> None:
    """MAVProxy, headless: it prints our status text and writes what it heard to a telemetry log."""
    link, vehicle, port = crowd
    log = tmp_path / "heard.tlog"
    command = [
        sys.executable,
        str(Path(sys.executable).with_name("mavproxy.py")),
        f"--master=udpin:127.0.0.1:{port}",
        "--daemon",
        "--non-interactive",
        "--default-modules=",
        f"--logfile={log}",
        f"--state-basedir={tmp_path}",
    ]
    with Process(*command) as proxy:
        keep_talking(link, vehicle, lambda: b"QI_J_XX" not in (log.read_bytes() if log.exists() else b""), 3.0, LIMIT)
        keep_talking(link, vehicle, lambda: True, 0.0, 1.0)
        proxy.end(signal.SIGTERM)
    assert log.exists(), proxy.text
    reader = mavutil.mavlink_connection(str(log))
    found: dict[str, set[Any]] = {}
    while (message := reader.recv_match()) is not None:
        if message.get_srcComponent() == 191:
            kind = message.get_type()
            value = {"PARAM_VALUE": "param_id", "STATUSTEXT": "text", "NAMED_VALUE_FLOAT": "name"}.get(kind, "type")
            found.setdefault(kind, set()).add(getattr(message, value, None))
    assert "QI_J_XX" in found.get("PARAM_VALUE", set()), proxy.text
    assert "quadid: set 3 accepted" in found["STATUSTEXT"]
    assert "QI_B" in found["NAMED_VALUE_FLOAT"]
    assert found["HEARTBEAT"] == {18}


def test_the_whole_service_over_udp(port: int, tmp_path: Path) -> None:
    """`quadid serve` and a simulated vehicle, each a process: the set is in force and in the history."""
    quadid = str(Path(sys.executable).with_name("quadid"))
    out, history = tmp_path / "served.json", tmp_path / "h.sqlite"
    serve = [
        quadid, "serve", "--vehicle", "pelican", "--mavlink", f"udpin:127.0.0.1:{port}", "--window", "5",
        "--gate", "windows=2,width=0.08,yaw_width=0.6", "--history", str(history), "--json", str(out),
    ]  # fmt: skip
    with Process(*serve) as service:
        service.wait_for("ready")
        fly = [quadid, "simulate", f"udpout:127.0.0.1:{port}", "--seconds", "240", "--seed", "6"]
        begin = time.monotonic()
        with Process(*fly):
            service.wait_for("in force")
        assert time.monotonic() - begin > 5.0, "five seconds of flight, the window, take as long"
        code, work = service.end(signal.SIGINT, times=2)
    assert code == 0, service.text
    assert work < 2.0
    result = json.loads(out.read_text())
    assert result["system"] == 1
    assert result["rates"].keys() >= {"HIGHRES_IMU", "ATTITUDE_QUATERNION", "ESC_STATUS"}
    values = {p["name"]: p["value"] for p in result["in_force"]["parameters"]}
    assert values["b"] == pytest.approx(2.33e-5, rel=0.01)
    assert read_history(history, "pelican")["sets"]


# --- Which outputs of a live vehicle are motors: as the autopilot says, and nothing once that changes in use


PULSES = tuple(1000.0 + 10.0 * k for k in range(1, 17))


@pytest.fixture
def order() -> MotorOrder:
    """Of an ArduPilot with four rotors."""
    made = MotorOrder(4)
    made.ardupilot = True
    return made


def tell(order: MotorOrder, *told: int) -> None:
    for output, function in enumerate(told, 1):
        order.tell(f"SERVO{output}_FUNCTION", float(function))


def take(order: MotorOrder, now: float = 0.0) -> tuple[float, ...]:
    return order.take(PULSES, "SERVO_OUTPUT_RAW", now)


def test_nothing_is_taken_for_a_motor_before_an_ardupilot_has_told_which_are(order: MotorOrder) -> None:
    """The first outputs were taken until the answers came, and other ones afterwards."""
    assert take(order, 100.0) == ()
    tell(order, 34, 33)
    assert take(order, 100.2) == ()
    assert order.problem == ""
    tell(order, 34, 33, 36, 35)
    assert take(order, 100.4) == (1020.0, 1010.0, 1040.0, 1030.0)
    assert order.problem == ""


def test_an_ardupilot_that_never_tells_has_its_motors_on_the_first_outputs_and_that_is_said(order: MotorOrder) -> None:
    assert take(order, 100.0) == ()
    assert take(order, 100.0 + PATIENCE) == PULSES[:4]
    assert "has not sent SERVOn_FUNCTION, which names the motor outputs" in order.problem
    tell(order, 33, 34, 35, 36)
    assert take(order, 110.0) == PULSES[:4]


@pytest.mark.parametrize(("first", "esc"), [(1, 1), (5, 5), (9, 9), (9, 1), (29, 29)])
def test_rotor_speeds_go_with_the_outputs_of_their_motors(first: int, esc: int) -> None:
    """Motors 4 1 2 3 on four outputs; ESCs are counted by output, or up to ArduPilot 4.4 from the first of them."""
    decoder, motors, got = MavlinkDecoder(4), (4, 1, 2, 3), []
    decoder.order.ardupilot = True
    for k, motor in enumerate(motors):
        decoder.order.tell(f"SERVO{first + k}_FUNCTION", 32.0 + motor)
    assert f"ESC_TELEMETRY_{esc}_TO_{esc + 3}" in decoder.order.esc_groups()
    pulses = [1000 + 100 * motors[n - first] if 0 <= n - first < 4 else 0 for n in range(1, 33)]
    for k in range(80):  # a better source may still come for a second
        us, none = 2_000_000 + 20_000 * k, [0] * 4
        sent = [
            dialect.MAVLink_servo_output_raw_message(us, port, *pulses[16 * port : 16 * port + 16]) for port in range(2)
        ]
        for group in (1, 5, 9, 29):
            made = getattr(dialect, f"MAVLink_esc_telemetry_{group}_to_{group + 3}_message")
            sent.append(made(none, none, none, none, [1000 * m if group == esc else 0 for m in motors], none))
        for message in sent:
            got += flat(decoder.blocks(decoded(message), us * 1e-6))
    rows = {s.channel: s.values for s in got}
    np.testing.assert_allclose(np.array(rows["rotor_speed"]) / RPM, [1000, 2000, 3000, 4000])
    assert rows["motor_command"] == (1100.0, 1200.0, 1300.0, 1400.0)


@pytest.mark.parametrize(("kind", "motors"), [(2, True), (13, True), (0, True), (1, False), (4, False), (22, False)])
def test_outputs_of_a_plane_are_no_rotors_on_a_live_link_either(order: MotorOrder, kind: int, motors: bool) -> None:
    """The test of the logs: a plane's ailerons passed for rotors."""
    order.kind = kind
    tell(order, 33, 34, 35, 36)
    assert take(order) == (PULSES[:4] if motors else ())
    assert ("no multirotor" in order.problem) is not motors


def test_another_autopilot_is_not_waited_for() -> None:
    assert take(MotorOrder(3)) == PULSES[:3]


@pytest.mark.parametrize(
    ("before", "name", "value"),
    [
        ((33, 34, 35, 36), "SERVO1_FUNCTION", 34.0),
        ((33, 34, 35, 36), "SERVO3_FUNCTION", 0.0),
        ((33, 34, 35, 36), "SERVO4_FUNCTION", 37.0),
        ((), "SERVO1_FUNCTION", 36.0),  # told at last, and not as was taken to go without saying
    ],
)
def test_a_motor_that_moves_in_use_ends_the_use_of_all_outputs(
    before: tuple[int, ...], name: str, value: float, order: MotorOrder, happened: Happened
) -> None:
    """Two motors changed in flight were followed silently: each rotor was taken for the other."""
    tell(order, *before)
    take(order, 0.0)
    assert take(order, PATIENCE) == PULSES[:4]
    order.tell(name, value)
    assert take(order, 11.0) == ()
    assert order.problem.startswith("the motor order changes in use")
    assert name in order.problem
    tell(order, 33, 34, 35, 36)
    assert take(order, 12.0) == (), "what came between is of other rotors"
    happened(31, f"{name} told as {value:g} in flight: no output is used from then on, said")


@pytest.mark.parametrize("told", [[102.0], [101.0, 0.0]])
def test_a_motor_of_px4_that_is_elsewhere_or_moves_ends_the_use_of_all_outputs(told: list[float]) -> None:
    order = MotorOrder(4)
    assert take(order) == PULSES[:4]
    for value in told:
        order.tell("PWM_MAIN_FUNC1", value)
    assert take(order) == ()
    assert "PWM_MAIN_FUNC1" in order.problem


def test_parameters_that_move_no_motor_change_nothing(order: MotorOrder) -> None:
    tell(order, 33, 34, 35, 36, 0, 0)
    assert take(order) == PULSES[:4]
    tell(order, 33, 34, 35, 36, 70, 0)
    order.tell("SERVO1_MIN", 1100.0)
    order.tell("SERVO9_FUNCTION", 35.0)  # drives motor 3 too
    order.tell("SERVO5_FUNCTION", float("nan"))
    assert take(order) == PULSES[:4]
    assert order.problem == ""


def test_a_tricopter_and_a_vehicle_of_more_rotors_than_the_file_has() -> None:
    tricopter, six = MotorOrder(3), MotorOrder(4)
    tell(tricopter, 33, 34, 0, 36, 0, 0, 39)
    assert take(tricopter) == (1010.0, 1020.0, 1040.0)
    tell(six, 33, 34, 35, 36, 37, 38)
    assert take(six) == (), "the first four of six were taken once"
    assert "no order of 4 motors" in six.problem


def test_a_message_with_fewer_outputs_than_the_one_before_ends_nothing() -> None:
    order = MotorOrder(4)
    tell(order, 33, 34, 35)
    order.tell("SERVO17_FUNCTION", 36.0)
    assert order.take((*PULSES, *PULSES), "ACTUATOR_OUTPUT_STATUS", 0.0)[3] == PULSES[0]
    assert take(order) == ()
    assert "motor 4 on output 17" in order.problem


@pytest.fixture
def link() -> Iterator[tuple[MavlinkLink, Sender]]:
    """A service's link, and an ArduPilot on it."""
    port = free_port()
    made = MavlinkLink(f"udpin:127.0.0.1:{port}", 4)
    yield made, Sender(port)
    made.close()


def test_functions_are_asked_for_again_until_they_are_told_but_not_for_ever(link: tuple[MavlinkLink, Sender]) -> None:
    """They were asked for once: one lost frame, and the first outputs were taken."""
    service, vehicle = link
    asked = []
    for k in range(MOST_ROUNDS + 2):
        vehicle.heartbeat(autopilot=3)
        samples(service, 0.05)
        asked.append([m.param_id for m in vehicle.heard(0.1) if m.get_type() == "PARAM_REQUEST_READ"])
        if k == 0:
            told = dialect.MAVLink_param_value_message(b"SERVO1_FUNCTION", 33.0, 9, 900, 1)
            vehicle.send(told)
    assert asked[0] == list(ASKED)
    assert asked[1] == list(ASKED[1:])
    assert asked[MOST_ROUNDS - 1] == list(ASKED[1:])
    assert asked[MOST_ROUNDS] == []
