"""Fits on a ground machine: takes windows from services over Zenoh and answers with fits (`quadid worker`).

quadid/<vehicle>/work/fit        query: a request as `parcel`; reply: the answer as `parcel`
quadid/worker/<id>/alive         liveliness token of a worker whose kernels are warm
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from quadid.online.jobs import Job, unexpected
from quadid_node.parcel import LARGEST, ParcelError, content, pack, unpack
from quadid_node.zenoh_session import ROOT, ZenohError, config_of, open_session

WORK = f"{ROOT}/*/work/fit"
ALIVE = f"{ROOT}/worker/*/alive"
MOST_WAITING, MOST_BYTES = 64, 4 * LARGEST
"""Requests that wait, and their bytes in all; a usual one has some ten thousand."""
WAIT = 0.1
RETRY = 3.0


@dataclass
class Done:
    """What a worker has done: requests answered, requests refused, seconds spent on them."""

    answered: int = 0
    refused: int = 0
    seconds: float = 0.0


def work(where: str, stop: Callable[[], bool], told: Callable[[str], None]) -> Done:
    """Answers requests until `stop` says so; waits for a router that is not there yet.

    Args:
        where: see `zenoh_session.open_session`.
        stop: asked often.
        told: takes a sentence for people.

    Raises:
        ZenohError: a configuration that is none.
    """
    config_of(where)
    done, session = Done(), _connected(where, stop, told)
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


def _connected(where: str, stop: Callable[[], bool], told: Callable[[str], None]) -> Any:
    said = ""
    while not stop():
        try:
            return open_session(where)
        except ZenohError as error:
            if str(error) != said:
                said = str(error)
                told(f"{said}; trying again")
            time.sleep(RETRY)
    return None


def _answer(query: Any, done: Done, told: Callable[[str], None]) -> None:
    try:
        request = unpack(content(query.payload))
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
