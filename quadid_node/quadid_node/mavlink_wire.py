"""MAVLink wire: connection, peers, signatures and their memory."""

import errno
import hashlib
import hmac
import json
import math
import os
import socket
import time
from collections import deque
from collections.abc import Callable, Container, Hashable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega
from quadid_replay.mavlink_messages import extend_dialect, two_rows

from quadid.errors import QuadidError
from quadid.files import read_regular, written_whole

# --- Who speaks on a MAVLink link: one source for the vehicle, and the few peers that are answered


Address = Hashable
SILENT = 3.0
"""A source that is silent for so long [s] may be replaced by another: the vehicle came back from elsewhere.

Time counts only while we listened (`Wire.listened`): who sent during a stall of ours was not silent."""
JUDGED, ROWS = 40, 160
"""Checks whether frame numbers come in two rows is judged after so many frames, of the last so many."""
CALM = 2.0
"""Frame numbers must follow for so long [s] before a stream that two had mixed is believed again."""
REPEATS, REPEAT_SECONDS = 3, 10.0
"""A number that comes again with something else in it, so often within this time [s], comes from a second sender: one
that follows the first one's numbers, which then look like those of one."""
PAUSE = 0.1
"""After so long without a frame [s] numbers may have run on unheard: none is known then."""
HELLOS, HELLO_SECONDS = 2, 0.5
"""A peer is answered after so many believable heartbeats that span this time [s],"""
FORGOTTEN = 15.0
"""... until it is silent for so long [s],"""
MOST_PEERS = 8
"""... and never more of them at a time."""


class VehicleSender:
    """Holds that all frames of the vehicle come from one sender.

    Attributes:
        problem: what speaks against it now, or empty.
    """

    def __init__(self) -> None:
        self.problem = ""
        self._address: Address | None = None
        self._heard, self._mixed_until, self._refused_at = -1e9, -1e9, -1e9
        self._numbers: deque[int] = deque(maxlen=ROWS)
        self._frames = 0
        self._contents: dict[int, int] = {}
        self._newest, self._counted = 0, -1e9
        self._repeated: deque[float] = deque(maxlen=REPEATS)

    def may_be(self, address: Address | None, now: float) -> bool:
        """True if `take` would believe a frame from an address now [s], were it not for the frames' numbers."""
        return address == self._address or now - self._heard > SILENT

    def take(self, address: Address | None, now: float) -> bool:
        """True if a frame of the vehicle from an address (None on a serial link) may be believed now [s]."""
        if now - self._heard > SILENT:
            self._address = address
            self._numbers.clear()
        if address != self._address:
            self._refused_at = now
            self.problem = f"a second source {address} sends as our vehicle ({self._address}): its frames are refused"
            return False
        self._heard = now
        if now < self._mixed_until:
            self.problem = "two sources are mixed in one stream (by their frame numbers): nothing is believed"
            return False
        if now - self._refused_at > SILENT:
            self.problem = ""
        return True

    def count(self, address: Address | None, sequence: int, now: float, frame: bytes = b"") -> None:
        """Looks at the number of every frame: those of one sender follow each other, those of two alternate or repeat.

        Bits turn over on a serial line, so that there, without an address, repeated numbers are not looked at.
        """
        if address != self._address:
            return
        if address is not None and self._repeats(sequence, now, hash(frame)):
            self._mixed_until = now + REPEAT_SECONDS
        self._numbers.append(sequence)
        self._frames += 1
        if self._frames >= JUDGED:
            self._frames = 0
            if two_rows(np.array(self._numbers)):
                self._mixed_until = now + CALM

    def _repeats(self, sequence: int, now: float, content: int) -> bool:
        """Checks whether numbers used a moment ago have come with something else in them again and again."""
        if now - self._counted > PAUSE:
            self._contents.clear()
        self._counted = now
        behind = (self._newest - sequence) % 256
        if not self._contents or behind >= 128:
            for number in range(1, 257 - behind if self._contents else 1):
                self._contents.pop((self._newest + number) % 256, None)
            self._newest, self._contents[sequence] = sequence, content
            return False
        if self._contents.setdefault(sequence, content) == content:
            return False
        self._contents.clear()
        self._repeated.append(now)
        return len(self._repeated) == REPEATS and now - self._repeated[0] <= REPEAT_SECONDS


class Peers:
    """Addresses that are answered: the vehicle's, and those that have shown to be ground stations."""

    def __init__(self) -> None:
        self._hellos: dict[Address, list[float]] = {}
        self._vehicle: Address | None = None

    def hello(self, address: Address, now: float, vehicle: bool) -> None:
        """Notes a believable heartbeat."""
        if vehicle:
            self._vehicle = address
        known = self._hellos.get(address)
        if known is not None:
            self._hellos[address] = [known[0], now, known[2] + 1.0]
        elif vehicle or len(self._hellos) < 4 * MOST_PEERS:
            self._hellos[address] = [now, now, 1.0]

    def answered(self, now: float) -> set[Address]:
        """Who gets what we send."""
        self._hellos = {a: seen for a, seen in self._hellos.items() if now - seen[1] <= FORGOTTEN}
        steady = [a for a, (first, last, n) in self._hellos.items() if n >= HELLOS and last - first >= HELLO_SECONDS]
        return {*steady[:MOST_PEERS], *([self._vehicle] if self._vehicle in self._hellos else [])}


# --- MAVLink on the wire: frames out of bytes, signatures that fail closed, one transport for any pymavlink URL


