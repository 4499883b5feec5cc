"""MAVLink on the wire: frames out of bytes, signatures that fail closed, one transport for any pymavlink URL."""

from __future__ import annotations

import errno
import hashlib
import hmac
import math
import socket
import time
from collections.abc import Callable, Container, Iterator
from pathlib import Path
from typing import Any

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega
from quadid_replay.esc_messages import extend_dialect
from quadid_workflow.files import read_regular

from quadid.errors import QuadidError
from quadid_node.mavlink_peers import Peers
from quadid_node.signing_memory import SigningMemory

dialect: Any = extend_dialect(ardupilotmega)
_Coder: Any = dialect.MAVLink
SIGNING_EPOCH = 1420070400
"""Signature timestamps count 10 us units from 2015-01-01."""
MOST_BEHIND = 60 * 100_000
"""A new stream may be this far behind the newest signature seen [10 us]: older ones are replays."""
LAST_PORT = 65535
KEY_BYTES = 32
_HEAD = {0xFE: 8, 0xFD: 12}
_SIGNED, _SIGNATURE = 1, 13
READS_AT_ONCE = 500
"""Datagrams or pieces of a stream after which whoever receives gets to do other things, as heeding a signal."""
STALL = 0.25
"""A pause between two looks is so much time of listening [s] at most: in a longer one we slept, not the others."""
SENT_A_SECOND, SENT_AT_ONCE = 100.0, 300.0
"""Messages that are sent on average and in a burst; answers leave half of the burst to what we say by ourselves."""
_LONGEST = 12 + 255 + _SIGNATURE
_DATAGRAM = 65535
_RECEIVED = 1 << 22
"""Bytes that wait in the vehicle's socket while we are busy, as far as the system allows."""


class LinkError(QuadidError):
    """A link that cannot be opened, or a key that cannot be used."""


def frames(buffer: bytearray, whole: bool) -> Iterator[bytes]:
    """Takes complete frames off the front of `buffer`; what is no frame is skipped.

    Args:
        buffer: bytes received; frames and garbage before them are removed.
        whole: a datagram, which never holds half a frame: whatever is left of it is dropped.
    """
    while buffer:
        start = next((i for i, b in enumerate(buffer) if b in _HEAD), len(buffer))
        if start:
            del buffer[:start]
            continue
        length = _length(buffer)
        if length is None or length > len(buffer):
            if whole:
                del buffer[:1]
                continue
            return
        yield bytes(buffer[:length])
        del buffer[:length]


def _length(buffer: bytearray) -> int | None:
    if len(buffer) < 3:
        return None
    extra = _SIGNATURE if buffer[0] == 0xFD and buffer[2] & _SIGNED else 0
    return _HEAD[buffer[0]] + buffer[1] + extra


def message_id(frame: bytes) -> int:
    """Number of the message in a frame."""
    return frame[5] if frame[0] == 0xFE else frame[7] | frame[8] << 8 | frame[9] << 16


def sender(frame: bytes) -> tuple[int, int, int]:
    """Frame number, system and component of a frame."""
    place = 2 if frame[0] == 0xFE else 4
    return frame[place], frame[place + 1], frame[place + 2]


class SafeMavlink(_Coder):
    """pymavlink's coder with its signature check mended: nothing of a frame is believed before its signature.

    pymavlink notes a frame's timestamp first and checks the signature afterwards, so that one forged frame from the far
    future locks the true sender out.

    Attributes:
        behind: how far the newest stream refused for its age alone is behind [s]; 0 when the last one was believed.
    """

    behind = 0.0

    def check_signature(self, msgbuf: bytearray, srcSystem: int, srcComponent: int) -> bool:
        """Checks signature, then timestamp; notes the timestamp only of a frame that passed both."""
        digest = hashlib.sha256(bytes(self.signing.secret_key) + bytes(msgbuf[:-6])).digest()[:6]
        if not hmac.compare_digest(digest, bytes(msgbuf[-6:])):
            return False
        timestamp = int.from_bytes(msgbuf[-12:-6], "little")
        stream = (msgbuf[-13], srcSystem, srcComponent)
        last = self.signing.stream_timestamps.get(stream)
        if last is None and timestamp + MOST_BEHIND < self.signing.timestamp:
            self.behind = (self.signing.timestamp - timestamp) * 1e-5
            return False
        if last is not None and timestamp <= last:
            return False
        self.behind = 0.0
        self.signing.stream_timestamps[stream] = timestamp
        self.signing.timestamp = max(self.signing.timestamp, timestamp)
        return True


