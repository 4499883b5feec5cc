"""Publication: on the disk before on the wire, one service a topic, neighbours named."""

import os
import random
import sqlite3
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from quadid_node.history import LARGEST_NUMBER, Restored, Row, Store, StoreError, connect, read_history
from quadid_node.messages import Output
from quadid_node.publish import BESIDE, FOUND_WITHIN, OBSERVES, STRANGER, YOUNG, GraphMonitor, Offer, TopicOwnership
from quadid_node.service import MOST_WAITING, Publication, Service
from quadid_node.worker import InlineWorker

from quadid.online import SessionSettings, SetState
from quadid.online.records import Event, OnlineSet, Publish
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened
from tests.node.killed_services import Services
from tests.node.peers import LIMIT
from tests.node.test_history import left
from tests.online.test_gate import TRUE, online_set

# --- On the disk before on the wire: what was published has its row, and its number is never given again


ROOT = Path(__file__).resolve().parents[2]
PELICAN = Vehicle.shipped("pelican")
SETTINGS = SessionSettings(window=5.0, diagnose=0.0)


def numbers_of(path: Path) -> list[int]:
    return [s["sequence"] for s in read_history(path, "pelican")["sets"]]


@pytest.fixture(scope="module")
def services() -> Iterator[Services]:
    with Services() as made:
        yield made


@pytest.mark.parametrize("die", ["before", "between", "wire", "outside"])
def test_a_set_that_was_published_has_its_row_and_its_number_is_never_given_again(
    services: Services, tmp_path: Path, die: str, happened: Happened
) -> None:
    path, given, kills = tmp_path / "h.sqlite", list[int](), 3
    for k in range(kills):
        published = services.killed(path, die, 2 + 3 * k)
        rows = numbers_of(path) if path.is_file() else []
        assert set(published) <= set(rows), "on the wire, and not on the disk"
        assert not set(published) & set(given), "a number twice"
        given += published
        assert len(rows) == len(set(rows))
    assert given == sorted(given)
    happened(23, f"{kills} kills with -9, {die}: {len(given)} sets published, every one has its row, no number twice")


def service_with(store: Store | None) -> Service:
    return Service(PELICAN, SETTINGS, InlineWorker(), store)


def accept(service: Service, **changes: float) -> OnlineSet:
    session = service.session
    session._outbox.act(*session.active_set.accept(online_set({**TRUE, **changes}), "auto", 1.0, 1.0))
    assert session.active_set.in_force is not None
    return session.active_set.in_force


def said(service: Service, *wanted: Callable[[Output], bool]) -> list[Output]:
    """Outputs of a service until each `wanted` output has come; without any, in one step."""
    out, deadline = service.step(), time.monotonic() + LIMIT
    while not all(any(map(one, out)) for one in wanted):
        assert time.monotonic() < deadline, out
        time.sleep(0.01)
        out += service.step()
    return out


def numbered(number: int) -> Callable[[Output], bool]:
    """A published set of this number."""
    return lambda output: isinstance(output, Publish) and output.item.sequence == number


def event(word: str) -> Callable[[Output], bool]:
    """An event that says so."""
    return lambda output: isinstance(output, Event) and word in output.text


def test_nothing_is_published_that_a_full_disk_did_not_take(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, happened: Happened
) -> None:
    import quadid_node.history as writing

    store = Store(tmp_path / "h.sqlite", "pelican")
    service = service_with(store)
    first = accept(service)
    said(service, numbered(first.sequence))

    def full(path: Path, read_only: bool = False) -> sqlite3.Connection:
        db = connect(path, read_only)
        db.execute("PRAGMA max_page_count = 1")
        return db

    monkeypatch.setattr(writing, "connect", full)
    with store._changed:  # one transaction for all: a single row may still fit into a page that the file has
        held = [accept(service) for _ in range(2 * MOST_WAITING)]
    assert not [o for o in said(service, event("full")) if isinstance(o, Publish)]
    assert service.published is not None
    assert service.published.sequence == first.sequence, "who asks is told what is on the wire"
    monkeypatch.setattr(writing, "connect", connect)
    said(service, numbered(held[-1].sequence))  # with room again the newest one comes
    store.close(60.0)
    assert numbers_of(tmp_path / "h.sqlite") == [first.sequence, *(h.sequence for h in held)]
    happened(23, "disk full: 128 sets accepted, none published, said as ERROR; with room again the newest came")


