"""The node itself, with a count of the messages it takes and how late it does, a line a minute."""

from __future__ import annotations

import json
import os
import struct
import sys
import time
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import quadid_node.node
from quadid_node.identify import main
from quadid_node.publish import Publishers
from quadid_node.service import Service

from quadid_evaluation.studies.soak import memory

OUT, EVERY = "QUADID_SOAK_OUT", 60.0
_LAST_DOUBLE = struct.Struct("<d")


class CountingNode(quadid_node.node.IdentifyNode):
    """Counts messages by topic and notes latencies; everything else is the node's own."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.late, self.counted, self.noted = array("d"), Counter[str](), time.monotonic()

    def poll(self, kind: Any, topic: str, qos: Any) -> Callable[[], bytes | None]:
        """As the node's, with a count."""
        take = super().poll(kind, topic, qos)

        def counted() -> bytes | None:
            data = take()
            if data is not None:
                self.counted[topic] += 1
                if topic == "imu":
                    self.late.append(time.time() - _LAST_DOUBLE.unpack_from(data, len(data) - 8)[0])
            return data

        return counted

    def _report(self, service: Service, speaker: Publishers) -> Iterator[None]:
        yield from super()._report(service, speaker)
        if time.monotonic() - self.noted >= EVERY and self.late:
            self.note()

    def note(self) -> None:
        """Appends a line to the file of the counts."""
        self.noted = time.monotonic()
        ms = 1e3 * np.array(self.late)
        session = self._service.session if self._service is not None else None
        status = session.status() if session else None
        line = {
            "t": time.time(), "messages": dict(self.counted), "p50": float(np.median(ms)) if len(ms) else None,
            "p99": float(np.quantile(ms, 0.99)) if len(ms) else None, "max": float(ms.max()) if len(ms) else None,
            "taken": dict(session.resampler.counts) if session else {},
            "dropped": dict(session.resampler.faults) if session else {},
            "fits": status.fits if status else 0, "in_force": status.in_force if status else 0,
            "backlog": status.backlog if status else 0.0, "memory": memory.parts(),
        }  # fmt: skip
        self.late = array("d")
        with Path(os.environ[OUT]).open("a") as file:
            file.write(json.dumps(line) + "\n")

    def on_shutdown(self, state: Any) -> Any:
        """Notes the last counts."""
        self.note()
        return super().on_shutdown(state)


if __name__ == "__main__":
    quadid_node.node.IdentifyNode = CountingNode  # type: ignore[misc]
    sys.exit(main())