def read_key(path: Path) -> bytes:
    """Reads a signing key: 32 bytes, or 64 hexadecimal digits.

    Raises:
        LinkError: no such file, or no key in it; the link is then not opened at all.
    """
    try:
        data = read_regular(path)
    except OSError as error:
        raise LinkError(f"signing key {path} cannot be read ({error.strerror})", fix="check the path") from error
    text = data.strip()
    if len(text) == 2 * KEY_BYTES:
        try:
            return bytes.fromhex(text.decode("ascii"))
        except (ValueError, UnicodeDecodeError):
            pass
    if len(data) != KEY_BYTES:
        raise LinkError(f"{path} holds {len(data)} bytes", "a key of 32 bytes, or 64 hexadecimal digits")
    return data


def _check_port(device: str) -> None:
    """Raises LinkError for a port that none is, or that is taken.

    pymavlink lets two programs listen on one UDP port, and the second one takes the first one's frames away.
    """
    kind, _, place = device.partition(":")
    host, _, port = place.rpartition(":")
    if port.isdigit() and int(port) > LAST_PORT:
        raise LinkError(f"port {port} in {device}", f"1 to {LAST_PORT}", "for example udpin:0.0.0.0:14550")
    if kind not in ("udpin", "udp") or not port.isdigit():
        return
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((host, int(port)))
        except OverflowError as error:
            raise LinkError(f"UDP port {port}", "1 to 65535") from error
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise LinkError(
                    f"another program listens on UDP port {port}", "one service a port", "stop it, or use another port"
                ) from error