def test_numbers_do_not_begin_anew_after_a_lost_history_or_without_one(tmp_path: Path, happened: Happened) -> None:
    path, given = tmp_path / "h.sqlite", list[int]()
    for loss in ("none", "deleted", "damaged", "kept"):
        store = Store(path, "pelican")
        service = service_with(store)
        given.append(accept(service).sequence)
        store.close(60.0)
        if loss == "deleted":
            for found in tmp_path.glob("h.sqlite*"):
                found.unlink()
        elif loss == "damaged":
            path.write_bytes(b"no history" * 1000)
        time.sleep(0.002)
    assert given == sorted(set(given))
    ids = {service_with(None).boot_id for _ in range(3)}
    assert len(ids) == 3
    happened(23, "history kept, deleted, damaged between runs: numbers rise on; each run has a boot id of its own")


def test_a_restored_set_has_a_row_and_a_new_number(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    store = Store(path, "pelican")
    before = accept(first := service_with(store))
    first.step()
    store.close(60.0)
    store = Store(path, "pelican")
    service = service_with(store)
    stale = service.session.active_set.in_force
    assert stale is not None
    assert stale.state is SetState.STALE
    assert stale.sequence > before.sequence, "a consumer that has the set learns that it is stale"
    said(service, numbered(stale.sequence))
    store.close(60.0)
    assert numbers_of(path) == [before.sequence, stale.sequence]


def test_a_decision_of_a_person_outlives_the_service(tmp_path: Path, happened: Happened) -> None:
    path = tmp_path / "h.sqlite"

    def next_run() -> Service:
        return service_with(Store(path, "pelican"))

    service = next_run()
    accept(service)
    accept(service, b=2.4e-5)
    answer = service.roll_back("bob")
    assert answer.done
    assert "NOT on the disk" not in answer.text
    rolled = numbers_of(path)[-1]
    assert service.session.active_set.approval == "manual"
    os_kill_like_end(service)
    again = next_run()
    assert again.session.active_set.approval == "manual", "a rollback asks for approval from then on, a restart or not"
    assert any(isinstance(o, Event) and o.kind == "approval" for o in said(again))
    force = again.session.active_set.in_force
    assert force is not None
    assert force.parameters["b"].value == TRUE["b"]
    held = again.session.active_set.hold(online_set(TRUE), 1.0)
    assert again.approve("ann", held.sequence).done
    assert numbers_of(path)[-1] > rolled, "approved: on the disk before the answer"
    assert again.decide_approval("auto").done
    os_kill_like_end(again)
    last = next_run()
    assert last.session.active_set.approval == "auto"
    assert last.session.active_set.baseline is not None
    assert last.session.active_set.baseline.approved_by == "ann"
    os_kill_like_end(last)
    happened(24, "rollback, approval and mode each on the disk before the answer, and there after a restart")


def test_a_rollback_is_never_on_the_disk_without_the_mode_that_it_sets(tmp_path: Path, happened: Happened) -> None:
    """Two commits could part them: the set taken back was published, and a restart then learned it again by itself."""
    path = tmp_path / "h.sqlite"
    store = Store(path, "pelican")
    service = service_with(store)
    accept(service)
    accept(service, b=2.4e-5)
    put, rows = store._put, list[Row]()

    def noted(row: Row) -> None:
        rows.append(row)
        put(row)

    store._put = noted  # type: ignore[method-assign]
    assert service.roll_back("bob").done
    service.close()
    kinds = [row.table for row in rows]
    assert {"decisions", "sets"} <= set(kinds)
    seen = set[tuple[bool, str]]()
    for cut in range(len(rows)):  # the kill leaves the first rows
        with connect(path) as db:
            for table in ("sets", "decisions"):
                db.execute(f"DELETE FROM {table}")
            for row in rows[: cut + 1]:
                assert not row.insert(db)
        restored = left(path)
        seen.add((restored.item is not None and restored.item.state is SetState.ROLLED_BACK, restored.approval))
    assert (True, "manual") in seen
    assert (True, "") not in seen
    happened(24, f"killed between any two of the {len(rows)} rows of a rollback: never the set without the mode")


def test_a_row_that_never_reaches_the_disk_holds_up_no_later_set(tmp_path: Path, happened: Happened) -> None:
    service = service_with(Store(tmp_path / "h.sqlite", "pelican"))
    odd = replace(online_set(TRUE), reason="odd \udcff bytes")
    service.session._outbox.act(*service.session.active_set.accept(odd, "auto", 1.0, 1.0))
    after = accept(service)
    outputs = said(service, numbered(after.sequence), event("no history can hold"))
    assert [o.item.sequence for o in outputs if isinstance(o, Publish)] == [after.sequence]
    service.close()
    happened(23, "a set whose reason no history can hold: not published, said; the next one is")


@pytest.mark.parametrize("name", ["", ":memory:", "loop", "fifo", "file/h.sqlite"])
def test_a_history_that_is_no_file_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """The first was a ValueError; the second a database in memory, of which nothing was ever kept."""
    monkeypatch.chdir(tmp_path)
    Path("loop").symlink_to("loop")
    os.mkfifo("fifo")
    Path("file").write_text("no folder")
    store = Store(Path(name), "pelican")
    store.numbered(replace(online_set(TRUE), sequence=7))
    assert store.flush(60.0 if name == ":memory:" else 1.0) == (7 in store.written) == (name == ":memory:")
    assert bool(store.problem) != (7 in store.written)
    assert store.restore().item is None or 7 in store.written
    store.close(60.0)


def test_a_path_that_names_no_file_is_one_line() -> None:
    with pytest.raises(StoreError, match="names no file"):
        Store(Path("nul\0"), "pelican")


def test_while_the_disk_takes_nothing_candidates_are_forgotten_before_sets_and_decisions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, happened: Happened
) -> None:
    import quadid_node.history as writing

    def full(path: Path, read_only: bool = False) -> sqlite3.Connection:
        raise sqlite3.OperationalError("database or disk is full")

    store = Store(tmp_path / "h.sqlite", "pelican")
    service = service_with(store)
    monkeypatch.setattr(writing, "connect", full)
    first = accept(service)
    service.step()
    assert "NOT on the disk" in service.decide_approval("manual").text
    many = writing.MOST_WAITING + 10
    for _ in range(many):
        store.journal(Publish("candidate", replace(online_set(TRUE, SetState.REJECTED), sequence=0)))
    monkeypatch.setattr(writing, "connect", connect)
    said(service, numbered(first.sequence))  # it was forgotten, and everything after it waited for good
    service.close()
    assert left(tmp_path / "h.sqlite").approval == "manual"
    happened(23, f"{many} candidates while the disk is full: the set and the decision before them are kept")


