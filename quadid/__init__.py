"""quadid: identify the parameters of a multirotor simulation from flight data and name what it gets wrong.

    import quadid
    log = quadid.load("flight.mcap", vehicle="pelican")     # read, checked (units, frames, motors), on the grid
    fit = quadid.identify(log, validate=quadid.load("other.mcap", vehicle="pelican"))
    found = quadid.diagnose(log)
    found.vehicle.save("mine.yaml")

Every check, status, refusal and warning of the commands is made here too: the commands call these functions.
Nothing heavy is imported before it is used; no process that it starts imports from the folder we stand in.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from quadid.files import guard
from quadid.old_paths import install
from quadid.version import __version__ as __version__

if TYPE_CHECKING:
    from quadid.app.diagnose import diagnose as diagnose
    from quadid.app.excite import propose as excite
    from quadid.app.export import export as export
    from quadid.app.fleet import fleet as fleet
    from quadid.app.gains import gains as gains
    from quadid.app.health import health as health
    from quadid.app.identify import identify as identify
    from quadid.app.init import init as init
    from quadid.app.inspect import inspect as inspect
    from quadid.app.logs import load as load
    from quadid.app.score import compare_vehicles as compare_vehicles
    from quadid.app.score import score as score
    from quadid.app.simulate import simulate as simulate
    from quadid.model.step import Simulator as Simulator
    from quadid.parameters import ParameterSet as ParameterSet
    from quadid.vehicle import Vehicle as Vehicle

guard()

_OF_APP = ("init", "inspect", "identify", "diagnose", "health", "score", "simulate", "export", "fleet", "gains")
_PUBLIC = {
    **{name: f"quadid.app.{name}" for name in _OF_APP},
    "load": "quadid.app.logs",
    "compare_vehicles": "quadid.app.score",
    "Simulator": "quadid.model.step",
    "Vehicle": "quadid.vehicle",
    "ParameterSet": "quadid.parameters",
}
"""Public names and where they are defined."""
_EXTRAS = ("jax", "symbolic")
"""Modules that need an extra package; imported when they are used."""
__all__ = [*_PUBLIC, "excite"]

install()


def __getattr__(name: str) -> Any:
    if name == "excite":
        return importlib.import_module("quadid.app.excite").propose
    if name in _EXTRAS:
        return importlib.import_module(f"quadid.{name}")
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'quadid' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
