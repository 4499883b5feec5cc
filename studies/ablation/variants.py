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

WHOLE = ("FEWEST_BLOCKS", "FEWEST_SEGMENTS", "MOST_REFITS", "SMOOTH", "WAVES", "NOISE_ROUNDS", "FAR_SEGMENTS")
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


def numbers() -> dict[str, float]:
    """Named numbers of the diagnosis, each where it is defined, by name."""
    out = {}
    for module in modules():
        source = module.__file__ or ""
        with open(source, encoding="utf-8") as file:
            defined = {line.split(" = ")[0] for line in file if " = " in line and line[0].isupper()}
        for name, value in vars(module).items():
            if name in defined and isinstance(value, int | float) and name.isupper():
                out[name] = value
    return out


def variants() -> list[Variant]:
    """The method as it is (`base`), without each rule, and with half and twice each number."""
    out = [Variant("base", {}), *(Variant(f"without {name}", values) for name, values in RULES.items())]
    for name, value in numbers().items():
        for factor in (0.5, 2.0):
            other = max(round(value * factor), 1) if name in WHOLE else value * factor
            out.append(Variant(f"{name} {value:g} -> {other:g}", {name: other}))
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


RULES: dict[str, dict[str, Callable[..., Any]]] = {
    "swaps": {"_swaps": _none},
    "calibration (Godambe)": {"calibration": _one},
    "veto on held-out blocks": {"relevant": _always},
    "impossible numbers": {"impossible_causes": _nothing},
    "constancy of a bias": {"inconstant_causes": _nothing},
    "a last pruning": {"pruned": _unpruned},
}
"""Rules that are functions, and what stands in their place."""
