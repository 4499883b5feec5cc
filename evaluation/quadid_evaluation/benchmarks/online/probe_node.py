"""The node itself, watched: how late each IMU message was taken and whether a fit ran, how long each step took.

By the clock, and of this thread's processor time, which other programs on the machine do not lengthen much.  Steps
count from the first message on, and only those in which there was something to do.
"""

from __future__ import annotations

import json
import os
import struct
import sys
import time
from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Any

import quadid_node.node
from quadid_node.identify import main

OUT = "QUADID_PROBE_OUT"
_LAST_DOUBLE = struct.Struct("<d")


class ProbeNode(quadid_node.node.IdentifyNode):
    """Notes latencies; everything else is the node's own."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.idle, self.fitting, self.steps, self.cpu = array("d"), array("d"), array("d"), array("d")

    def poll(self, kind: Any, topic: str, qos: Any) -> Callable[[], bytes | None]:
        """As the node's, with a note of each IMU message."""
        take = super().poll(kind, topic, qos)
        if topic != "imu":
            return take

        def noted() -> bytes | None:
            data = take()
            if data is not None:
                (published,) = _LAST_DOUBLE.unpack_from(data, len(data) - 8)
                busy = self._service is not None and self._service.session.running is not None
                (self.fitting if busy else self.idle).append(time.time() - published)
            return data

        return noted

    def _step(self) -> None:
        resting, begin, cpu = self._scheduler.resting, time.monotonic(), time.thread_time()
        super()._step()
        if self.idle and not resting:
            self.cpu.append(time.thread_time() - cpu)
            self.steps.append(time.monotonic() - begin)

    def destroy_node(self) -> None:
        """Writes what was noted."""
        arrays = {"idle": self.idle, "fitting": self.fitting, "step": self.steps, "step_cpu": self.cpu}
        noted = {name: array.tolist() for name, array in arrays.items()}
        Path(os.environ[OUT]).write_text(json.dumps(noted))
        super().destroy_node()


if __name__ == "__main__":
    quadid_node.node.IdentifyNode = ProbeNode  # type: ignore[misc]
    sys.exit(main())
