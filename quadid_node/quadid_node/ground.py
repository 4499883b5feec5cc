"""Fits on a ground machine: requests from on board, and the worker that answers them."""

from __future__ import annotations

import contextlib
import queue
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import zenoh

from quadid.online.records import Job, JobReply, unexpected
from quadid.sanitise import one_line
from quadid.vehicle import Vehicle
from quadid_node.wire_format import LARGEST, ParcelError, pack, unpack
from quadid_node.worker import MEMORY_MB, STUDY_LIMIT, ProcessWorker, Trouble, Worker
from quadid_node.zenoh import ROOT, LateSession, config_of, key_of, wait_for_session

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
    config_of(where)
    said = set[str]()

    def tell_once(problem: str) -> None:
        if problem not in said:
            told(f"{problem}; trying again")
        said.add(problem)

    def stopped_after(pause: float) -> bool:
        time.sleep(pause)
        return stop()

    done, session = Done(), wait_for_session(where, stopped_after, tell_once)
    if session is None:
        return done
    waiting: queue.Queue[Any] = queue.Queue(MOST_WAITING)

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

    try:
        served = session.declare_queryable(WORK, take)
        alive = session.liveliness().declare_token(ALIVE.replace("*", str(session.zid())))
        told("ready: takes windows and answers fits")
        while not stop():
            try:
                query = waiting.get(timeout=WAIT)
            except queue.Empty:
                continue
            begin = time.monotonic()
            with query:
                _answer(query, done, told)
            done.seconds += time.monotonic() - begin
        alive.undeclare()
        served.undeclare()
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


class Ground:
    """The way to ground machines: a Zenoh session that is opened in the background."""

    def __init__(self, where: str, vehicle: str, clock: Callable[[], float] = time.monotonic) -> None:
        """Begins to connect; raises ZenohError for a configuration that is none."""
        self._key, self._clock = key_of(vehicle, "work/fit"), clock
        self._session: Any = None
        self.alive: set[str] = set()
        self._rests_until = -1e9
        self._late = LateSession(where, self._declare)

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

    def close(self) -> None:
        """Leaves."""
        self._late.close()
        self._session = None

    def _declare(self, session: Any) -> None:
        self._watch = session.liveliness().declare_subscriber(ALIVE, self._on_token, history=True)
        self._session = session

    def _on_token(self, sample: Any) -> None:
        name = str(sample.key_expr)
        if sample.kind != zenoh.SampleKind.PUT:
            self.alive.discard(name)
        elif len(self.alive) < MOST_GROUNDS:
            self.alive.add(name)


class RemoteWorker:
    """Asks a ground machine; falls back to the child process on board when there is none.

    Attributes:
        far: how many answers came from a ground machine.
    """

    def __init__(self, local: ProcessWorker, ground: Ground, clock: Callable[[], float] = time.monotonic) -> None:
        """Takes over `local`, which is closed with it."""
        self._local, self._ground, self._clock = local, ground, clock
        self._answers: queue.Queue[tuple[int, Any]] = queue.Queue(MOST_ANSWERS)
        self._asked: Job | None = None
        self._until = 0.0
        self._told: list[Trouble] = []
        self._was_there = False
        self.far = 0

    @property
    def ready(self) -> bool:
        """Checks whether the child on board is warm: only then nothing depends on the ground machine."""
        return self._local.ready

    @property
    def state(self) -> str:
        """As of the child; ``busy`` while a ground machine fits."""
        return "busy" if self._asked is not None else self._local.state

    @property
    def restarts(self) -> int:
        """Of the child."""
        return self._local.restarts

    def submit(self, request: Job) -> None:
        """Begins a fit on the ground, or on board."""
        if not self._ground.there:
            self._local.submit(request)
            return
        limit = STUDY_LIMIT if request.background else FAR_LIMIT
        self._asked, self._until = request, self._clock() + limit
        try:
            self._ground.ask(request, self._answers, limit)
        except zenoh.ZError as error:
            self._fall_back(f"cannot be asked ({str(error).splitlines()[0]:.80})")

    def poll(self) -> list[JobReply | Trouble]:
        """Replies of either; never waits."""
        out: list[JobReply | Trouble] = list(self._local.poll())
        while not self._answers.empty():
            number, data = self._answers.get_nowait()
            if self._asked is not None and number == self._asked.number:
                self._take(data, out)
        if self._asked is not None and (not self._ground.alive or self._clock() > self._until):
            self._fall_back("does not answer" if self._ground.alive else "vanished")
        there = self._ground.there
        if there and not self._was_there:
            self._told.append(Trouble("info", "a ground machine is there: fits go to it"))
        self._was_there = there
        told, self._told = self._told, []
        return [*out, *told]

    def sibling(self) -> RemoteWorker:
        """Another one, for diagnoses, on the same way to the ground."""
        return RemoteWorker(self._local.sibling(), self._ground, self._clock)

    def close(self) -> None:
        """Ends child and session."""
        self._local.close()
        self._ground.close()

    def _take(self, data: bytes | None, out: list[JobReply | Trouble]) -> None:
        try:
            reply = unpack(data) if data is not None else None
        except ParcelError as error:
            self._fall_back(f"answers what cannot be read ({error})")
            return
        if self._asked is None or not self._asked.is_answered_by(reply):
            self._fall_back("refused the request" if data is None else "answers something else")
            return
        if reply.is_unexpected:
            self._fall_back("fails at the request")
            return
        self._asked = None
        self.far += 1
        sentences: dict[str, Any] = {n: one_line(text) for n, text in vars(reply).items() if isinstance(text, str)}
        out.append(replace(reply, **sentences))

    def _fall_back(self, why: str) -> None:
        request, self._asked = self._asked, None
        self._ground.rest()
        self._was_there = False
        self._told.append(Trouble("warning", f"the ground machine {why}: work on board for {REST:g} s or longer"))
        if request is not None:
            self._local.submit(request)


# --- Who fits for a service: the child process on board, or a ground machine where one is asked for


def fit_worker(vehicle: Vehicle, name: str, where: str = "", memory_mb: int = MEMORY_MB) -> Worker:
    """The child process on board; with a place on Zenoh, one that lets ground machines there fit as well.

    Args:
        where: see `zenoh.open_session`; empty: no ground machine is asked.
        memory_mb: most memory of the child [MiB]; 0 for no limit.

    Raises:
        ZenohError: a configuration that is none.
    """
    ground = Ground(where, name) if where else None
    local = ProcessWorker(vehicle, memory_mb)
    return RemoteWorker(local, ground) if ground is not None else local
