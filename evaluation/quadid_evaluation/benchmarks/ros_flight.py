"""The ROS node watched beside a vehicle on its topics, each in a process of its own: load, latency, memory, losses.

    python -m quadid_evaluation.benchmarks.ros_flight fly SECONDS RATE PROFILE
    python -m quadid_evaluation.benchmarks.ros_flight node --ros-args ...

The moment of publishing stands in the last number of each IMU message, a covariance that nobody reads.
"""

import contextlib
import json
import os
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from array import array
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil

THIS_MACHINE = {
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT",
    "FASTRTPS_DEFAULT_PROFILES_FILE": str(Path(__file__).parents[3] / "quadid_node" / "config" / "loopback.xml"),
}
"""Environment of ROS processes that meet within this machine alone, without shared memory."""
OUT, EVERY = "QUADID_PROBE_OUT", "QUADID_PROBE_EVERY"
"""Variables of the watched node: file of its notes, time between two [s]."""
FLIGHT, GROUND = 120.0, 5.0
"""Longest flight, and pause before the next one [s]."""
FAST, SLOWER = 1000.0, {"attitude": 4, "rotor_speed": 4, "attitude_reference": 20, "velocity": 20, "position": 20}
"""IMU rate of the load [Hz]; of these channels every so many rows are sent then."""
START_LIMIT, SETTLE = 240.0, 2.0
"""Longest start of a node; time after the first message before anything counts [s]."""
_LAST_DOUBLE = struct.Struct("<d")


# --- The vehicle


def recording(seconds: float, rate: float, profile: str) -> Any:
    """A Pelican flight as a recording; at `FAST`, IMU apart, with slower channels."""
    from quadid.data.window import Channel, Recording  # not for the node, whose memory is measured
    from quadid.flight import fly
    from quadid.vehicle import Vehicle

    extras = ["velocity"] if rate == FAST else []
    flight = fly(Vehicle.shipped("pelican"), seconds=seconds, seed=4, profile=profile, log_rate=rate, extras=extras)
    step = SLOWER if rate == FAST else {}
    channels = {
        name: Channel(name, c.t[:: step.get(name, 1)], c.values[:: step.get(name, 1)], name)
        for name, c in flight.recording.channels.items()
    }
    return Recording("feeder", "stream", channels)


def feed(seconds: float, rate: float, profile: str) -> None:
    """Flies in real time, again and again, until the time is over; prints what was sent by topic."""
    import rclpy
    from quadid_node.process import StopSignal
    from quadid_node.replay_node import Stopped, TopicPlayer, epoch_of
    from quadid_replay.writers import write_recording
    from rclpy.signals import SignalHandlerOptions

    class Feeder(TopicPlayer):
        counts = Counter[str]()

        def again(self) -> None:
            self._begin = None

        def write_cdr(self, topic: str, kind: str, data: bytes, stamp_ns: int) -> None:
            self._wait(stamp_ns)
            if topic == "imu":
                data = data[:-8] + _LAST_DOUBLE.pack(time.time())
            self._publisher(topic, kind).publish(data)
            self.counts[topic] += 1

    stop, made = StopSignal(), recording(min(FLIGHT, seconds), rate, profile)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("feeder")
    feeder = Feeder(node, 1.0, stop)
    feeder.announce(made, 3.0)
    print("flying", flush=True)
    end = time.monotonic() + seconds
    with contextlib.suppress(Stopped):
        while time.monotonic() < end - 0.01 * seconds:
            write_recording(feeder, made, epoch_of(made, "now"))
            feeder.again()
            time.sleep(min(GROUND, max(end - time.monotonic(), 0.0)))
    print(json.dumps(feeder.counts), flush=True)
    time.sleep(1.0)
    node.destroy_node()
    rclpy.try_shutdown()


# --- The node


