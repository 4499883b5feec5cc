"""Zenoh: real sessions through a router process with mutual TLS and access control by certificate name."""

from __future__ import annotations

import contextlib
import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import zenoh
from quadid_node.zenoh import KINDS, FleetView, ZenohError, ZenohLink, key_of

from quadid.cli.serve import snapshot, table, watch
from quadid.online.records import OnlineDiagnosis, OnlineFinding
from quadid_node import zenoh as zenoh_fleet
from tests.faults.evidence import Happened
from tests.node.peers import LIMIT, Process, until
from tests.node.zenoh_net import Net, accepted, free_port, service
from tests.online.test_gate import TRUE, online_set


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Net]:
    made = Net(tmp_path_factory.mktemp("zenoh"))
    yield made
    made.close()


def test_three_vehicles_are_seen_and_who_comes_late_gets_the_latest(net: Net) -> None:
    links = {n: ZenohLink(net.client(n), n, service()) for n in ("quad1", "quad2", "quad3")}
    try:
        for k, link in enumerate(links.values()):
            link.publish(accepted(1, 2.0e-5))
            link.publish(accepted(2, 2.0e-5 + 1e-6 * k))
            link.report(service().health())
        assert until(lambda: not any(link.problem for link in links.values())), "they speak before anybody listens"
        fleet = FleetView(net.client("watch"))
        try:
            complete = until(lambda: len(fleet.latest) == 3 and all(len(v) == 2 for v in fleet.latest.values()))
            assert complete, fleet.latest.keys()
            assert until(lambda: fleet.alive == dict.fromkeys(links, True))
            found = {n: k["parameters"]["parameters"][0]["value"] for n, k in fleet.latest.items()}
            assert found == pytest.approx({"quad1": 2.0e-5, "quad2": 2.1e-5, "quad3": 2.2e-5})
            assert {k["parameters"]["sequence"] for k in fleet.latest.values()} == {2}
            links["quad2"].publish(accepted(3))
            assert until(lambda: fleet.latest["quad2"]["parameters"]["sequence"] == 3)
            links.pop("quad3").close()
            assert until(lambda: not fleet.alive["quad3"]), "its token went with it"
            assert "quad1" in json.dumps(snapshot(fleet))
            assert table(snapshot(fleet)).row_count == 3
        finally:
            fleet.close()
    finally:
        for link in links.values():
            link.close()


def test_commands_reach_the_service_and_are_answered(net: Net) -> None:
    owned = service()
    owned.session.active_set.approval = "manual"
    held = [owned.session.active_set.hold(online_set(TRUE), 30.0).sequence for _ in range(2)]
    link, fleet = ZenohLink(net.client("quad1"), "quad1", owned), FleetView(net.client("watch"))
    try:
        assert until(lambda: fleet.alive.get("quad1"))
        with link_attended(link):
            answers = [fleet.command("quad1", "approve", n, LIMIT) for n in (None, held[0], held[1])]
        assert "say which" in answers[0][1]
        assert answers[1][0]
        assert answers[2] == (False, "nothing waits for approval")
        assert owned.session.active_set.in_force is not None
        assert owned.session.active_set.in_force.approved_by == "zenoh"
    finally:
        fleet.close()
        link.close()


