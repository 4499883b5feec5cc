"""The node itself, watched: how late each IMU message was taken and whether a fit ran, how long each step took."""

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
        self.idle, self.fitting, self.steps = array("d"), array("d"), array("d")

    def poll(self, kind: Any, topic: str, qos: Any, **options: Any) -> Callable[[], bytes | None]:
        """As the node's, with a note of each IMU message."""
        take = super().poll(kind, topic, qos, **options)
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
        begin = time.time()
        super()._step()
        self.steps.append(time.time() - begin)

    def destroy_node(self) -> None:
        """Writes what was noted."""
        noted = {"idle": self.idle.tolist(), "fitting": self.fitting.tolist(), "step": self.steps.tolist()}
        Path(os.environ[OUT]).write_text(json.dumps(noted))
        super().destroy_node()


if __name__ == "__main__":
    quadid_node.node.IdentifyNode = ProbeNode  # type: ignore[misc]
    sys.exit(main())
