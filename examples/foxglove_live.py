"""Plays a flight, and what the online session made of it, into Foxglove as if it were live.

    pip install quadid[foxglove]
    quadid replay flight.mcap --vehicle pelican --out result.mcap
    python examples/foxglove_live.py flight.mcap result.mcap [--speed 1] [--port 8765]

In Foxglove: Open connection, ws://localhost:8765, then import docs/layouts/foxglove.json as a layout.  The server
listens on this machine only.
"""

import argparse
import heapq
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import foxglove
from mcap.reader import make_reader
from mcap.records import Channel, Message, Schema


def main() -> None:
    """Plays until the files end or Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+", metavar="F.mcap")
    parser.add_argument("--speed", type=float, default=1.0, help="times real time")
    parser.add_argument("--port", type=int, default=8765, help="0: any that is free")
    parser.add_argument("--wait", type=float, default=60.0, help="seconds to wait for a viewer before playing")
    options = parser.parse_args()
    server = foxglove.start_server(name="quadid", port=options.port)
    print(f"Serving ws://localhost:{server.port}", flush=True)
    channels: dict[str, foxglove.Channel] = {}
    with ExitStack() as open_files:
        streams = [make_reader(open_files.enter_context(file.open("rb")), validate_crcs=True) for file in options.files]
        for reader in streams:  # announced before the first message, so that panels find them
            for schema, channel in announced(reader.get_summary()):
                channels.setdefault(channel.topic, opened(schema, channel))
        wait_for_viewer(channels, options.wait)
        count = play([reader.iter_messages() for reader in streams], channels, options.speed)
    time.sleep(0.5)  # what is still on its way
    server.stop()
    print(f"{count} messages on {len(channels)} topics")


def announced(summary: object) -> Iterator[tuple[Schema, Channel]]:
    """Schemas and channels of a file."""
    for channel in getattr(summary, "channels", {}).values():
        yield summary.schemas[channel.schema_id], channel  # type: ignore[attr-defined]


def opened(schema: Schema, channel: Channel) -> foxglove.Channel:
    """The same topic, type and encoding towards Foxglove."""
    kind = foxglove.Schema(name=schema.name, encoding=schema.encoding, data=schema.data)
    return foxglove.Channel(channel.topic, schema=kind, message_encoding=channel.message_encoding)


def wait_for_viewer(channels: dict[str, foxglove.Channel], seconds: float) -> None:
    """Returns once somebody looks at any topic."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and not any(channel.has_sinks() for channel in channels.values()):
        time.sleep(0.05)


def play(
    streams: list[Iterator[tuple[Schema | None, Channel, Message]]], channels: dict[str, foxglove.Channel], speed: float
) -> int:
    """Sends all messages in the order of their stamps, paced; returns how many."""
    count, begin, first = 0, time.monotonic(), None
    for _, channel, message in heapq.merge(*streams, key=lambda item: item[2].log_time):
        first = message.log_time if first is None else first
        time.sleep(max(0.0, begin + (message.log_time - first) * 1e-9 / speed - time.monotonic()))
        channels[channel.topic].log(message.data, log_time=message.log_time)
        count += 1
    return count


if __name__ == "__main__":
    main()
