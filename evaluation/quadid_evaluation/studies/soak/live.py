"""An hour of the real node: DDS, fit process, history, in real time; memory, files, latency, lost messages."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from quadid_evaluation.benchmarks.online.load import THIS_MACHINE, _resident, _wait_for, _worker_of
from quadid_evaluation.studies.soak.node import OUT

WHERE = ("--ros-args", "-r", "__ns:=/soak")
WATCH = 60.0


def hour(seconds: float, tell: Callable[[str], None]) -> dict[str, Any]:
    """Runs node and vehicle for `seconds`; one entry a minute, and what was sent and taken in."""
    with tempfile.TemporaryDirectory() as folder:
        kept = Path(folder) / "kept"
        kept.mkdir()
        environment = {
            **os.environ, OUT: f"{folder}/counts.jsonl", "PYTHONUNBUFFERED": "1", "AMENT_PREFIX_PATH": sys.prefix,
            "ROS_DOMAIN_ID": str(1 + os.getpid() % 100), **THIS_MACHINE,
            "ROS_LOG_DIR": f"{kept}/log",
        }  # fmt: skip
        said = (Path(folder) / "said.txt").open("w+")
        node = _start(
            "quadid_evaluation.studies.soak.node",
            environment,
            subprocess.PIPE,
            *WHERE,
            "-p",
            f"history:={kept}/h.sqlite",
        )
        try:
            _wait_for(node, "ready")
            _drain(node, said)
            feeder = _start("quadid_evaluation.studies.soak.feeder", environment, subprocess.PIPE, str(seconds), *WHERE)
            _wait_for(feeder, "flying")
            points = _watch(node.pid, feeder, kept, tell)
        finally:
            node.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                node.wait(300)  # on a crowded machine; what was measured must not be lost for it
        sent = json.loads(feeder.stdout.read().strip().splitlines()[-1]) if feeder.stdout else {}
        noted = [json.loads(line) for line in Path(f"{folder}/counts.jsonl").read_text().splitlines()]
        said.seek(0)
        problems = [line.strip() for line in said if "[ERROR]" in line or "[WARN]" in line or "Traceback" in line]
    return {"asked_seconds": seconds, "sent": sent, "points": points, "minutes": noted, "exit_code": node.returncode,
            "problems": problems}  # fmt: skip


def _start(module: str, environment: dict[str, str], out: int, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", module, *arguments], env=environment, stdout=out, stderr=subprocess.STDOUT, text=True
    )


def _drain(child: subprocess.Popen[str], into: Any) -> None:
    """Keeps reading what a child says, so that its pipe never fills."""

    def read() -> None:
        assert child.stdout is not None
        for line in child.stdout:
            into.write(line)
            into.flush()

    threading.Thread(target=read, daemon=True).start()


def _watch(pid: int, feeder: subprocess.Popen[str], kept: Path, tell: Callable[[str], None]) -> list[dict[str, float]]:
    begin, points = time.monotonic(), []
    while feeder.poll() is None:
        time.sleep(min(WATCH, 5.0) if not points else WATCH)
        size = sum(f.stat().st_size for f in kept.rglob("*") if f.is_file()) / 2**20
        worker = _worker_of(pid)
        points.append({
            "hours": (time.monotonic() - begin) / 3600.0, "memory_mib": _resident(pid), "files_mib": size,
            "worker_mib": _resident(worker) if worker else float("nan"), "load": os.getloadavg()[0],
            "handles": len(list(Path(f"/proc/{pid}/fd").iterdir())),
            "threads": len(list(Path(f"/proc/{pid}/task").iterdir())),
        })  # fmt: skip
        tell(f"{points[-1]['hours'] * 60:.0f} min, {points[-1]['memory_mib']:.0f} MiB")
    return points
