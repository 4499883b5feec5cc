"""Where replies land: fuse a fit, ask the gate, watch the set in force, learn anew after a change."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from quadid.online.active_set import ActiveSet
from quadid.online.background_diagnosis import BackgroundDiagnosis
from quadid.online.change_detection import LEAST, ChangePoint
from quadid.online.checks import Consistency
from quadid.online.estimator import Estimator
from quadid.online.fault_isolation import PULL, ChangeReply, ChangeRequest
from quadid.online.fusion import WindowEstimate
from quadid.online.gate import GateSettings, decide
from quadid.online.records import OnlineDiagnosis, OnlineFinding, OnlineSet, Outbox, Phase, Publish, SetState
from quadid.online.window_fit import FitReply, FitRequest
from quadid.parameters import NOMINAL_NAMES

_EPS = 1e-6


class Supervisor:
    """Judges what the fits bring.

    Attributes:
        learn_from: nothing before this time is learned from [s].
        fits, rejected: fits done, and those the gate refused.
    """

    def __init__(
        self, estimator: Estimator, active_set: ActiveSet, outbox: Outbox, gate: GateSettings, consistency: Consistency,
        diagnosis: BackgroundDiagnosis,
    ) -> None:  # fmt: skip
        """Works on the estimate of `estimator` and the sets of `active_set`, speaks through `outbox`."""
        self._consistency, self._diagnosis = consistency, diagnosis
        self._estimator, self._active_set, self._outbox, self._gate = estimator, active_set, outbox, gate
        self.learn_from = -math.inf
        self.fits = self.rejected = 0
        self._disagrees_since: float | None = None

    def interrupted(self, t: float) -> None:
        """The stream begins anew at `t` [s]."""
        self.learn_from, self._disagrees_since = max(self.learn_from, t), None

    def distrust(self, t: float, why: str) -> None:
        """The sensors disagree at `t` [s]: nothing is learned until they do not, and what was learned is forgotten."""
        if self._estimator.learned:
            self.relearn(t, "sensors disagree")
        self.interrupted(t)
        self._outbox.note(t, Phase.BLOCKED, why)

    def relearn(self, start: float, why: str) -> None:
        """Forgets what was learned; learns from `start` [s] on."""
        self._estimator.forget()
        self.interrupted(start)
        self._active_set.drop_pending()
        self._outbox.state(Phase.COLLECTING, f"{why}: learning restarts")

    def changed(self, request: ChangeRequest, reply: ChangeReply) -> None:
        """Publishes what a sudden change was; where it may be the mass, the sets after it wait for a person."""
        finding = reply.finding
        self._active_set.load *= mass_factor(request.change, finding)
        text = finding.evidence if finding is not None else f"cause unknown: {reply.problem}"
        self._has_changed(request.start, request.stop, finding, "finding", text, request.start + 0.1, "unknown_cause")

    def _has_changed(
        self, start: float, stop: float, finding: OnlineFinding | None, kind: str, text: str, learn_from: float,
        unexplained: str,
    ) -> None:  # fmt: skip
        """Says what happened between `start` and `stop` [s]; the set in force is out of date, learning begins anew."""
        since, until = self._outbox.stamp(start), self._outbox.stamp(stop)
        explained = finding is not None and finding.confident
        code = finding.effect if finding is not None and explained else unexplained
        verdict = "explained" if explained else "unknown"
        self._outbox.act(OnlineDiagnosis(until, since, until, (finding,) if finding is not None else (), verdict))
        self._outbox.say(stop, "warning", kind, text)
        self._outbox.act(*self._active_set.withdraw(text, code))
        self.relearn(learn_from, "the vehicle has changed")

    def fitted(self, request: FitRequest, reply: FitReply) -> Iterator[None]:
        """Takes in the fit of a window, piece by piece."""
        if reply.problem:
            self._outbox.note(request.stop, Phase.FAILED, reply.problem)
            return
        if reply.estimate is None:
            self._estimator.take(request, reply)
            why = f"roll and pitch move too little: {_unrevealed(reply)}"
            self._outbox.note(request.stop, Phase.NOT_EXCITED, why)
            return
        self.fits += 1
        if not reply.estimate.finite:
            # Information adds up: one such window would spoil every estimate after it.
            self._outbox.note(request.stop, Phase.FAILED, "the fit of the newest window gave no numbers")
            return
        if reply.flexible and not self._estimator.flexible:
            self._join(request, reply)
        if not self._estimator.fusion.agrees(reply.estimate):
            self._leave_out(request)
            return
        self._disagrees_since = None
        self._estimator.take(request, reply)
        yield
        if not self._rolled_back(reply.estimate):
            self._judge(request, reply)

    def _join(self, request: FitRequest, reply: FitReply) -> None:
        """From now on effects are fitted along; what was learned without them is forgotten."""
        self._estimator.fit_along()
        self._disagrees_since = None
        share = f"{reply.lack.share:.0%} of what" if reply.lack is not None else "what"
        text = f"effects that the vehicle file lacks explain {share} its model misses: every one is fitted along"
        self._outbox.say(request.stop, "info", "model", text)

    def _leave_out(self, request: FitRequest) -> None:
        """Leaves out a window that disagrees; when one without a common sample does too, the vehicle has changed."""
        if self._disagrees_since is None:
            self._disagrees_since = request.stop
        self._outbox.state(Phase.CANDIDATE, "the newest window disagrees with what was known: held back")
        if request.start < self._disagrees_since - _EPS:
            return
        text = "windows disagree with the earlier estimate for the length of a window: learning restarts"
        self._has_changed(self._disagrees_since, request.stop, None, "change", text, request.start, "disagreement")

    def _rolled_back(self, estimate: WindowEstimate) -> bool:
        """Watches the set in force; rolls it back when its predecessor predicts new windows better."""
        active_set = self._active_set
        if active_set.predecessor is None:
            return False
        loss = self._estimator.deviance(estimate, active_set.in_force) - self._estimator.deviance(
            estimate, active_set.predecessor
        )
        if not active_set.watch(estimate.start, estimate.stop, loss) or active_set.watched <= self._gate.watch:
            return False
        why = f"it predicts new windows worse than its predecessor (deviance {active_set.watched:.0f})"
        self._outbox.act(*active_set.roll_back(self._outbox.stamp(estimate.stop), "auto", why).actions)
        self.relearn(estimate.stop, "a set was taken back")
        return True

    def _judge(self, request: FitRequest, reply: FitReply) -> None:
        parameters = self._estimator.parameters()
        if parameters is None:
            return
        active_set, outbox = self._active_set, self._outbox
        scale = self._diagnosis.wrong_scale
        case = replace(
            self._estimator.case(parameters, request, reply, active_set, self._gate.windows),
            unexplained=f"the diagnosis is in force: {scale}" if scale else "", doubts=self._consistency.doubts(),
            loaded=self._loaded,
        )  # fmt: skip
        decision = decide(case, self._gate)
        mse, unseen = self._estimator.scores()
        stop = outbox.stamp(request.stop)
        item = OnlineSet(
            0, decision.state, decision.reason, parameters, outbox.stamp(self._estimator.start), stop,
            self._estimator.rows, mse, unseen, self._estimator.input_hash, check=decision.check,
            mass=self._estimator.vehicle.mass, reference=active_set.reference(self._estimator.stated),
        )  # fmt: skip
        if decision.state is SetState.ACCEPTED:
            outbox.act(*active_set.accept(item, "auto", stop, request.stop))
            item = active_set.in_force or item
        elif decision.state is SetState.PENDING:
            item = active_set.hold(item, request.stop)
        else:
            self.rejected += 1
        outbox.act(Publish("candidate", item))
        said, waiting = f"{decision.check}: {decision.reason}", active_set.pending
        if waiting is not None and decision.state is SetState.REJECTED:
            said = f"set {waiting.sequence} waits for approval; a newer estimate was held back ({decision.check})"
        outbox.state(self._phase_of(decision.state), said)

    @property
    def _loaded(self) -> str:
        load, mass = self._active_set.load, self._estimator.vehicle.mass
        if abs(math.log(load)) <= LEAST:
            return ""
        changed = f"the mass changed by about {load - 1.0:+.0%} in flight, as far as the thrust tells"
        return f"{changed}; b and the inertias of this set rest on {mass:g} kg"

    def _phase_of(self, state: SetState) -> Phase:
        if state is SetState.PENDING or self._active_set.pending is not None:
            return Phase.PENDING
        force = self._active_set.in_force
        return Phase.ACCEPTED if force is not None and force.state is not SetState.STALE else Phase.CANDIDATE


def mass_factor(change: ChangePoint, finding: OnlineFinding | None) -> float:
    """Factor on the mass that a change may be."""
    if finding is not None and finding.effect == "mass_change":
        return max(1.0 + finding.values["fraction"], LEAST)
    sure = finding is not None and finding.confident and finding.effect != PULL
    return 1.0 if sure or change.channel != "thrust" else math.exp(-change.size)


def _unrevealed(reply: FitReply) -> str:
    assert reply.excitation is not None
    worst = sorted(zip(reply.excitation, NOMINAL_NAMES, strict=True), reverse=True)[:3]
    return ", ".join(f"{name} only to {min(bound, 99.0):.0%}" for bound, name in worst)
