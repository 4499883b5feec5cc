"""Rows 2, 6 and 8: a killed recorder, saturation, and a stream with duplicates, jitter and dropout."""

import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from quadid_replay import open_log
from quadid_replay.mcap_file import McapFile

from quadid.checks import inspect
from quadid.data.window import at_limit, data_faults
from quadid.online import Session, SessionSettings
from quadid.online.checks import judge
from quadid.online.gate import GateSettings
from quadid.online.grid_buffer import WindowCut
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened
from tests.online.driving import drive, flight, published, samples
from tests.online.test_quality import thrust_of
from tests.samples import Sample

# --- Row 8: duplicates, reordering, jitter and 30 % dropout change the estimate by no more than its interval says


PELICAN = Vehicle.shipped("pelican")
QUICK = SessionSettings(window=5.0, gate=GateSettings(windows=2, width=0.08, yaw_width=0.6))


def disturbed(stream: list[Sample], how: str) -> list[Sample]:
    rng = np.random.default_rng(8)
    if how == "duplicates":
        return [s for sample in stream for s in (sample,) * int(rng.integers(1, 4))]
    if how == "reordering":
        return sorted(stream, key=lambda s: s.t + rng.uniform(0.0, 0.2))
    if how == "jitter":
        return [Sample(s.t + rng.normal(0.0, 0.001), s.channel, s.values) for s in stream]
    return [s for s in stream if rng.random() > 0.3]


@pytest.mark.parametrize("how", ["duplicates", "reordering", "jitter", "dropout"])
def test_a_disturbed_stream_gives_the_same_estimate_or_the_reason(how: str, happened: Happened) -> None:
    stream = samples(flight(16.0, 6).recording)
    clean = published(drive(Session(PELICAN, QUICK), stream), "candidate")[-1].parameters
    session = Session(PELICAN, QUICK)
    sets = published(drive(session, disturbed(stream, how)), "candidate")
    if not sets:
        reason = session.status().reason
        assert reason
        happened(8, f"{how} at 50 Hz: no estimate, the reason said: {reason}")
        return
    found = sets[-1].parameters
    pairs = [(found[name], clean[name]) for name in ("b", "J_xx", "J_yy")]
    off = [abs(a.value - b.value) / np.hypot(a.sigma, b.sigma) for a, b in pairs]
    assert max(off) < 3.0, off
    wider = found["J_xx"].sigma / found["J_xx"].value / (clean["J_xx"].sigma / clean["J_xx"].value)
    happened(8, f"{how}: b, J_xx, J_yy within {max(off):.1f} sigma of the clean run; interval x {wider:.2f}")


# --- Row 6: one rule for saturation, shared by inspection, online windows and diagnosis


@pytest.mark.parametrize("share", [0.5, 0.7])
def test_three_places_agree_on_a_saturated_sensor(share: float, happened: Happened) -> None:
    made = flight(30.0, 3)
    gyro = made.recording.channels["gyro"]
    top = share * float(np.abs(gyro.values[:, 1]).max())
    clipped = np.clip(gyro.values, -top, top)
    recording = replace(made.recording, channels={**made.recording.channels, "gyro": replace(gyro, values=clipped)})
    assert made.window.gyro is not None
    window = replace(made.window, gyro=np.clip(made.window.gyro, -top, top))
    assert any(end.axis == 1 for end in at_limit(clipped))
    assert any("saturated" in c.name for c in inspect(recording, PELICAN).checks)
    assert (
        "saturated" in judge(WindowCut((window,), len(window) * window.dt, 0), PELICAN, thrust_of(2.33e-5), True).fault
    )
    assert [f for f in data_faults([window]) if f.kind == "saturated"]
    happened(6, f"gyro clipped at {share:.0%} of its peak: inspection, online window and diagnosis name it by one rule")


@pytest.mark.parametrize("profile", ["excited", "hover"])
def test_no_true_flight_is_called_saturated_not_even_with_coarse_steps(profile: str) -> None:
    made = flight(30.0, 3, profile)
    for name, step in (("gyro", 0.02), ("accel", 0.1)):
        values = made.recording.channels[name].values
        assert at_limit(values) == []
        assert at_limit(np.round(values / step) * step) == []


def test_a_resting_command_is_not_saturated() -> None:
    rng = np.random.default_rng(0)
    command = np.concatenate([np.zeros(500), rng.uniform(0.3, 0.6, 1000), np.zeros(500)])[:, None]
    assert at_limit(command) == []


# --- Row 2: a recording process that is killed with -9 loses at most the chunk it was filling


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
    happened(2, f"killed with -9 after {written} messages: {max(lost, 0)} of them lost, a chunk holds {a_chunk}")
