"""How Fast DDS, the middleware of these wheels and of Jazzy by default, carries messages between processes."""

from __future__ import annotations

import os

_CHOSEN_BY_USER = ("FASTDDS_BUILTIN_TRANSPORTS", "FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")


def without_shared_memory() -> None:
    """Lets messages travel over UDP alone, also between processes of one machine; to be called before `rclpy.init`.

    The shared memory of Fast DDS 2.14 is a port that a peer takes down when a reader is late or a process was killed.
    The messages in it are lost, and a participant that ends just then dies by SIGSEGV (in
    ``SharedMemChannelResource::release``).  Whoever has chosen a transport or a profile keeps it.
    """
    if not any(os.environ.get(name) for name in _CHOSEN_BY_USER):
        os.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"
