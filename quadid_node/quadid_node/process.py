"""The process around a node: signals that end it, and how the middleware carries messages and ends.

Fast DDS is the middleware of these wheels, and of Jazzy by default.
"""

from __future__ import annotations

import gc
import os
import signal
from types import FrameType

SPIN_SECONDS = 0.2
"""Longest wait before signals are looked at [s]; the executor of these wheels needs a limit to deliver anything."""
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables of NumPy's number of threads: on a busy machine more than one wait for each other, of small matrices."""
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_CHOSEN_BY_USER = ("FASTDDS_BUILTIN_TRANSPORTS", "FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")


def one_thread() -> None:
    """Has linear algebra take one thread, where the user does not say otherwise; before NumPy is imported."""
    for name in THREADS:
        os.environ.setdefault(name, "1")


class StopSignal:
    """Notes SIGINT and SIGTERM from the first moment on; true once one has come."""

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


def without_shared_memory() -> None:
    """Lets messages travel over UDP alone, also between processes of one machine; to be called before `rclpy.init`.

    The shared memory of Fast DDS 2.14 is a port that a peer takes down when a reader is late or a process was killed.
    The messages in it are lost, and a participant that ends just then dies by SIGSEGV (in
    ``SharedMemChannelResource::release``).  Whoever has chosen a transport or a profile keeps it.
    """
    if not any(os.environ.get(name) for name in _CHOSEN_BY_USER):
        os.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"


def end_middleware() -> None:
    """Ends the middleware's threads, once no variable holds a node or an executor any more.

    Cycles keep them beyond `destroy_node` and `rclpy.shutdown`.  Left to the interpreter's own end, threads that still
    receive what peers send race with it, and the process dies by SIGSEGV now and then.
    """
    gc.collect()
