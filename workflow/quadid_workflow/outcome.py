"""What every result of the library offers: tables as text and HTML, a data frame, JSON."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quadid.errors import QuadidError
from quadid.jsonable import jsonable
from quadid.types import Json

if TYPE_CHECKING:
    import pandas as pd
    from quadid_report.text_table import TextTable
    from quadid_report.verdict import Verdict


class Outcome(ABC):
    """A result that prints as its command prints it.

    Attributes:
        result: plain data of the command's JSON, without the files that only the command writes.
    """

    result: dict[str, Any]

    @abstractmethod
    def tables(self) -> list[TextTable]:
        """The tables that the command prints, in order."""

    @property
    def verdict(self) -> Verdict | None:
        """What the result means and what to do next; None where the numbers speak alone."""
        return None

    @property
    def heading(self) -> str:
        """What stands above the tables."""
        return ""

    @property
    def sentences(self) -> list[str]:
        """What stands below the tables, a sentence each."""
        return []

    @property
    def warnings(self) -> list[str]:
        """What a user should know, from logs and from the work itself."""
        return list(self.result.get("warnings", ()))

    def text(self, width: int = 100) -> str:
        """Tables, verdict and warnings, for a page of `width` columns."""
        parts = [self.heading] if self.heading else []
        parts += [table.text(width) for table in self.tables()]
        if self.sentences:
            parts.append("\n".join(self.sentences))
        if self.verdict is not None:
            parts.append("\n".join(self.verdict.lines()))
        parts += [f"warning: {warning}" for warning in self.warnings]
        return "\n\n".join(parts)

    def __repr__(self) -> str:
        return self.text()

    def _repr_html_(self) -> str:
        parts = [f"<p><b>{escape(self.heading)}</b></p>"] if self.heading else []
        parts += [table.html() for table in self.tables()]
        parts += [f"<p>{escape(line)}</p>" for line in self.sentences]
        if self.verdict is not None:
            head, *more = (escape(line) for line in self.verdict.lines())
            parts.append(f"<p><b>{head}</b></p>" + "".join(f"<p>{line}</p>" for line in more))
        return "".join([*parts, *(f"<p>warning: {escape(warning)}</p>" for warning in self.warnings)])

    def to_json(self, path: str | Path | None = None) -> str:
        """The result as JSON text; with `path` also written there."""
        text = json_text(self.result)
        if path is not None:
            Path(path).write_text(text, encoding="utf-8")
        return text

    def to_frame(self) -> pd.DataFrame:
        """The main table with plain numbers as a pandas data frame."""
        return data_frame(self.records(), self.columns)

    @property
    def columns(self) -> Sequence[str]:
        """Columns of a main table that may have no row; else those of its rows."""
        return ()

    @abstractmethod
    def records(self) -> list[dict[str, Any]]:
        """Rows of the main table with plain numbers."""


NUMBER_COLUMNS = ("effect", "confident", "parameter", "unit", "value", "low", "high")
"""Columns of a table with one row a number of a finding."""


def number_rows(found: Sequence[Json]) -> Iterator[tuple[Json, tuple[Any, ...]]]:
    """Each finding with each of its numbers, as `NUMBER_COLUMNS`."""
    for one in found:
        for p in one["parameters"]:
            low, high = p["ci95"] or (None, None)
            yield one, (one["effect"], one["confident"], p["name"], p["unit"], p["value"], low, high)


def json_text(result: Any) -> str:
    """A result as JSON for people and programs; numbers that JSON has no word for become null."""
    return json.dumps(jsonable(result), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def data_frame(records: list[dict[str, Any]], columns: Sequence[str] = ()) -> pd.DataFrame:
    """Rows as a data frame, without rows with these columns; raises QuadidError where pandas is not installed."""
    try:
        import pandas
    except ImportError as error:
        raise QuadidError("pandas is not installed", fix="pip install pandas, or use .records()") from error
    return pandas.DataFrame(records) if records else pandas.DataFrame(columns=list(columns))
