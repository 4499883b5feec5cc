"""Zenoh: sessions, results of one vehicle, what is known of all, and fits on a ground machine."""

import contextlib
import json
import queue
import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import zenoh

from quadid.errors import QuadidError
from quadid.online.records import Job, JobReply, unexpected
from quadid.sanitise import LONGEST_NAME, one_line, plain
from quadid.vehicle import Vehicle
from quadid_node.messages import RESULTS, Output, ServiceHealth, status_to_dict
from quadid_node.service import Service
from quadid_node.wire_format import LARGEST, ParcelError, pack, unpack
from quadid_node.worker import MEMORY_MB, STUDY_LIMIT, ProcessWorker, Trouble

# --- Opens Zenoh sessions: peers of this network, a locator, or a configuration file with TLS and access control


ROOT = "quadid"
LARGEST_MESSAGE = 1 << 25
"""Zenoh itself takes no larger messages [bytes], whatever its configuration allows; its own default is 1 GiB."""


class ZenohError(QuadidError):
    """A Zenoh configuration or connection that cannot be used."""


RETRY = 3.0
"""Pause between two attempts to open a session [s]."""


def open_session(where: str) -> Any:
    """Opens a Zenoh session.

    Args:
        where: ``local`` (peers on this network find each other), a locator such as ``tcp/host:7447``, or a
            configuration file (JSON5) with TLS and access control.

    Raises:
        ZenohError: no such file, not a configuration, or nothing listens there.
    """
    config = config_of(where)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise ZenohError(
            f"Zenoh at {where}: {str(error).splitlines()[0]:.120}",
            "a router that lets us in",
            "check locator and certificates",
        ) from error


class LateSession:
    """A session that is opened in the background, as soon as somebody listens there; routers that go come back."""

    def __init__(
        self,
        where: str,
        opened: Callable[[Any], None],
        told: Callable[[str], None] = lambda problem: None,
        retry: float = RETRY,
    ) -> None:
        """Begins to connect.

        Args:
            where: see `open_session`.
            opened: gets the session, once, under `lock`.
            told: takes why there is none yet.
            retry: pause between two attempts [s].

        Raises:
            ZenohError: a configuration that is none.
        """
        config_of(where)
        self.lock, self._closed = threading.Lock(), threading.Event()
        self._session: Any = None

        def connect() -> None:
            session = None
            while session is None and not self._closed.is_set():
                try:
                    session = open_session(where)
                except ZenohError as error:
                    told(str(error))
                    self._closed.wait(retry)
            with self.lock:
                if session is not None and self._closed.is_set():
                    session.close()
                elif session is not None:
                    self._session = session
                    opened(session)

        threading.Thread(target=connect, name="zenoh", daemon=True).start()

    def close(self) -> None:
        """Leaves; a session that comes later is closed at once."""
        self._closed.set()
        with self.lock:
            if self._session is not None:
                self._session.close()
                self._session = None


def config_of(where: str) -> Any:
    """The Zenoh configuration that `where` stands for, see `open_session`; raises ZenohError."""
    locator = re.match(r"^(tcp|udp|tls|quic|ws|unixsock-stream)/", where)
    if where != "local" and not locator and not Path(where).is_file():
        raise ZenohError(f"no Zenoh configuration {where}", "local, a locator, or a configuration file")
    try:
        config = zenoh.Config() if where == "local" or locator else zenoh.Config.from_file(where)
    except zenoh.ZError as error:
        why = str(error).splitlines()[0][:120]
        raise ZenohError(f"{where} is no Zenoh configuration ({why})", "JSON5 as in examples/zenoh") from error
    if locator:
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([where]))
        config.insert_json5("connect/timeout_ms", "2000")
    config.insert_json5("transport/link/rx/max_message_size", str(LARGEST_MESSAGE))
    return config


def key_of(vehicle: str, kind: str) -> str:
    """Key of one kind of one vehicle, another for every name; raises ZenohError for a name that cannot be shown.

    Letters, digits and ``_.-~`` stay, everything else is percent-encoded as in a URL (RFC 3986).
    """
    if not (vehicle.isprintable() and 0 < len(vehicle) <= LONGEST_NAME):
        raise ZenohError(f"vehicle id '{plain(vehicle, 60)}'", f"1 to {LONGEST_NAME} printable characters")
    return f"{ROOT}/{quote(vehicle, safe='')}/{kind}"


def _vehicle_of(key: str) -> str | None:
    """The name that `key_of` made a key of; None for any other key."""
    parts = key.split("/")
    name = unquote(parts[1]) if len(parts) == 3 else ""
    try:
        return name if key_of(name, parts[-1]) == key else None
    except ZenohError:
        return None