def watched_node() -> int:
    """The node itself, with notes of messages by topic, of the latency of IMU messages, and of its rounds."""
    import quadid_node.node
    from quadid_node.identify import main

    class Watched(quadid_node.node.IdentifyNode):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            self.late: dict[str, array[float]] = {name: array("d") for name in ("idle", "fitting", "round")}
            self.counted, self.noted = Counter[str](), time.monotonic()

        def poll(self, kind: Any, topic: str, qos: Any) -> Callable[[], bytes | None]:
            take = super().poll(kind, topic, qos)

            def counted() -> bytes | None:
                data = take()
                if data is not None:
                    self.counted[topic] += 1
                    if topic == "imu":
                        busy = self._service is not None and self._service.session.running is not None
                        published = _LAST_DOUBLE.unpack_from(data, len(data) - 8)[0]
                        self.late["fitting" if busy else "idle"].append(time.time() - published)
                return data

            return counted

        def _round(self) -> None:
            begin = time.monotonic()
            super()._round()
            if self.counted:
                self.late["round"].append(time.monotonic() - begin)
            if time.monotonic() - self.noted >= float(os.environ[EVERY]):
                self.note()

        def note(self) -> None:
            """Appends a line to the file of notes."""
            session = self._service.session if self._service is not None else None
            status = session.status() if session else None
            both = latency([*self.late["idle"], *self.late["fitting"]])
            line = {
                "t": time.time(),
                "messages": dict(self.counted),
                **{n: both.get(n) for n in ("p50", "p99", "max")},
                **{name: latency(values) for name, values in self.late.items()},
                "taken": dict(session.resampler.counts) if session else {},
                "dropped": dict(session.resampler.faults) if session else {},
                "fits": status.fits if status else 0,
                "in_force": status.in_force if status else 0,
                "backlog": status.backlog if status else 0.0,
            }
            self.late, self.noted = {name: array("d") for name in self.late}, time.monotonic()
            with Path(os.environ[OUT]).open("a") as file:
                file.write(json.dumps(line) + "\n")

        def on_shutdown(self, state: Any) -> Any:
            self.note()
            return super().on_shutdown(state)

    quadid_node.node.IdentifyNode = Watched  # type: ignore[misc,assignment]
    return main()


def latency(seconds: Any) -> dict[str, float]:
    """Number, median, 99 % and worst latency [ms]."""
    if not len(seconds):
        return {"count": 0}
    ms = np.array(seconds) * 1e3
    return {"count": len(ms), "p50": float(np.median(ms)), "p99": float(np.quantile(ms, 0.99)), "max": float(ms.max())}


# --- Both


def resident(process: psutil.Process | None) -> float:
    """Memory of a process [MiB]; NaN for none."""
    return float("nan") if process is None else process.memory_info().rss / 2**20


def fit_process(service: int) -> psutil.Process | None:
    """The fit process of a service, by the service's process id; None while there is none."""
    try:
        children = psutil.Process(service).children()
        return next((child for child in children if any("node.worker" in word for word in child.cmdline())), None)
    except psutil.Error:
        return None


def beside(
    stream: Sequence[str],
    kept: Path,
    parameters: Sequence[str],
    between: float,
    tell: Callable[[str], None] = lambda line: None,
    more: Mapping[str, str] = {},
    word: str = "",
) -> dict[str, Any]:
    """Runs the node beside a stream.

    Args:
        stream: module and arguments of who publishes; it ends with the flight.
        kept: folder to be made, of `h.sqlite` and the node's logs.
        parameters: of the node, NAME:=VALUE.
        between: time between two points [s]; the first comes after `SETTLE`.
        more: variables of both.
        word: that the stream says when it begins; its start counts without.

    Returns:
        The `points` seen from outside, the notes of the node (`minutes`), `problems` that it said, its `exit_code`, and
        exit code and words of the `stream`.
    """
    notes, said = kept.with_suffix(".jsonl"), list[str]()
    kept.mkdir()
    environment = {
        **os.environ,
        **THIS_MACHINE,
        **more,
        OUT: str(notes),
        EVERY: str(between),
        "PYTHONUNBUFFERED": "1",
        "AMENT_PREFIX_PATH": sys.prefix,
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
        "ROS_LOG_DIR": f"{kept}/log",
    }
    given = (f"history:={kept}/h.sqlite", *parameters)
    node = _start(environment, __spec__.name, "node", "--ros-args", *(a for g in given for a in ("-p", g)))
    try:
        _wait_for(node, "ready")
        # Somebody has to go on reading what it says, so that its pipe never fills.
        threading.Thread(target=lambda: said.extend(node.stdout or ()), daemon=True).start()
        streaming = _start(environment, *stream)
        if word:
            _wait_for(streaming, word)
        points = _watch(node.pid, streaming, kept, between, tell)
        told, _ = streaming.communicate()
    finally:
        node.send_signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            node.wait(300)  # on a crowded machine; what was measured must not be lost for it
    return {
        "exit_code": node.returncode,
        "points": points,
        "minutes": [json.loads(line) for line in notes.read_text().splitlines()],
        "problems": [line.strip() for line in said if any(w in line for w in ("[ERROR]", "[WARN]", "Traceback"))],
        "stream": (streaming.returncode, told.strip()),
    }