def os_kill_like_end(service: Service) -> None:
    """Ends a service without what an orderly end writes: only the lock is let go, as the kernel does."""
    store = service._store
    assert store is not None
    assert store._lock is not None
    store._lock.close()


def test_a_waiting_set_is_on_the_disk_before_its_number_is_told(tmp_path: Path) -> None:
    service = service_with(Store(tmp_path / "h.sqlite", "pelican"))
    held = service.session.active_set.hold(online_set(TRUE), 1.0)
    service.session._outbox.act(Publish("candidate", held))
    said(service, numbered(held.sequence))
    assert numbers_of(tmp_path / "h.sqlite") == [held.sequence]
    service.close()


def test_the_writer_outlives_what_no_history_can_hold(tmp_path: Path, happened: Happened) -> None:
    store = Store(tmp_path / "h.sqlite", "pelican")
    store.journal(Event(1.0, "info", "test", "odd \udcff bytes"))
    store.numbered(replace(online_set(TRUE), sequence=2**63 + 5, approved_by="auto"))
    store.journal(Event(2.0, "info", "test", "afterwards"))
    assert store.flush(60.0)
    store.close(60.0)
    found = read_history(tmp_path / "h.sqlite", "pelican", events=10)
    assert [e["text"] for e in found["events"]] == ["afterwards"]
    assert sum("no history can hold" in note for note in store.notes) == 2
    with pytest.raises(StoreError, match="no text"):
        Store(tmp_path / "h.sqlite", "quad\udcff")
    happened(25, "an entry with odd bytes and one with number 2^63 + 5: left out, said; the rest is written")


@pytest.mark.parametrize("number", [2**63 - 1, LARGEST_NUMBER])
def test_a_history_whose_numbers_are_used_up_is_set_aside(tmp_path: Path, number: int) -> None:
    path = tmp_path / "h.sqlite"
    store = Store(path, "pelican")
    store.numbered(replace(online_set(TRUE), sequence=number, approved_by="auto"))
    store.close(60.0)
    store = Store(path, "pelican")
    assert "set aside" in store.notes[0]
    assert store.restore().next_sequence < LARGEST_NUMBER
    store.numbered(replace(online_set(TRUE), sequence=5, approved_by="auto"))
    store.close(60.0)
    assert numbers_of(path) == [5]


