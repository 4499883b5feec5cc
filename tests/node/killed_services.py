"""Services that accept set after set until they are killed with -9 at a chosen place: real processes.

Run as a program it starts one, by a fork, for every line that it reads: what takes long, the imports, is done once.
"""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Self

from quadid_node.history import Store
from quadid_node.service import Service
from quadid_node.worker import InlineWorker

from quadid.online import SessionSettings
from quadid.online.records import Publish
from quadid.vehicle import Vehicle
from quadid_node import history as history_writer
from tests.online.test_gate import TRUE, online_set

ROOT = Path(__file__).resolve().parents[2]


class Services:
    """The program, as a context: starts services and says what they published."""

    def __enter__(self) -> Self:
        command = [sys.executable, "-m", __name__]
        self._starter = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT)
        return self

    def __exit__(self, *_: object) -> None:
        self._starter.kill()
        self._starter.communicate()

    def killed(self, path: Path, die: str, after: int) -> list[int]:
        """Runs a service on the history `path` and returns the numbers of the sets that it published.

        It dies `before` or between commit and wire (`between`) of commit number `after`, by its own hand after so many
        sets on the `wire`, or by ours after as many (`outside`).
        """
        told, heard = self._starter.stdin, self._starter.stdout
        assert told is not None
        assert heard is not None
        told.write(json.dumps([str(path), die, after]) + "\n")
        told.flush()
        child, published = int(heard.readline()), list[int]()
        if die == "outside":
            published = [int(heard.readline()) for _ in range(after)]
            os.kill(child, signal.SIGKILL)
        while not (line := heard.readline()).startswith("ended"):
            published.append(int(line))
        assert line == f"ended by {signal.SIGKILL.value}\n"
        return published


def serve(path: Path, die: str, after: int) -> None:
    """Publishes without end, and prints the numbers."""
    store = Store(path, "pelican")
    service = Service(Vehicle.shipped("pelican"), SessionSettings(window=5.0, diagnose=0.0), InlineWorker(), store)
    commit, commits = history_writer.Store._commit, 0

    def dying(self: history_writer.Store, batch: Any) -> Any:
        nonlocal commits
        commits += 1
        if die == "before" and commits == after:
            os.kill(os.getpid(), signal.SIGKILL)
        out = commit(self, batch)
        if die == "between" and commits == after:
            os.kill(os.getpid(), signal.SIGKILL)
        return out

    history_writer.Store._commit = dying  # type: ignore[method-assign]
    published = 0
    for k in range(10**6):
        service.session._outbox.act(*service.session.active_set.accept(online_set(TRUE), "auto", float(k), float(k)))
        time.sleep(0.003)
        for output in service.step():
            if isinstance(output, Publish) and output.topic == "parameters":
                os.write(1, f"{output.item.sequence}\n".encode())  # at once: it may be killed any time
                published += 1
                if die == "wire" and published == after:
                    os.kill(os.getpid(), signal.SIGKILL)


def main() -> None:
    """Starts a service for every line `[path, die, after]`; its process prints its number first."""
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            os.write(1, f"{os.getpid()}\n".encode())
            path, die, after = json.loads(line)
            serve(Path(path), die, after)
        print("ended by", os.WTERMSIG(os.waitpid(child, 0)[1]), flush=True)


if __name__ == "__main__":
    main()
