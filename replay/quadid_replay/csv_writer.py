"""Writes a recording as CSV of the contract; every number is written so that it reads back to the same bits."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from quadid.errors import LogError
from quadid.types import FloatArray
from quadid.window import Recording
from quadid_replay.csv_reader import GROUPS
from quadid_replay.writing import Source, open_for_writing, recording_of, union_rows

_ROWS = 4096


def write_csv(file: str | Path | BinaryIO, source: Source) -> None:
    """Writes a recording or windows to CSV: one row a time, cells empty where a channel has no sample.

    Args:
        file: path or binary stream.
        source: what to write.

    Raises:
        LogError: nothing to write, or a file that cannot be written.
    """
    recording = recording_of(source)
    if not recording.channels:
        raise LogError(f"{recording.name}: no channel to write", "at least one")
    layout = column_names(recording)
    t, columns = union_rows([recording.channels[name] for name in layout])
    table = np.column_stack([t, *(c for c in columns if c is not None)])
    write_table(file, ["t", *(column for names in layout.values() for column in names)], table)


def column_names(recording: Recording) -> dict[str, tuple[str, ...]]:
    """Names of the columns of every channel that a recording has."""
    layout = {name: GROUPS[name] for name in GROUPS if name in recording.channels}
    for name, letter in (("rotor_speed", "w"), ("motor_command", "u")):
        if name in recording.channels:
            width = recording.channels[name].values.shape[1]
            layout[name] = tuple(f"{letter}{i + 1}" for i in range(width))
    return layout


def write_table(file: str | Path | BinaryIO, header: Sequence[str], table: FloatArray) -> None:
    """Writes numbers (rows, columns) under their names; cells of NaN stay empty."""
    stream = open_for_writing(file) if isinstance(file, str | Path) else file
    try:
        stream.write((",".join(header) + "\n").encode())
        for begin in range(0, len(table), _ROWS):
            lines = (",".join("" if v != v else repr(v) for v in row) for row in table[begin : begin + _ROWS].tolist())
            stream.write(("\n".join(lines) + "\n").encode())
    finally:
        if stream is not file:
            stream.close()
