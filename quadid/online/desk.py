"""Where replies land: fuse a fit, ask the gate, watch the set in force, learn anew after a change."""

from __future__ import annotations

import math
from collections.abc import Iterator

from quadid.online.changes import ChangeReply, ChangeRequest
from quadid.online.fitting import FitReply, FitRequest
from quadid.online.gate import GateSettings, decide
from quadid.online.learner import Learner
from quadid.online.ledger import Ledger
from quadid.online.quality import Quality
from quadid.online.records import Diagnosed, OnlineSet, Phase, Publish, SetState
from quadid.online.voice import Voice
from quadid.parameters import NOMINAL_NAMES

_EPS = 1e-6


class Desk:
    """Judges what the fits bring.

    Attributes:
        learn_from: nothing before this time is learned from [s].
        quality: of the newest window.
        fits, rejected: fits done, and those the gate refused.
    """

    def __init__(self, learner: Learner, ledger: Ledger, voice: Voice, gate: GateSettings) -> None:
        """Works on the estimate of `learner` and the sets of `ledger`, speaks through `voice`."""
        self._learner, self._ledger, self._voice, self._gate = learner, ledger, voice, gate
        self.learn_from = -math.inf
        self.quality = Quality()
        self.fits = self.rejected = 0
        self._odd_since: float | None = None

    def interrupted(self, t: float) -> None:
        """The stream begins anew at `t` [s]."""
        self.learn_from, self._odd_since = max(self.learn_from, t), None

    def relearn(self, start: float, why: str) -> None:
        """Forgets what was learned; learns from `start` [s] on."""
        self._learner.forget()
        self.interrupted(start)
        self._ledger.drop_pending()
        self._voice.state(Phase.COLLECTING, f"{why}: learning anew")

    def changed(self, request: ChangeRequest, reply: ChangeReply) -> None:
        """Publishes what a sudden change was."""
        voice, finding = self._voice, reply.finding
        verdict = "explained" if finding is not None and finding.confident else "unknown"
        start, stop = voice.stamp(request.start), voice.stamp(request.stop)
        voice.act(Diagnosed(stop, start, stop, (finding,) if finding is not None else (), verdict))
        text = finding.evidence if finding is not None else f"cause unknown: {reply.problem}"
        voice.say(request.stop, "warning", "finding", text)
        self.relearn(request.start + 0.1, "the vehicle has changed")

    def fitted(self, request: FitRequest, reply: FitReply) -> Iterator[None]:
        """Takes in the fit of a window, piece by piece."""
        if reply.problem:
            self._voice.note(request.stop, Phase.FAILED, reply.problem)
            return
        if reply.estimate is None:
            self._learner.take(reply, trusted=False)
            why = f"roll and pitch move too little: {_unrevealed(reply)}"
            self._voice.note(request.stop, Phase.NOT_EXCITED, why)
            return
        self.fits += 1
        if not reply.estimate.finite:
            # Information adds up: one such window would spoil every estimate after it.
            self._voice.note(request.stop, Phase.FAILED, "the fit of the newest window gave values that are no numbers")
            return
        if not self._learner.fusion.judge(reply.estimate).agrees:
            self._odd(request)
            return
        self._odd_since = None
        self._learner.take(reply, trusted=True)
        yield
        if not self._taken_back(reply):
            self._judge(request, reply)

    def _odd(self, request: FitRequest) -> None:
        """Leaves out a window that disagrees; when one without a common sample does too, the vehicle has changed."""
        if self._odd_since is None:
            self._odd_since = request.stop
        self._voice.state(Phase.CANDIDATE, "the newest window disagrees with what was known: held back")
        if request.start < self._odd_since - _EPS:
            return
        start, stop = self._voice.stamp(self._odd_since), self._voice.stamp(request.stop)
        self._voice.act(Diagnosed(stop, start, stop, (), "unknown"))
        text = "windows disagree with what was known, for as long as a window: learning anew"
        self._voice.say(request.stop, "warning", "change", text)
        self.relearn(request.start, "the vehicle has changed")

    def _taken_back(self, reply: FitReply) -> bool:
        """Watches the set in force; rolls it back when its predecessor predicts new windows better."""
        estimate, ledger = reply.estimate, self._ledger
        if estimate is None or ledger.predecessor is None:
            return False
        loss = self._learner.deviance(estimate, ledger.in_force) - self._learner.deviance(estimate, ledger.predecessor)
        if not ledger.watch(estimate.start, estimate.stop, loss) or ledger.watched <= self._gate.watch:
            return False
        why = f"it predicts new windows worse than its predecessor (deviance {ledger.watched:.0f})"
        self._voice.act(*ledger.roll_back(self._voice.stamp(estimate.stop), "auto", why).actions)
        self.relearn(estimate.stop, "a set was taken back")
        return True

    def _judge(self, request: FitRequest, reply: FitReply) -> None:
        parameters = self._learner.parameters()
        if parameters is None:
            return
        ledger, voice = self._ledger, self._voice
        case = self._learner.case(
            parameters, self.quality, reply, ledger.in_force, ledger.baseline, ledger.approval, self._gate.windows,
            ledger.seen,
        )  # fmt: skip
        decision = decide(case, self._gate)
        mse, unseen = self._learner.scores()
        stop = voice.stamp(request.stop)
        item = OnlineSet(
            0, decision.state, decision.reason, parameters, voice.stamp(self._learner.start), stop,
            self._learner.rows, mse, unseen, self._learner.input_hash, check=decision.check,
        )  # fmt: skip
        if decision.state is SetState.ACCEPTED:
            voice.act(*ledger.accept(item, "auto", stop, request.stop))
            item = ledger.in_force or item
        elif decision.state is SetState.PENDING:
            item = ledger.hold(item, request.stop)
        else:
            self.rejected += 1
        voice.act(Publish("candidate", item))
        voice.state(self._phase_of(decision.state), f"{decision.check}: {decision.reason}")

    def _phase_of(self, state: SetState) -> Phase:
        if state is SetState.PENDING or self._ledger.pending is not None:
            return Phase.PENDING
        force = self._ledger.in_force
        return Phase.ACCEPTED if force is not None and force.state is not SetState.STALE else Phase.CANDIDATE


def _unrevealed(reply: FitReply) -> str:
    assert reply.excitation is not None
    worst = sorted(zip(reply.excitation, NOMINAL_NAMES, strict=True), reverse=True)[:3]
    return ", ".join(f"{name} only to {min(bound, 99.0):.0%}" for bound, name in worst)
