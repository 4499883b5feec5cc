"""Writes recordings of one flight side by side, such as measured and simulated, for viewers that draw curves."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from quadid.errors import LogError
from quadid.window import Recording
from quadid_replay.csv_reader import EULER
from quadid_replay.csv_writer import column_names, write_table
from quadid_replay.frames import to_euler
from quadid_replay.mcap_writer import write_recordings
from quadid_replay.topic_writer import TopicWriter
from quadid_replay.writing import union_rows


def write_compared(path: str | Path, recordings: Mapping[str, Recording], epoch_ns: int = 0) -> None:
    """Writes recordings under their names: topics ``simulated/imu`` in MCAP, columns ``simulated/p`` in CSV.

    Args:
        path: ends in .mcap (ENU, FLU) or .csv (NED, FRD).
        recordings: by name.
        epoch_ns: added to recording time in MCAP, so that stamps count from the UNIX epoch [ns].

    Raises:
        LogError: another suffix, nothing to write, or a file that cannot be written.
    """
    kind = Path(path).suffix.lower()
    if kind == ".mcap":
        with TopicWriter(path) as writer:
            write_recordings(writer, recordings, epoch_ns)
        return
    if kind != ".csv":
        raise LogError(f"cannot tell the format of '{path}'", ".mcap, .csv")
    channels = [(name, layout) for name, r in recordings.items() for layout in column_names(r).items()]
    t, columns = union_rows([recordings[name].channels[channel] for name, (channel, _) in channels])
    header, table = ["t"], [t[:, None]]
    for (name, (channel, names)), values in zip(channels, columns, strict=True):
        assert values is not None
        # Angles show more in a picture than a quaternion does.
        header += [f"{name}/{column}" for column in (EULER if channel == "attitude" else names)]
        table.append(to_euler(values) if channel == "attitude" else values)
    write_table(path, header, np.concatenate(table, axis=1))
