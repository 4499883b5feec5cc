"""Fits on a ground machine: a real `quadid worker` behind a Zenoh router, each in a process of its own."""

from __future__ import annotations

import builtins
import contextlib
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.msgpack import decode, encode
from quadid_node.wire_format import KINDS, LARGEST, LARGEST_RECORD, ParcelError, pack, unpack
from quadid_node.worker import InlineWorker, ProcessWorker, Trouble
from quadid_node.zenoh import FleetView, Ground, RemoteWorker, ZenohLink, work

from quadid.estimate.kalman import N_NOISE
from quadid.online import FitReply, FitRequest, Session, SessionSettings
from quadid.online.change_job import ChangeReply, DiagnosisReply
from quadid.online.fit_job import Noise
from quadid.online.records import OnlineFinding
from quadid.sanitise import one_line
from quadid.vehicle import Vehicle
from quadid_node import zenoh as ground
from tests.commands import QUADID
from tests.faults.evidence import Happened
from tests.node.peers import LIMIT, until
from tests.node.zenoh_net import Net, accepted, free_port, service
from tests.online.driving import flight, samples

PELICAN = Vehicle.shipped("pelican")


@pytest.fixture(scope="module")
def request_() -> FitRequest:
    session = Session(PELICAN, SessionSettings(window=5.0))
    for sample in samples(flight(8.0, 6).recording):
        session.push(sample.block)
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
    process.wait(LIMIT)


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
        process.wait(LIMIT)


@pytest.fixture
def worker(router: str) -> Iterator[RemoteWorker]:
    remote = RemoteWorker(PELICAN, Ground(router, "quad1"))
    assert until(lambda: remote.poll() == [] and remote.ready)
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

    assert until(look), told
    return replies[0], told


def same(a: FitReply, b: FitReply) -> bool:
    assert a.theta is not None
    assert b.theta is not None
    return a.theta.tobytes() == b.theta.tobytes() and pickle.dumps(a.excitation) == pickle.dumps(b.excitation)


def test_a_ground_machine_fits_and_what_it_leaves_is_fitted_on_board(
    worker: RemoteWorker, ground_machine: Start, request_: FitRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ground, "FAR_LIMIT", LIMIT)  # however busy this machine is
    inline = InlineWorker()
    inline.submit(request_)
    (here,) = inline.poll()
    assert isinstance(here, FitReply)
    alone, _ = answered(worker, request_)
    assert worker.far == 0
    machine = ground_machine()
    assert until(lambda: worker._ground.there)
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


def test_sentences_of_a_ground_machine_are_short_and_printable(
    request_: FitRequest, monkeypatch: pytest.MonkeyPatch, happened: Happened
) -> None:
    """They are shown and kept: 256 KiB of control characters a second were, too."""
    long = "\x1b[2J\n" * 30_000
    monkeypatch.setattr(ProcessWorker, "_start", lambda worker: None)
    for hostile in (FitReply(request_.number, problem=long), FitReply(request_.number, fault=long)):

        def ask(job: FitRequest, answers: queue.Queue[Any], _: float, item: FitReply = hostile) -> None:
            answers.put((job.number, pack(item)))

        worker = RemoteWorker(PELICAN, cast(Ground, SimpleNamespace(there=True, alive={"it"}, ask=ask)))
        worker.submit(request_)
        (told,) = [reply for reply in worker.poll() if isinstance(reply, FitReply)]
        assert told.problem + told.fault == one_line(long)
    happened(20, f"{len(long)} characters that a terminal acts on, answered by the ground: cut, shown as ?")