def test_a_history_held_at_the_start_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, happened: Happened
) -> None:
    import quadid_node.history as files

    path = tmp_path / "h.sqlite"
    Store(path, "pelican").close(60.0)
    monkeypatch.setattr(files, "BUSY_SECONDS", 0.3)
    holder = sqlite3.connect(path)
    holder.execute("PRAGMA journal_mode = DELETE")
    holder.execute("BEGIN EXCLUSIVE")
    with pytest.raises(StoreError, match="another program holds"):
        Store(path, "pelican")
    holder.rollback()
    holder.close()
    Store(path, "pelican").close(60.0)
    happened(25, "history held exclusively at the start: waited for, then refused with the fix; no number is given")


def test_outputs_that_need_no_row_wait_for_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    publication = Publication(Store(tmp_path / "file" / "h.sqlite", "pelican"))  # writes nothing
    refused = Publish("candidate", replace(online_set(TRUE, SetState.REJECTED), sequence=0))
    warning = Event(1.0, "warning", "change", "thrust stepped")
    assert publication.take([refused, warning]) == [refused, warning]
    waits = Publish("parameters", online_set(TRUE))
    told = Event(1.0, "info", "accepted", "set 1 in force")
    assert publication.take([waits, told, warning]) == [warning]
    assert Publication(None).take([waits, told]) == [waits, told]


def test_a_service_without_history_begins_where_it_is_told() -> None:
    service = Service(PELICAN, SETTINGS, InlineWorker(), None, restored=Restored(None, 41))
    assert accept(service).sequence == 41


# --- The right to publish: simulated services that look once a second, see each other late, come and go


SETTLED = FOUND_WITHIN + 2.0
"""By then [s] a service that sees no other one speaks."""


class Topic:
    """Publishers of a topic, as services see them; `apart`: they do not see each other."""

    def __init__(self) -> None:
        self.now, self.apart = 0.0, False
        self.publishers: dict[int, str] = {}
        self._next = 0

    def service(self) -> TopicOwnership:
        """A service that looks at this topic; its own publisher it always sees."""
        seen = Seen(self)
        return TopicOwnership(seen, "topic", seen.create, lambda: self.now)

    def stranger(self, name: str = "someone") -> int:
        self._next += 1
        self.publishers[self._next] = name
        return self._next

    def run(self, seconds: float, *services: TopicOwnership) -> None:
        for _ in range(round(seconds)):
            self.now += 1.0
            for service in services:
                service.step()


class Seen:
    """The topic as the node of one service sees it."""

    def __init__(self, topic: Topic) -> None:
        self._topic, self._mine = topic, set[int]()

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        seen = self._mine if self._topic.apart else self._topic.publishers
        return [SimpleNamespace(node_name=self._topic.publishers[number]) for number in seen]

    def count_publishers(self, topic: str) -> int:
        return len(self.get_publishers_info_by_topic(topic))

    def get_name(self) -> str:
        return "quadid"

    def create(self) -> int:
        number = self._topic.stranger("quadid")
        self._mine.add(number)
        return number

    def destroy_lifecycle_publisher(self, number: int) -> None:
        self._mine.discard(number)
        del self._topic.publishers[number]


def speaking(*services: TopicOwnership) -> int:
    return sum(s.publisher is not None for s in services)


def test_the_second_observes_and_takes_over_when_the_first_is_gone() -> None:
    topic = Topic()
    first, second = topic.service(), topic.service()
    topic.run(SETTLED, first)
    topic.run(30.0, first, second)
    assert (first.publisher is not None, second.publisher) == (True, None)
    assert (first.problem, second.problem) == ("", OBSERVES)
    first.let_go()
    topic.run(6.0, second)
    assert second.publisher is not None
    assert second.problem == ""


def test_one_that_is_found_by_its_next_announcement_is_not_talked_over() -> None:
    topic = Topic()
    first = topic.service()
    topic.run(SETTLED, first)
    second = topic.service()
    topic.apart = True
    topic.run(3.0, second)  # Fast DDS announces a participant every 3 s
    assert second.publisher is None
    topic.apart = False
    topic.run(30.0, first, second)
    assert (first.publisher is not None, second.publisher) == (True, None)


def test_one_that_is_not_active_yet_tells_and_claims_nothing() -> None:
    topic = Topic()
    first, second = topic.service(), topic.service()
    topic.run(SETTLED, first)
    assert not second.step(wanted=False)
    assert second.problem == OBSERVES
    first.let_go()
    topic.now += 60.0
    assert not second.step(wanted=False)
    assert (second.publisher, second.problem) == (None, "")