def test_forged_values_and_spying_are_refused_by_the_router(net: Net, happened: Happened) -> None:
    watcher = FleetView(net.client("watch"))
    mallory = zenoh.open(zenoh.Config.from_file(net.client("quad2")))
    victim = ZenohLink(net.client("quad1"), "quad1", service())
    try:
        heard: list[bytes] = []
        spy = mallory.declare_subscriber("quadid/**", lambda sample: heard.append(sample.payload.to_bytes()))

        def speak() -> None:
            mallory.put(key_of("quad1", "parameters"), json.dumps({"sequence": 666}))
            mallory.put(key_of("quad2", "parameters"), json.dumps({"sequence": 7}))
            victim.publish(accepted(1))

        assert until(lambda: "quad2" in watcher.latest and "quad1" in watcher.latest, speak)
        time.sleep(0.5)
        assert watcher.latest["quad1"]["parameters"]["sequence"] == 1
        own = [json.dumps({"sequence": n}).encode() for n in (666, 7)]
        assert [h for h in heard if h not in own] == [], "no vehicle hears another's values, only its own session's"
        stolen = [r for r in mallory.get("quadid/quad1/*", timeout=1.0) if r.ok is not None]
        assert stolen == []
        told = [r for r in mallory.get("quadid/quad1/command/rollback", timeout=1.0) if r.ok is not None]
        assert told == []
        happened(16, "put, get, subscription, command under another vehicle's name: refused by certificate name")
        spy.undeclare()  # type: ignore[no-untyped-call]
    finally:
        for session in (watcher, victim):
            session.close()
        mallory.close()  # type: ignore[no-untyped-call]


@pytest.mark.parametrize("how", ["foreign authority", "no certificate", "no TLS"])
def test_who_has_no_certificate_of_ours_does_not_get_in(net: Net, how: str, happened: Happened) -> None:
    if how == "foreign authority":
        config = zenoh.Config.from_file(net.client("quad1", "foreign"))
        config.insert_json5("transport/link/tls/root_ca_certificate", json.dumps(str(net.folder / "certs" / "ca.pem")))
    else:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        scheme = "tls" if how == "no certificate" else "tcp"
        config.insert_json5("connect/endpoints", f'["{scheme}/localhost:{net.port}"]')
        config.insert_json5("connect/timeout_ms", "2000")
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("transport/link/tls/root_ca_certificate", json.dumps(str(net.folder / "certs" / "ca.pem")))
    link = ZenohLink(net.client("quad1"), "quad1", service())
    link.publish(accepted(1))
    try:
        try:
            session = zenoh.open(config)
        except zenoh.ZError:
            happened(16, f"{how}: refused at the door")
            return
        heard = [r for r in session.get("quadid/**", timeout=1.0) if r.ok is not None]
        session.close()  # type: ignore[no-untyped-call]
        assert heard == []
        happened(16, f"{how}: let in nowhere, heard nothing")
    finally:
        link.close()