class Wire:
    """A link.

    Attributes:
        refused: frames with a wrong checksum, and with a key those without a good signature.
        dropped: bytes dropped unread because too many came.
        source: of the frame yielded last: UDP address, None on other links.
        signed: whether a signed frame came, believed or not.
        drained: whether nothing of the vehicle was left unread when messages were looked for last.
        listened: for how long somebody has listened to everything that came [s].
        held_back: when a message was last not sent because too much is asked for [s].
    """

    def __init__(
        self, url: str, system: int, component: int, key: bytes | None = None, memory: Path | None = None,
    ) -> None:  # fmt: skip
        """Opens the link.

        Args:
            url: any URL of pymavlink, as ``udpin:0.0.0.0:14540`` or ``/dev/ttyACM0,921600``.
            system: our system id.
            component: our component id.
            key: signing key; with one, every frame that is not signed with it is refused.
            memory: file that keeps the newest time stamps of signatures over a restart.

        Raises:
            LinkError: the link cannot be opened.
        """
        device, _, baud = url.partition(",")
        _check_port(device)
        try:
            options = {"baud": int(baud)} if baud else {}
            self._conn: Any = mavutil.mavlink_connection(device, autoreconnect=True, **options)
        except (OSError, ValueError, IndexError, OverflowError) as error:
            raise LinkError(
                f"cannot open {url} ({error})",
                "a pymavlink URL",
                "for example udpin:0.0.0.0:14540 or /dev/ttyACM0,921600",
            ) from error
        self._datagrams = isinstance(self._conn, mavutil.mavudp)
        self._serves = self._datagrams and bool(self._conn.udp_server)
        self.mav = SafeMavlink(None, srcSystem=system, srcComponent=component)
        self._memory: SigningMemory | None = None
        if key is not None:
            self.mav.signing.secret_key = key
            self.mav.signing.sign_outgoing = True
            self.mav.signing.timestamp = int((time.time() - SIGNING_EPOCH) * 100_000)
            self._memory = SigningMemory(memory, self.mav.signing) if memory is not None else None
        self._buffer = bytearray()
        self._own: socket.socket | None = None
        self._own_address: Any = None
        self._looked, self._filled, self._tokens = -math.inf, -math.inf, SENT_AT_ONCE
        self.listened = 0.0
        self.refused = self.dropped = 0
        self.held_back = -math.inf
        self.source: Any = None
        self.peers = Peers()
        self.signed = False
        self.drained = True

    @property
    def memory_problem(self) -> str:
        """Why time stamps of signatures are not kept over a restart, or empty."""
        return self._memory.problem if self._memory is not None else ""

    def receive(
        self, wanted: Container[int], admits: Callable[[bytes], bool], now: float,
        count: Callable[[bytes], None] | None = None,
    ) -> Iterator[Any]:  # fmt: skip
        """Yields the wanted messages that have arrived; never waits, and ends however fast more of them come.

        Args:
            wanted: message numbers; others are not even decoded.
            admits: whether a wanted frame is worth its decoding; what is not is dropped.
            now: any clock that runs on [s].
            count: gets every frame, whether wanted and believable or not.
        """
        pause, self._looked = now - self._looked, now
        ports = [self._own, None] if self._own is not None else [None]
        for port in ports:
            drained = False
            for _ in range(READS_AT_ONCE):
                data = self._read(port)
                if not data:
                    drained = True
                    break
                self._buffer = bytearray(data) if self._datagrams else self._buffer + data
                for frame in frames(self._buffer, self._datagrams):
                    if count is not None:
                        count(frame)
                    if message_id(frame) not in wanted:
                        continue
                    if not admits(frame):
                        self.dropped += len(frame)
                        continue
                    self.signed |= _is_signed(frame)
                    try:
                        message = self.mav.decode(bytearray(frame))
                    except dialect.MAVError:
                        self.refused += 1
                        continue
                    yield message
            if port is ports[0]:
                self.drained = drained
                self.listened += min(pause, STALL) * drained
        if self._memory is not None:
            self._memory.keep()

    def follow(self, address: Any) -> None:
        """Gives what comes from one address a buffer of its own, so that the others' floods leave it alone.

        A socket that is bound to the same port and connected gets what comes from there (Linux and BSD).
        """
        if address == self._own_address or not self._serves:
            return
        self._own_address = address
        if self._own is not None:
            self._own.close()
        self._own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._own.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVED)
            self._own.setblocking(False)
            self._own.bind(self._conn.port.getsockname())
            self._own.connect(address)
        except OSError:
            self._own.close()
            self._own = None

    def send(self, message: Any, now: float, answer: bool = False) -> None:
        """Sends a message, as far as the budget allows; a link that is down loses it.

        Args:
            message: to be sent.
            now: clock of `receive` [s].
            answer: to what the frame yielded last asked for: only its sender gets it, if it is a peer, else all do.
        """
        self._tokens = min(self._tokens + (now - self._filled) * SENT_A_SECOND, SENT_AT_ONCE)
        self._filled = now
        peers = self.peers.answered(self.listened) if self._datagrams else set()
        if answer and self._serves:
            peers &= {self.source}
            if not peers:
                return
        if self._tokens < (0.5 * SENT_AT_ONCE if answer else 1.0):
            self.held_back = now
            return
        self._tokens -= 1.0
        frame = message.pack(self.mav)
        self.mav.seq = (self.mav.seq + 1) % 256
        if self._datagrams:
            self._conn.clients = peers
        try:
            self._conn.write(frame)
        except OSError:
            self.dropped += len(frame)

    def close(self) -> None:
        """Closes the link."""
        if self._memory is not None:
            self._memory.keep(at_once=True)
        if self._own is not None:
            self._own.close()
        self._conn.close()

    def _read(self, port: socket.socket | None) -> bytes:
        """Bytes that have arrived, or none; notes where they came from."""
        try:
            if self._datagrams:
                data, self.source = (port or self._conn.port).recvfrom(_DATAGRAM)
                return bytes(data)
            return bytes(self._conn.recv(4096) or b"")
        except (OSError, TypeError):
            return b""


def _is_signed(frame: bytes) -> bool:
    return frame[0] == 0xFD and bool(frame[2] & _SIGNED)