# --- Results between machines over Zenoh: one key a vehicle and kind, the latest value for who comes late, liveliness
#
#     quadid/<vehicle>/parameters   set in force                       JSON as in `quadid replay`, latest value kept
#     quadid/<vehicle>/candidate    every estimate with its reason     latest value kept
#     quadid/<vehicle>/diagnosis    findings                           latest value kept
#     quadid/<vehicle>/health       of the service, once a second      latest value kept
#     quadid/<vehicle>/vehicle_health   against its healthy flights    latest value kept
#     quadid/<vehicle>/alive        liveliness token
#     quadid/<vehicle>/command/approve?sequence=N, …/rollback, …/fit_now   queries; access control decides
#
# TLS and access control come from a Zenoh configuration file (docs/online.md, examples/zenoh).


KINDS = (*RESULTS, "health")
COMMANDS = ("approve", "rollback", "fit_now")
MOST_COMMANDS = 16
REPEAT = 5
"""Every so many reports of health the set in force and the last diagnosis are sent again."""
_JSON = zenoh.Encoding.APPLICATION_JSON


class ZenohLink(LateSession):
    """Publishes one vehicle's results, and keeps the latest of each kind for late subscribers.

    A router that is not there yet is waited for in the background; one that goes away is found again by Zenoh itself.

    Attributes:
        problem: why nothing is sent at the moment, or empty.
    """

    def __init__(self, where: str, vehicle: str, service: Service, retry: float = RETRY) -> None:
        """Begins to connect.

        Args:
            retry: pause between two attempts [s].

        Raises:
            ZenohError: a configuration that is none, or a name that no key can be made of.
        """
        self._vehicle, self._service = vehicle, service
        self._keys = {kind: key_of(vehicle, kind) for kind in (*KINDS, "*", "command/*", "alive")}
        self._latest: dict[str, bytes] = {}
        self._commands: queue.Queue[tuple[str, Any]] = queue.Queue(MOST_COMMANDS)
        self._publishers: dict[str, Any] = {}
        self._reports = 0
        self.problem = f"Zenoh at {where}: connecting"
        super().__init__(where, self._declare, lambda problem: setattr(self, "problem", problem), retry)

    def _declare(self, session: Any) -> None:
        self.problem = ""
        self._publishers = {kind: session.declare_publisher(self._keys[kind]) for kind in KINDS}
        self._open = [
            session.declare_queryable(self._keys["*"], self._on_query),
            session.declare_queryable(self._keys["command/*"], self._on_command),
            session.liveliness().declare_token(self._keys["alive"]),
        ]
        for kind, payload in self._latest.items():
            self._publishers[kind].put(payload, encoding=_JSON)

    def publish(self, output: Output) -> None:
        """Publishes a result."""
        if output.topic in RESULTS:
            self._put(output.topic, RESULTS[output.topic].json(output))

    def report(self, health: ServiceHealth) -> None:
        """Publishes health."""
        feeds = {name: {"rate": feed.rate, "silence": feed.silence} for name, feed in health.feeds.items()}
        self._put(
            "health",
            {
                "status": status_to_dict(health.status),
                "feeds": feeds,
                "worker": health.worker,
                "restarts": health.restarts,
                "history": health.history,
            },
        )
        self._reports += 1
        if self._reports % REPEAT == 0:
            # Sends again what a crowded network may have lost, since it never waits for one
            with self.lock:
                for kind in ("parameters", "diagnosis", "vehicle_health"):
                    if kind in self._latest and kind in self._publishers:
                        self._publishers[kind].put(self._latest[kind], encoding=_JSON)

    def attend(self) -> None:
        """Carries out commands that have come; called by the loop that owns the service."""
        while True:
            try:
                name, query = self._commands.get_nowait()
            except queue.Empty:
                return
            with query:
                done, text = self._carry_out(name, str(query.selector.parameters))
                query.reply(query.key_expr, json.dumps({"done": done, "text": text}), encoding=_JSON)

    def _carry_out(self, name: str, asked: str) -> tuple[bool, str]:
        number = re.fullmatch(r"sequence=(\d{1,18})", asked)
        if name == "approve":
            if number is None:
                return False, "say which set: approve?sequence=N"
            answer = self._service.approve("zenoh", int(number[1]))
        elif name == "rollback":
            answer = self._service.roll_back("zenoh")
        elif name == "fit_now":
            answer = self._service.session.fit_now()
        else:
            return False, f"unknown command; use one of {', '.join(COMMANDS)}"
        return answer.done, answer.text

    def _put(self, kind: str, data: dict[str, Any]) -> None:
        payload = json.dumps({"vehicle": self._vehicle, **data}).encode()
        with self.lock:
            self._latest[kind] = payload
            if kind in self._publishers:
                self._publishers[kind].put(payload, encoding=_JSON)

    def _on_query(self, query: Any) -> None:
        with query:
            for kind, payload in list(self._latest.items()):
                key = self._keys[kind]
                if query.key_expr.intersects(zenoh.KeyExpr(key)):
                    query.reply(key, payload, encoding=_JSON)

    def _on_command(self, query: Any) -> None:
        try:
            if query.payload is not None:  # what waits would hold it
                raise queue.Full
            self._commands.put_nowait((str(query.key_expr).rsplit("/", 1)[-1], query))
        except queue.Full:
            with query:
                query.reply_err(b"too many commands, or one with a payload")


