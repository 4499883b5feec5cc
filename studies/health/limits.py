"""What the spread of healthy flights forbids: the same comparison when every cut does just what the mean cut does."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quadid.health import FlightTrim, Health, assess, healthy_spread
from quadid.health.changes import SIGNIFICANT
from quadid.health.hypotheses import rotor_effect
from studies.health.recorded import CRAZYFLIE, Flown, Judged

SIZES = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)
DRAWS = 300


def loss_per_mm(judged: Sequence[Judged]) -> float:
    """Loss of thrust per millimetre cut from one propeller, least squares through zero over what was found."""
    pairs = [
        (j.flown.total, sum(p[2] for c in j.health.changes for p in c.parameters if p[0] == "loss"))
        for j in judged
        if j.flown.condition == "cut" and j.flown.rotors == set(j.named)
    ]
    sizes, losses = np.array(pairs).T
    return float(sizes @ losses / (sizes @ sizes))


def power(flights: Sequence[Flown], airframe: str, slope: float, seed: int = 1) -> list[tuple[float, float, float]]:
    """For each size: share of simulated flights found, and share with M3 named first, from the healthy spread alone."""
    rng = np.random.default_rng(seed)
    baseline = [f.trim for f in flights if f.airframe == airframe and f.condition == "healthy"]
    healthy = healthy_spread(baseline)
    effect = rotor_effect(CRAZYFLIE, 2, float(healthy.shares[2]), healthy.mean).sum(axis=1)
    out = []
    for size in SIZES:
        found = named = 0
        for _ in range(DRAWS):
            noise = healthy.predictive(1) * rng.standard_t(healthy.freedom)
            mean = healthy.mean + effect * slope * size + noise
            result = _judged(mean, baseline)
            found += result.p_value < SIGNIFICANT
            first = result.changes[0] if result.changes else None
            named += first is not None and first.effect == "weak_rotor" and first.parameters[0][2] == 3.0
        out.append((size, found / DRAWS, named / DRAWS))
    return out


def _judged(mean: np.ndarray[tuple[int], np.dtype[np.float64]], baseline: list[FlightTrim]) -> Health:
    return assess([baseline[0]._replace(mean=mean)], baseline, CRAZYFLIE)


def text(judged: Sequence[Judged]) -> str:
    """The limits as Markdown."""
    flights = [j.flown for j in judged]
    slope = loss_per_mm(judged)
    lines = [
        f"A cut costs {100.0 * slope:.1f} % of thrust a millimetre (least squares over the single cuts whose rotor is "
        "named). If every cut cost just that, and flights differed from the healthy mean as healthy flights do, "
        f"{DRAWS} draws a size would give:",
        "",
        "| mm cut from M3 | E8 found | E8 named first | E9 found | E9 named first |",
        "|---|---|---|---|---|",
    ]
    both = [power(flights, airframe, slope) for airframe in ("E8", "E9")]
    for a, b in zip(*both, strict=True):
        lines.append(f"| {a[0]:g} | " + " | ".join(f"{100.0 * v:.0f} %" for v in (*a[1:], *b[1:])) + " |")
    for airframe in ("E8", "E9"):
        spread = healthy_spread([f.trim for f in flights if f.airframe == airframe and f.condition == "healthy"])
        shown = ", ".join(f"{100.0 * s:.2f}" for s in spread.deviation)
        lines.append(f"\nSpread of healthy flights of {airframe} (roll, pitch, yaw, effort; %): {shown}.")
    return "\n".join(lines)
