"""The libraries that others read logs with, on the same files; what they yield is counted, not kept."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path


def _mcap(path: Path) -> int:
    """Messages as bytes, by mcap's reader: nothing in them is decoded."""
    from mcap.reader import make_reader

    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file).iter_messages(log_time_order=False))


def _mcap_decoded(path: Path) -> int:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return sum(1 for _ in reader.iter_decoded_messages(log_time_order=False))


def _pymavlink(path: Path) -> int:
    """Messages of a telemetry log or of DataFlash, decoded; telemetry through its index."""
    from pymavlink import mavutil

    log, count = mavutil.mavlink_connection(str(path), dialect="ardupilotmega"), 0
    while log.recv_msg() is not None:
        count += 1
    return count


def _pyulog(path: Path) -> int:
    from pyulog import ULog

    return len(ULog(str(path)).data_list)


LIBRARIES: dict[str, dict[str, Callable[[Path], int]]] = {
    ".mcap": {"mcap, bytes only": _mcap, "mcap and mcap-ros2-support": _mcap_decoded},
    ".tlog": {"pymavlink": _pymavlink},
    ".bin": {"pymavlink": _pymavlink},
    ".ulg": {"pyulog": _pyulog},
}
"""By suffix and name."""