# --- What is known of all vehicles over Zenoh, for `quadid watch`: what comes is data of strangers, limited in size


LARGEST_PAYLOAD = 1 << 18
"""A payload beyond this is not ours [bytes]."""
LONGEST_INTEGER = 20
"""Digits; longer ones are read as floating point, that no arithmetic overflows."""


class FleetView:
    """State of all vehicles, from a Zenoh session.

    Attributes:
        latest: by vehicle and kind, the last value.
        refused: payloads that were not ours.
    """

    MOST, MOST_BYTES = 500, 1 << 24
    """Vehicles, and bytes of their values in all: a parsed value takes some twenty times its bytes."""

    def __init__(self, where: str) -> None:
        """Connects, asks for what there is, and listens; raises ZenohError."""
        self._session = open_session(where)
        self.latest: dict[str, dict[str, dict[str, Any]]] = {}
        self.alive: dict[str, bool] = {}
        self.refused = 0
        self._sizes: dict[tuple[str, str], int] = {}
        everything = f"{ROOT}/*/*"
        self._open = [
            self._session.declare_subscriber(
                everything, lambda sample: self._take(str(sample.key_expr), sample.payload)
            ),
            self._session.liveliness().declare_subscriber(f"{ROOT}/*/alive", self._on_token, history=True),
        ]
        self._session.get(everything, self._on_reply)

    def waiting(self, vehicle: str) -> int:
        """Number of the newest set that waits for approval on a vehicle, by its last report; 0: none."""
        status = self.latest.get(vehicle, {}).get("health", {}).get("status", {})
        pending = status.get("pending", 0) if isinstance(status, dict) else 0
        return pending if isinstance(pending, int) else 0

    def command(self, vehicle: str, name: str, sequence: int | None = None, seconds: float = 5.0) -> tuple[bool, str]:
        """Sends a command to one vehicle; returns whether it was done, and what the vehicle said.

        Args:
            name: approve, rollback or fit_now.
        """
        asked = f"?sequence={sequence}" if sequence is not None else ""
        for reply in self._session.get(key_of(vehicle, f"command/{name}") + asked, timeout=seconds):
            if reply.ok is not None:
                answer = _parse(reply.ok.payload)
                if answer is not None:
                    return bool(answer.get("done")), str(answer.get("text"))
        return False, f"no answer from '{vehicle}': it is not there, too busy, or access control refuses the command"

    def close(self) -> None:
        """Leaves."""
        self._session.close()

    def _on_reply(self, reply: Any) -> None:
        if reply.ok is not None:
            self._take(str(reply.ok.key_expr), reply.ok.payload, only_if_new=True)

    def _on_token(self, sample: Any) -> None:
        vehicle = _vehicle_of(str(sample.key_expr))
        if vehicle is not None and (vehicle in self.alive or len(self.alive) < self.MOST):
            self.alive[vehicle] = sample.kind == zenoh.SampleKind.PUT

    def _take(self, key: str, payload: Any, only_if_new: bool = False) -> None:
        vehicle, kind = _vehicle_of(key), key.rsplit("/", 1)[-1]
        data = _parse(payload)
        if vehicle is None or kind not in KINDS or data is None:
            self.refused += 1
            return
        place = vehicle, kind
        held = sum(self._sizes.values()) - self._sizes.get(place, 0) + len(payload)
        if held > self.MOST_BYTES or (vehicle not in self.latest and len(self.latest) >= self.MOST):
            self.refused += 1
            return
        kinds = self.latest.setdefault(vehicle, {})
        if not (only_if_new and kind in kinds):
            kinds[kind], self._sizes[place] = data, len(payload)


