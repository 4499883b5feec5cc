"""The diagnosis of a flight while it lasts: now and then `quadid.diagnose` on the last minute, beside the fits.

It takes seconds of a processor, so the session does not wait for it: what it found is told once a fixed time of data
has passed, later only when it took longer than that.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

from quadid.checks.motion import ALLOWED
from quadid.chi_square import Z95
from quadid.data.rotor_signal import INERTIA_RATE
from quadid.effects import EFFECTS
from quadid.online.grid_buffer import COMPLETE, GridBuffer
from quadid.online.records import MOST_ERRORS, Job, JobReply, OnlineAlternative, OnlineDiagnosis, OnlineFinding
from quadid.vehicle import Vehicle

if TYPE_CHECKING:
    from quadid.diagnosis.result import Finding

DIAGNOSED_SECONDS = 60.0
"""Flight that a diagnosis looks at [s]."""
ANSWER_AFTER = 30.0
"""Time of the data between question and published answer [s]."""


@dataclass(frozen=True)
class DiagnosisReply(JobReply):
    """Answer, or why there is none.

    Attributes:
        findings: most important first.
        verdict: of `quadid.diagnose`.
    """

    findings: tuple[OnlineFinding, ...] = ()
    verdict: str = ""


@dataclass(frozen=True)
class DiagnosisRequest(Job):
    """The last minute, to be diagnosed.

    Attributes:
        seed: of what is drawn.
        slow: rotors were read too slowly to show lags and delays.
    """

    background: ClassVar[bool] = True
    reply = DiagnosisReply

    seed: int
    slow: bool = False

    def answer(self) -> DiagnosisReply:
        """Diagnoses the windows."""
        from quadid.diagnosis import diagnose  # a large import that only the process which diagnoses needs

        result, _ = diagnose(self.windows, self.vehicle, seed=self.seed, swarm=True)
        findings = tuple(_online(f, self.slow) for f in result.findings)
        return DiagnosisReply(self.number, "", findings, result.verdict.value)


def _online(f: Finding, slow: bool) -> OnlineFinding:
    sure = f.confident and not (slow and EFFECTS[f.effect].needs_fast_rotors)
    return OnlineFinding(
        f.effect,
        {p.name: p.value for p in f.parameters},
        {p.name: (p.ci95[1] - p.ci95[0]) / (2.0 * Z95) for p in f.parameters},
        {p.name: p.unit for p in f.parameters},
        f.gain.mse_before,
        f.gain.mse_after,
        f.p_value,
        tuple(OnlineAlternative(a.effect, a.mse_after) for a in f.alternatives),
        f.evidence,
        sure,
    )


class BackgroundDiagnosis:
    """Asks for diagnoses of one vehicle, and reports what is new in their answers.

    Attributes:
        wrong_scale: a sensor's scale by the last answer, if too large for calibrated ones; else empty.
    """

    def __init__(
        self, vehicle: Vehicle, store: GridBuffer, every: float, seed: int, stamp: Callable[[float], float]
    ) -> None:
        """Studies the rows of `store` every so many seconds of flight [s]; 0: never; `stamp` as of `Outbox`."""
        self._vehicle, self._store, self._every, self._seed, self._stamp = vehicle, store, every, seed, stamp
        self.wrong_scale = ""
        self._asked: DiagnosisRequest | None = None
        self._reply: DiagnosisReply | None = None
        self._last, self._errors = -math.inf, 0
        self._told: DiagnosisReply | None = None

    def ask(self, number: int, tick: float, since: float) -> DiagnosisRequest | None:
        """The next question, if it is time for one.

        Args:
            tick: now [s].
            since: data before this belong to another vehicle [s].
        """
        start = max(tick - DIAGNOSED_SECONDS, since)
        early = tick - self._last < self._every or tick - start < DIAGNOSED_SECONDS
        if not self._every or self._asked is not None or early or self._errors >= MOST_ERRORS:
            return None
        cut = self._store.cut(start, tick)
        if cut.reason or cut.seconds < COMPLETE * (tick - start):
            return None
        self._last = tick
        slow = any(cut.spacing * window.dt > 1.0 / INERTIA_RATE for window in cut.windows)
        self._asked = DiagnosisRequest(number, self._vehicle, cut.windows, start, tick, self._seed, slow)
        return self._asked

    def deliver(self, reply: JobReply) -> None:
        """Takes the answer to the running question; an answer to any other is ignored."""
        if self._asked is not None and self._asked.is_answered_by(reply) and isinstance(reply, DiagnosisReply):
            self._reply = reply

    def answer(self, tick: float, since: float) -> OnlineDiagnosis | None:
        """Part of an answer to publish, when it is time to use it; None where it was published before.

        Args:
            tick: now [s].
            since: an answer about data from before this is no longer true [s].
        """
        asked, reply = self._asked, self._reply
        if asked is None or reply is None or tick < asked.stop + ANSWER_AFTER:
            return None
        self._asked = self._reply = None
        self._errors = self._errors + 1 if reply.is_unexpected else 0
        if asked.start < since:
            return None
        self.wrong_scale = next((f.evidence for f in reply.findings if f.confident and _is_wrong_scale(f)), "")
        if reply.problem or (self._told is not None and _same(self._told, reply)):
            return None
        self._told, stop = reply, self._stamp(asked.stop)
        return OnlineDiagnosis(
            stop, self._stamp(asked.start), stop, tuple(map(self._stamped, reply.findings)), reply.verdict
        )

    def _stamped(self, finding: OnlineFinding) -> OnlineFinding:
        if "time" not in finding.values:
            return finding
        return replace(finding, values={**finding.values, "time": self._stamp(finding.values["time"])})


def _is_wrong_scale(finding: OnlineFinding) -> bool:
    return finding.effect == "gyro_scale" and max(map(abs, finding.values.values()), default=0.0) > ALLOWED


def _same(old: DiagnosisReply, new: DiagnosisReply) -> bool:
    """No news: the same verdict and causes, and no number outside the interval reported before."""
    if old.verdict != new.verdict or [f.effect for f in old.findings] != [f.effect for f in new.findings]:
        return False
    return all(
        abs(b.values.get(name, math.inf) - value) <= Z95 * a.sigma.get(name, 0.0)
        for a, b in zip(old.findings, new.findings, strict=True)
        for name, value in a.values.items()
    )
