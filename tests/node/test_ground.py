"""Fits on a ground machine: a real `quadid worker` behind a Zenoh router, each in a process of its own."""

from __future__ import annotations

import builtins
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from quadid_node.ground import work
from quadid_node.parcel import LARGEST, ParcelError, pack, unpack
from quadid_node.remote_worker import Ground, RemoteWorker
from quadid_node.worker import InlineWorker, ProcessWorker, Trouble
from quadid_node.zenoh_link import Fleet, ZenohLink

from quadid.online import FitReply, FitRequest, Session, SessionSettings
from quadid.vehicle import Vehicle
from quadid_node import remote_worker
from tests.cli.conftest import QUADID
from tests.faults.evidence import Happened
from tests.node.zenoh_net import Net, accepted, free_port, service, until
from tests.online.driving import flight, samples

PELICAN = Vehicle.shipped("pelican")
START = 120.0


@pytest.fixture(scope="module")
def request_() -> FitRequest:
    session = Session(PELICAN, SessionSettings(window=5.0))
    for sample in samples(flight(8.0, 6).recording):
        session.push(sample)
    session.poll()
    assert isinstance(session.running, FitRequest)
    return session.running


@pytest.fixture(scope="module")
def router(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    where = f"tcp/127.0.0.1:{free_port()}"
    config = tmp_path_factory.mktemp("router") / "router.json5"
    config.write_text(
        f'{{mode: "router", listen: {{endpoints: ["{where}"]}}, scouting: {{multicast: {{enabled: false}}}}}}'
    )
    script = str(Path(__file__).with_name("zenoh_router.py"))
    process = subprocess.Popen(
        [sys.executable, script, str(config)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "routing\n"
    yield where
    assert process.stdin is not None
    process.stdin.close()
    process.wait(10)


Start = Callable[[], "subprocess.Popen[str]"]


@pytest.fixture
def ground_machine(router: str) -> Iterator[Start]:
    started: list[subprocess.Popen[str]] = []

    def start() -> subprocess.Popen[str]:
        command = [*QUADID, "worker", "--connect", router]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        started.append(process)
        assert process.stdout is not None
        assert "ready" in process.stdout.readline()
        return process

    yield start
    for process in started:
        process.kill()
        process.wait(10)


@pytest.fixture
def worker(router: str) -> Iterator[RemoteWorker]:
    local = ProcessWorker(PELICAN)
    assert until(local.poll_ready, START)
    remote = RemoteWorker(local, Ground(router, "quad1"))
    yield remote
    remote.close()


def answered(worker: RemoteWorker, request: FitRequest) -> tuple[FitReply, list[str]]:
    """Submits a request; returns its answer and what was told meanwhile."""
    worker.submit(request)
    return wait(worker)


def wait(worker: RemoteWorker) -> tuple[FitReply, list[str]]:
    replies: list[FitReply] = []
    told: list[str] = []

    def look() -> bool:
        for item in worker.poll():
            if isinstance(item, Trouble):
                told.append(item.text)
            elif isinstance(item, FitReply):
                replies.append(item)
        return bool(replies)

    assert until(look, 60.0), told
    return replies[0], told


def same(a: FitReply, b: FitReply) -> bool:
    assert a.theta is not None
    assert b.theta is not None
    return a.theta.tobytes() == b.theta.tobytes() and pickle.dumps(a.excitation) == pickle.dumps(b.excitation)


def test_a_ground_machine_fits_and_what_it_leaves_is_fitted_on_board(
    worker: RemoteWorker, ground_machine: Start, request_: FitRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote_worker, "FAR_LIMIT", 60.0)  # however busy this machine is
    inline = InlineWorker()
    inline.submit(request_)
    (here,) = inline.poll()
    assert isinstance(here, FitReply)
    alone, _ = answered(worker, request_)
    assert worker.far == 0
    machine = ground_machine()
    assert until(lambda: worker.sees_ground, START)
    far, told = answered(worker, request_)
    assert worker.far == 1, told
    assert same(here, alone)
    assert same(here, far)
    os.kill(machine.pid, signal.SIGSTOP)
    worker.submit(request_)
    machine.kill()
    after, told = wait(worker)
    assert worker.far == 1
    assert same(here, after)
    assert any("vanished" in text and "on board" in text for text in told)


def test_a_ground_machine_ends_in_peace_and_refuses_what_is_no_request(router: str, ground_machine: Start) -> None:
    machine = ground_machine()
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{router}"]')
    with zenoh.open(config) as session:
        for payload in (b"", b"junk", pack(PELICAN), pickle.dumps(builtins.eval)):
            (reply,) = session.get("quadid/quad1/work/fit", payload=payload, timeout=10.0)
            assert reply.ok is None
    machine.send_signal(signal.SIGTERM)
    out, _ = machine.communicate(timeout=20)
    assert machine.returncode == 0
    assert "4 refused" in out


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Net]:
    made = Net(tmp_path_factory.mktemp("zenoh"))
    yield made
    made.close()


@pytest.fixture
def secure_ground(net: Net) -> Iterator[None]:
    """A ground machine with the certificate `ground` behind the example's router."""
    stop, told = threading.Event(), list[str]()
    thread = threading.Thread(target=work, args=(net.client("ground"), stop.is_set, told.append))
    thread.start()
    assert until(lambda: any("ready" in text for text in told), START), told
    yield
    stop.set()
    thread.join(20)


@pytest.mark.usefixtures("secure_ground")
def test_through_mutual_tls_only_the_ground_machine_fits(net: Net, request_: FitRequest, happened: Happened) -> None:
    inline = InlineWorker()
    inline.submit(request_)
    (here,) = inline.poll()
    assert isinstance(here, FitReply)
    impostor, asked = zenoh.open(zenoh.Config.from_file(net.client("quad2"))), list[str]()
    declared: list[Any] = [impostor.liveliness().declare_token("quadid/worker/impostor/alive")]
    declared += [
        impostor.declare_queryable(key, lambda query: asked.append(str(query.key_expr)))
        for key in ("quadid/quad1/work/fit", "quadid/*/work/fit")
    ]
    ground, answers = Ground(net.client("quad1"), "quad1"), queue.Queue[tuple[int, object]]()
    try:
        assert until(lambda: ground.there, START)
        for _ in range(3):
            ground.ask(request_, answers, 100.0)
            number, data = answers.get(timeout=150.0)
            assert isinstance(data, bytes)
            far = unpack(data)
            assert isinstance(far, FitReply)
            assert number == request_.number
            assert same(here, far)
        assert asked == [], "windows of a vehicle go to the ground machine only"
        assert ground.count == 1, "the impostor is not seen"
        payload = pack(request_)
        stolen = impostor.get("quadid/quad1/work/fit", payload=payload, timeout=1.0)
        assert [reply for reply in stolen if reply.ok is not None] == []
        happened(16, "fits on a ground machine: another vehicle can neither answer nor ask for them")
    finally:
        ground.close()
        for one in declared:
            one.undeclare()
        impostor.close()  # type: ignore[no-untyped-call]


def test_the_ground_machine_sees_and_sends_windows_and_fits_only(net: Net) -> None:
    ground, heard = zenoh.open(zenoh.Config.from_file(net.client("ground"))), list[bytes]()
    spy = ground.declare_subscriber("quadid/**", lambda sample: heard.append(sample.payload.to_bytes()))
    link, fleet = ZenohLink(net.client("quad1"), "quad1", service()), Fleet(net.client("watch"))
    try:
        assert until(lambda: fleet.alive.get("quad1", False), START)
        time.sleep(0.3)
        ground.put("quadid/quad1/health", b'{"sequence": 666}')
        link.publish(accepted(1))
        assert until(lambda: "parameters" in fleet.latest.get("quad1", {}))
        time.sleep(0.3)
        assert "health" not in fleet.latest["quad1"]
        for key in ("quadid/quad1/command/rollback", "quadid/quad1/parameters"):
            assert [reply for reply in ground.get(key, timeout=1.0) if reply.ok is not None] == []
        assert heard in ([], [b'{"sequence": 666}']), "at most its own, from its own session"
    finally:
        spy.undeclare()  # type: ignore[no-untyped-call]
        ground.close()  # type: ignore[no-untyped-call]
        link.close()
        fleet.close()


def test_a_parcel_comes_out_as_it_went_in(request_: FitRequest) -> None:
    back = unpack(pack(request_))
    assert isinstance(back, FitRequest)
    assert back.theta.tobytes() == request_.theta.tobytes()
    assert back.vehicle == request_.vehicle
    assert np.array_equal(back.windows[0].rotor_speed, request_.windows[0].rotor_speed)
    assert not back.windows[0].rotor_speed.flags.writeable, "kernels are warm for read-only arrays"


class _Evil:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("true",)


WANTED = [_Evil(), builtins.eval, subprocess.Popen, np.load, Path("/"), pickle.loads]


@pytest.mark.parametrize("item", WANTED, ids=lambda item: type(item).__name__)
def test_a_parcel_that_wants_more_than_records_is_refused(item: object) -> None:
    with pytest.raises(ParcelError, match=r"wants|damaged"):
        unpack(pickle.dumps(item))


def test_functions_of_our_own_rooms_are_refused() -> None:
    for name in ("quadid.online.window_fit\nfit_window", "quadid.online.jobs\nnp", "quadid.window\nWindow.__init__"):
        with pytest.raises(ParcelError):
            unpack(b"c" + name.encode() + b"\n.")


def test_an_endless_parcel_is_refused() -> None:
    with pytest.raises(ParcelError, match="bytes"):
        unpack(bytes(LARGEST + 1))