def test_garbage_and_floods_are_counted_not_shown(net: Net, happened: Happened) -> None:
    fleet = FleetView(net.client("watch"))
    rogue = zenoh.open(zenoh.Config.from_file(net.client("quad3")))
    try:
        garbage = (b"\xff\xfe", b"[1, 2]", b"{" * 20000, b'{"a":' + b" " * 400_000 + b"1}", b"null")
        for payload in garbage:
            before = fleet.refused
            counted = until(
                lambda before=before: fleet.refused > before,  # type: ignore[misc]
                lambda payload=payload: rogue.put("quadid/quad3/parameters", payload),  # type: ignore[misc]
            )
            assert counted, "a busy machine may lose some, not all"
        for k in range(2000):
            rogue.put("quadid/quad3/health", json.dumps({"status": {"phase": f"\x1b[31m{k}", "reason": "<b>"}}))

        last = {"status": {"phase": "\x1b[31mlast", "reason": "<b>"}}
        known = until(
            lambda: fleet.latest.get("quad3", {}).get("health") == last,
            lambda: rogue.put("quadid/quad3/health", json.dumps(last)),
        )
        assert known, "a flood may lose messages on a busy machine, but it passes"
        assert fleet.refused >= len(garbage)
        assert "parameters" not in fleet.latest["quad3"]
        from rich.console import Console

        console = Console(width=120, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
        console.print(table(snapshot(fleet)))
        assert "\x1b[31m" not in console.export_text()
        happened(16, f"flood of 2000 values, {len(garbage)} kinds of garbage: not shown; the last value arrived")
    finally:
        fleet.close()
        rogue.close()  # type: ignore[no-untyped-call]


def test_a_router_that_comes_late_is_found_and_a_wrong_configuration_told(tmp_path: Path) -> None:
    port = free_port()
    where = f"tcp/127.0.0.1:{port}"
    link = ZenohLink(where, "quad1", service(), retry=0.2)
    link.publish(accepted(1))
    assert until(lambda: "Unable to connect" in link.problem)
    with pytest.raises(ZenohError, match="Unable to connect"):
        FleetView(where)
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([where]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config):
        assert until(lambda: not link.problem)
        fleet = FleetView(where)
        assert until(lambda: "parameters" in fleet.latest.get("quad1", {}))
        fleet.close()
    link.close()
    with pytest.raises(ZenohError, match="no Zenoh configuration"):
        ZenohLink(str(tmp_path / "none.json5"), "quad1", service())
    (tmp_path / "bad.json5").write_text("{ mode: ")
    with pytest.raises(ZenohError, match="is no Zenoh configuration"):
        ZenohLink(str(tmp_path / "bad.json5"), "quad1", service())


def test_findings_cross_too(net: Net) -> None:
    link, fleet = ZenohLink(net.client("quad2"), "quad2", service()), FleetView(net.client("watch"))
    try:
        finding = OnlineFinding(
            "mass_change", {"fraction": 0.15}, {"fraction": 0.01}, {"fraction": ""}, 3.0, 1.0, 0.0, (), "seen"
        )
        told = OnlineDiagnosis(44.0, 40.0, 44.0, (finding,), "explained")
        assert until(lambda: "diagnosis" in fleet.latest.get("quad2", {}), lambda: link.publish(told))
        assert fleet.latest["quad2"]["diagnosis"]["findings"][0]["effect"] == "mass_change"
    finally:
        link.close()
        fleet.close()


class _Listening:
    """A session whose subscriber is called by hand."""

    def declare_subscriber(self, key: str, take: Callable[..., None], history: bool = False) -> None:
        self.take = getattr(self, "take", take)

    def liveliness(self) -> _Listening:
        return self

    def get(self, key: str, take: Callable[..., None]) -> None:
        return


class _Heard(NamedTuple):
    key_expr: str
    payload: Any


class _Bytes(bytes):
    def to_bytes(self) -> bytes:
        return bytes(self)


def test_a_watcher_is_not_filled_up_nor_upset_by_strangers(monkeypatch: pytest.MonkeyPatch, happened: Happened) -> None:
    session = _Listening()
    monkeypatch.setattr(zenoh_fleet, "open_session", lambda where: session)
    fleet = FleetView("local")
    huge = b'{"parameters": [{"name": "b", "value": ' + b"9" * 4000 + b', "sigma": 1}], "feeds": 1, "sequence": -1}'
    session.take(_Heard("quadid/odd/parameters", _Bytes(huge)))
    table(snapshot(fleet))
    large = _Bytes(b'{"a": "' + b"x" * (zenoh_fleet.LARGEST_PAYLOAD - 20) + b'"}')
    for k in range(300):
        session.take(_Heard(f"quadid/v{k}/{KINDS[k % 5]}", large))
    held = sum(len(str(value)) for kinds in fleet.latest.values() for value in kinds.values())
    assert held <= FleetView.MOST_BYTES
    assert fleet.refused > 200
    session.take(_Heard("quadid/v0/parameters", _Bytes(b'{"a": 1}')))
    assert fleet.latest["v0"]["parameters"] == {"a": 1}, "who is known goes on"
    happened(16, f"300 values of 256 KiB from strangers: {held >> 20} MiB kept; a number of 4000 digits is shown")


SAME_ONCE = [
    "a*",
    "a_",
    "a/b",
    "a_b",
    "a#",
    "a$",
    "a?",
    "a b",
    "a%2A",
    "a%2a",
    "%",
    "é",
    "e\u0301",
    "機",
    "@a",
    "a=1",
    ".",
]
"""Names of which an earlier version made the same key, or none that Zenoh takes."""


def test_every_name_has_a_key_of_its_own_and_is_shown_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    names = [*SAME_ONCE, "x" * 200, "機" * 200]
    assert len({key_of(name, "parameters") for name in names}) == len(names)
    session = _Listening()
    monkeypatch.setattr(zenoh_fleet, "open_session", lambda where: session)
    fleet = FleetView("local")
    for k, name in enumerate(names):
        key = key_of(name, "parameters")
        assert zenoh.KeyExpr("quadid/*/*").includes(zenoh.KeyExpr(key))
        session.take(_Heard(key, _Bytes(json.dumps({"sequence": k}).encode())))
    shown = {name: kinds["parameters"]["sequence"] for name, kinds in fleet.latest.items()}
    assert shown == {name: k for k, name in enumerate(names)}
    for forged in ("quadid/a%2a/parameters", "quadid/a b/parameters", "quadid/%0a/parameters", "quadid/%ff/parameters"):
        session.take(_Heard(forged, _Bytes(b"{}")))
    assert len(fleet.latest) == len(names)
    assert key_of("Quad-1.b_c", "health") == "quadid/Quad-1.b_c/health", "plain names as ever: certificates name them"


@pytest.mark.parametrize("name", ["", "a\nb", "\x1b[31m", "\udcff", "x" * 201])
def test_a_name_that_no_screen_shows_is_refused(name: str) -> None:
    with pytest.raises(ZenohError, match="vehicle id .* allowed: 1 to 200 printable characters"):
        ZenohLink("local", name, service())


# --- `quadid watch`, run as a user runs it, through a router with TLS


def test_a_command_goes_to_the_vehicle_that_was_named(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, str, int | None]] = []

    class Fleet:
        def waiting(self, vehicle: str) -> int:
            return 7

        def command(self, vehicle: str, name: str, sequence: int | None) -> tuple[bool, str]:
            asked.append((vehicle, name, sequence))
            return True, ""

        def close(self) -> None:
            pass

    monkeypatch.setattr(zenoh_fleet, "FleetView", lambda where: Fleet())
    watch(rollback="a=1")
    for named in ("a=1=2", "a=b", "a=2"):
        watch(approve=named)
    assert asked == [("a=1", "rollback", None), ("a=1", "approve", 2), ("a=b", "approve", 7), ("a", "approve", 2)]