def _parse(payload: Any) -> dict[str, Any] | None:
    if len(payload) > LARGEST_PAYLOAD:
        return None
    data = payload.to_bytes()
    try:
        found = json.loads(data, parse_int=_whole)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _whole(text: str) -> float:
    """An integer, or a float for one that no float holds."""
    return int(text) if len(text) < LONGEST_INTEGER else float(text)


# --- Fits on a ground machine: takes windows from services over Zenoh and answers with fits (`quadid worker`)
#
# quadid/<vehicle>/work/fit        query: a request as `parcel`; reply: the answer as `parcel`
# quadid/worker/<id>/alive         liveliness token of a worker whose kernels are warm


WORK = f"{ROOT}/*/work/fit"
ALIVE = f"{ROOT}/worker/*/alive"
MOST_WAITING, MOST_BYTES = 64, 4 * LARGEST
"""Requests that wait, and their bytes in all; a usual one has some ten thousand."""
WAIT = 0.1


@dataclass
class Done:
    """Work of a worker: requests answered, requests refused, seconds spent on them."""

    answered: int = 0
    refused: int = 0
    seconds: float = 0.0


def work(where: str, stop: Callable[[], bool], told: Callable[[str], None]) -> Done:
    """Answers requests until `stop` is true; waits for a router that is not there yet."""
    done, said, declared = Done(), set[str](), list[Any]()
    waiting: queue.Queue[Any] = queue.Queue(MOST_WAITING)

    def tell_once(problem: str) -> None:
        if problem not in said:
            told(f"{problem}; trying again")
        said.add(problem)

    def take(query: Any) -> None:
        with waiting.mutex:
            held = sum(map(_size, waiting.queue)) + _size(query)
        try:
            if _size(query) > LARGEST or held > MOST_BYTES:
                raise queue.Full
            waiting.put_nowait(query)
        except queue.Full:
            with query:
                query.reply_err(b"too much to do")

    def serve(session: Any) -> None:
        declared.append(session.declare_queryable(WORK, take))
        declared.append(session.liveliness().declare_token(ALIVE.replace("*", str(session.zid()))))
        told("ready: takes windows and answers fits")

    session = LateSession(where, serve, tell_once)
    try:
        while not stop():
            try:
                query = waiting.get(timeout=WAIT)
            except queue.Empty:
                continue
            begin = time.monotonic()
            with query:
                _answer(query, done, told)
            done.seconds += time.monotonic() - begin
    finally:
        session.close()
    return done


def _size(query: Any) -> int:
    return len(query.payload) if query.payload is not None else 0


def _answer(query: Any, done: Done, told: Callable[[str], None]) -> None:
    try:
        request = unpack(query.payload.to_bytes() if query.payload is not None else b"")
        if not isinstance(request, Job):
            raise ParcelError(f"a parcel with a {type(request).__name__}", "a request of a fit")
    except ParcelError as error:
        done.refused += 1
        told(f"refused: {error}")
        query.reply_err(str(error).encode())
        return
    try:
        reply = request.run()
    except MemoryError as error:
        reply = request.failed(unexpected(error))
    if reply.is_unexpected:
        done.refused += 1
        told(f"refused: a request that cannot be worked on ({reply.problem})")
    else:
        done.answered += 1
    query.reply(query.key_expr, pack(reply))


# --- A worker that lets a ground machine fit, and the child process on board whenever that machine is not there
#
# The same kernels get the same windows and start from the same values, so an answer is the same to the bit wherever it
# was worked out, as long as both machines have the same kind of processor and the same version.


FAR_LIMIT = 5.0
"""A ground machine that does not answer a fit within this time [s] is given up for `REST`."""
REST = 30.0
MOST_ANSWERS, MOST_GROUNDS = 8, 256
"""Most answers that wait to be looked at, and most ground machines that are kept apart; more are rejected."""


