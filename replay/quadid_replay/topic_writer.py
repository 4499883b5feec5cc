"""Writes ROS 2 messages of any type to MCAP without ROS: profile ros2, schemas ros2msg, CDR, zstd chunks with CRC."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace, TracebackType
from typing import Any, BinaryIO

import yaml
from mcap.writer import CompressionType, Writer
from mcap_ros2._dynamic import serialize_dynamic

from quadid.errors import LogError
from quadid_replay.cdr_blocks import BlockWriter
from quadid_replay.schemas import has_definition, schema_text
from quadid_replay.writing import open_for_writing

CHUNK_BYTES = 1 << 20
"""Compresses well; a caller who must not be held up for ten milliseconds takes less."""

LATCHED = ("quadid/parameters", "quadid/diagnosis", "quadid/health")
"""Ends of topics that the node offers transient local, depth 1: `ros2 bag play` offers them likewise."""


def offered_qos(topic: str) -> str:
    """QoS of a topic's publisher in the form of rosbag2 since Jazzy, which plays with it."""
    latched = topic.endswith(LATCHED)
    forever = {"sec": 9223372036, "nsec": 854775807}
    return yaml.safe_dump([{
        "history": "keep_last", "depth": 1 if latched else 10, "reliability": "reliable",
        "durability": "transient_local" if latched else "volatile", "deadline": forever, "lifespan": forever,
        "liveliness": "automatic", "liveliness_lease_duration": forever, "avoid_ros_namespace_conventions": False,
    }], sort_keys=False)  # fmt: skip


class TopicWriter:
    """An MCAP file being written.  Use as a context manager; the file is complete only after `close`.

    Args:
        file: path, or a binary stream that stays open.
        metadata: records by name, for `quadid_replay.mcap_metadata`; they stand at the beginning.
        chunk_bytes: what is compressed and written at once, `CHUNK_BYTES` unless given; the caller waits for it.

    Raises:
        LogError: the file cannot be written.
    """

    def __init__(
        self, file: str | Path | BinaryIO, metadata: Mapping[str, Mapping[str, str]] | None = None,
        chunk_bytes: int | None = None,
    ) -> None:  # fmt: skip
        self._owned = open_for_writing(file) if isinstance(file, str | Path) else None
        self._writer = Writer(
            self._owned or file,  # type: ignore[arg-type]
            chunk_size=CHUNK_BYTES if chunk_bytes is None else chunk_bytes,
            compression=CompressionType.ZSTD,
            enable_crcs=True,
        )
        self._writer.start(profile="ros2", library="quadid")
        for name, data in (metadata or {}).items():
            self._writer.add_metadata(name, dict(data))
        self._definitions: dict[str, str] = {}
        self._encoders: dict[str, Callable[[Any], bytes]] = {}
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sequence: dict[int, int] = {}
        self._open = True
        self._flushed = 0

    def write(self, topic: str, kind: str, message: Any, stamp_ns: int) -> None:
        """Writes one message.

        Args:
            topic: name, such as ``quadid/parameters``.
            kind: ``package/msg/Type``, one of `quadid_replay.schemas`.
            message: object or dict with the message's fields, nested likewise; absent fields take their defaults.
            stamp_ns: log and publish time [ns].

        Raises:
            LogError: no definition of this type, or a message that does not fit it.
        """
        try:
            data = self.encoder(kind)(_namespace(message))
        except (ValueError, TypeError, AttributeError, LookupError) as error:
            raise LogError(
                f"message for {topic} does not fit {kind}: {error}", "the fields of its definition"
            ) from error
        self.write_cdr(topic, kind, data, stamp_ns)

    def write_cdr(self, topic: str, kind: str, data: bytes, stamp_ns: int) -> None:
        """Writes one message that is CDR already."""
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._writer.register_channel(
                topic, "cdr", self._schema(kind), {"offered_qos_profiles": offered_qos(topic)}
            )
            self._channels[topic] = channel
        sequence = self._sequence.get(channel, 0)
        self._sequence[channel] = sequence + 1
        self._writer.add_message(channel, stamp_ns, data, stamp_ns, sequence)
        if self._owned is not None and self._owned.tell() != self._flushed:
            # A chunk was written: its end must not wait in a buffer, or a killed process would lose two chunks.
            self._owned.flush()
            self._flushed = self._owned.tell()

    def define(self, kind: str, text: str) -> None:
        """Gives the definition of a type that `quadid_replay.schemas` does not hold (form ros2msg)."""
        self._definitions[kind] = text

    def encoder(self, kind: str) -> Callable[[Any], bytes]:
        """Returns the function that makes CDR of a message of this type."""
        if kind not in self._encoders:
            self._encoders[kind] = serialize_dynamic(kind, _definition(kind))[kind]
        return self._encoders[kind]

    def blocks(self, kind: str, build: Callable[[list[list[float]]], Any], sizes: Sequence[int]) -> BlockWriter:
        """Returns a fast writer for messages that differ in stamp and runs of doubles only; see `cdr_blocks`."""
        return BlockWriter(self.encoder(kind), build, sizes)

    def close(self) -> None:
        """Writes index and footer; the file is readable without `close` too, but as a damaged one."""
        if self._open:
            self._open = False
            self._writer.finish()  # type: ignore[no-untyped-call]
            if self._owned is not None:
                self._owned.close()

    def _schema(self, kind: str) -> int:
        if kind not in self._schemas:
            text = self._definitions.get(kind) or _definition(kind)
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", text.encode())
        return self._schemas[kind]

    def __enter__(self) -> TopicWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _namespace(message: Any) -> Any:
    """Turns dicts into objects, throughout: the library takes an absent key ``values`` for the dict's own method."""
    if isinstance(message, Mapping):
        return SimpleNamespace(**{str(name): _namespace(value) for name, value in message.items()})
    if isinstance(message, list | tuple):
        return [_namespace(value) for value in message]
    return message


def _definition(kind: str) -> str:
    if not has_definition(kind):
        raise LogError(
            f"no definition of message type {kind}", "the types in quadid_replay/schemas", "add its .msg there"
        )
    return schema_text(kind)
