"""The service under fire: `quadid serve` as a process, its history as it is seen from outside, its fit process."""

from __future__ import annotations

import contextlib
import os
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

GATE = "windows=2,width=0.08,yaw_width=0.6"


class Running:
    """Starts, watches, ends the service.

    Attributes:
        crashes: ends that nobody asked for, and tracebacks.
        rows: (sequence, b) of every numbered set ever seen in a history file.
    """

    def __init__(self, folder: Path, port: int, key: Path) -> None:
        self.folder, self.history = folder, folder / "disk" / "h.sqlite"
        self._port, self._key = port, key
        self.crashes: list[str] = []
        self.rows: set[tuple[int, float]] = set()
        self.lines: list[str] = []
        self.child: subprocess.Popen[str] | None = None
        self.start()

    def start(self) -> None:
        """Starts the service."""
        self.child = self.another(self.history)
        threading.Thread(target=self._read, args=(self.child,), daemon=True).start()

    def another(self, history: Path) -> subprocess.Popen[str]:
        """A further service on the same vehicle."""
        command = [
            str(Path(sys.executable).with_name("quadid")), "serve", "--vehicle", "pelican", "--window", "5",
            "--diagnose", "0", "--gate", GATE, "--history", str(history), "--key", str(self._key),
            "--mavlink", f"udpin:127.0.0.1:{self._port}",
        ]  # fmt: skip
        environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
        return subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
        )  # fmt: skip

    def end(self, number: int) -> float:
        """Sends a signal and waits; returns how long it took [s]."""
        assert self.child is not None
        begin, child = time.monotonic(), self.child
        self.child = None
        child.send_signal(number)
        try:
            code = child.wait(60)
        except subprocess.TimeoutExpired:
            self.crashes.append(f"not gone within 60 s of signal {number}: {self.lines[-3:]}")
            child.kill()
            child.wait(30)
            return time.monotonic() - begin
        if number != signal.SIGKILL and code != 0:
            self.crashes.append(f"exit code {code} after signal {number}: {self.lines[-3:]}")
        return time.monotonic() - begin

    def check(self) -> None:
        """Notes a crash, and starts the service anew after one."""
        if self.child is not None and self.child.poll() is not None:
            self.crashes.append(f"ended by itself with code {self.child.returncode}: {self.lines[-3:]}")
            self.start()

    def worker(self) -> int:
        """Process id of the fit process; 0 while there is none."""
        if self.child is None:
            return 0
        pid = self.child.pid
        try:
            children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
            return next((int(c) for c in children if b"worker_main" in Path(f"/proc/{c}/cmdline").read_bytes()), 0)
        except OSError:
            return 0

    def newest_estimate(self) -> float:
        """When the newest estimate was journalled (UNIX time); remembers the numbered sets on the way."""
        try:
            address = f"{self.history.as_uri()}?mode=ro"
            with contextlib.closing(sqlite3.connect(address, uri=True, timeout=0.2)) as db:
                for sequence, b in db.execute(
                    "SELECT sequence, json_extract(data, '$.parameters[0].value') FROM sets"
                ).fetchall():
                    self.rows.add((int(sequence), float(b)))
                (wall,) = db.execute("SELECT max(wall) FROM candidates").fetchone()
        except sqlite3.Error:
            return 0.0
        return float(wall or 0.0)

    def newest_number(self) -> int:
        """Largest number of a set in the history; 0 for none."""
        try:
            address = f"{self.history.as_uri()}?mode=ro"
            with contextlib.closing(sqlite3.connect(address, uri=True, timeout=0.2)) as db:
                return int(db.execute("SELECT max(sequence) FROM sets").fetchone()[0] or 0)
        except sqlite3.Error:
            return 0

    def _read(self, child: subprocess.Popen[str]) -> None:
        assert child.stdout is not None
        for line in child.stdout:
            self.lines = [*self.lines[-200:], line.rstrip()]
            if "Traceback" in line:
                self.crashes.append(f"a traceback was said, after: {self.lines[-2:-1]}")


def low_bits(number: int) -> int:
    """What QI_SEQ says of a set's number: a float on the wire holds 24 bits, QI_SEQ_HI the others."""
    return number % (1 << 24)


def stop_quietly(process: subprocess.Popen[Any]) -> None:
    """Ends a process of ours."""
    if process.poll() is None:
        process.kill()
    process.wait(30)
