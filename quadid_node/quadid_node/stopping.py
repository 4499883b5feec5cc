"""SIGINT and SIGTERM: noted from the first moment on, ignored while everything is put away."""

from __future__ import annotations

import gc
import os
import signal
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """Says whether the process was asked to end."""

    def __init__(self, nothing_open: bool = False) -> None:
        """Takes the signals over.

        Args:
            nothing_open: until `opens` is called a signal ends the process at once: imports may take long.
        """
        self._asked, self._nothing_open = False, nothing_open
        for number in _SIGNALS:
            signal.signal(number, self._on_signal)

    def __call__(self) -> bool:
        """True once a signal has come."""
        return self._asked

    def opens(self) -> None:
        """From now on there is something to put away: signals are only noted."""
        self._nothing_open = False

    def ignore_more(self) -> None:
        """Lets further signals change nothing any more.

        `ros2 launch` and impatient people send a second one: it must not interrupt what is being stored, nor the
        interpreter's own end, in which Python puts the deadly default handlers back for all but ignored signals.
        """
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._asked = True
        if self._nothing_open:
            os._exit(0)


def end_middleware() -> None:
    """Ends the middleware's threads, once no variable holds a node or an executor any more.

    Cycles keep them beyond `destroy_node` and `rclpy.shutdown`.  Left to the interpreter's own end, threads that still
    receive what peers send race with it, and the process dies by SIGSEGV now and then.
    """
    gc.collect()
