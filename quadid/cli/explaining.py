"""When there is no answer, the report says why."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from quadid.errors import QuadidError

if TYPE_CHECKING:
    from quadid.vehicle import Vehicle


@contextmanager
def explained(report: Path | None, what: str, texts: Sequence[str], vehicle: Vehicle, preset: str) -> Iterator[None]:
    """When the block fails for want of good data, the report says why and shows the data; the error goes on.

    Args:
        report: file to write; None for none.
        what: what was asked for, for the title.
        texts: logs as given on the command line.
        vehicle: its description.
        preset: topic names of ROS logs.
    """
    from quadid.app.identify import UnansweredError

    try:
        yield
    except UnansweredError:
        raise  # it has a report of its own
    except QuadidError as error:
        if report is not None:
            from quadid.app.logs import write_text
            from quadid.app.outcome import failure_html
            from quadid.cli.terminal import command_line, warn

            file = write_text(report, failure_html(error, what, texts, vehicle, preset, command_line()))
            warn([f"no answer; why, and the data as they are: {file}"])
        raise
