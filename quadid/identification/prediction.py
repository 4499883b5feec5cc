"""Open-loop prediction error: how far the simulation, started from the measured state, has drifted after h samples.

Every sample starts one run (`open_loop`).  Errors are Euclidean for vectors and the angle of the relative rotation
(q and -q alike), as in the IDSIA nano-drone benchmark.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral

import numpy as np

from quadid.data.window import Window
from quadid.errors import NotIdentifiableError, ParameterError
from quadid.identification.open_loop import QUANTITIES, OpenLoop, lengths
from quadid.model.layout import Layout
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

HORIZONS = (1, 10, 50)
SUM_TO = 50
"""The summed score adds the mean errors of the first fifty samples."""
LONGEST = 2000


@dataclass(frozen=True)
class HorizonScore:
    """Pooled errors of all starts.

    Attributes:
        samples: number of starts.
        mean: mean error by sample after the start, shape (longest, 4), columns as `QUANTITIES`; row h - 1 is h samples
            on; NaN for what the log lacks.
        horizons: those asked for.
    """

    samples: int
    mean: FloatArray
    horizons: tuple[int, ...]

    def at(self, horizon: int) -> dict[str, float]:
        """Mean error after `horizon` samples by quantity; NaN for what the log lacks."""
        return dict(zip(QUANTITIES, self.mean[horizon - 1].tolist(), strict=True))

    @property
    def sum(self) -> dict[str, float]:
        """Sum of the mean errors after 1, 2, … `SUM_TO` samples, by quantity."""
        return dict(zip(QUANTITIES, self.mean[:SUM_TO].sum(axis=0).tolist(), strict=True))


def horizon_scores(
    files: Sequence[Sequence[Window]], vehicle: Vehicle, theta: FloatArray, horizons: Sequence[int] = HORIZONS
) -> tuple[HorizonScore, list[HorizonScore]]:
    """Scores `theta` on several files.

    Args:
        files: windows of each file, on the file's grid.
        vehicle: geometry and mass.
        theta: full parameter vector, shape (size,); see `Layout.initial` for that of a vehicle file.
        horizons: samples after the start, 1 to `LONGEST`.

    Returns:
        The score pooled over all starts, and that of each file (with no samples where no run fits).

    Raises:
        ParameterError: impossible horizons.
        NotIdentifiableError: no run fits into any file, or there is no gyro.
    """
    wanted = _checked(horizons)
    longest = max(*wanted, SUM_TO)
    tallies = [_tally(windows, vehicle, theta, longest) for windows in files]
    pooled, starts = np.sum([sums for sums, _ in tallies], axis=0), sum(count for _, count in tallies)
    if starts == 0:
        raise NotIdentifiableError(
            f"no run of {longest} samples fits: measured rate, and no gap for {longest} samples after it",
            f"stretches longer than {longest} samples with gyro", "log without gaps, or ask for a lower --rate",
        )  # fmt: skip
    return _score(pooled, starts, wanted), [_score(*tally, wanted) for tally in tallies]


def _checked(horizons: Sequence[int]) -> tuple[int, ...]:
    """The horizons, each once; raises ParameterError for what is none."""
    wanted = tuple(dict.fromkeys(horizons))
    if not wanted or not all(isinstance(h, Integral) and 1 <= h <= LONGEST for h in wanted):
        raise ParameterError(f"horizons {list(horizons)}", f"whole numbers of samples from 1 to {LONGEST}")
    return wanted


def start_errors(windows: Sequence[Window], vehicle: Vehicle, horizons: Sequence[int]) -> list[FloatArray]:
    """Errors of every run, for pairs of models from the same starts.

    Args:
        windows: of one file.
        vehicle: its values, effects included, are taken as they are.
        horizons: samples after the start, 1 to `LONGEST`.

    Returns:
        Of each window, shape (starts, horizons, 4), columns as `QUANTITIES`; NaN for what was not measured.

    Raises:
        ParameterError: impossible horizons.
    """
    wanted = _checked(horizons)
    theta = Layout(vehicle).initial(vehicle)[None]
    return [lengths(OpenLoop(w, vehicle, max(wanted)).misses(theta, np.array(wanted))[0]) for w in windows]


def _score(sums: FloatArray, starts: int, horizons: tuple[int, ...]) -> HorizonScore:
    total, count = sums
    mean = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
    mean.setflags(write=False)
    return HorizonScore(starts, mean, horizons)


def _tally(windows: Sequence[Window], vehicle: Vehicle, theta: FloatArray, longest: int) -> tuple[FloatArray, int]:
    """Summed errors of all runs and their counts, shape (2, longest, 4), and the number of runs."""
    sums, starts, at = np.zeros((2, longest, 4)), 0, 1 + np.arange(longest)
    for window in windows:
        for rows, misses in OpenLoop(window, vehicle, longest).parts(theta[None], at):
            errors = lengths(misses[0])
            known = ~np.isnan(errors)
            sums += np.where(known, errors, 0.0).sum(axis=0), known.sum(axis=0)
            starts += len(rows)
    return sums, starts
