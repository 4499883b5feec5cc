"""The searches that `quadid identify` offers, behind one call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from quadid.errors import ParameterError, nearest

if TYPE_CHECKING:
    from quadid.identify.fit import Fit
    from quadid.vehicle import Vehicle
    from quadid.window import Window
    from quadid_cli.terminal import Advance

OPTIMIZERS = ("pso_polish", "pso", "initial")


def check_optimizer(name: str) -> None:
    """Raises ParameterError for an unknown search, with the nearest known one."""
    if name not in OPTIMIZERS:
        raise ParameterError(f"unknown optimizer '{name}'", ", ".join(OPTIMIZERS), nearest(name, OPTIMIZERS))


def search(name: str, windows: Sequence[Window], vehicle: Vehicle, seed: int, advance: Advance) -> Fit:
    """Identifies the parameters with the search called `name`.

    The sensor noise, which decides intervals and scores, always comes from the polished fit.
    """
    from quadid.identify.fit import FitOptions, fit

    if name == "pso_polish":
        return fit(windows, vehicle, FitOptions(seed=seed), progress=advance)
    raise ParameterError(f"optimizer '{name}' is not available yet")
