"""A signed MAVLink vehicle in a thread of its own, flying the same two minutes over and over; may be spoilt."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from quadid_node.mavlink_wire import SIGNING_EPOCH, dialect
from quadid_replay.writers import mavlink_messages

from quadid.data.window import Channel, Recording
from quadid.flight import Flight

GROUND = 5.0
"""Pause between two flights [s]."""


class Sender:
    """Something that speaks MAVLink over UDP to a port of this machine."""

    def __init__(self, port: int, key: bytes | None, system: int = 1) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(("127.0.0.1", port))
        self.socket.setblocking(False)
        self.mav: Any = dialect.MAVLink(None, srcSystem=system, srcComponent=1)
        if key is not None:
            self.mav.signing.secret_key = key
            self.mav.signing.sign_outgoing = True
            self.tell_time()

    def tell_time(self) -> None:
        """Signs with the time of day from now on, as an autopilot with GPS does; pymavlink only counts frames."""
        self.mav.signing.timestamp = max(self.mav.signing.timestamp, int((time.time() - SIGNING_EPOCH) * 100_000))

    def send(self, message: Any) -> bytes:
        """Sends a message; returns its frame."""
        frame = bytes(message.pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) % 256
        self.raw(frame)
        return frame

    def raw(self, data: bytes) -> None:
        """Sends bytes; nobody listening is no error."""
        try:
            self.socket.send(data)
        except OSError:
            return

    def heard(self) -> Iterator[Any]:
        """Messages that came back."""
        reader: Any = dialect.MAVLink(None)
        reader.robust_parsing = True
        while True:
            try:
                data = self.socket.recv(4096)
            except OSError:
                return
            yield from reader.parse_buffer(data) or []


class Vehicle(threading.Thread):
    """Flies until told to stop.

    Attributes:
        silent: sends nothing while set.
        spoil: changes a message before it is sent, or drops it (None).
        jump: added to the vehicle's own time from the next message on [s]: a reboot.
        told: parameter values that the service sent, newest last: (time, name, value).
        frames: newest frames, for who wants to replay them.
    """

    def __init__(self, port: int, key: bytes, flight: Flight) -> None:
        super().__init__(daemon=True)
        self._sender, self._flight = Sender(port, key), flight
        self._end = threading.Event()
        self.silent = False
        self.spoil: Callable[[Any], Any | None] | None = None
        self.jump = 0.0
        self.told: list[tuple[float, str, float]] = []
        self.frames: list[bytes] = []

    def run(self) -> None:
        """Flies."""
        shift = 10.0
        while not self._end.is_set():
            begin = time.monotonic()
            jumped = self.jump
            for t, message in mavlink_messages(_later(self._flight.recording, max(shift + jumped, 1.0))):
                due = begin + t - max(shift + jumped, 1.0)
                self._wait(due)
                if self._end.is_set() or self.jump != jumped:
                    break
                self._send(message)
                self._listen()
            shift += time.monotonic() - begin + GROUND
            self._wait(time.monotonic() + GROUND)

    def stop(self) -> None:
        """Lands for good."""
        self._end.set()
        self.join(10.0)

    def _send(self, message: Any) -> None:
        changed = self.spoil(message) if self.spoil is not None else message
        if changed is not None and not self.silent:
            self._sender.tell_time()
            self.frames = [*self.frames[-50:], self._sender.send(changed)]

    def _listen(self) -> None:
        for message in self._sender.heard():
            if message.get_type() == "PARAM_VALUE" and message.get_srcComponent() == 191:
                self.told.append((time.time(), str(message.param_id), float(message.param_value)))

    def _wait(self, due: float) -> None:
        left = due - time.monotonic()
        if left > 0.0:
            self._end.wait(left)


def _later(recording: Recording, shift: float) -> Recording:
    channels = {n: Channel(n, c.t + shift, c.values, n) for n, c in recording.channels.items()}
    return Recording(recording.name, recording.format, channels)
