"""Results between machines over Zenoh: one key a vehicle and kind, the latest value for who comes late, liveliness.

    quadid/<vehicle>/parameters   set in force                       JSON as in `quadid replay`, latest value kept
    quadid/<vehicle>/candidate    every estimate with its reason     latest value kept
    quadid/<vehicle>/diagnosis    findings                           latest value kept
    quadid/<vehicle>/health       of the service, once a second      latest value kept
    quadid/<vehicle>/vehicle_health   against its healthy flights    latest value kept
    quadid/<vehicle>/alive        liveliness token
    quadid/<vehicle>/command/approve?sequence=N, …/rollback, …/fit_now   queries; access control decides

TLS and access control come from a Zenoh configuration file (docs/online.md, examples/zenoh).
"""

from __future__ import annotations

import json
import queue
import re
import threading
from collections.abc import Callable, Mapping
from typing import Any

import zenoh

from quadid_node.codec import diagnosis_to_dict, set_to_dict, status_to_dict
from quadid_node.publication import Output
from quadid_node.service import Health, Service
from quadid_node.vehicle_health import health_to_dict
from quadid_node.zenoh_session import ZenohError, config_of, connect, key_of

RESULTS: Mapping[str, Callable[[Any], dict[str, Any]]] = {
    "parameters": lambda output: set_to_dict(output.item), "candidate": lambda output: set_to_dict(output.item),
    "diagnosis": diagnosis_to_dict, "vehicle_health": health_to_dict,
}  # fmt: skip
"""What is told of an output, by its topic."""
KINDS = (*RESULTS, "health")
COMMANDS = ("approve", "rollback", "fit_now")
MOST_COMMANDS = 16
RETRY = 3.0
REPEAT = 5
"""Every so many reports of health the set in force and the last diagnosis are told again."""
_JSON = zenoh.Encoding.APPLICATION_JSON


class ZenohLink:
    """Tells one vehicle's results, and keeps the latest of each kind for who comes late.

    A router that is not there yet is waited for in the background; one that goes away is found again by Zenoh itself.

    Attributes:
        problem: why nothing is told at the moment, or empty.
    """

    def __init__(self, where: str, vehicle: str, service: Service | None = None, retry: float = RETRY) -> None:
        """Begins to connect.

        Args:
            where: see `open_session`.
            vehicle: name of the vehicle.
            service: takes commands; None refuses them.
            retry: pause between two attempts [s].

        Raises:
            ZenohError: a configuration that is none.
        """
        self._where, self._config = where, config_of(where)
        self._vehicle, self._service = vehicle, service
        self._latest: dict[str, bytes] = {}
        self._commands: queue.Queue[tuple[str, Any]] = queue.Queue(MOST_COMMANDS)
        self._publishers: dict[str, Any] = {}
        self._session: Any = None
        self._reports = 0
        self._lock, self._closed = threading.Lock(), threading.Event()
        self.problem = f"Zenoh at {where}: connecting"
        threading.Thread(target=self._keep_connecting, args=(retry,), name="zenoh", daemon=True).start()

    def _keep_connecting(self, retry: float) -> None:
        while not self._closed.is_set():
            try:
                session = connect(self._where, self._config)
            except ZenohError as error:
                self.problem = str(error)
                self._closed.wait(retry)
                continue
            with self._lock:
                self._declare(session)
            return

    def _declare(self, session: Any) -> None:
        if self._closed.is_set():
            session.close()
            return
        self._session, self.problem = session, ""
        self._publishers = {kind: session.declare_publisher(key_of(self._vehicle, kind)) for kind in KINDS}
        self._open = [
            session.declare_queryable(key_of(self._vehicle, "*"), self._on_query),
            session.declare_queryable(key_of(self._vehicle, "command/*"), self._on_command),
            session.liveliness().declare_token(key_of(self._vehicle, "alive")),
        ]
        for kind, payload in self._latest.items():
            self._publishers[kind].put(payload, encoding=_JSON)

    def publish(self, output: Output) -> None:
        """Tells a result."""
        if output.topic in RESULTS:
            self._put(output.topic, RESULTS[output.topic](output))

    def report(self, health: Health) -> None:
        """Tells how things are."""
        feeds = {name: {"rate": feed.rate, "silence": feed.silence} for name, feed in health.feeds.items()}
        self._put("health", {
            "status": status_to_dict(health.status), "feeds": feeds, "worker": health.worker,
            "restarts": health.restarts, "history": health.history,
        })  # fmt: skip
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
        self._closed.set()
        with self._lock:
            if self._session is not None:
                self._session.close()

    def _repeat(self) -> None:
        """Tells again what a crowded network may have lost, since it never waits for one."""
        with self._lock:
            for kind in ("parameters", "diagnosis", "vehicle_health"):
                if kind in self._latest and kind in self._publishers:
                    self._publishers[kind].put(self._latest[kind], encoding=_JSON)

    def _carry_out(self, name: str, asked: str) -> tuple[bool, str]:
        if self._service is None:
            return False, "this service takes no commands"
        number = re.fullmatch(r"sequence=(\d{1,18})", asked)
        if name == "approve" and number is None:
            return False, "say which set: approve?sequence=N"
        calls: dict[str, Callable[[], Any]] = {
            "approve": lambda: self._service.approve("zenoh", int(number[1])),  # type: ignore[union-attr, index]
            "rollback": lambda: self._service.roll_back("zenoh"),  # type: ignore[union-attr]
            "fit_now": lambda: self._service.session.fit_now(),  # type: ignore[union-attr]
        }
        if name not in calls:
            return False, f"unknown command; use one of {', '.join(COMMANDS)}"
        answer = calls[name]()
        return answer.done, answer.text

    def _put(self, kind: str, data: dict[str, Any]) -> None:
        payload = json.dumps({"vehicle": self._vehicle, **data}).encode()
        with self._lock:
            self._latest[kind] = payload
            if kind in self._publishers:
                self._publishers[kind].put(payload, encoding=_JSON)

    def _on_query(self, query: Any) -> None:
        with query:
            for kind, payload in list(self._latest.items()):
                key = key_of(self._vehicle, kind)
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
