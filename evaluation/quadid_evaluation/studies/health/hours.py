"""Online rotor health: false alarms in 100 h of hover, and how soon a loss is named.  Accelerated.

python -m quadid_evaluation.studies.health.hours --hours 100 --out docs/results
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from quadid.condition.watch import HealthReport, HealthWatch
from quadid.online import Session, SessionSettings
from quadid.online.records import Action
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import study, table
from quadid_evaluation.studies.health.flights import Wrong, hover_blocks, hover_seconds

FLIGHT, HISTORY, ONSET = 1200, 12, 60
"""Seconds of a flight; healthy flights before; second at which a loss begins."""
AFTER = 30
"""Seconds that are flown on with a loss."""
PELICAN = Vehicle.shipped("pelican_x")
SETTINGS = SessionSettings(diagnose=0.0, refit=60.0)
Found = tuple[float, int] | None
"""Seconds from the onset of a loss to its alarm, and the rotor that it names (0: none); None without an alarm."""


def practised(rng: np.random.Generator, flights: int = HISTORY, seconds: int = 90) -> HealthWatch:
    """A watch that has seen healthy flights."""
    watch = HealthWatch(PELICAN)
    for _ in range(flights):
        alarms(watch, rng, seconds)
    return watch


def alarms(watch: HealthWatch, rng: np.random.Generator, seconds: int) -> int:
    """Flies one healthy flight; how many alarms it raised."""
    found = sum(report.verdict == "changed" for report in _watched(watch, rng, seconds))
    watch.landed()
    return found


def named(watch: HealthWatch, rng: np.random.Generator, rotor: int, loss: float) -> Found:
    """Flies a loss of thrust and drag torque of a rotor (from 0)."""
    reports = list(_watched(watch, rng, ONSET + AFTER, _lost(rotor, loss)))
    watch.landed()
    return _alarm(reports, float(ONSET))


def _lost(rotor: int, loss: float) -> Wrong:
    return Wrong({rotor + 1: loss}, {rotor + 1: loss})


def _watched(
    watch: HealthWatch, rng: np.random.Generator, seconds: int, wrong: Wrong | None = None
) -> Iterator[HealthReport]:
    for t, (load, force) in enumerate(hover_seconds(PELICAN, seconds, rng, None, wrong, ONSET)):
        report = watch.second(float(t + 1), load, force)
        if report is not None:
            yield report


def _alarm(reports: Sequence[HealthReport], onset: float) -> Found:
    first = next((report for report in reports if report.verdict == "changed"), None)
    if first is None:
        return None
    weak = first.changes and first.changes[0].effect == "weak_rotor"
    return first.t - onset, int(first.changes[0].parameters[0][2]) if weak else 0


class Flown:
    """A session at 50 Hz with all its duties, a fit a minute among them, over flights in a row."""

    def __init__(self, rng: np.random.Generator) -> None:
        """Starts with a history of healthy flights."""
        self._rng = rng
        self._session = Session(PELICAN, SETTINGS)
        self._begin = 1.7e9
        for _ in range(HISTORY):
            self.fly(90)

    def fly(self, seconds: int, wrong: Wrong | None = None) -> list[HealthReport]:
        """Flies once; what it reports."""
        out: list[Action] = []
        for block in hover_blocks(PELICAN, self._begin, seconds, self._rng, wrong, ONSET):
            self._session.push(block)
            out += self._session.poll()
            while (job := self._session.running) is not None:
                self._session.deliver(job.run())
                out += self._session.poll()
        self._begin += seconds + 100.0
        return [action for action in out if isinstance(action, HealthReport)]

    def named(self, rotor: int, loss: float) -> Found:
        """As `named`; the onset comes after 6 s on the ground."""
        onset = self._begin + 6.0 + ONSET
        return _alarm(self.fly(ONSET + AFTER, _lost(rotor, loss)), onset)


def _row(what: str, loss: float, each: int, flown: Callable[[int], Found]) -> tuple[object, ...]:
    found = [flown(k % 4) for k in range(each)]
    seconds = [f[0] if f is not None else np.inf for f in found]
    rotors = [f is not None and f[1] == k % 4 + 1 for k, f in enumerate(found)]
    soon = sum(s <= 5.0 and r for s, r in zip(seconds, rotors, strict=True))
    return f"{100 * loss:.0f} %", what, f"{soon} of {each}", sum(rotors), f"{np.median(seconds):.0f}"


def quiet(hours: float, session: float) -> str:
    """Alarms in healthy hover, as Markdown."""
    rng = np.random.default_rng(11)
    watch, flown = practised(rng), Flown(rng)
    count, whole = (round(h * 3600.0 / FLIGHT) for h in (hours, session))
    raised = sum(alarms(watch, rng, FLIGHT) for _ in range(count))
    told = sum(report.verdict == "changed" for _ in range(whole) for report in flown.fly(FLIGHT))
    return (
        f"## Online\n`make health-hours`, seed 11. Healthy flights of {FLIGHT // 60} min after {HISTORY} others; "
        "rotors, battery and load vary (1 %, 1 mm, 1 %: 1 sigma), thrust sags by 15 % an hour: "
        f"**{raised} false alarms in {count * FLIGHT / 3600.0:.0f} h** of the monitor, **{told} in "
        f"{whole * FLIGHT / 3600.0:.0f} h** of a whole session."
    )


def soon(each: int) -> list[str]:
    """Delays until losses of a rotor are named, as Markdown; `each`: of every size."""
    rng = np.random.default_rng(12)
    rows = [
        _row("watch", loss, each, lambda j, loss=loss: named(practised(rng), rng, j, loss))  # type: ignore[misc]
        for loss in (0.03, 0.05, 0.1, 0.2)
    ]
    session = Flown(rng)
    rows.append(_row("session", 0.1, each, lambda j: session.named(j, 0.1)))
    heads = ("loss of one rotor", "through", "named within 5 s", "rotor right", "median delay [s]")
    about = f"`make health-hours`, seed 12. A rotor loses thrust and drag torque after {ONSET} s."
    return ["### A loss in flight", about, "", *table(heads, rows)]


if __name__ == "__main__":
    parts = {"online": lambda g: quiet(g.hours, g.session), "losses": lambda g: soon(g.each)}
    study(__doc__, "health.md", "Health: what changed in this vehicle", parts, hours=100.0, session=10.0, each=25)
