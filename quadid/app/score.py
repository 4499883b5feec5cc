"""Open-loop prediction error of a vehicle on logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quadid.app.logs import Given, fitted_before, settled
from quadid.app.outcome import Outcome
from quadid.model.layout import Layout
from quadid.report.verdict import Verdict, score_verdict
from quadid.vehicle import Vehicle

if TYPE_CHECKING:
    from quadid.report.tables import TextTable

HORIZONS = (1, 10, 50)


@dataclass(frozen=True, repr=False)
class Scored(Outcome):
    """Prediction errors; `result` has the form ``quadid.score/1``."""

    result: dict[str, Any]
    notes: tuple[str, ...] = ()

    @property
    def warnings(self) -> list[str]:
        """What was wrong with the logs."""
        return list(self.notes)

    @property
    def verdict(self) -> Verdict:
        """How the errors stand beside sensor noise, and beside predicting no change."""
        return score_verdict(self.result)

    def tables(self) -> list[TextTable]:
        """Errors after every horizon, pooled and a log."""
        from quadid.report.tables import horizon_table

        return [horizon_table(self.result)]

    def records(self) -> list[dict[str, Any]]:
        """One row a log and horizon, the pooled ones with the log None."""
        entries = [*self.result["files"], {"log": None, **self.result}]
        return [{"log": e["log"], "after": int(h), **errors} for e in entries for h, errors in e["horizons"].items()]


def score(
    logs: Given, *, vehicle: str | Path | Vehicle | None = None, horizons: Sequence[int] = HORIZONS,
    rate: float | None = None,
) -> Scored:  # fmt: skip
    """Open-loop prediction error after h samples: every sample starts one run from the measured state.

    Args:
        logs: a log or several, as paths or from `load`.
        vehicle: whose values are scored as they are; default that of the first loaded log.
        horizons: samples of the grid after the start of each run.
        rate: of the grid [Hz]; None for each log's own, whatever it was loaded with.

    Raises:
        LogError: a log that does not fit the vehicle.
        ParameterError: horizons that are no positive numbers.
    """
    from quadid.identification.open_loop import QUANTITIES, no_change
    from quadid.identification.prediction import horizon_scores
    from quadid.identification.prediction_floor import prediction_floor
    from quadid.identification.result import score_result

    given = settled(logs, (), vehicle)
    described, opened = given.vehicle, [log.at(rate) for log in given.train]
    theta = Layout(described).initial(described)
    windows = [w for log in opened for w in log.windows]
    pooled, each = horizon_scores([log.windows for log in opened], described, theta, list(horizons))
    files = [(log.recording.name, log.grid.gaps, one) for log, one in zip(opened, each, strict=True)]
    result = score_result(described.name, pooled, files)
    wanted = [int(h) for h in result["horizons"]]
    result["noise_floor"] = {str(h): prediction_floor(windows, h) for h in wanted}
    result["no_change"] = {str(h): no_change(windows, described, h) for h in wanted}
    result["units"] = dict(QUANTITIES)
    result["verdict"] = score_verdict(result).level
    seen = [
        f"{log.name}: the vehicle file was fitted to this flight, so these errors are no proof"
        for log in opened
        if fitted_before(described, log)
    ]
    return Scored(result, (*seen, *(text for log in opened for text in log.warnings)))
