"""quadid: identify the parameters of a multirotor simulation from flight data and name what it gets wrong.

    import quadid
    log = quadid.load("flight.mcap", vehicle="pelican")     # read, checked (units, frames, motors), on the grid
    fit = quadid.identify(log, validate=quadid.load("other.mcap", vehicle="pelican"))
    found = quadid.diagnose(log)
    found.vehicle.save("mine.yaml")

Every check, status, refusal and warning of the commands is made here too: the commands call these functions.
Nothing heavy is imported before it is used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quadid.parameters import ParameterSet as ParameterSet
    from quadid.vehicle import Vehicle as Vehicle
    from quadid.workflow.diagnose import diagnose as diagnose
    from quadid.workflow.export import export as export
    from quadid.workflow.health import health as health
    from quadid.workflow.identify import identify as identify
    from quadid.workflow.inspect import inspect as inspect
    from quadid.workflow.loading import load as load
    from quadid.workflow.score import score as score
    from quadid.workflow.simulate import simulate as simulate

__version__ = "0.1.0"

_PUBLIC = {
    "load": "quadid.workflow.loading",
    "inspect": "quadid.workflow.inspect",
    "identify": "quadid.workflow.identify",
    "diagnose": "quadid.workflow.diagnose",
    "health": "quadid.workflow.health",
    "score": "quadid.workflow.score",
    "simulate": "quadid.workflow.simulate",
    "export": "quadid.workflow.export",
    "Vehicle": "quadid.vehicle",
    "ParameterSet": "quadid.parameters",
}
"""Public names and where they are defined."""
_ROOMS = ("identify", "diagnose", "health")
"""Names that are packages too: those are callable (`quadid.callable_room`)."""
__all__ = [*_PUBLIC]


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return importlib.import_module(f"quadid.{name}")
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'quadid' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
