"""What an ablation changes: every number of `quadid.diagnose` halved and doubled, and every rule left out."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import quadid.diagnose
from quadid.diagnose.model import Model, fit_model
from quadid.identify.shooting import Shooting
from studies.ablation.house import measured

WHOLE = ("FEWEST_BLOCKS", "FEWEST_SEGMENTS", "FAR_ITERATIONS", "MOST_ROUNDS", "SMOOTH", "WAVES")
"""Numbers that count something and stay whole."""


@dataclass(frozen=True)
class Variant:
    """One change of the method.

    Attributes:
        name: for the page.
        values: what replaces what, by name of a module's attribute.
    """

    name: str
    values: dict[str, Any]

    @contextmanager
    def in_force(self) -> Iterator[None]:
        """Within it every module of the diagnosis that knows one of the names has the other value."""
        changed: list[tuple[ModuleType, str, Any]] = []
        try:
            for module in modules():
                for name, value in self.values.items():
                    if hasattr(module, name):
                        changed.append((module, name, getattr(module, name)))
                        setattr(module, name, value)
            if self.values and not changed:
                raise LookupError(f"no module of quadid.diagnose has {', '.join(self.values)}")
            yield
        finally:
            for module, name, value in reversed(changed):
                setattr(module, name, value)


def modules() -> list[ModuleType]:
    """All modules of the diagnosis."""
    found = pkgutil.iter_modules(quadid.diagnose.__path__, "quadid.diagnose.")
    return [importlib.import_module(m.name) for m in found]


def numbers() -> dict[str, Any]:
    """Named numbers of the diagnosis, or tuples of such, by name."""
    return {name: getattr(m, name) for m in modules() for name in measured().numbers if hasattr(m, name)}


def variants() -> list[Variant]:
    """The method as it is (`base`), without each rule, and with half and twice each number."""
    out = [Variant("base", {}), *(Variant(f"without {name}", values) for name, values in RULES.items())]
    for name, value in numbers().items():
        for factor in (0.5, 2.0):
            other = tuple(factor * v for v in value) if isinstance(value, tuple) else factor * value
            other = max(round(other), 1) if name in WHOLE else other
            out.append(Variant(f"{name} {value} -> {other}", {name: other}))
    return out


def _nothing(*_: object, **__: object) -> dict[str, str]:
    return {}


def _none(*_: object, **__: object) -> Iterator[Any]:
    return iter(())


def _one(*_: object) -> float:
    return 1.0


def _unpruned(shooting: object, model: Any) -> Any:
    return model


def _always(*_: object) -> bool:
    return True


def _same_noise(windows: object, short: Any, model: object) -> Any:
    return short.noise


def _own_states(shooting: object, model: Any) -> Any:
    return model.states


def _nominal(shooting: Shooting, *_: object) -> Model:
    return fit_model(shooting, shooting.layout.initial(shooting.vehicle), ())


def _no_trial(*_: object) -> None:
    return None


RULES: dict[str, dict[str, Callable[..., Any]]] = {
    "swaps": {"_swaps": _none},
    "calibration (Godambe)": {"calibration": _one},
    "veto on held-out blocks": {"relevant": _always},
    "impossible numbers": {"impossible_causes": _nothing},
    "constancy of a bias": {"inconstant_causes": _nothing},
    "a last pruning": {"pruned": _unpruned},
    "a possible cause for an impossible one": {"_possible": _no_trial},
    "noise around the causes": {"_noise_around": _same_noise},
    "a start from everything": {"from_everything": _nominal},
    "initial states settled first": {"settled_states": _own_states},
}
"""Rules that are functions, and what stands in their place."""
