"""A word on the terminal while the program itself is loaded, before there is a bar."""

from __future__ import annotations

import sys
import threading
import time


class Loading:
    """Seconds of loading in one line of stderr, on a terminal only; `end` takes the line away."""

    def __init__(self) -> None:
        self._ended = threading.Event()
        self._line = threading.Thread(target=self._count, daemon=True)
        if sys.stderr is not None and sys.stderr.isatty():
            self._line.start()

    def _count(self) -> None:
        begin = time.monotonic()
        while not self._ended.wait(0.5):
            print(f"\rquadid: loading, {time.monotonic() - begin:.0f} s", end="", file=sys.stderr, flush=True)

    def end(self) -> None:
        """Erases the line, if there is one, for good."""
        if self._line.is_alive() and not self._ended.is_set():
            self._ended.set()
            self._line.join()
            print("\r\x1b[2K", end="", file=sys.stderr, flush=True)
