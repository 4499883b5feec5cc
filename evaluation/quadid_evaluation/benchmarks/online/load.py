"""The node under load: its share of a core, how late its callbacks are while it idles and fits, its memory."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

TICKS = os.sysconf("SC_CLK_TCK")
PAGE = os.sysconf("SC_PAGE_SIZE")
START_LIMIT = 240.0
WAYS = ("woken", "polled")
"""How a node gets its messages: a callback for each, or all that wait, every now and then."""
THIS_MACHINE = {
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT",
    "FASTRTPS_DEFAULT_PROFILES_FILE": str(Path(__file__).parents[4] / "quadid_node" / "config" / "loopback.xml"),
}
"""Environment of ROS processes that meet within this machine alone, without shared memory."""
SETTLE = 2.0
"""Time after the first message before anything counts [s]."""


def _processor_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def _resident(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE / 2**20


def _worker_of(pid: int) -> int:
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return next((int(c) for c in children if b"worker_main" in Path(f"/proc/{c}/cmdline").read_bytes()), 0)


def _wait_for(child: subprocess.Popen[str], word: str) -> None:
    deadline = time.monotonic() + START_LIMIT
    assert child.stdout is not None
    for line in child.stdout:
        if word in line:
            return
        if time.monotonic() > deadline:
            break
    raise RuntimeError(f"'{word}' was not said")


def under_load(seconds: float, profile: str, record: bool = False) -> dict[str, Any]:
    """Runs the node and a feeder for `seconds` of flight.

    Args:
        seconds: length of the flight.
        profile: what the pilot does.
        record: whether the node records what it takes in.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "noted.json"
        environment = {
            **os.environ, "QUADID_PROBE_OUT": str(out), "PYTHONUNBUFFERED": "1", "AMENT_PREFIX_PATH": sys.prefix,
            "ROS_DOMAIN_ID": str(1 + os.getpid() % 100), **THIS_MACHINE,
        }  # fmt: skip
        options = ["-p", f"history:={folder}/h.sqlite", *(["-p", f"record:={folder}/r.mcap"] if record else [])]
        node = _start(["quadid_evaluation.benchmarks.online.probe_node", "--ros-args", *options], environment)
        try:
            _wait_for(node, "ready")
            feeder = _start(["quadid_evaluation.benchmarks.online.feeder", str(seconds), profile], environment)
            _wait_for(feeder, "flying")
            time.sleep(SETTLE)
            result = _watch(node.pid, feeder, seconds - 2.0 * SETTLE)
        finally:
            node.send_signal(signal.SIGINT)
            node.communicate(timeout=30)
        noted = json.loads(out.read_text())
    return {**result, "seconds": seconds, "profile": profile, "record": record, "exit_code": node.returncode,
            **{k: _latency(noted[k]) for k in ("idle", "fitting", "step", "step_cpu")},
            "imu_received": (len(noted["idle"]) + len(noted["fitting"])) / (seconds * 1000.0)}  # fmt: skip


def bare(seconds: float, way: str) -> dict[str, float]:
    """A node that takes the same messages and does nothing with them: its share of a core; see `bare_node`."""
    environment = {
        **os.environ, "PYTHONUNBUFFERED": "1", "AMENT_PREFIX_PATH": sys.prefix,
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100), **THIS_MACHINE,
    }  # fmt: skip
    node = _start(["quadid_evaluation.benchmarks.online.bare_node", way], environment)
    try:
        _wait_for(node, "ready")
        feeder = _start(["quadid_evaluation.benchmarks.online.feeder", str(seconds), "excited"], environment)
        _wait_for(feeder, "flying")
        time.sleep(SETTLE)
        before, begin = _processor_seconds(node.pid), time.monotonic()
        time.sleep(seconds - 2.0 * SETTLE)
        share = (_processor_seconds(node.pid) - before) / (time.monotonic() - begin)
        feeder.communicate(timeout=60)
    finally:
        node.send_signal(signal.SIGINT)
        node.communicate(timeout=30)
    return {"share": share}


def _start(command: list[str], environment: dict[str, str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", *command], env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def _watch(pid: int, feeder: subprocess.Popen[str], seconds: float) -> dict[str, Any]:
    worker = _worker_of(pid)
    before = _processor_seconds(pid), _processor_seconds(worker), time.monotonic(), _resident(pid)
    time.sleep(seconds)
    span = time.monotonic() - before[2]
    result = {
        "cpu_node": (_processor_seconds(pid) - before[0]) / span,
        "cpu_worker": (_processor_seconds(worker) - before[1]) / span,
        "memory_begin": before[3], "memory_end": _resident(pid), "memory_worker": _resident(worker),
        "load_average": os.getloadavg()[0],
    }  # fmt: skip
    said, _ = feeder.communicate(timeout=60)
    result["messages"] = int(said.split(" messages")[0].split()[-1]) if " messages" in said else 0
    return result


def _latency(seconds: list[float]) -> dict[str, float]:
    """Median, 99 % and worst latency [ms]."""
    if not seconds:
        return {"count": 0}
    ms = np.array(seconds) * 1e3
    return {"count": len(ms), "p50": float(np.median(ms)), "p99": float(np.quantile(ms, 0.99)), "max": float(ms.max())}
