"""Channels over time, as a pandas data frame and as an xarray data set, where those are installed."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from quadid.errors import QuadidError
from quadid.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


def imported(name: str) -> Any:
    """Imports an optional module.

    Raises:
        QuadidError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise QuadidError(f"{name} is not installed", fix="pip install 'quadid[notebook]'") from error


@dataclass(frozen=True)
class OverTime:
    """Channels on one time axis.

    Attributes:
        t: times [s], shape (n,).
        values: rows of each channel by its name, shape (n, k).
        labels: of the k columns: name of the dimension, and of each place in it.
        names: columns of the data frame by channel, where they are not ``channel_label``.
    """

    t: FloatArray
    values: Mapping[str, FloatArray]
    labels: Mapping[str, tuple[str, Sequence[str | int]]]
    names: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @property
    def columns(self) -> list[str]:
        """Columns of the data frame, in order."""
        return [
            column
            for name in self.values
            for column in self.names.get(name) or [f"{name}_{label}" for label in self.labels[name][1]]
        ]

    @property
    def table(self) -> FloatArray:
        """All channels side by side, a row a time."""
        return np.concatenate(list(self.values.values()), axis=1)

    def to_frame(self) -> pd.DataFrame:
        """A pandas data frame: a row a time [s], a column a number.

        Raises:
            QuadidError: pandas is not installed.
        """
        pandas = imported("pandas")
        return pandas.DataFrame(self.table, index=pandas.Index(self.t, name="t"), columns=self.columns)

    def to_xarray(self) -> xr.Dataset:
        """An xarray data set: a variable a channel, over time ``t`` [s] and its axes, rotors or outputs.

        Raises:
            QuadidError: xarray is not installed.
        """
        named = {name: (("t", self.labels[name][0]), rows) for name, rows in self.values.items()}
        axes = {dimension: list(places) for dimension, places in self.labels.values()}
        found: xr.Dataset = imported("xarray").Dataset(named, {"t": self.t, **axes})
        return found
