"""Processes and ears for tests of the node: start it, play a log to it, listen to what it says, call its services."""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

from quadid_node.worker import processor_seconds

ROOT = Path(__file__).resolve().parents[2]
QUICK = {"window": 5.0, "gate.windows": 2, "gate.width": 0.08, "gate.yaw_width": 0.6}
"""A first set after 10 s of flight."""


LIMIT = 1500.0
"""Longest wait for an event [s], below that of a test: only a hang takes so long, kernels may compile for minutes."""


def until(done: Callable[[], object], say: Callable[[], object] = lambda: None) -> bool:
    """Waits until something is true; meanwhile `say` is called again and again: a network may lose what it says."""
    deadline = time.monotonic() + LIMIT
    while not done() and time.monotonic() < deadline:
        say()
        time.sleep(0.02)
    return bool(done())


class Process:
    """A child whose output is kept line by line."""

    def __init__(self, *command: str, **environment: str) -> None:
        self.lines: list[str] = []
        self._fresh: queue.Queue[str] = queue.Queue()
        self.child = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=ROOT,
            env={**os.environ, "PYTHONUNBUFFERED": "1", **environment},
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.child.stdout is not None
        for line in self.child.stdout:
            self.lines.append(line.rstrip())
            self._fresh.put(line)

    @property
    def text(self) -> str:
        """Everything said so far; of a child that has ended, all of it."""
        if self.child.poll() is not None:
            self._reader.join(10.0)
        return "\n".join(self.lines)

    def wait_for(self, word: str, seconds: float = LIMIT) -> str:
        """Waits for a line with `word` in it, and returns it."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            for line in self.lines:
                if word in line:
                    return line
            if self.child.poll() is not None and self._fresh.empty():
                break
            time.sleep(0.02)
        raise AssertionError(f"'{word}' was not said within {seconds:g} s; said: {self.text}")

    def end(self, number: int = signal.SIGINT, times: int = 1) -> tuple[int, float]:
        """Sends a signal (several times), waits; returns the exit code and the processor seconds that its end took."""
        before = processor_seconds(self.child.pid) or 0.0
        for _ in range(times):
            if self.child.poll() is None:
                self.child.send_signal(number)
                time.sleep(0.05)
        if self.child.returncode is None:
            os.waitid(os.P_PID, self.child.pid, os.WEXITED | os.WNOWAIT)  # what it used is known until it is reaped
        used = processor_seconds(self.child.pid) or before
        return self.child.wait(), used - before

    def code(self) -> int:
        """Waits for its end; returns the exit code."""
        return self.child.wait(LIMIT)

    def __enter__(self) -> Process:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.child.poll() is None:
            self.child.kill()
            self.child.wait()


def node(history: Path | str, namespace: str = "", **parameters: Any) -> Process:
    """Starts the node, as `ros2 run quadid_node identify` would."""
    given = {**QUICK, "history": str(history), **{k.replace("__", "."): v for k, v in parameters.items()}}
    arguments = [a for k, v in given.items() for a in ("-p", f"{k}:={str(v).lower() if isinstance(v, bool) else v}")]
    where = ["-r", f"__ns:=/{namespace}"] if namespace else []
    return Process(sys.executable, "-m", "quadid_node.identify", "--ros-args", *arguments, *where)


def player(log: Path, speed: float = 1.0, namespace: str = "", *more: str) -> Process:
    """Plays a log, as `ros2 run quadid_node replay LOG` would."""
    where = ["--ros-args", "-r", f"__ns:=/{namespace}"] if namespace else []
    return Process(sys.executable, "-m", "quadid_node.replay_node", str(log), "--speed", str(speed), *more, *where)


class Ear:
    """A ROS node in this process that keeps what it hears."""

    def __init__(self, namespace: str = "") -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        self.context = rclpy.Context()
        self.context.init()
        self.node = rclpy.create_node("ear", namespace=namespace, context=self.context)
        self.heard: dict[str, list[Any]] = {}
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)

    def listen(self, topic: str, kind: Any, qos: Any = 10, raw: bool = False) -> list[Any]:
        """Subscribes; what comes is in the returned list."""
        return self.on(topic, kind, self.heard.setdefault(topic, []).append, qos, raw)

    def sets(self, topic: str = "quadid/parameters") -> list[Any]:
        """Subscribes to parameter sets, latched; that nothing is in force yet is left out."""
        from quadid_msgs.msg import ParameterSet
        from quadid_node.publish import LATCHED_QOS

        heard: list[Any] = []

        def take(message: Any) -> None:
            if message.state != ParameterSet.STATE_NONE:
                heard.append(message)

        self.on(topic, ParameterSet, take, LATCHED_QOS)
        return heard

    def on(self, topic: str, kind: Any, callback: Callable[[Any], Any], qos: Any = 10, raw: bool = False) -> list[Any]:
        """Subscribes with a callback."""
        self.node.create_subscription(kind, topic, callback, qos, raw=raw)
        return self.heard.setdefault(topic, [])

    def until(self, done: Callable[[], Any], seconds: float = LIMIT) -> bool:
        """Spins until something is true; returns whether it became so."""
        deadline = time.monotonic() + seconds
        while not done() and time.monotonic() < deadline:
            self._executor.spin_once(timeout_sec=0.05)
        return bool(done())

    def call(self, service: str, kind: Any, request: Any = None, seconds: float = LIMIT) -> Any:
        """Calls a service and returns its answer."""
        client = self.node.create_client(kind, service)
        assert self.until(client.service_is_ready, seconds), f"no service {service}"
        future = client.call_async(kind.Request() if request is None else request)
        assert self.until(future.done, seconds), f"no answer of {service}"
        self.node.destroy_client(client)
        return future.result()

    def close(self) -> None:
        """Ends it."""
        self._executor.shutdown()
        self.node.destroy_node()
        self.context.shutdown()

    def __enter__(self) -> Ear:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def latched() -> Any:
    from quadid_node.publish import LATCHED_QOS

    return LATCHED_QOS


def message(health: list[Any], part: str) -> str:
    found: str = next(s.message for s in health[-1].status if s.name.endswith(part))
    return found


def level(health: list[Any], part: str) -> bytes:
    found: bytes = next(s.level for s in health[-1].status if s.name.endswith(part))
    return found
