"""quadid: identify the parameters of a multirotor simulation from flight data and name what it gets wrong.

    import quadid
    log = quadid.load("flight.mcap", vehicle="pelican")     # read, checked (units, frames, motors), on the grid
    fit = quadid.identify(log, validate=quadid.load("other.mcap", vehicle="pelican"))
    found = quadid.diagnose(log)
    found.vehicle.save("mine.yaml")

Every check, status, refusal and warning of the commands is made here too: the commands call these functions.
Nothing heavy is imported before it is used; nothing is imported or run from the folder the program stands in.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from quadid.working_folder import guard

if TYPE_CHECKING:
    from quadid_workflow.diagnose import diagnose as diagnose
    from quadid_workflow.excite import propose as excite
    from quadid_workflow.export import export as export
    from quadid_workflow.health import health as health
    from quadid_workflow.identify import identify as identify
    from quadid_workflow.init import init as init
    from quadid_workflow.inspect import inspect as inspect
    from quadid_workflow.loading import load as load
    from quadid_workflow.score import score as score
    from quadid_workflow.simulate import simulate as simulate

    from quadid.model.step import Simulator as Simulator
    from quadid.parameters import ParameterSet as ParameterSet
    from quadid.vehicle import Vehicle as Vehicle

guard()
__version__ = "0.1.0"

_PUBLIC = {
    "init": "quadid_workflow.init",
    "load": "quadid_workflow.loading",
    "inspect": "quadid_workflow.inspect",
    "identify": "quadid_workflow.identify",
    "diagnose": "quadid_workflow.diagnose",
    "health": "quadid_workflow.health",
    "score": "quadid_workflow.score",
    "simulate": "quadid_workflow.simulate",
    "export": "quadid_workflow.export",
    "Simulator": "quadid.model.step",
    "Vehicle": "quadid.vehicle",
    "ParameterSet": "quadid.parameters",
}
"""Public names and where they are defined."""
_ROOMS = ("identify", "diagnose", "health")
"""Names that are packages too: those are callable (`quadid.callable_room`)."""
__all__ = [*_PUBLIC, "excite"]


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return importlib.import_module(f"quadid.{name}")
    if name == "excite":
        return importlib.import_module("quadid_workflow.excite").propose
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'quadid' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
