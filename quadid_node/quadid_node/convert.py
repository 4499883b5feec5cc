"""Between ROS messages and the core: the only file that knows message types.

In: the same decoders as for MCAP logs (`quadid_replay.mcap_messages`) read the serialized bytes, so that a live stream
and its recording give the same numbers bit for bit.  Out: dictionaries of `messages` become messages.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from quadid_replay.cdr_blocks import BlockReader, Read
from quadid_replay.mcap_messages import SIGNALS, TYPES
from quadid_replay.signal_columns import SignalColumns

from quadid.errors import QuadidError
from quadid.window import Block, Sample
from quadid_node.chooser import Chooser
from quadid_node.pace import MEMORY, Pace
from quadid_node.presets import Input
from quadid_node.stamps import many_seconds, seconds

FEWEST = 2
"""Fewer messages than these are quicker read one by one."""
_BEHIND = {"pose_attitude": 5}
"""The attitude of a pose stands behind a topic of its own, as when reading logs."""


class MessageTypeError(QuadidError):
    """A message type whose package is not installed."""


def message_class(name: str) -> Any:
    """The class of ``package/Type`` or ``package/msg/Type``.

    Raises:
        MessageTypeError: the package is not installed, or has no such type.
    """
    return _interface(name, "msg")


def service_class(name: str) -> Any:
    """The class of the service ``package/Type``; raises MessageTypeError."""
    return _interface(name, "srv")


def _interface(name: str, folder: str) -> Any:
    package, kind = name.split("/")[0], name.split("/")[-1]
    apt = f"ros-jazzy-{package.replace('_', '-')}"
    try:
        return getattr(importlib.import_module(f"{package}.{folder}"), kind)
    except ModuleNotFoundError as error:
        fix = "colcon build the msgs folder, or run 'make messages'" if package == "quadid_msgs" else f"install {apt}"
        raise MessageTypeError(f"message type {name}: package {package} is not installed", fix=fix) from error
    except (ImportError, AttributeError) as error:
        fix = f"install the version for this ROS distribution ({apt})"
        raise MessageTypeError(f"message type {name} cannot be used ({error})", fix=fix) from error


def deserializer(name: str) -> Callable[[bytes], Any]:
    """ROS' own decoder of ``package/Type``; raises MessageTypeError."""
    from rclpy.serialization import deserialize_message, serialize_message

    cls = message_class(name)
    deserialize_message(serialize_message(cls()), cls)  # loads its type support now, not when the first one arrives
    return lambda data: deserialize_message(data, cls)