def flown(
    seconds: float, rate: float, profile: str, record: bool, between: float, tell: Callable[[str], None]
) -> dict[str, Any]:
    """Runs the node beside a vehicle whose channels have a rate [Hz]; as `beside`, and what was `sent` by topic."""
    with tempfile.TemporaryDirectory() as folder:
        stream, kept = (__spec__.name, "fly", str(seconds), str(rate), profile), Path(folder) / "kept"
        found = beside(stream, kept, [f"record:={kept}/r.mcap"] if record else [], between, tell, word="flying")
    _, told = found.pop("stream")
    return {"asked_seconds": seconds, "sent": json.loads(told.splitlines()[-1]), **found}


def under_load(seconds: float, profile: str, record: bool = False) -> dict[str, Any]:
    """The node's share of a core, its latencies and memory with an IMU of `FAST`."""
    found = flown(seconds, FAST, profile, record, seconds - 2.0 * SETTLE, lambda line: None)
    (first, last), note = found["points"], found["minutes"][-1]
    longest = max(found["minutes"], key=lambda m: m["round"]["count"])
    span = 3600.0 * (last["hours"] - first["hours"])
    return {
        "seconds": seconds,
        "profile": profile,
        "record": record,
        "exit_code": found["exit_code"],
        **{
            f"cpu_{who}": (last[name] - first[name]) / span
            for who, name in (("node", "processor"), ("worker", "worker_processor"))
        },
        "memory_begin": first["memory_mib"],
        "memory_end": last["memory_mib"],
        "memory_worker": last["worker_mib"],
        "load_average": last["load"],
        "messages": sum(found["sent"].values()),
        **{name: longest[name] for name in ("idle", "fitting", "round")},
        "imu_received": note["messages"].get("imu", 0) / found["sent"]["imu"],
    }


def _start(environment: dict[str, str], *module: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", *module]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def _wait_for(child: subprocess.Popen[str], word: str) -> None:
    deadline = time.monotonic() + START_LIMIT
    assert child.stdout is not None
    for line in child.stdout:
        if word in line:
            return
        if time.monotonic() > deadline:
            break
    raise RuntimeError(f"'{word}' was not said")


def _processor(process: psutil.Process | None) -> float:
    """Processor time of a process [s]; 0 for none."""
    return 0.0 if process is None else float(sum(process.cpu_times()[:2]))


def _watch(
    pid: int, feeder: subprocess.Popen[str], kept: Path, between: float, tell: Callable[[str], None]
) -> list[dict[str, float]]:
    begin, node, points = time.monotonic(), psutil.Process(pid), list[dict[str, float]]()
    while True:
        with contextlib.suppress(subprocess.TimeoutExpired):
            feeder.wait(between if points else SETTLE)
            return points
        worker = fit_process(pid)
        points.append(
            {
                "hours": (time.monotonic() - begin) / 3600.0,
                "memory_mib": resident(node),
                "files_mib": size_of(kept),
                "worker_mib": resident(worker),
                "load": os.getloadavg()[0],
                "processor": _processor(node),
                "worker_processor": _processor(worker),
                "handles": node.num_fds(),
                "threads": node.num_threads(),
            }
        )
        tell(f"{points[-1]['hours'] * 60:.0f} min, {points[-1]['memory_mib']:.0f} MiB")


def size_of(folder: Path) -> float:
    """Files in a folder [MiB]."""
    return sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) / 2**20


if __name__ == "__main__":
    what, *rest = sys.argv[1:]
    if what == "node":
        sys.argv = [sys.argv[0], *rest]
        sys.exit(watched_node())
    feed(float(rest[0]), float(rest[1]), rest[2])
