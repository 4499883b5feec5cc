"""Zenoh: sessions, results of one vehicle, and what is known of all."""

from __future__ import annotations

import json
import queue
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import zenoh

from quadid.errors import QuadidError
from quadid.sanitise import LONGEST_NAME, plain
from quadid_node.messages import RESULTS, Output, ServiceHealth, status_to_dict
from quadid_node.service import Service

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


def wait_for_session(
    where: str, wait: Callable[[float], bool], told: Callable[[str], None], retry: float = RETRY
) -> Any:
    """Opens a session as soon as somebody listens there; None once `wait`, given a pause [s], returns True."""
    while True:
        try:
            return open_session(where)
        except ZenohError as error:
            told(str(error))
        if wait(retry):
            return None


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
        self.lock, self._closed, self._session = threading.Lock(), threading.Event(), None

        def connect() -> None:
            session = wait_for_session(where, self._closed.wait, told, retry)
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


class ZenohLink:
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
        self._session = LateSession(where, self._declare, lambda problem: setattr(self, "problem", problem), retry)

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
            self._repeat()

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

    def close(self) -> None:
        """Leaves."""
        self._session.close()

    def _repeat(self) -> None:
        """Sends again what a crowded network may have lost, since it never waits for one."""
        with self._session.lock:
            for kind in ("parameters", "diagnosis", "vehicle_health"):
                if kind in self._latest and kind in self._publishers:
                    self._publishers[kind].put(self._latest[kind], encoding=_JSON)

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
        with self._session.lock:
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


LARGEST = 1 << 18
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
    if len(payload) > LARGEST:
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
