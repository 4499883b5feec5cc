"""Inputs of the node: topics and types of the stacks, decoded messages, one source a channel."""

import importlib
import math
import re
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from quadid_replay.motors import no_multirotor
from quadid_replay.ros_messages import SIGNALS, TOPICS, TYPES, MessageReader, sources

from quadid.data.window import Block
from quadid.errors import QuadidError, nearest
from quadid.sanitise import plain
from quadid.types import FloatArray, IntArray

# --- Stamps: absolute times of messages, in nanoseconds there and in seconds [s, UNIX] here, to a quarter microsecond


def seconds(ns: IntArray) -> FloatArray:
    """Seconds of stamps in nanoseconds, shape (n,)."""
    return np.asarray(ns * 1e-9)


def nanoseconds(t: float) -> int:
    """Nanoseconds of a time [s], to the microsecond; 0 for none."""
    return max(round(t * 1e6) * 1000, 0) if math.isfinite(t) else 0


def stamp(t: float) -> dict[str, int]:
    """builtin_interfaces/Time of a time [s]; zero for none."""
    ns = nanoseconds(t)
    return {"sec": ns // 10**9, "nanosec": ns % 10**9}


# --- Of several topics with one channel, the best that arrives is used, from the first sample on


DECIDE = 1.0
"""Time of the data [s] in which a better source may still show up before a worse one is used."""
SILENT = 3.0
"""A chosen source that is silent for this long [s] gives way to the next."""
MOST_HELD = 5000
_ROTORS = ("motor_command", "rotor_speed")


class SourceSelector:
    """Picks one source for each channel.

    Samples of a source that is not the best possible are held back until it is certain that no better one comes, so
    that a channel never mixes two sources.  How samples are cut into blocks changes nothing.

    Attributes:
        other: why the vehicle's outputs are no rotors; empty where they are.  Of them nothing is used.
    """

    def __init__(self, best: dict[str, int]) -> None:
        """Knows the best (lowest) rank that each channel could have."""
        self._best, self.other = best, ""
        self._chosen: dict[str, int] = {}
        self._last: dict[str, float] = {}
        self._held: dict[str, dict[int, list[Block]]] = {}

    def take(self, block: Block, rank: int) -> Iterator[Block]:
        """Yields what may be used now.

        Args:
            rank: of its source for this channel; 0 is the best.
        """
        channel, t = block.columns[0][0], block.t
        if self.other and channel in _ROTORS:
            return
        # A worse source than the chosen one is of use once that has fallen silent.
        chosen = self._chosen.get(channel)
        if chosen is not None and rank > chosen:
            late = np.flatnonzero(t > self._last[channel] + SILENT)
            if not late.size:
                return
            block, chosen = block.part(late[0]), None
            t = block.t
        # The chosen source, and the best that there could be, pass at once.
        if chosen is not None or rank == self._best.get(channel, 0):
            self._held.pop(channel, None)
            self._chosen[channel], self._last[channel] = rank, float(t[-1])
            yield block
            return
        # Held back, until a better one had time to show up, or too many wait.
        by_rank = self._held.setdefault(channel, {})
        held = by_rank.setdefault(rank, [])
        first = min(float(blocks[0].t[0]) if blocks else float(t[0]) for blocks in by_rank.values())
        count = sum(len(one.t) for one in held) + np.arange(1, len(t) + 1)
        enough = np.flatnonzero((t - first >= DECIDE) | (count >= MOST_HELD))
        stop = int(enough[0]) + 1 if enough.size else len(t)
        held.append(block.part(0, stop))
        if not enough.size:
            return
        best = min(by_rank)
        released = self._held.pop(channel)[best]
        self._chosen[channel], self._last[channel] = best, float(released[-1].t[-1])
        yield from released
        if stop < len(t):
            yield from self.take(block.part(stop), rank)

    def has(self, channel: str) -> bool:
        """Checks whether a source has the channel."""
        return channel in self._chosen or channel in self._held


# --- Whether the messages of a topic come evenly: by when they are there, and by their stamps


QUIET = 0.25
"""Messages that come together after more than this [s] without any are a burst: half of what rows wait for."""
TOGETHER = 5
"""... of so many at least."""
AGAIN, MEMORY = 3, 10.0
"""So many bursts within this [s] are no accident.  What was wrong with a message is reported for as long."""
STAMPS = 100
"""Newest stamps that are compared."""
GAP = 1.0
"""A step between stamps of more than this [s] is a pause."""
CLOSE, CROWDED = 0.2, 0.4
"""Stamps closer than this share of the mean step, and the share of them that even a random stream does not have."""


class ArrivalMonitor:
    """The pace of one topic.

    Attributes:
        looked: when somebody looked for its messages last [s].
    """

    def __init__(self) -> None:
        self.looked, self._quiet = 0.0, 0.0
        self._bursts: deque[tuple[float, int, float]] = deque(maxlen=AGAIN)
        self._stamps: deque[float] = deque(maxlen=STAMPS)

    def look(self, now: float, since: float, count: int) -> None:
        """Somebody looked for messages."""
        self.looked = now
        if not count:
            self._quiet += now - since
            return
        if self._quiet > QUIET and count >= TOGETHER:
            self._bursts.append((now, count, self._quiet))
        self._quiet = 0.0

    def stamped(self, t: FloatArray) -> None:
        """Takes the stamps of messages [s], shape (n,)."""
        self._stamps.extend(t[-STAMPS:].tolist())

    @property
    def trouble(self) -> str:
        """Description of how they bunch; empty where they do not."""
        if len(self._bursts) == AGAIN and self._bursts[0][0] > self.looked - MEMORY:
            _, count, quiet = self._bursts[-1]
            return f"comes in bursts: {count} messages at once after {quiet:.1f} s without one: send each when measured"
        steps = np.diff(np.sort(np.array(self._stamps)))
        steps = steps[steps < GAP]
        if len(steps) < STAMPS // 2:
            return ""
        close = int(np.count_nonzero(steps < CLOSE * steps.mean()))
        if close < CROWDED * len(steps):
            return ""
        return f"stamped in bursts: {close} of {len(steps)} follow at once on the one before: stamp when measured"


# --- Topics and types that the stacks really publish, for live subscription; what a stack lacks, and the way out


@dataclass(frozen=True)
class Input:
    """One topic to subscribe to.

    Attributes:
        channels: the core's channels it may feed, each with its rank: the lowest that arrives is used.
    """

    topic: str
    type: str
    channels: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class InputPreset:
    """A preset: its inputs, and what its users should know when there is no motor signal."""

    inputs: tuple[Input, ...]
    motor_hint: str


_PREFIX = {"mavros": "mavros/"}
_HINTS = {
    "canonical": "publish rotor_speeds (sensor_msgs/JointState, rad/s) or motor_command (quadid_msgs/MotorCommand)",
    "mavros": "mavros/rc/out carries the motor outputs: ask the autopilot for SERVO_OUTPUT_RAW at 80 Hz "
    "(ros2 service call /mavros/set_message_interval, id 36), or for ESC telemetry",
    "px4": "the default bridge exports no motor signal: add actuator_motors (or esc_status) to the publications in "
    "dds_topics.yaml of the PX4 firmware and rebuild, or use quadid serve on MAVLink",
    "ardupilot": "ArduPilot's DDS bridge has no motor topic: use quadid serve on MAVLink beside it, or MAVROS",
    "rotors": "publish motor_speed (actuator_msgs/Actuators, rad/s)",
}


def source(name: str) -> InputPreset:
    """The preset of that name.

    Raises:
        QuadidError: unknown preset, with the nearest one.
    """
    if name not in TOPICS:
        raise QuadidError(f"unknown source '{name}'", ", ".join(TOPICS), nearest(name, TOPICS))
    inputs = []
    for topic, (kind, channels) in TOPICS[name].items():
        if not kind:
            continue
        ranks = [(channel, sources(name, channel).index(topic)) for channel in channels.split()]
        for version in ("", "_v1") if name == "px4" else ("",):  # newer PX4 appends the version of its messages
            inputs.append(Input(_PREFIX.get(name, "") + topic + version, kind, tuple(ranks)))
    return InputPreset(tuple(inputs), _HINTS[name])


# --- Between ROS messages and the core: the only file with message types
#
# In: the same decoders as for MCAP logs (`quadid_replay.ros_messages`) read the serialized bytes, so that a live
# stream and its recording give the same numbers bit for bit.  Out: dictionaries of `messages` become messages.


_BEHIND = {"pose_attitude": 5}
"""The attitude of a pose stands behind a topic of its own, as when reading logs."""


class MessageTypeError(QuadidError):
    """A message type whose package is not installed."""


def message_class(name: str, folder: str = "msg") -> Any:
    """The class of ``package/Type`` or ``package/msg/Type``.

    Raises:
        MessageTypeError: the package is not installed, or has no such type.
    """
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


def service_class(name: str) -> Any:
    """The class of the service ``package/Type``; raises MessageTypeError."""
    return message_class(name, "srv")


def deserializer(name: str) -> Callable[[bytes], Any]:
    """ROS' own decoder of ``package/Type``; raises MessageTypeError."""
    from rclpy.serialization import deserialize_message, serialize_message

    cls = message_class(name)
    deserialize_message(serialize_message(cls()), cls)  # loads its type support now, not when the first one arrives
    return lambda data: deserialize_message(data, cls)


class Decoder:
    """Turns the serialized messages of one topic into blocks.

    Attributes:
        failed: messages that could not be decoded; unstamped: those whose stamp is zero; of all that came.
    """

    def __init__(
        self, entry: Input, chooser: SourceSelector, rotors: int, decode: Callable[[bytes], Any], mounted: bool = True
    ) -> None:
        """Prepares for one input.

        Args:
            rotors: number of rotors; surplus motor outputs are left out.
            mounted: the vehicle file has how the IMU stands in the body.
        """
        kind = TYPES[entry.type]
        self._frame, self._mounted = "", mounted
        self._kind = kind
        self._ranks = dict(entry.channels)
        self._chooser, self._rotors = chooser, rotors
        self.failed = self.unstamped = 0
        self._failed_at = self._unstamped_at = -math.inf
        self.pace = ArrivalMonitor()
        self._deniable, self._denied = _DENIABLE.get(entry.type, {}), list[str]()

        def noted(data: bytes) -> Any:
            """Decodes a message of another layout, as is one of another frame."""
            message = decode(data)
            self._frame = message.header.frame_id if kind.stamp is None else ""
            return message

        self._reader = MessageReader(kind, noted)

    @property
    def trouble(self) -> str:
        """Problem of messages of this topic, or empty."""
        if self._chooser.other and "vehicle_kind" in self._ranks:
            return self._chooser.other
        lately = self.pace.looked - MEMORY
        if self._unstamped_at >= lately:
            return f"{self.unstamped} messages have no time (header.stamp is zero) and are left out: stamp them"
        if self._failed_at >= lately:
            return f"{self.failed} messages could not be read"
        for name in self._denied:
            channel = SIGNALS[name][0]
            if channel in self._ranks and not self._chooser.has(channel):
                field = self._deniable[name]
                return f"declares no {field} ({field}_covariance[0] is -1; 0 if unknown), and no other topic has any"
        if "gyro" in self._ranks and not self._mounted and not _BODY_FRAME.search(self._frame):
            frame = plain(self._frame, 40)
            return f"is measured in {frame}, not base_link: say mounting: {{rotation, position}} in the vehicle file"
        return self.pace.trouble

    def take(self, messages: Sequence[bytes]) -> Iterator[Block]:
        """Yields what may be used now of messages in order, at once where only numbers differ between them."""
        # Messages that are not all alike are read in halves, down to single ones.
        read = self._read(messages)
        if read is None:
            for part in (messages[: len(messages) // 2], messages[len(messages) // 2 :]) if len(messages) > 1 else ():
                yield from self.take(part)
            return
        t, together = seconds(read[0]), list[tuple[str, FloatArray]]()
        self.pace.stamped(t)
        # Notes which signals the newest messages say to have none of.
        told = (name for name, _ in read[1])
        self._denied = sorted(self._deniable.keys() - set(told)) if self._deniable else []
        # Each signal in the core's units and frames, where this topic is its channel's source.
        for name, values in read[1]:
            channel, convert = SIGNALS[name]
            if channel == "vehicle_kind":
                self._chooser.other = no_multirotor({}, int(values[-1, 0]))
            if channel not in self._ranks or channel == "vehicle_kind":
                continue
            width = self._rotors if channel in _ROTORS else None
            block = Block(t, ((channel, convert(values)[:, :width]),))
            for used in self._chooser.take(block, self._ranks[channel] + _BEHIND.get(name, 0)):
                if used is block:
                    together += block.columns
                else:
                    yield used
        if together:
            yield Block(t, tuple(together))

    def _read(self, messages: Sequence[bytes]) -> tuple[IntArray, list[tuple[str, FloatArray]]] | None:
        """Stamps [ns] and signals of messages; None where they must be looked at in smaller parts.

        A single message that cannot be used is counted.
        """
        try:
            read = self._reader.read(messages)
            told = [] if read is None else self._kind.signals(read.blocks, read.extra)
        except Exception:  # noqa: BLE001 - a decoder of untrusted bytes raises anything; it is counted and reported
            self.failed, self._failed_at = self.failed + 1, self.pace.looked
            return None
        if read is None or any(np.any(known) and not np.all(known) for _, _, known in told):
            return None
        if (read.ns <= 0).any():
            if len(messages) == 1:
                self.unstamped, self._unstamped_at = self.unstamped + 1, self.pace.looked
            return None
        return read.ns, [(name, values) for name, values, known in told if np.all(known)]


_BODY_FRAME = re.compile(r"^$|(^|/)(base_|body|fcu)[^/]*$")
"""Names of frames that are the body's, or say nothing."""
_DENIABLE = {
    "sensor_msgs/Imu": {"body_rate": "angular_velocity", "body_force": "linear_acceleration", "attitude": "orientation"}
}
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
            cls = message_class(kinds[name].removeprefix("sequence<").split("[")[0].rstrip(">"))
            setattr(message, name, [_filled(cls(), item) for item in value])
        else:
            setattr(message, name, value)
    return message


# --- Messages are taken from the middleware many at a time, topic by topic, whenever the service looks for them
#
# Nobody is woken for a message: each carries its own time, and the rows of the grid wait half a second for the slowest
# channel anyway.  Many of a kind are read for little more than one.


Record = Callable[[str, str, bytes], None]

SLICE = 0.2
"""When longer than this [s] nobody looked, the messages of that time are taken in by slices of this length, so that no
topic runs far ahead of the others, which would then come too late."""
DEPTH = 4000
"""Messages of a topic that are kept for the next look, and the most that one look takes."""


class Topic(NamedTuple):
    """A topic of an `Intake`, by the name that it is resolved to."""

    name: str
    entry: Input
    decoder: Decoder
    take: Callable[[], bytes | None]


class Intake:
    """The messages of all topics of one vehicle."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Takes a clock that never steps [s]."""
        self._topics: list[Topic] = []
        self._clock, self._looked = clock, clock()

    def open(self, entry: Input, topic: str, decoder: Decoder, take: Callable[[], bytes | None]) -> None:
        """Adds a topic.

        Args:
            take: gives the next serialized message that waits; None when there is none.
        """
        self._topics.append(Topic(topic, entry, decoder, take))
        # The gyro sets the pace of the grid: what came with it has been taken in before it.
        self._topics.sort(key=lambda item: any(channel == "gyro" for channel, _ in item.entry.channels))

    def take(self) -> list[tuple[Topic, list[bytes]]]:
        """Takes all messages that wait, in the order in which to read them: slice of time by slice, topic by topic."""
        before, self._looked = self._looked, self._clock()
        slices = max(1, math.ceil((self._looked - before) / SLICE))
        pieces: list[list[tuple[Topic, list[bytes]]]] = [[] for _ in range(slices)]
        for topic in self._topics:
            taken = list(islice(iter(topic.take, None), DEPTH))
            topic.decoder.pace.look(self._looked, before, len(taken))
            for k, slice_ in enumerate(pieces):
                slice_.append((topic, taken[k * len(taken) // slices : (k + 1) * len(taken) // slices]))
        return [(topic, messages) for slice_ in pieces for topic, messages in slice_ if messages]

    def read(self, taken: Iterable[tuple[Topic, list[bytes]]], record: Record | None = None) -> Iterator[Block]:
        """Reads what was taken; what is not read is forgotten.

        Args:
            record: writes a message down (topic, type, bytes), in the order in which they are read.
        """
        for topic, messages in taken:
            if record is not None:
                for data in messages:
                    record(topic.entry.topic, topic.entry.type.replace("/", "/msg/"), data)
            yield from topic.decoder.take(messages)

    def troubles(self) -> dict[str, str]:
        """Problems of the messages of topics, by topic name as resolved."""
        return {topic.name: why for topic in self._topics if (why := topic.decoder.trouble)}

    def clear(self) -> None:
        """Forgets the topics."""
        self._topics.clear()
