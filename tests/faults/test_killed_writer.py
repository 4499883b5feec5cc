"""Row 2: a recording process that is killed with -9 loses at most the chunk it was filling."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from quadid_replay import open_log
from quadid_replay.mcap_file import McapFile

from tests.faults.evidence import Happened

CHUNK = 16384
WRITER = f"""
import sys
import quadid_replay.writers as topic_writer
topic_writer.CHUNK_BYTES = {CHUNK}
writer = topic_writer.TopicWriter(sys.argv[1])
for k in range(10**9):
    stamp = {{"sec": k // 100, "nanosec": k % 100 * 10**7}}
    message = {{"header": {{"stamp": stamp}}, "values": [0.5 + k % 7 * 0.01] * 4}}
    writer.write("motor_command", "quadid_msgs/msg/MotorCommand", message, k * 10**7 + 1)
    if k % 100 == 0:
        print(k, flush=True)
"""


@pytest.mark.parametrize("after", [700, 1500, 3300])
def test_a_killed_writer_loses_at_most_one_chunk(tmp_path: Path, after: int, happened: Happened) -> None:
    path = tmp_path / "run.mcap"
    with subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        written = next(int(line) for line in writer.stdout if int(line) >= after)
        writer.send_signal(signal.SIGKILL)
    recording = open_log(path)
    t = recording.channels["motor_command"].t
    lost = written - len(t)
    file = McapFile(path)
    a_chunk = CHUNK // (31 + len(next(file.messages(file.topics.keys()))[2])) + 1
    assert lost <= a_chunk
    assert any("recording was not closed" in w or "cut" in w for w in recording.warnings)
    happened(
        2,
        f"killed with -9 after {written} messages: {max(lost, 0)} of them lost, a chunk holds {a_chunk}",
    )