dialect: Any = extend_dialect(ardupilotmega)
_Coder: Any = dialect.MAVLink
UNITS = 100_000
"""Units of a signature's timestamp in a second;"""
SIGNING_EPOCH = 1420070400
"""... they are counted from 2015-01-01 [s, UNIX]."""
SAVED_EVERY = 1.0
"""Timestamps are saved so often [s],"""
_MOST_STREAMS = 256
"""... those of so many streams."""
MOST_BEHIND = 60 * UNITS
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
"""Bytes that wait in a socket while we are busy, as far as the system allows."""


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
        length = 0  # of a frame; its head tells
        if len(buffer) > 2:
            signature = _SIGNATURE if buffer[0] == 0xFD and buffer[2] & _SIGNED else 0
            length = _HEAD[buffer[0]] + buffer[1] + signature
        if not 0 < length <= len(buffer):
            if whole:
                del buffer[:1]
                continue
            return
        yield bytes(buffer[:length])
        del buffer[:length]


def message_id(frame: bytes) -> int:
    """Number of the message in a frame."""
    return frame[5] if frame[0] == 0xFE else frame[7] | frame[8] << 8 | frame[9] << 16


def sender(frame: bytes) -> tuple[int, int, int]:
    """Frame number, system and component of a frame."""
    place = 2 if frame[0] == 0xFE else 4
    return frame[place], frame[place + 1], frame[place + 2]


def is_autopilot(frame: bytes) -> bool:
    """True if a frame is a heartbeat of an autopilot, without a look at its checksum."""
    place = 11 if frame[0] == 0xFE else 15
    return message_id(frame) == 0 and frame[place : place + 1] not in (b"", bytes([dialect.MAV_AUTOPILOT_INVALID]))


def memory_path(folder: Path, key: bytes) -> Path:
    """The file that remembers the streams signed with a key."""
    return folder / f"signing-{hashlib.sha256(key).hexdigest()[:16]}.json"


class SafeMavlink(_Coder):
    """pymavlink's coder with its signature check mended: nothing of a frame is believed before its signature.

    pymavlink notes a frame's timestamp first and checks the signature afterwards, so that one forged frame from the far
    future locks the true sender out.  The newest timestamps outlive a restart, as the MAVLink specification asks: what
    was sent before it is a replay.

    Attributes:
        behind: how far the newest stream refused for its age alone is behind [s]; 0 when the last one was believed.
        problem: why timestamps are not kept over a restart, or empty.
    """

    def __init__(self, system: int, component: int, key: bytes | None = None, memory: Path | None = None) -> None:
        """Speaks as a component of a system.

        Args:
            key: signs what is sent; what comes is refused where it is not signed with it.
            memory: file that keeps the newest timestamps.  What came after its last save is refused too, being at most
                `SAVED_EVERY` newer.
        """
        super().__init__(None, srcSystem=system, srcComponent=component)
        self.behind, self.problem = 0.0, ""
        self._memory, self._saved_at, self._saved = memory, -math.inf, dict[Any, int]()
        if key is not None:
            self.signing.secret_key, self.signing.sign_outgoing = key, True
            self.signing.timestamp = int((time.time() - SIGNING_EPOCH) * UNITS)
        if key is None or memory is None:
            return
        try:
            kept = json.loads(read_regular(memory))
            streams = {tuple(int(n) for n in name.split(".")): int(stamp) for name, stamp in kept["streams"].items()}
            newest = int(kept["newest"])
        except FileNotFoundError:
            return
        except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            self.problem = f"time stamps of signatures in {memory} cannot be read ({error}): only this clock guards now"
            return
        unsaved = round(SAVED_EVERY * UNITS)
        self.signing.stream_timestamps.update({stream: stamp + unsaved for stream, stamp in streams.items()})
        self.signing.timestamp = max(self.signing.timestamp, newest + unsaved)

    def keep(self, at_once: bool = False) -> None:
        """Saves timestamps that have changed, once a second."""
        now, streams, path = time.monotonic(), self.signing.stream_timestamps, self._memory
        if path is None or not (at_once or now - self._saved_at >= SAVED_EVERY) or streams == self._saved:
            return
        self._saved_at = now
        last = sorted(streams.items(), key=lambda entry: -entry[1])[:_MOST_STREAMS]
        kept = {"newest": last[0][1], "streams": {".".join(map(str, stream)): stamp for stream, stamp in last}}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with written_whole(path) as part, part.open("w", encoding="ascii") as file:
                json.dump(kept, file)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            self.problem = f"time stamps of signatures cannot be kept in {path} ({error.strerror})"
            return
        self._saved, self.problem = dict(streams), ""

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
        self, url: str, system: int, component: int, key: bytes | None = None, memory: Path | None = None
    ) -> None:
        """Opens the link.

        Args:
            url: any URL of pymavlink, as ``udpin:0.0.0.0:14540`` or ``/dev/ttyACM0,921600``.
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
        if self._serves:
            self._conn.port.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVED)
        self.mav = SafeMavlink(system, component, key, memory)
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

    def receive(
        self,
        wanted: Container[int],
        admits: Callable[[bytes], bool],
        now: float,
        count: Callable[[bytes], None] | None = None,
    ) -> Iterator[Any]:
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
                    self.signed |= frame[0] == 0xFD and bool(frame[2] & _SIGNED)
                    try:
                        message = self.mav.decode(bytearray(frame))
                    except dialect.MAVError:
                        self.refused += 1
                        continue
                    yield message
            if port is ports[0]:
                self.drained = drained
                self.listened += min(pause, STALL) * drained
        self.mav.keep()

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
        self.mav.keep(at_once=True)
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