def test_a_ground_machine_ends_in_peace_and_refuses_what_is_no_request(router: str, ground_machine: Start) -> None:
    machine = ground_machine()
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{router}"]')
    with zenoh.open(config) as session:
        for payload in (b"", b"junk", pickle.dumps(PELICAN), pickle.dumps(builtins.eval)):
            (reply,) = session.get("quadid/quad1/work/fit", payload=payload, timeout=LIMIT)
            assert reply.ok is None
    machine.send_signal(signal.SIGTERM)
    out, _ = machine.communicate(timeout=LIMIT)
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
    assert until(lambda: any("ready" in text for text in told)), told
    yield
    stop.set()
    thread.join(LIMIT)


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
        assert until(lambda: ground.there)
        for _ in range(3):
            ground.ask(request_, answers, LIMIT)
            number, data = answers.get(timeout=LIMIT)
            assert isinstance(data, bytes)
            far = unpack(data)
            assert isinstance(far, FitReply)
            assert number == request_.number
            assert same(here, far)
        assert asked == [], "windows of a vehicle go to the ground machine only"
        assert len(ground.alive) == 1, "the impostor is not seen"
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
    link, fleet = ZenohLink(net.client("quad1"), "quad1", service()), FleetView(net.client("watch"))
    try:
        assert until(lambda: fleet.alive.get("quad1", False))

        def speak() -> None:
            ground.put("quadid/quad1/health", b'{"sequence": 666}')
            link.publish(accepted(1))

        assert until(lambda: "parameters" in fleet.latest.get("quad1", {}), speak)
        time.sleep(0.3)
        assert "health" not in fleet.latest["quad1"]
        for key in ("quadid/quad1/command/rollback", "quadid/quad1/parameters"):
            assert [reply for reply in ground.get(key, timeout=1.0) if reply.ok is not None] == []
        assert set(heard) <= {b'{"sequence": 666}'}, "at most its own, from its own session"
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


def test_every_kind_of_answer_comes_out_as_it_went_in(request_: FitRequest) -> None:
    reply = request_.run()
    assert isinstance(reply, FitReply)
    back = unpack(pack(reply))
    assert pickle.dumps(back.excitation) == pickle.dumps(reply.excitation)
    assert reply.theta is not None
    assert back.theta.tobytes() == reply.theta.tobytes()
    for name in ("z", "information", "score"):
        assert getattr(back.estimates[0], name).tobytes() == getattr(reply.estimates[0], name).tobytes()
    finding = OnlineFinding("motor_lag", {"tau": 0.05}, {"tau": 0.001}, {"tau": "s"}, 3.0, 1.0, 1e-9, (), "seen")
    for item in (ChangeReply(3, "", finding), ChangeReply(4, "no"), DiagnosisReply(5, "", (finding,), "explained")):
        assert unpack(pack(item)) == item


class _Evil:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("true",)


WANTED = [_Evil(), builtins.eval, subprocess.Popen, np.load, Path("/"), bytearray(9), set(range(9)), np.zeros(3)]


@pytest.mark.parametrize("item", WANTED, ids=lambda item: type(item).__name__)
def test_a_pickle_is_no_parcel(item: object) -> None:
    with pytest.raises(ParcelError):
        unpack(pickle.dumps(item))
    with pytest.raises(ParcelError):
        pack(item)


REQUEST = next(tag for tag, kind in KINDS.items() if kind is FitRequest)


def parcel(record: object, numbers: bytes = b"", tag: str = REQUEST) -> bytes:
    """Bytes of a parcel, whatever is in it."""
    return bytes(encode((tag, record if isinstance(record, bytes) else encode(record), numbers)))


def spoilt(request: FitRequest, **fields: Any) -> bytes:
    """A request with other fields."""
    _, record, numbers = decode(pack(request))
    return parcel({**decode(record), **fields}, numbers)


def test_a_few_bytes_never_take_much_memory(request_: FitRequest, happened: Happened) -> None:
    huge = 2**31 - 1
    nested = b"\xdc\x0f\xff" + (b"\xdc\x0f\xff" + b"\x80" * 4095) * 4095
    claims = [
        *(bytes([code]) + huge.to_bytes(4, "big") + b"\x01" for code in (0xDD, 0xDF, 0xDB, 0xC6, 0xC9)),
        b"\x93\xa8FitReply" + nested[: LARGEST - 10], b"\xdc\x0f\xff" * 5000, b"\xdd\x00\x0f\xff\xff" * (1 << 20),
        b"\x91" * 100_000, parcel(nested[: LARGEST - 100]), parcel(nested[:LARGEST_RECORD]), parcel({}),
        spoilt(request_, theta=[[1 << 20, 1 << 20, 8], False]), spoilt(request_, theta=[[huge], True]),
        spoilt(request_, theta=[[0] * 30, False]), spoilt(request_, theta=[[-1, -1], False]),
        spoilt(request_, theta=[[1.5], False]), spoilt(request_, theta=nested[: 1 << 17]),
        spoilt(request_, windows=[None] * 4000), spoilt(request_, number="9" * 60_000),
        spoilt(request_, vehicle="{" * 60_000), spoilt(request_, seed=True), spoilt(request_, start=None),
        parcel(decode(pack(request_))[1], tag="FitRequest 00000000"), parcel(decode(pack(request_))[1], bytes(8)),
    ]  # fmt: skip
    tracemalloc.start()
    try:
        for data in claims:
            with pytest.raises(ParcelError):
                unpack(data)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < 1 << 26
    happened(
        26, f"{len(claims)} parcels that claim gigabytes, wrong types, other kinds: refused, at most {most >> 20} MiB"
    )


