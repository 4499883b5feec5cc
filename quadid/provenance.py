"""What shows that the values of a vehicle file predict, and which flights they were fitted to."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from quadid.sanitise import LONGEST_NAME
from quadid.vehicle_parts import Strict

MOST_FLIGHTS = 100
"""Flights that a file remembers."""


class FittedFlight(Strict):
    """A flight that values were fitted to, so that it is known again under another name, in another format, in part.

    Attributes:
        log: its file name.
        seconds: length of the part that was fitted.
        begin: UNIX time of its first sample [s]; None where its clock has no date.
        marks: short hashes of some stretches of its gyro, see `quadid_workflow.overlap`.
    """

    log: str = Field(max_length=LONGEST_NAME)
    seconds: Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
    begin: Annotated[float, Field(allow_inf_nan=False)] | None = None
    marks: Annotated[str, Field(max_length=600)] = ""


class Proof(Strict):
    """What shows that the values of this file predict.

    Attributes:
        verdict: on the result that the file was written by: good (green), fair (amber), poor (red).
        unseen: flights that were predicted and not fitted.
        error: largest of their errors over one second, in noise variances (1 is the noise floor).
        fitted: flights that the values rest on; their standard deviations are no knowledge beside the same flights.
    """

    verdict: Literal["good", "fair", "poor"]
    unseen: tuple[str, ...] = ()
    error: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] | None = None
    fitted: Annotated[tuple[FittedFlight, ...], Field(max_length=MOST_FLIGHTS)] = ()

    @property
    def lacking(self) -> str:
        """Why the values are not proven; empty when they are."""
        if self.verdict == "poor":
            error = f": error {self.error:.3g} times the noise variance on an unseen flight" if self.error else ""
            return f"its fit was judged poor{error}"
        return "" if self.unseen else "no flight was predicted that was not fitted"
