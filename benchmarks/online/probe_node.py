"""The node itself, with a watch on every IMU callback: how long after publishing it began, and whether a fit ran."""

from __future__ import annotations

import json
import os
import struct
import sys
import time
from array import array
from pathlib import Path
from typing import Any

import quadid_node.node
from quadid_node.convert import Decoder
from quadid_node.identify import main
from quadid_node.presets import Input

OUT = "QUADID_PROBE_OUT"
_LAST_DOUBLE = struct.Struct("<d")


class ProbeNode(quadid_node.node.IdentifyNode):
    """Notes latencies; everything else is the node's own."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.idle, self.fitting, self.spent = array("d"), array("d"), array("d")

    def _on_message(self, decoder: Decoder, entry: Input, data: bytes) -> None:
        begin = time.time()
        super()._on_message(decoder, entry, data)
        if entry.topic == "imu" and self._service is not None:
            (published,) = _LAST_DOUBLE.unpack_from(data, len(data) - 8)
            kept = self.fitting if self._service.session.running is not None else self.idle
            kept.append(begin - published)
            self.spent.append(time.time() - begin)

    def destroy_node(self) -> None:
        """Writes what was noted."""
        noted = {"idle": self.idle.tolist(), "fitting": self.fitting.tolist(), "spent": self.spent.tolist()}
        Path(os.environ[OUT]).write_text(json.dumps(noted))
        super().destroy_node()


if __name__ == "__main__":
    quadid_node.node.IdentifyNode = ProbeNode  # type: ignore[misc]
    sys.exit(main())
