"""What our own code costs a message, without ROS: decode, choose, buffer, grid; fits left out."""

from __future__ import annotations

import tempfile
import time
from collections import deque
from pathlib import Path
from typing import Any

from quadid_node.inputs import Chooser, Decoder, Intake, best_ranks, deserializer, source
from quadid_node.service import ROUND_SECONDS, Service
from quadid_node.worker import InlineWorker
from quadid_replay import write_mcap
from quadid_replay.mcap_file import McapFile

from quadid.online import SessionSettings
from quadid_evaluation.benchmarks.online.accuracy import PELICAN
from quadid_evaluation.benchmarks.online.feeder import recording


def own_code(seconds: float) -> dict[str, Any]:
    """Processor time a message [us], and as a share of one core at the feeder's rates."""
    made = recording(seconds, "excited")
    with tempfile.TemporaryDirectory() as folder:
        write_mcap(Path(folder) / "k.mcap", made, 1_700_000_000 * 10**9)
        file = McapFile(Path(folder) / "k.mcap")
        topics = file.topics
        messages = [(topics[number].name, data) for number, _, data in file.messages(topics.keys())]
    inputs = source("canonical").inputs
    chooser = Chooser(best_ranks(inputs))
    intake = Intake()
    arrived: dict[str, deque[bytes]] = {}
    for e in inputs:
        arrived[e.topic] = deque()
        decoder = Decoder(e, chooser, 4, deserializer(e.type))
        intake.open(e, e.topic, decoder, lambda q=arrived[e.topic]: q.popleft() if q else None)  # type: ignore[misc]
    service = Service(PELICAN, SessionSettings(window=60.0, diagnose=0.0), InlineWorker())
    a_round = round(len(messages) / seconds * ROUND_SECONDS)
    begin = time.process_time()
    for k, (topic, data) in enumerate(messages):
        arrived[topic].append(data)
        if k % a_round == 0:
            for items in intake.read(intake.take()):
                for item in items:
                    service.push(item)
            service.step()
    spent = time.process_time() - begin
    return {"messages": len(messages), "us_per_message": spent / len(messages) * 1e6, "share": spent / seconds}