@pytest.mark.parametrize("seed", range(20))
def test_two_that_claimed_at_once_or_apart_end_with_one(seed: int) -> None:
    random.seed(seed)
    topic = Topic()
    services = topic.service(), topic.service(), topic.service()
    topic.apart = True
    topic.run(SETTLED if seed % 2 else SETTLED + 2.0 * YOUNG, *services)
    assert speaking(*services) == 3, "they do not see each other"
    topic.apart = False
    topic.run(60.0, *services)
    assert speaking(*services) == 1
    assert sorted(s.problem for s in services) == ["", OBSERVES, OBSERVES]


def test_to_a_stranger_a_settled_service_does_not_give_way_and_says_so() -> None:
    topic = Topic()
    service = topic.service()
    topic.run(SETTLED + YOUNG, service)
    forger = topic.stranger()
    topic.run(30.0, service)
    assert service.publisher is not None
    assert service.problem == STRANGER
    del topic.publishers[forger]
    topic.run(1.0, service)
    assert service.problem == ""


def test_one_that_gives_way_says_so_first() -> None:
    topic = Topic()
    service = topic.service()
    topic.run(SETTLED + YOUNG, service)
    topic.stranger("quadid")
    topic.run(1.0, service)
    assert (service.publisher is not None, service.problem) == (True, BESIDE)
    topic.run(5.0, service)
    assert (service.publisher, service.problem) == (None, OBSERVES)


# --- What others do on the topics is told, and taken back when it is over


IMU, JOINTS = "sensor_msgs/msg/Imu", "sensor_msgs/msg/JointState"
GOOD = Offer(IMU, True)


class HeardTopic:
    """One input, whose publishers are as set."""

    def __init__(self) -> None:
        self.offers: list[Offer] = [GOOD]
        self.lines: list[str] = []
        self.unbroken = 0.0
        self.graph = GraphMonitor(
            {"/imu": IMU}, lambda topic: self.offers, lambda topic: self.unbroken, self.lines.append
        )

    def look(self, *offers: Offer, deaf: bool = False) -> dict[str, str]:
        self.offers = [*offers]
        self.graph.look({"/candidate": deaf})
        return self.graph.notes


@pytest.fixture
def topic() -> HeardTopic:
    return HeardTopic()


@pytest.mark.parametrize(
    ("offers", "told"),
    [
        ([GOOD, GOOD], "2 publishers on one topic: paused until only one publishes"),
        ([Offer(IMU, False)], "its publisher's QoS does not match"),
        ([GOOD, Offer(JOINTS, True)], f"a publisher of another type ({JOINTS} for {IMU}), which is not listened to"),
    ],
)
def test_what_is_wrong_is_told_once_and_taken_back(topic: HeardTopic, offers: list[Offer], told: str) -> None:
    assert topic.look(*offers) == {"/imu": told}
    topic.look(*offers)
    assert topic.lines == [f"/imu: {told}"]
    assert topic.look(GOOD) == {}
    assert topic.look(*offers) == {"/imu": told}
    assert topic.look() == {}, "nobody there any more"


def test_two_publishers_pause_at_once_and_one_goes_on(topic: HeardTopic) -> None:
    topic.graph.count("/imu", 1)
    assert not topic.graph.paused
    topic.graph.count("/imu", 2)
    assert topic.graph.paused
    topic.look(GOOD, GOOD)
    assert topic.graph.paused
    topic.look(GOOD)
    assert not topic.graph.paused


def test_a_publisher_that_is_listed_but_not_heard_does_not_pause(topic: HeardTopic) -> None:
    """One that was killed is listed until its lease ends."""
    topic.graph.count("/imu", 2)
    assert topic.graph.paused
    topic.unbroken = 1.1
    assert topic.look(GOOD, GOOD) == {"/imu": "2 publishers on one topic, only one publishes"}
    assert not topic.graph.paused
    topic.unbroken = 0.02
    topic.graph.count("/imu", 2)
    assert topic.graph.paused


def test_two_types_on_a_topic_do_not_pause(topic: HeardTopic) -> None:
    topic.look(GOOD, Offer(JOINTS, True))
    assert not topic.graph.paused


def test_a_subscriber_that_hears_nothing_is_named_while_it_is_there(topic: HeardTopic) -> None:
    assert topic.look(GOOD, deaf=True) == {
        "/candidate, its subscriber": "asks for a QoS that is not offered here, and receives nothing"
    }
    assert topic.look(GOOD) == {}
