"""What an ablation changes: every number of `quadid.diagnose` left out, halved and doubled, every rule left out."""

from __future__ import annotations

import importlib
import math
import pkgutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import quadid.diagnosis
from quadid.diagnosis.attribution import stated_errors
from quadid.diagnosis.evidence import RELEVANT
from quadid.diagnosis.hypotheses import Model, candidates, fit_model, paired_gain
from quadid.diagnosis.pipeline import SHARE_TO_NAME
from quadid.diagnosis.search import LINEAR_MISFIT
from quadid.identification.noise_fit import flexible_fit
from quadid.identification.problem import Shooting
from quadid_evaluation.studies.ablation.house import measured


@dataclass(frozen=True)
class Variant:
    """One change of the method.

    Attributes:
        name: for the page; subject: the rule or number that it changes; scaled: a number is halved or doubled.
        values: what replaces what, by name of an attribute of a module, or of a class there (`Class.name`).
    """

    name: str
    subject: str
    values: dict[str, Any]
    scaled: bool = False

    @contextmanager
    def in_force(self) -> Iterator[None]:
        """Within it every module of the diagnosis that knows one of the names has the other value."""
        changed: list[tuple[Any, str, Any]] = []
        try:
            for module in modules():
                for path, value in self.values.items():
                    owner, _, name = path.rpartition(".")
                    place = getattr(module, owner, None) if owner else module
                    if place is not None and hasattr(place, name) and getattr(place, name) is not value:
                        changed.append((place, name, getattr(place, name)))
                        setattr(place, name, value)
            if self.values and not changed:
                raise LookupError(f"no module of quadid.diagnose has {', '.join(self.values)}")
            yield
        finally:
            for place, name, value in reversed(changed):
                setattr(place, name, value)


def modules() -> list[ModuleType]:
    """All modules of the diagnosis."""
    found = pkgutil.iter_modules(quadid.diagnosis.__path__, "quadid.diagnosis.")
    return [importlib.import_module(m.name) for m in found]


def numbers() -> dict[str, Any]:
    """Named numbers of the diagnosis, or tuples of such, by name."""
    return {name: getattr(m, name) for m in modules() for name in measured().numbers if hasattr(m, name)}


def variants() -> list[Variant]:
    """The method as it is (`base`), without each rule, and without, with half and with twice each number."""
    out = [Variant("base", "base", {}), *(Variant(f"without {name}", name, values) for name, values in RULES.items())]
    for name, value in numbers().items():
        out += [Variant(f"{name} out", name, {name: OUT[name]})] if name in OUT else []
        out += [Variant(f"{name} × {f:g}", name, {name: _times(value, f)}, scaled=True) for f in (0.5, 2.0)]
    return out


def _times(value: Any, factor: float) -> Any:
    """A number or tuple of numbers times `factor`; what counts something stays whole."""
    if isinstance(value, tuple):
        return tuple(factor * v for v in value)
    return max(round(factor * value), 1) if isinstance(value, int) else factor * value


def _given(value: Any) -> Callable[..., Any]:
    """A function that gives `value` whatever it is asked."""
    return lambda *_, **__: value


def _none(*_: object, **__: object) -> Iterator[Any]:
    return iter(())


def _unpruned(shooting: object, model: Any) -> Any:
    return model


def _same_noise(windows: object, short: Any, model: object) -> Any:
    return short.noise


def _own_noise(windows: object, shooting: Shooting, *_: object) -> Any:
    return shooting.noise


def _nominal(shooting: Shooting, *_: object) -> Model:
    return fit_model(shooting, shooting.layout.initial(shooting.vehicle), ())


def _gains(small: Model, large: Model) -> bool:
    return paired_gain(small.held_out, large.held_out).total > RELEVANT * small.rows


def _regains(score: Any, cause: Any, regains: bool) -> bool:
    return regains and score.candidate.effect != cause.effect


def _unpaired(*given: Any) -> Any:
    return [c for c in candidates(*given) if not c.split]


def _unrefined(*given: Any) -> Any:
    return [c for c in candidates(*given) if not c.refines]


def _as_scanned(shooting: object, model: Any, candidate: object) -> Any:
    return model


def _uncontradicted(*given: Any) -> Any:
    return replace(stated_errors(*given), contradicted=False)


def _as_fitted(parameters: Any) -> Any:
    return parameters, None


def _first_guess(*given: Any, **more: Any) -> Any:
    return flexible_fit(*given[:2], given[2][:1], given[3], given[1].noise, **more)


RULES: dict[str, dict[str, Any]] = {
    "swaps": {"_swaps": _none},
    "swaps within a family": {"_rivals": _regains},
    "impossible numbers": {"impossible_causes": _given({})},
    "constancy of a bias": {"inconstant_causes": _given({})},
    "calibration (Godambe)": {"calibration": _given(1.0)},
    "use on held-out blocks": {"relevant": _given(True)},
    "use without the best block": {"relevant": _gains},
    "a last pruning": {"pruned": _unpruned},
    "noise around the causes": {"_noise_around": _same_noise},
    "memory of the noise": {"with_memory": _own_noise},
    "a start from everything": {"from_everything": _nominal},
    "two starts of the flexible fit when far": {"flexible_fit": _first_guess},
    "what the fit left undone, in scores": {"Everything._unspent": _given(0.0)},
    "causes that show only in pairs": {"candidates": _unpaired},
    "optional numbers of a cause": {"candidates": _unrefined},
    "onset refined": {"_refine_time": _as_scanned},
    "a look at the longest segments": {"Stage.longest": _given(None)},
    "longest segments where velocity is found": {"is_long": _given(False)},
    "ordinary sizes last": {"ordinary": _given(False)},
    "contradiction by unseen data": {"stated_errors": _uncontradicted},
    "what the rest follows": {"follows": _given(())},
    "fast motion beside unmodelled moments": {"held_by_fast_motion": _given(None)},
    "moments that a rigid body can have": {"possible_moments": _as_fitted},
    "slight steps and winds": {"slight_causes": _given({})},
    "lags beside unreliable inertias": {"late_unknown": _given({})},
}
"""Rules that are functions, and what stands in their place."""
OUT: dict[str, Any] = {
    "UNTIDY": 0.0, "BLOCKS": 2, "STEP_SIGMA": 0.0, "TIME_SIGMA": 0.0, "FALSE_ALARM": 1.0, "RELEVANT": 0.0,
    "NOISE_FELL": 0.0, "SHARE_TO_NAME": 0.0, "SHARE_ALONE": SHARE_TO_NAME,
    "LEAST_STRUCTURE": 0.0, "LEAST_OF_EXPLAINED": 0.0, "LIKELY_SENSOR": math.inf, "WRONG_SIGN": 0.0, "ERRORS": 0.0,
    "WAVES": 0, "ALARM": math.inf, "_RIDGE": 0.0,
    "CHANGE_SHARE": 0.0, "LINEAR_MISFIT": math.inf, "CLEAN_MISFIT": LINEAR_MISFIT, "NEAR": 1.0, "ALIKE": 1.0,
    "MOST_REFITS": 1000,
}  # fmt: skip
"""What stands for a number that is left out; numbers that have no such value are halved and doubled only."""