class Ground(LateSession):
    """The way to ground machines: a Zenoh session that is opened in the background."""

    def __init__(self, where: str, vehicle: str, clock: Callable[[], float] = time.monotonic) -> None:
        """Begins to connect; raises ZenohError for a configuration that is none."""
        self._key, self._clock = key_of(vehicle, "work/fit"), clock
        self.alive: set[str] = set()
        self._rests_until = -1e9
        super().__init__(where, self._declare)

    @property
    def there(self) -> bool:
        """Checks whether a ground machine can be asked."""
        return self._session is not None and bool(self.alive) and self._clock() >= self._rests_until

    def ask(self, request: Job, answers: queue.Queue[tuple[int, Any]], seconds: float) -> None:
        """Sends a request; what comes back is put into `answers` with its number, None for a refusal."""

        def take(reply: Any) -> None:
            ok = reply.ok
            small = ok is not None and len(ok.payload) <= LARGEST
            with contextlib.suppress(queue.Full):
                answers.put_nowait((request.number, None if ok is None else ok.payload.to_bytes() if small else b""))

        self._session.get(
            self._key, take, payload=pack(request), timeout=seconds, target=zenoh.QueryTarget.BEST_MATCHING
        )

    def rest(self) -> None:
        """Asks no ground machine for a while."""
        self._rests_until = self._clock() + REST

    def _declare(self, session: Any) -> None:
        self._watch = session.liveliness().declare_subscriber(ALIVE, self._on_token, history=True)

    def _on_token(self, sample: Any) -> None:
        name = str(sample.key_expr)
        if sample.kind != zenoh.SampleKind.PUT:
            self.alive.discard(name)
        elif len(self.alive) < MOST_GROUNDS:
            self.alive.add(name)


class RemoteWorker(ProcessWorker):
    """Asks a ground machine; the child process on board fits when there is none.

    Attributes:
        far: how many answers came from a ground machine.
    """

    def __init__(self, vehicle: Vehicle, ground: Ground, *options: Any) -> None:
        """Starts the child on board, with the `options` of one."""
        self._ground = ground
        self._answers: queue.Queue[tuple[int, Any]] = queue.Queue(MOST_ANSWERS)
        self._sent: Job | None = None
        self._until = 0.0
        self._was_there = False
        self.far = 0
        super().__init__(vehicle, *options)

    @property
    def state(self) -> str:
        """As of the child; ``busy`` while a ground machine fits."""
        return "busy" if self._sent is not None else self._state

    def submit(self, request: Job) -> None:
        """Begins a fit on the ground, or on board."""
        if not self._ground.there:
            super().submit(request)
            return
        limit = STUDY_LIMIT if request.background else FAR_LIMIT
        self._sent, self._until = request, self._clock() + limit
        try:
            self._ground.ask(request, self._answers, limit)
        except zenoh.ZError as error:
            self._fall_back(f"cannot be asked ({str(error).splitlines()[0]:.80})")

    def poll(self) -> list[JobReply | Trouble]:
        """Replies of either; never waits."""
        while not self._answers.empty():
            number, data = self._answers.get_nowait()
            if self._sent is not None and number == self._sent.number:
                self._take(self._sent, data)
        if self._sent is not None and (not self._ground.alive or self._clock() > self._until):
            self._fall_back("does not answer" if self._ground.alive else "vanished")
        there = self._ground.there
        if there and not self._was_there:
            self._out.append(Trouble("info", "a ground machine is there: fits go to it"))
        self._was_there = there
        return super().poll()

    def sibling(self) -> "RemoteWorker":
        """Another one, for diagnoses, on the same way to the ground."""
        return RemoteWorker(self._vehicle, self._ground, self._memory, self._clock, "diagnosis", STUDY_LIMIT)

    def close(self) -> None:
        """Ends child and session."""
        super().close()
        self._ground.close()

    def _take(self, asked: Job, data: bytes | None) -> None:
        try:
            reply = unpack(data) if data is not None else None
        except ParcelError as error:
            self._fall_back(f"answers what cannot be read ({error})")
            return
        if not asked.is_answered_by(reply):
            self._fall_back("refused the request" if data is None else "answers something else")
        elif reply.is_unexpected:
            self._fall_back("fails at the request")
        else:
            self._sent = None
            self.far += 1
            sentences: dict[str, Any] = {n: one_line(text) for n, text in vars(reply).items() if isinstance(text, str)}
            self._out.append(replace(reply, **sentences))

    def _fall_back(self, why: str) -> None:
        request, self._sent = self._sent, None
        self._ground.rest()
        self._was_there = False
        self._out.append(Trouble("warning", f"the ground machine {why}: work on board for {REST:g} s or longer"))
        if request is not None:
            super().submit(request)


# --- Who fits for a service: the child process on board, or a ground machine where one is asked for


def fit_worker(vehicle: Vehicle, name: str, where: str = "", memory_mb: int = MEMORY_MB) -> ProcessWorker:
    """The child process on board; with a place on Zenoh, one that lets ground machines there fit as well.

    Args:
        where: see `zenoh.open_session`; empty: no ground machine is asked.
        memory_mb: most memory of the child [MiB]; 0 for no limit.

    Raises:
        ZenohError: a configuration that is none.
    """
    return RemoteWorker(vehicle, Ground(where, name), memory_mb) if where else ProcessWorker(vehicle, memory_mb)
