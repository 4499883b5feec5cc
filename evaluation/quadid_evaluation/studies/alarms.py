"""`make alarms`: false alarms on healthy flights in wind, and how soon a payload and a weak rotor are named.

    python -m quadid_evaluation.studies.alarms --hours 6 --out docs/results

Alarms are those of the watch for sudden changes, which knows the vehicle as a session does after its first set, and
faults that the checks of a window find (stuck, frame, motor order), every second.  Detections are named by what a
session asks three seconds after the change.
"""

import itertools
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from quadid.flight import Flight, draw_truth, fly
from quadid.model.layout import Layout, ThrustModel
from quadid.online.change_job import AFTER_CHANGE, ASK_FLYING, ChangeRequest
from quadid.online.changes import BASELINE, CHUNK, ChangeDetector, ChangePoint
from quadid.online.checks import judge
from quadid.online.grid_buffer import Rows, WindowCut
from quadid.online.records import OnlineFinding
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import study, table

SECONDS, AT = 300.0, 40.3
"""Length of a healthy flight [s]; moment of a change [s]."""
VEHICLES, PROFILES = ("pelican", "hexacopter", "crazyflie"), ("hover", "gentle", "excited")
AIR = {"calm": 0.0, "light": 0.3, "gusty": 0.6, "rough": 0.9}
"""Turbulence of Dryden's form: specific force, rms [m/s^2]; moments come with it, and 3 m/s of wind for each 0.3."""
KNOWN = 0.02
"""Prior knowledge of the vehicle: error and standard deviation of log parameters."""
SIGMA = np.array([0.001, 0.006, KNOWN, KNOWN, KNOWN, 0.05])
SENSORS = ("rotor_speed", "gyro", "accel", "attitude")
CHANGES: dict[str, dict[str, dict[str, float]]] = {
    f"{share:+.0%} mass": {"mass_change": {"time": AT, "fraction": share}} for share in (0.18, -0.15, 0.1)
}
LOSS = 0.12
"""Loss of a rotor that is looked for."""


class Seen(NamedTuple):
    """A change that was seen at `t` [s], and what it was."""

    t: float
    change: ChangePoint


def flown(vehicle: Vehicle, seed: int, profile: str, air: float, seconds: float, **changes: dict[str, float]) -> Flight:
    """One flight of an individual vehicle with motor lag, rotor drag and inflow, in wind of strength `air`."""
    effects = {
        "motor_lag": {"tau": 0.03},
        "rotor_drag": {"k_x": 0.25, "k_y": 0.25},
        "axial_inflow": {"k_z": 0.2},
        "wind": {"north": 10.0 * air, "east": 0.0},
        **changes,
    }
    gusts = {"gusts": {"push": air, "turn": 1.3 * air, "time": 0.6}} if air else {}
    truth = draw_truth(vehicle, seed)
    return fly(vehicle, truth, seconds, seed, profile, effects=effects, outside=gusts)


def watched(vehicle: Vehicle, flight: Flight, seed: int) -> Iterator[Seen]:
    """Sudden changes that a session would see, which knows the vehicle to `KNOWN`."""
    window, truth, rng = flight.window, flight.truth.parameters, np.random.default_rng(seed)
    inertia = np.array([truth.J_xx, truth.J_yy, truth.J_zz]) * np.exp(KNOWN * rng.standard_normal(3))
    detector, rows = ChangeDetector(vehicle), round(CHUNK / window.dt)
    for k in range(0, len(window) - rows, rows):
        part = {n: getattr(window, n)[k : k + rows] for n in SENSORS}
        detector.add(Rows(window.t[k : k + rows], part, window.sampling, ""))
        change = detector.look(truth.b, inertia, np.full(2, np.sqrt(2.0) * KNOWN))
        if change is not None:
            yield Seen(float(window.t[k + rows - 1]), change)
            detector.restart()


def known_theta(vehicle: Vehicle, flight: Flight) -> FloatArray:
    """Parameter vector of a session whose vehicle is identified."""
    theta = Layout(vehicle).initial(vehicle)
    theta[: len(NOMINAL_NAMES)] = list(flight.truth.parameters.as_dict().values())
    return theta


def faults(vehicle: Vehicle, flight: Flight) -> Iterator[str]:
    """Complaints of the checks about the windows of a healthy flight, before and after the vehicle is known."""
    window, second = flight.window, round(1.0 / flight.window.dt)
    thrust = ThrustModel(Layout(vehicle), known_theta(vehicle, flight))
    for known, length in ((False, 10.0), (True, ASK_FLYING)):
        rows = round(length / window.dt)
        for k in range(0, len(window) - rows, second):
            quality = judge(WindowCut((window.slice(k, k + rows),), length, 0), vehicle, thrust, known)
            if said := quality.fault or quality.grounded:
                yield said.split(":")[0].split(" (")[0]


def named(vehicle: Vehicle, flight: Flight, seen: Seen) -> OnlineFinding | None:
    """Report of a session on a change, `AFTER_CHANGE` [s] after it."""
    window, at, theta = flight.window, seen.change.time, known_theta(vehicle, flight)
    first, last = np.searchsorted(window.t, [at - BASELINE, at + AFTER_CHANGE]).tolist()
    part = window.slice(first, last)
    request = ChangeRequest(1, vehicle, (part,), part.t0, part.t0 + AFTER_CHANGE, theta, SIGMA, seen.change, at)
    return request.answer().finding


