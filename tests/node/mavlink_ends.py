"""The other end of a MAVLink link over UDP, for tests: vehicles, ground stations, attackers."""

import contextlib
import socket
import time
from dataclasses import replace
from typing import Any

from quadid_node.mavlink_link import MavlinkLink
from quadid_node.mavlink_wire import SIGNING_EPOCH, dialect

from quadid.online.records import Publish
from tests.online.test_gate import TRUE, online_set
from tests.samples import flat

KEY = bytes(range(32))


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Sender:
    """Something that speaks MAVLink over UDP to a port."""

    def __init__(self, port: int, system: int = 1, component: int = 1, key: bytes | None = None) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(("127.0.0.1", port))
        self.socket.settimeout(0.2)
        self.mav = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        if key is not None:
            self.mav.signing.secret_key = key
            self.mav.signing.sign_outgoing = True
            self.mav.signing.timestamp = int((time.time() - SIGNING_EPOCH) * 100_000)

    def send(self, message: Any) -> bytes:
        frame = bytes(message.pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) % 256
        self.socket.send(frame)
        return frame

    def heartbeat(self, autopilot: int = 12) -> bytes:
        return self.send(dialect.MAVLink_heartbeat_message(2, autopilot, 0, 0, 4, 3))

    def imu(self, t: float, rate: float = 0.1) -> bytes:
        return self.send(
            dialect.MAVLink_highres_imu_message(int(t * 1e6), 0.0, 0.0, -9.8, rate, 0.0, 0.0, *[0.0] * 7, 0x3F)
        )

    def heard(self, seconds: float = 0.5) -> list[Any]:
        """Messages that came back, until none comes for so long [s], at most 0.2."""
        reader = dialect.MAVLink(None)
        out: list[Any] = []
        reader.robust_parsing = True
        self.socket.settimeout(min(seconds, 0.2))
        with contextlib.suppress(TimeoutError):
            while True:
                out += reader.parse_buffer(self.socket.recv(4096)) or []
        return out


def decoded(message: Any) -> Any:
    mav = dialect.MAVLink(None, 1, 1)
    return mav.decode(bytearray(message.pack(mav)))


def samples(link: MavlinkLink, seconds: float = 0.3) -> list[Any]:
    """Messages that a link receives in so long [s], in five looks at least: earlier ones wait in its socket."""
    out: list[Any] = []
    deadline, looks = time.monotonic() + seconds, 0
    while time.monotonic() < deadline or looks < 5:
        looks += 1
        out += flat(link.receive())
        link.step()
        time.sleep(0.005)
    return out


def accepted() -> Publish:
    return Publish("parameters", replace(online_set(TRUE), sequence=3, approved_by="auto"))
