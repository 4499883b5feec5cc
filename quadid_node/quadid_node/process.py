"""The process around a node: signals that end it, and how the middleware carries messages and ends.

Fast DDS is the middleware of these wheels, and of Jazzy by default.
"""

import gc
import os
import signal
from collections.abc import Mapping
from types import FrameType
from typing import Any

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


# --- Arguments of the launch files: only what was given overrides the configuration file


ARGUMENTS: dict[str, str] = {
    "vehicle": "a shipped vehicle, or the path of a vehicle file",
    "source": "whose topic names and types: canonical, mavros, px4, ardupilot, rotors",
    "approval": "auto, or manual: a set waits for quadid/approve",
    "history": "history file; none keeps none",
    "record": "MCAP file to record what arrives to",
    "observer": "true: keep no history and publish nothing",
    "zenoh": "Zenoh locator or configuration file to publish on too, for quadid watch",
    "autostart": "false: a lifecycle manager configures and activates",
    "use_sim_time": "true: take the time from /clock",
}
"""Arguments that become parameters of the node when they are given; none has a default of its own."""
NODE_ARGUMENTS: dict[str, tuple[str, str]] = {
    "log_level": ("", "debug, info, warn, error"),
    "respawn": ("false", "true: start the node again when it ends by itself"),
}
"""Arguments of the process: default and description."""
_BOOLEAN = ("observer", "autostart", "use_sim_time")
_ONE_EACH = ("record",)


def parameters(given: Mapping[str, str]) -> dict[str, Any]:
    """Parameters of the node from launch arguments; an empty one was not given.

    Raises:
        ValueError: a truth value that is none.
    """
    named = {name: given[name] for name in ARGUMENTS if given.get(name)}
    return {name: truth(name, text) if name in _BOOLEAN else text for name, text in named.items()}


def truth(name: str, text: str) -> bool:
    """Reads true or false; raises ValueError."""
    if text.lower() not in ("true", "false"):
        raise ValueError(f"{name}:={text}: true or false")
    return text.lower() == "true"


def fleet(namespaces: str, given: Mapping[str, str]) -> list[dict[str, str]]:
    """Arguments of each vehicle of a fleet.

    Args:
        namespaces: comma-separated, one a vehicle.
        given: each argument once for all, or comma-separated, one a vehicle.

    Raises:
        ValueError: a namespace twice or none at all, or an argument given for some vehicles only.
    """
    names = [n.strip() for n in namespaces.split(",") if n.strip()]
    if not names or len(set(names)) < len(names):
        raise ValueError(f"namespaces:={namespaces}: give each vehicle its own, as namespaces:=quad1,quad2")
    columns = {}
    for name, text in given.items():
        values = [v.strip() for v in text.split(",")]
        if len(values) not in (1, len(names)) or (len(values) == 1 < len(names) and text and name in _ONE_EACH):
            wanted = f"one for each of the {len(names)} vehicles" + " or one for all" * (name not in _ONE_EACH)
            raise ValueError(f"{name}:={text}: give {wanted}, separated by commas")
        columns[name] = values if len(values) == len(names) else values * len(names)
    return [{"namespace": n, **{name: column[k] for name, column in columns.items()}} for k, n in enumerate(names)]