def upper(count: int, hours: float) -> float:
    """One-sided 95 % upper bound of a rate an hour (Poisson)."""
    return float(chi2.ppf(0.95, 2 * (count + 1))) / 2.0 / hours


def healthy(hours: float, seed: int) -> list[str]:
    """Alarms on healthy flights, as Markdown."""
    rows, changes, refused, flights = [], 0, 0, 0
    each = max(round(hours * 3600.0 / SECONDS / len(VEHICLES) / len(PROFILES) / len(AIR)), 1)
    for (air, strength), profile in itertools.product(AIR.items(), PROFILES):
        alarms, said = Counter[str](), Counter[str]()
        for name, k in itertools.product(VEHICLES, range(each)):
            vehicle = Vehicle.shipped(name)
            flight = flown(vehicle, seed + k, profile, strength, SECONDS)
            alarms += Counter(s.change.channel for s in watched(vehicle, flight, k))
            said += Counter(faults(vehicle, flight))
        changes, refused, flights = changes + alarms.total(), refused + said.total(), flights + each * len(VEHICLES)
        texts = "; ".join(f"{what} ({n})" for what, n in (alarms + said).items())
        flew_here = f"{each * len(VEHICLES) * SECONDS / 3600.0:.2f}"
        rows.append((air, profile, flew_here, alarms.total(), said.total(), texts))
        print(*rows[-1], flush=True)
    flew = flights * SECONDS / 3600.0
    return [
        f"## Healthy flights\n`make alarms`, seed {seed}. {', '.join(VEHICLES)}; individuals known to {KNOWN:.0%}, "
        f"with motor lag, rotor drag and inflow. **{changes} false changes in {flew:.1f} h, at most "
        f"{upper(changes, flew):.2f} an hour (95 %); {refused} windows refused.**\n",
        *table(("air", "flight", "hours", "changes", "windows refused", "what"), rows),
    ]


def detections(each: int, seed: int) -> list[str]:
    """Delays until changes are named, as Markdown."""
    pelican, rows = Vehicle.shipped("pelican"), []
    cases = [*((what, "mass_change") for what in CHANGES), (f"-{LOSS:.0%} of a rotor", "weak_rotor")]
    for (what, effect), profile, air in itertools.product(cases, ("hover", "excited"), AIR):
        soon, right, false, sizes = [], 0, 0, []
        for k in range(each):
            rotor = k % 4 + 1
            flight = _changed(pelican, seed + k, profile, AIR[air], what, rotor)
            seen = next((s for s in watched(pelican, flight, k) if s.t > AT), None)
            if seen is None:
                continue
            soon.append(max(seen.t, seen.change.time + AFTER_CHANGE) - AT)
            found = named(pelican, flight, seen)
            if found is None:
                continue
            same = found.effect == effect and (effect != "weak_rotor" or found.values.get("rotor") == rotor)
            right += same or not found.confident and effect in {a.effect for a in found.alternatives}
            false += found.confident and not same
            sizes.append(found.values.get("fraction", found.values.get("loss", np.nan)))
        times = f"{np.median(soon):.1f}" if soon else ""
        size = f"{np.nanmedian(sizes):+.0%}" if len(sizes) and np.isfinite(sizes).any() else ""
        within = sum(s <= 5.0 for s in soon)
        rows.append((what, profile, air, f"{within} of {each}", len(soon) - within, times, right, false, size))
        print(*rows[-1], flush=True)
    heads = ("change", "flight", "air", "within 5 s", "later", "delay [s]", "right", "wrong and sure", "size")
    return [
        f"## Changes\n`make alarms`, seed {seed}. Seen and named within 5 s, and within 8 s; median delay; right: "
        "named, a rotor by its number, or among the alternatives of a finding that is not sure; wrong and sure: "
        "another cause, with confidence; median size.\n",
        *table(heads, rows),
    ]


def _changed(vehicle: Vehicle, seed: int, profile: str, air: float, what: str, rotor: int) -> Flight:
    """A flight on which something changes at `AT`.

    A rotor that lost a share of its thrust and torque is logged as a sound one that turns as much faster: so fast its
    controller would make it turn, at once.
    """
    if what in CHANGES:
        return flown(vehicle, seed, profile, air, AT + 8.0, **CHANGES[what])
    flight = flown(vehicle, seed, profile, air, AT + 8.0)
    speed = flight.window.rotor_speed.copy()
    speed[flight.window.t > AT, rotor - 1] /= np.sqrt(1.0 - LOSS)
    return replace(flight, window=replace(flight.window, rotor_speed=speed))


if __name__ == "__main__":
    parts = {"healthy": lambda g: healthy(g.hours, g.seed), "changes": lambda g: detections(g.each, g.seed)}
    study(__doc__, "alarms.md", "False alarms, and changes that are seen", parts, hours=6.0, each=4, seed=500)