class Decoder:
    """Turns the serialized messages of one topic into samples.

    Attributes:
        failed: messages that could not be decoded; unstamped: those whose stamp is zero; of all that came.
        pace: how evenly they come.
    """

    def __init__(
        self, entry: Input, chooser: Chooser, rotors: int, decode: Callable[[bytes], Any]
    ) -> None:  # fmt: skip
        """Prepares for one input.

        Args:
            entry: topic, type, channels with ranks.
            chooser: shared by all topics.
            rotors: number of rotors; surplus motor outputs are left out.
            decode: serialized bytes to a message of the type; see `deserializer`.
        """
        kind = TYPES[entry.type]
        self._kind, self._columns = kind, SignalColumns(kind)
        self._ranks = dict(entry.channels)
        self._chooser, self._rotors = chooser, rotors
        self.failed = self.unstamped = 0
        self._failed_at = self._unstamped_at = -math.inf
        self.pace = Pace()
        self._deniable, self._denied = _DENIABLE.get(entry.type, {}), list[str]()

        self._layout: BlockReader | None = None
        if kind.stamp is None:
            self._layout = BlockReader(decode, kind.blocks, kind.extra)
            self._read = self._layout.read
        else:
            stamp = kind.stamp

            def read(data: bytes) -> Read:
                message = decode(data)
                return Read(*stamp(message), kind.blocks(message), kind.extra(message))

            self._read = read

    @property
    def trouble(self) -> str:
        """What is wrong with messages of this topic, or empty."""
        lately = self.pace.looked - MEMORY
        if self._unstamped_at >= lately:
            return f"{self.unstamped} messages have no time (header.stamp is zero) and are left out: stamp them"
        if self._failed_at >= lately:
            return f"{self.failed} messages could not be read"
        for name in self._denied:
            channel = SIGNALS[name][0]
            if channel in self._ranks and not self._chooser.has(channel):
                field = self._deniable[name]
                return f"says that it has no {field} ({field}_covariance[0] is -1; 0 if unknown); nothing else tells it"
        return self.pace.trouble

    def take(self, messages: Sequence[bytes]) -> Iterator[Sample | Block]:
        """Yields what may be used now of messages in order, at once where only numbers differ between them."""
        block = self._block(messages) if len(messages) >= FEWEST else None
        if block is None:
            for data in messages:
                yield from self.samples(data)
        elif block.columns:
            yield block

    def _block(self, messages: Sequence[bytes]) -> Block | None:
        """The messages as one block, the numbers of `samples` to the bit; None where each must be looked at."""
        read = self._layout.read_many(messages) if self._layout is not None else None
        told = self._columns.pick(read.blocks, read.extra) if read is not None else None
        if read is None or told is None:
            return None
        ns = read.seconds * 10**9 + read.nanoseconds
        if not (ns > 0).all():
            return None
        t = many_seconds(ns)
        self.pace.stamped(t)
        self._deny(name for name, _ in told)
        columns = []
        for name, values in told:
            channel, convert = SIGNALS[name]
            rank = self._ranks.get(channel)
            if rank is None:
                continue
            used = self._chooser.settled(channel, rank + _BEHIND.get(name, 0), float(t.max()))
            if used is None:
                return None
            if used:
                width = self._rotors if channel in ("motor_command", "rotor_speed") else None
                columns.append((channel, convert(values)[:, :width]))
        for channel, _ in columns:
            self._chooser.used(channel, float(t[-1]))
        return Block(t, tuple(columns))

    def samples(self, data: bytes) -> Iterator[Sample]:
        """Yields the samples of one message that may be used now."""
        try:
            message = self._read(data)
            signals = self._kind.signals(message.blocks, message.extra)
        except Exception:  # noqa: BLE001 - a decoder of untrusted bytes raises anything; it is counted and reported
            self.failed, self._failed_at = self.failed + 1, self.pace.looked
            return
        ns = message.seconds * 10**9 + message.nanoseconds
        if ns <= 0:
            self.unstamped, self._unstamped_at = self.unstamped + 1, self.pace.looked
            return
        t = seconds(ns)
        self.pace.stamped(np.array([t]))
        self._deny(name for name, _ in signals)
        for name, values in signals:
            channel, convert = SIGNALS[name]
            rank = self._ranks.get(channel)
            if rank is None:
                continue
            plain = tuple(convert(np.array([values]))[0].tolist())
            if channel in ("motor_command", "rotor_speed"):
                plain = plain[: self._rotors]
            yield from self._chooser.take(Sample(t, channel, plain), rank + _BEHIND.get(name, 0))

    def _deny(self, told: Iterable[str]) -> None:
        """Notes which signals the newest messages say to have none of."""
        self._denied = sorted(self._deniable.keys() - set(told)) if self._deniable else []


_DENIABLE = {
    "sensor_msgs/Imu": {
        "body_rate": "angular_velocity", "body_force": "linear_acceleration", "attitude": "orientation",
    }
}  # fmt: skip
"""Signals that a message may say to have none of, by a covariance of -1 (REP-145), and its field."""


def best_ranks(inputs: tuple[Input, ...]) -> dict[str, int]:
    """The best rank that each channel can have."""
    out: dict[str, int] = {}
    for entry in inputs:
        for channel, rank in entry.channels:
            out[channel] = min(rank, out.get(channel, rank))
    return out


def to_message(name: str, fields: Mapping[str, Any]) -> Any:
    """A message of type `name` with these fields; absent fields keep their defaults."""
    return _filled(message_class(name)(), fields)


def _filled(message: Any, fields: Mapping[str, Any]) -> Any:
    kinds: dict[str, str] = message.get_fields_and_field_types()
    for name, value in fields.items():
        if isinstance(value, Mapping):
            _filled(getattr(message, name), value)
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            cls = message_class(kinds[name].removeprefix("sequence<").rstrip(">"))
            setattr(message, name, [_filled(cls(), item) for item in value])
        else:
            setattr(message, name, value)
    return message