@settings(max_examples=300)
@given(place=st.floats(0.0, 1.0, exclude_max=True), value=st.integers(0, 255))
def test_a_spoilt_byte_gives_a_parcel_or_is_refused(request_: FitRequest, place: float, value: int) -> None:
    data = bytearray(pack(request_))
    data[int(place * len(data))] = value
    with contextlib.suppress(ParcelError):
        assert isinstance(unpack(bytes(data)), FitRequest)


def test_an_endless_parcel_is_refused() -> None:
    with pytest.raises(ParcelError, match="bytes"):
        unpack(bytes(LARGEST + 1))


class _Query:
    """A query as the ground machine sees one."""

    key_expr = "quadid/x/work/fit"

    def __init__(self, payload: bytes) -> None:
        self.payload, self.answers, self.errors = _Payload(payload), list[bytes](), list[bytes]()

    def __enter__(self) -> _Query:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def reply(self, key: str, payload: bytes) -> None:
        self.answers.append(payload)

    def reply_err(self, payload: bytes) -> None:
        self.errors.append(payload)


class _Payload(bytes):
    def to_bytes(self) -> bytes:
        return bytes(self)


class _Session:
    """A Zenoh session that hears what is put into it."""

    def __init__(self, queries: list[_Query]) -> None:
        self._queries = queries

    def declare_queryable(self, key: str, take: Callable[[_Query], None]) -> _Session:
        for query in self._queries:
            take(query)
        return self

    def liveliness(self) -> _Session:
        return self

    def declare_token(self, key: str) -> _Session:
        return self

    def undeclare(self) -> None:
        return

    def zid(self) -> str:
        return "1"

    def close(self) -> None:
        return


def served(monkeypatch: pytest.MonkeyPatch, payloads: list[bytes]) -> list[_Query]:
    """Answers of a ground machine to payloads that are there when it begins."""
    queries = [_Query(payload) for payload in payloads]
    monkeypatch.setattr(ground, "open_session", lambda where: _Session(queries))
    work("local", lambda: all(q.answers or q.errors for q in queries), lambda text: None)
    return queries


NOISE = Noise(np.ones(N_NOISE), np.zeros(4), np.ones(3), 0.0)
WRONG = [(NOISE.psi, np.zeros(0), NOISE.control), (NOISE.control,) * 3, (NOISE.psi, NOISE.tail, np.zeros(0))]
"""Noise of other sizes than the filter reads."""


def test_requests_that_make_no_sense_do_not_end_the_ground_machine(
    request_: FitRequest, monkeypatch: pytest.MonkeyPatch, happened: Happened
) -> None:
    broken = [
        replace(request_, theta=np.ones(3)),
        replace(request_, theta=np.full_like(request_.theta, np.nan)),
        replace(request_, windows=()),
        replace(request_, theta=np.zeros((3, 3))),
        *(replace(request_, noise=Noise(*sizes, 0.0)) for sizes in WRONG),
        replace(request_, noise=NOISE, z=np.ones(5)),
    ]
    answers = [unpack(q.answers[0]) for q in served(monkeypatch, [pack(item) for item in [*broken, request_]])]
    assert all(reply.problem for reply in answers[:-1])
    assert answers[-1].theta is not None
    happened(26, f"{len(broken)} requests that make no sense: told so, and the next one is worked on")


def test_what_waits_at_a_ground_machine_is_limited(monkeypatch: pytest.MonkeyPatch, happened: Happened) -> None:
    queries = served(monkeypatch, [bytes(LARGEST)] * 6 + [bytes(LARGEST + 1)])
    refused = [q.errors == [b"too much to do"] for q in queries]
    assert refused == [False] * 4 + [True] * 3
    happened(26, "seven parcels of 16 MiB at once: four wait, the others are refused before they take memory")
