"""MAVLink peers written by others, and the whole service, each a process of its own, over UDP."""

from __future__ import annotations

import contextlib
import json
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil
from quadid_node.history import read_history
from quadid_node.mavlink_link import MavlinkLink

from tests.node.mavlink_ends import Sender, accepted, free_port
from tests.node.peers import Process
from tests.online.test_gate import TRUE


@pytest.fixture
def port() -> int:
    return free_port()


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
        list(link.receive())
        link.step()
        time.sleep(0.01)


def test_mavsdk_finds_component_191_reads_its_parameters_and_cannot_write_them(
    crowd: tuple[MavlinkLink, Sender, int],
) -> None:
    """MAVSDK as ground station: it discovers the component by its heartbeat, and reads its text and parameters."""
    link, vehicle, port = crowd
    with Process(sys.executable, str(Path(__file__).with_name("mavsdk_station.py")), str(port)) as station:
        station.wait_for("listening")
        keep_talking(link, vehicle, lambda: station.child.poll() is None, 3.0, 240.0)
        assert station.child.wait(120) == 0, station.text
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
        sys.executable, str(Path(sys.executable).with_name("mavproxy.py")), f"--master=udpin:127.0.0.1:{port}",
        "--daemon", "--non-interactive", "--default-modules=", f"--logfile={log}", f"--state-basedir={tmp_path}",
    ]  # fmt: skip
    with Process(*command) as proxy:
        keep_talking(link, vehicle, lambda: b"QI_J_XX" not in (log.read_bytes() if log.exists() else b""), 3.0, 120.0)
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
        code, took = service.end(signal.SIGINT, times=2)
    assert code == 0, service.text
    assert took < 2.0
    result = json.loads(out.read_text())
    assert result["system"] == 1
    assert result["rates"].keys() >= {"HIGHRES_IMU", "ATTITUDE_QUATERNION", "ESC_STATUS"}
    values = {p["name"]: p["value"] for p in result["in_force"]["parameters"]}
    assert values["b"] == pytest.approx(2.33e-5, rel=0.01)
    assert read_history(history, "pelican")["sets"]
