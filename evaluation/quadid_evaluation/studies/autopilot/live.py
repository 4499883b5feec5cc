"""A telemetry log played into `quadid serve`: its bytes over UDP, each at its receive time."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from quadid_replay.tlog import read_frames

from quadid_evaluation.studies.autopilot.flights import Outcome

WARM = 120.0
"""Longest wait for the fit process to be warm [s]."""
LINGER = 5.0
"""The service goes on this long after the last byte [s]."""


def serve(log: Path, vehicle: Path, seconds: float) -> Outcome:
    """Plays a telemetry log in real time into a `quadid serve` of its own, and reads its history.

    Args:
        log: telemetry log.
        vehicle: vehicle file.
        seconds: of the log to play at most.
    """
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.bind(("127.0.0.1", 0))
        port, history = _free_port(), Path(folder) / "history.sqlite"
        command = [str(Path(sys.executable).with_name("quadid"))]
        served = subprocess.Popen(
            [*command, "serve", "--vehicle", str(vehicle), "--mavlink", f"udpin:127.0.0.1:{port}",
             "--history", str(history)],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        said, ready = list[str](), threading.Event()
        listener = threading.Thread(target=listen, args=(served, said, ready), daemon=True)
        listener.start()
        try:
            ready.wait(WARM)
            _send(log, wire, port, seconds)
            time.sleep(LINGER)
        finally:
            served.terminate()
            served.wait(30)
        listener.join(5)
        return stored(vehicle, history, said, time.monotonic() - begin)


def stored(vehicle: Path, history: Path, said: list[str], seconds: float) -> Outcome:
    """Record that an ended service left in its history; `said`: its lines; `seconds`: how long it ran."""
    told = subprocess.run(
        [str(Path(sys.executable).with_name("quadid")), "history", "--vehicle", str(vehicle), "--history", str(history),
         "--candidates", "10000", "--events", "10000", "--json", "-"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    found = json.loads(told.stdout)
    last = [line for line in said if " | Hz: " in line][-1:]
    status = last[0].split(" | Hz: ")[0] if last else ""
    return Outcome(found["sets"], found["candidates"], found["events"], status, seconds)


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def listen(served: subprocess.Popen[str], said: list[str], ready: threading.Event) -> None:
    """Keeps the lines of a service, and notes when it is ready."""
    assert served.stdout is not None
    for line in served.stdout:
        said.append(line.rstrip())
        if line.startswith("ready"):
            ready.set()


def _send(log: Path, wire: socket.socket, port: int, seconds: float) -> None:
    """Sends every frame when it came, counted from the first; what is asked of the vehicle finds no ear."""
    frames, begin = read_frames(log), time.monotonic()
    for k, due in enumerate(frames.received - frames.received[:1]):
        if due > seconds:
            return
        time.sleep(max(begin + due - time.monotonic(), 0.0))
        wire.sendto(frames.frame(k), ("127.0.0.1", port))