def quadid(*arguments: str) -> Process:
    return Process(str(Path(sys.executable).with_name("quadid")), *arguments, COLUMNS="160")


def test_quadid_watch_shows_the_fleet_and_carries_commands(net: Net) -> None:
    """The command itself, a process of its own: live view, JSON, approval, and a vehicle that is not there."""
    owned = service()
    owned.session.active_set.approval = "manual"
    owned.session.active_set.hold(online_set(TRUE), 30.0)
    link = ZenohLink(net.client("quad1"), "quad1", owned)
    link.publish(accepted(2))
    link.report(owned.health())
    where = ("watch", "--zenoh", net.client("watch"))
    with link_attended(link):
        with quadid(*where, "--seconds", "3") as live:
            assert live.code() == 0, live.text
        assert "quad1" in live.text
        assert "waiting: no samples yet" in live.text
        assert "J_xx" in live.text
        with quadid(*where, "--json", "-") as once:
            assert once.code() == 0
        assert json.loads(once.text)["vehicles"]["quad1"]["parameters"]["sequence"] == 2
        with quadid(*where, "--approve", "quad1", "--json", "-") as approve:
            assert approve.code() == 0, approve.text
        assert "approved, in force as set" in json.loads(approve.text)["text"]
        with quadid(*where, "--rollback", "quad9") as nobody:
            assert nobody.code() == 3
        assert "no answer from 'quad9'" in nobody.text
    link.close()
    with quadid("watch", "--zenoh", "nowhere.json5") as wrong:
        assert wrong.code() == 2
    assert "no Zenoh configuration" in wrong.text


@contextlib.contextmanager
def link_attended(link: ZenohLink) -> Iterator[None]:
    """A thread that does what the loop of `quadid serve` does for its link."""
    over = threading.Event()

    def attend() -> None:
        while not over.wait(0.02):
            link.attend()

    thread = threading.Thread(target=attend)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
