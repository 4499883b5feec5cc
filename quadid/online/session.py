"""The online session of one vehicle: messages and commands in, actions out; the same input gives the same output.

    push(messages)          buffer them
    poll() -> actions       every tick of the data's own time, in order:
        compare the sensors with each other     -> while they disagree, nothing is learned
        look for sudden changes                 -> ChangeRequest, OnlineDiagnosis
        compare with healthy flights            -> HealthReport, HealthyFlight
        diagnose the last minute, now and then  -> DiagnosisRequest, OnlineDiagnosis; nothing waits for it
        cut a window, judge its quality         -> what is missing, not flying, broken
        FitRequest                              -> the next tick waits until `deliver` brings the reply
        fuse, ask the gate                      -> Publish(candidate), Publish(parameters)

Data are read on while a fit runs, but the next tick waits for its reply: nothing depends on how long it takes.  A live
session has limited `patience`: where the machine is too slow, whoever drives it calls `go_on`, and ticks go on without
the reply and look for changes; it counts when it comes, and no further fit begins until then.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

from pydantic import BaseModel, ConfigDict, Field

from quadid.condition.trim import FlightTrim
from quadid.condition.watch import HealthWatch
from quadid.data.window import Block
from quadid.online.change_job import (
    DIAGNOSED_SECONDS,
    PULL,
    BackgroundDiagnosis,
    ChangeReply,
    ChangeRequest,
    ChangeWatch,
)
from quadid.online.changes import BASELINE, LEAST, ChangePoint
from quadid.online.checks import LEAD, Consistency, Quality, judge, mistake
from quadid.online.fit_job import FitReply, FitRequest, is_excited
from quadid.online.fusion import Estimator
from quadid.online.gate import ActiveSet, Answer, GateSettings, decide, implausible
from quadid.online.grid_buffer import GridBuffer, Rows, WindowCut
from quadid.online.records import (
    MOST_ERRORS,
    Action,
    HealthyFlight,
    Job,
    JobReply,
    OnlineDiagnosis,
    OnlineFinding,
    OnlineSet,
    Outbox,
    Phase,
    Publish,
    SessionStatus,
    SetState,
    unexpected,
)
from quadid.online.stream import BLOCK, LEADER, SETTLE, Resampler
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle

WARM_UP = 0.22
"""Flight before a window in which filters and delays settle [s]."""
STARTING = 3.0
"""Time from the begin of a stream [s] in which channels may still come, once the vehicle sends what was asked."""
LIFT_OFF = 5.0
"""Longest time from when rotors begin to carry until nothing else does [s]: autopilots ramp thrust up over 3 s."""
FOUND_AFTER = 3.0
"""An answer that takes long is used so long after it was asked for [s], so that a replay does what was done live."""
_EPS = 1e-6


class SessionSettings(BaseModel):
    """Settings of a session: what is learned, from how much data, and how cautiously it is published.

    Attributes:
        rate: grid rate [Hz].
        window: flight time that one fit looks at [s].
        refit: time between fits [s].
        memory: time constant of forgetting [s] of excited flight; hover does not make a session forget.
        diagnose: time between two diagnoses of the last minute [s]; 0: never. Sudden changes are looked for anyway.
        seed: decides every random number.
        gate: what an estimate must pass.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    rate: float = Field(default=50.0, ge=20.0, le=400.0)
    window: float = Field(default=10.0, ge=4.0, le=60.0)
    refit: float = Field(default=1.0, ge=0.5, le=60.0)
    memory: float = Field(default=120.0, ge=20.0)
    diagnose: float = Field(default=60.0, ge=0.0, le=3600.0)
    seed: int = Field(default=0, ge=0)
    gate: GateSettings = GateSettings()


class Session:
    """Session of one vehicle.

    Attributes:
        resampler: the samples; its `counts`, `last` and `faults` tell what arrives.
        active_set: which set is in force.
        settings: as given.
        skipped: fits that were due and left out, as the machine was too slow.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        settings: SessionSettings | None = None,
        restored: OnlineSet | None = None,
        next_sequence: int = 1,
        baseline: OnlineSet | None = None,
        healthy: Sequence[FlightTrim] = (),
        load: float = 1.0,
        patience: float = math.inf,
    ) -> None:
        """Starts a session.

        Args:
            vehicle: geometry, mass, first guess.
            settings: default `SessionSettings()`.
            restored: last accepted set of an earlier run; in force, but stale, until this flight confirms it.
            next_sequence: first number not yet given to a set.
            baseline: set from which creeping is measured; default `restored`.
            healthy: trims of the vehicle's healthy flights, the oldest first.
            load: mass over that of the vehicle file, as changes in earlier flights left it.
            patience: a fit that is due so much behind the newest data [s] is left out; the next one takes its rows.
        """
        self.settings = settings or SessionSettings()
        self.resampler = Resampler(vehicle, self.settings.rate)
        self.active_set = ActiveSet(self.settings.gate.approval, restored, next_sequence, baseline, load)
        self._vehicle, self._outbox = vehicle, Outbox(self.resampler.time.stamp)
        studied = DIAGNOSED_SECONDS if self.settings.diagnose else 0.0
        self._rows = GridBuffer(self.settings.rate, max(self.settings.window, studied, BASELINE) + 10.0)
        self._consistency = Consistency()
        self._changes = ChangeWatch(vehicle, self._rows)
        self._health, self._health_until = HealthWatch(vehicle, healthy), math.nan
        self._diagnosis = BackgroundDiagnosis(
            vehicle, self._rows, self.settings.diagnose, self.settings.seed, self._outbox.stamp
        )
        self._estimator = Estimator(vehicle, self.settings.memory, self.settings.window, self.settings.seed)
        # The walk: data read up to `_now` [s], the next tick [s], rows of a new stretch that wait as a tick does.
        self._now, self._tick_at = -math.inf, math.nan
        self._next: Rows | None = None
        # Jobs: the one whose reply is waited for, that reply, whether ticks go on without; a long fit, whose reply is
        # waited for when it is due, and that reply; replies up to `_outdated` are ignored.
        self._waiting: Job | None = None
        self._reply: JobReply | None = None
        self._overdue, self._patience = False, patience
        self._search: FitRequest | None = None
        self._found: JobReply | None = None
        self._number = self._outdated = self.skipped = 0
        # Learning: nothing before `_learn_from` [s] counts; since when [s] windows have disagreed with the estimate;
        # when the rotors last did not carry [s].
        self._learn_from, self._disagrees_since = -math.inf, math.inf
        self._cut, self._quality, self._grounded = WindowCut((), 0.0, 0), Quality(), -math.inf
        self._last_fit, self._asked_now = -math.inf, False
        self._fits = self._rejected = self._errors = 0
        if self.active_set.in_force is not None:
            self._estimator.start_from(self.active_set.in_force)
            self._outbox.act(Publish("parameters", self.active_set.in_force))

    # --- input

    def push(self, messages: Block) -> None:
        """Takes messages: stamps [s], channels in core units and frames; their portions change nothing."""
        self.resampler.push(messages)
        for channel, text in self.resampler.notices:
            if channel == LEADER:
                self._outbox.note(self.resampler.time.newest, Phase.BLOCKED, text)
            else:
                self._outbox.say(self.resampler.time.newest, "warning", "clock", text)
        self.resampler.notices.clear()

    def deliver(self, reply: JobReply) -> None:
        """Takes the answer to a running job; an answer to any other is ignored."""
        if self._waiting is not None and reply.number == self._waiting.number:
            self._reply = reply
        elif self._search is not None and reply.number == self._search.number:
            self._found = reply
        else:
            self._diagnosis.deliver(reply)

    def go_on(self) -> None:
        """Waits no longer for a fit, whose reply is taken when it comes."""
        self._overdue |= isinstance(self._waiting, FitRequest)

    def approve(self, by: str, sequence: int | None = None) -> Answer:
        """A person approves the set that waits."""
        answer = self.active_set.approve(self._outbox.stamp(self._now), by, sequence)
        self._outbox.act(*answer.actions)
        return answer

    def roll_back(self, by: str) -> Answer:
        """A person takes the set in force back; from then on sets wait for approval."""
        answer = self.active_set.roll_back(self._outbox.stamp(self._now), by)
        if answer.done:
            self._outdated = self._number
            self._changes.restart()
            self._relearn(self._now, f"rolled back by {by}")
            self._outbox.act(*answer.actions)
        return answer

    def fit_now(self) -> Answer:
        """Fits what there is at the next tick, without waiting for a full window, whatever failed before."""
        self._asked_now, self._errors = True, 0
        return Answer(True, "a fit follows at the next tick of the data")

    # --- output

    @property
    def running(self) -> Job | None:
        """The job whose reply the session waits for, or will."""
        return self._waiting or (self._search if self._found is None else None)

    @property
    def waits(self) -> bool:
        """True while the next tick has to wait for the reply to a job."""
        return self._waiting is not None and not self._overdue

    @property
    def backlog(self) -> float:
        """Data that have arrived and were not worked through yet [s]."""
        return max(self.resampler.time.newest - self._now, 0.0) if math.isfinite(self._now) else 0.0

    def poll(self) -> list[Action]:
        """Works through what has arrived and returns what to do, in order."""
        going_on = True
        while going_on:
            try:
                going_on = self._work()
            except Exception as error:  # noqa: BLE001 - whatever it is, the flight goes on, and it is told
                self._fail(self._now, unexpected(error))
        return self._outbox.take()

    def status(self) -> SessionStatus:
        """Status of the session now."""
        newest, active_set = self.resampler.time.newest, self.active_set
        window, cut = self._estimator.fusion.newest, self._cut
        force, pending = active_set.in_force, active_set.pending
        return SessionStatus(
            t=self._outbox.stamp(newest),
            phase=Phase.FITTING if self.running is not None else self._outbox.phase,
            reason=self._outbox.reason,
            excitation=self._estimator.excitation,
            samples=sum(len(w) for w in cut.windows),
            window_seconds=cut.seconds,
            gaps=cut.gaps,
            mse=window.mse if window is not None else math.nan,
            fits=self._fits,
            rejected=self._rejected,
            in_force=force.sequence if force else 0,
            pending=pending.sequence if pending else 0,
            stale=force is not None and force.state is SetState.STALE,
            approval=active_set.approval,
            faults=dict(self.resampler.faults),
            backlog=self.backlog,
            skipped=self.skipped,
        )

    # --- the walk of the data

    @property
    def _tick(self) -> float:
        return min(self.settings.refit, 1.0)

    def _work(self) -> bool:
        """Works on the next reply, tick or block of rows; returns False where there is none, or it has to wait."""
        # 1. A reply, as soon as it is there.
        if self._reply is not None:
            self._apply()
            return True
        # 2. Rows, until a tick is due.
        tick_due = self._now >= self._tick_at - _EPS
        if not tick_due and self._next is None:
            self._next = self.resampler.next_rows()
            if self._next is None:
                return False
        # 3. A tick, or the begin of a stretch, once no reply has to come before.
        if self.waits and (tick_due or (self._next is not None and self._next.fresh)):
            return False
        if tick_due:
            tick, self._tick_at = self._tick_at, self._tick_at + self._tick
            self._at(tick)
        elif self._next is not None:
            rows, self._next = self._next, None
            self._take(rows)
        return True

    def _take(self, rows: Rows) -> None:
        if rows.fresh:
            first = float(rows.t[0])
            self._tick_at = math.floor(first / self._tick + 1.0) * self._tick
        if rows.new_clock:
            self._learn_only_from(first)
            self._consistency.restart()
            self._changes.restart()
            self._outbox.say(first, "info", "stream", "a stream of data begins")
        self._rows.add(rows)
        self._now = float(rows.t[-1]) + 1.0 / self.settings.rate

    def _at(self, tick: float) -> None:
        """One tick: first look for sudden changes; then a fit."""
        self._consistency.add(self._rows.span(tick - self._tick - LEAD - _EPS, tick - _EPS), self._tick)
        if self._consistency.fault:
            self._distrust(tick)
            return
        seen = self._changes.look(tick, self._tick, self._estimator)
        if seen is not None:
            self._outbox.state(Phase.CANDIDATE, f"a change of {seen.channel} is being looked into")
            what = f"{seen.channel} stepped by {seen.size:+.1%} at {self._outbox.stamp(seen.time):.2f} s"
            self._outbox.say(tick, "warning", "change", f"{what} ({seen.errors:.0f} standard errors)")
        if not tick - self._health_until < 1.0 - _EPS:
            self._health_until = tick
            self._compare_with_healthy_flights(tick)
        self._diagnose(tick)
        if self._changes.seen is not None:
            self._explain_change(tick)
        elif (search := self._search) is not None:
            if tick >= search.stop + FOUND_AFTER - _EPS:
                found, self._search, self._found = self._found, None, None
                self._wait_for(search, found)
        elif self._asked_now or (self._errors < MOST_ERRORS and tick - self._last_fit >= self.settings.refit - _EPS):
            behind = self.resampler.time.newest - tick - SETTLE - BLOCK / self.settings.rate
            if self._waiting is not None or behind > self._patience:
                self.skipped += 1
            else:
                self._fit(tick)

    def _distrust(self, tick: float) -> None:
        """The sensors disagree: nothing is learned until they do not, and what was learned is forgotten."""
        # A unit, frame or motor order that is wrong has a name; which two channels it sets apart is less of a help.
        cut = self._rows.cut(tick - self.settings.window - _EPS, tick - _EPS)
        why = mistake(cut, self._vehicle, known=False) or self._consistency.fault
        if self._estimator.learned:
            self._relearn(tick, "sensors disagree")
        self._learn_only_from(tick)
        self._outbox.note(tick, Phase.BLOCKED, why)
        self._changes.restart()

    def _compare_with_healthy_flights(self, tick: float) -> None:
        rows = self._rows.span(tick - 1.0, tick)
        if rows is None or "rotor_speed" not in rows.columns:
            return
        found = self._health.look(tick, rows.columns["rotor_speed"], rows.columns.get("accel"))
        if isinstance(found, FlightTrim):
            self._outbox.act(HealthyFlight(self._outbox.stamp(tick), found))
        elif found is not None:
            self._outbox.act(replace(found, t=self._outbox.stamp(tick)))
            if found.verdict == "changed":
                self._outbox.say(tick, "warning", "health", found.text)
            elif not found.has_baseline:
                self._outbox.say(tick, "info", "health", found.text)

    def _diagnose(self, tick: float) -> None:
        """Publishes what a diagnosis brought, and asks for the next one when the vehicle is known and moves."""
        estimator = self._estimator
        told = self._diagnosis.answer(tick, self._learn_from)
        if told is not None:
            self._outbox.act(told)
        moving = estimator.learned and is_excited(estimator.excitation) and self._waiting is None
        if moving and self._changes.seen is None and self._quality == Quality():
            request = self._diagnosis.ask(self._number + 1, tick, max(self._learn_from, estimator.start))
            if request is not None:
                self._number = request.number
                self._outbox.act(request)

    def _explain_change(self, tick: float) -> None:
        """Asks what a change was, once there are data enough after it; answers where a fit could say nothing."""
        assert self._changes.seen is not None
        stamp = self._outbox.stamp(self._changes.seen.time)
        request = self._changes.ask(self._number + 1, tick, self._estimator, stamp)
        if request is None:
            return
        self._number, self._search = request.number, None
        self._wait_for(request)
        if not request.windows:
            self._reply = request.failed("too little data after the change")
        else:
            self._outbox.act(request)

    def _wait_for(self, request: Job, reply: JobReply | None = None) -> None:
        self._waiting, self._reply, self._overdue = request, reply, False

    def _fit(self, tick: float) -> None:
        """Cuts the window before `tick` [s], judges it, and asks for its fit; or reports why there is none."""
        wanted = self.settings.window
        if self._asked_now:
            self._asked_now, wanted = False, min(4.0, wanted)  # what a person asked for needs less
        start = max(tick - self.settings.window - WARM_UP, self._learn_from)
        cut = self._cut = self._rows.cut(start - _EPS, tick - _EPS)
        if cut.blocked and tick - start >= STARTING:
            self._outbox.note(tick, Phase.BLOCKED, cut.reason)
            return
        if cut.blocked:
            self._outbox.state(Phase.COLLECTING, cut.reason)
            return
        if cut.reason or tick - start < wanted - 0.5:
            have = f"{max(tick - start, 0.0):.0f} of {self.settings.window:g} s of flight"
            self._outbox.state(Phase.COLLECTING, f"{have}; {cut.reason or 'no gaps'}")
            return
        estimator = self._estimator
        self._quality = judge(cut, self._vehicle, estimator.thrust, estimator.in_order, units=not estimator.learned)
        if self._quality != Quality():
            self._grounded = max(self._grounded, self._quality.until)
            phase = Phase.BLOCKED if self._quality.fault else Phase.NOT_FLYING
            self._outbox.note(tick, phase, self._quality.fault or self._quality.grounded)
            return
        if start < self._grounded + LIFT_OFF:
            self._outbox.state(Phase.COLLECTING, f"the rotors have carried for {tick - self._grounded:.0f} s only")
            return
        self._last_fit = tick
        start = max(start, tick - self.settings.window)
        request = self._estimator.request(self._number + 1, cut, start, tick, self._rows)
        self._number = request.number
        if request.is_long:
            self._search, self._found = request, None
        else:
            self._wait_for(request)
        self._outbox.act(request)

    # --- what replies bring

    def _apply(self) -> None:
        request, reply = self._waiting, self._reply
        self._waiting = self._reply = None
        if request is None or request.number <= self._outdated or not request.is_answered_by(reply):
            return
        if isinstance(request, FitRequest) and (
            self._changes.seen is not None or request.start < self._learn_from - _EPS
        ):
            return  # a late one, of a time before what has happened since
        if reply.is_unexpected:
            self._fail(request.stop, reply.problem)
            return
        self._errors = 0
        if isinstance(request, FitRequest) and isinstance(reply, FitReply):
            self._fitted(request, reply)
        elif isinstance(request, ChangeRequest) and isinstance(reply, ChangeReply):
            self._changes.restart()
            # Where it may be the mass, the sets after it wait for a person.
            self.active_set.load *= mass_factor(request.change, reply.finding)
            text = reply.finding.evidence if reply.finding is not None else f"cause unknown: {reply.problem}"
            span = request.start, request.stop
            self._has_changed(span, "finding", text, "unknown_cause", request.start + 0.1, reply.finding)

    def _fitted(self, request: FitRequest, reply: FitReply) -> None:
        """Takes in the fit of a window: fuse it, watch the set in force, ask the gate."""
        outbox, estimator = self._outbox, self._estimator
        if reply.problem:
            outbox.note(request.stop, Phase.FAILED, reply.problem)
            return
        if reply.fault:
            self._quality, self._last_fit = Quality(reply.fault), -math.inf
            outbox.note(request.stop, Phase.BLOCKED, reply.fault)
            return
        if not reply.estimates:
            estimator.take(request, reply)
            assert reply.excitation is not None
            worst = sorted(zip(reply.excitation, NOMINAL_NAMES, strict=True), reverse=True)[:3]
            known = ", ".join(f"{name} only to {min(bound, 99.0):.0%}" for bound, name in worst)
            outbox.note(request.stop, Phase.NOT_EXCITED, f"roll and pitch move too little: {known}")
            return
        self._fits += 1
        if not reply.finite:
            # Information adds up: one such window would spoil every estimate after it.
            outbox.note(request.stop, Phase.FAILED, "the fit of the newest window gave no numbers")
            return
        if not estimator.agrees(request, reply):
            # It is left out; when one without a common sample disagrees too, the vehicle has changed.
            since = self._disagrees_since = min(self._disagrees_since, request.stop)
            outbox.state(Phase.CANDIDATE, "the newest window disagrees with what was known: held back")
            if request.start < since - _EPS:
                return
            text = "windows disagree with the earlier estimate for the length of a window"
            if estimator.confirmed:
                span = since, request.stop
                self._has_changed(span, "change", f"{text}: learning restarts", "disagreement", request.start)
            else:  # what nothing had confirmed was wrong itself
                self._relearn(request.start, text)
            return
        self._disagrees_since = math.inf
        estimator.take(request, reply)
        if request.noise is None and reply.noise is not None and reply.noise.late > 0.0:
            late = f"gyro and accelerometer come {1e3 * reply.noise.late:.0f} ms after the attitude"
            outbox.say(request.stop, "info", "sensors", f"{late}, as behind a low-pass: fits undo that")
        # The set in force is taken back when its predecessor predicts new windows better.
        sets, told = self.active_set, estimator.fusion.disjoint(1)
        if sets.predecessor is not None and told:
            new = told[0]
            loss = estimator.deviance(new, sets.in_force) - estimator.deviance(new, sets.predecessor)
            if sets.watch(new.start, new.stop, loss) and sets.watched > self.settings.gate.watch:
                why = f"it predicts new windows worse than its predecessor (deviance {sets.watched:.0f})"
                outbox.act(*sets.roll_back(outbox.stamp(new.stop), "auto", why).actions)
                self._relearn(new.stop, "a set was taken back")
                return
        self._judge(request, reply)

    def _judge(self, request: FitRequest, reply: FitReply) -> None:
        """Asks the gate, and publishes, holds or refuses the estimate."""
        sets, outbox, estimator = self.active_set, self._outbox, self._estimator
        parameters = estimator.parameters(self.settings.gate.yaw_width)
        if parameters is None:
            outbox.state(Phase.CANDIDATE, "thrust is known no better than by the vehicle file: keep flying")
            return
        scale, mass, loaded = self._diagnosis.wrong_scale, estimator.vehicle.mass, ""
        if abs(math.log(sets.load)) > LEAST:
            changed = f"the mass changed by about {sets.load - 1.0:+.0%} in flight, judged by its thrust"
            loaded = f"{changed}; b and the inertias of this set rest on {mass:g} kg"
        case = replace(
            estimator.case(parameters, request, reply, sets, self.settings.gate.windows),
            unexplained=f"the diagnosis is in force: {scale}" if scale else "",
            doubts=self._consistency.doubts(),
            loaded=loaded,
        )
        decision = decide(case, self.settings.gate)
        mse, unseen = estimator.scores()
        stop, (reference, spread) = outbox.stamp(request.stop), sets.reference(estimator.stated)
        item = OnlineSet(
            0, decision.state, decision.reason, parameters.scaled_together(spread), outbox.stamp(estimator.start), stop,
            estimator.rows, mse, unseen, estimator.input_hash, check=decision.check, mass=mass, reference=reference,
            reference_sd=spread,
        )  # fmt: skip
        if decision.state is SetState.ACCEPTED:
            outbox.act(*sets.accept(item, "auto", stop, request.stop))
            item = sets.in_force or item
        elif decision.state is SetState.PENDING:
            item = sets.hold(item, request.stop)
        else:
            self._rejected += 1
        outbox.act(Publish("candidate", item))
        if impossible := implausible(parameters, self.settings.gate):
            # No vehicle is like that: something else was learned, which would spoil what comes.
            estimator.reset()
            self._relearn(request.stop, impossible)
            return
        force, waiting = sets.in_force, sets.pending
        if waiting is not None and decision.state is SetState.REJECTED:
            kept = f"set {waiting.sequence} waits for approval; a newer estimate was held back ({decision.check})"
            outbox.state(Phase.PENDING, kept)
            return
        known = force is not None and force.state is not SetState.STALE
        phase = Phase.PENDING if waiting is not None else Phase.ACCEPTED if known else Phase.CANDIDATE
        outbox.state(phase, f"{decision.check}: {decision.reason}")

    # --- what is learned no longer

    def _learn_only_from(self, t: float) -> None:
        """Nothing before `t` [s] is learned from."""
        self._learn_from, self._disagrees_since = max(self._learn_from, t), math.inf

    def _relearn(self, start: float, why: str) -> None:
        """Forgets what was learned; learns from `start` [s] on."""
        self._estimator.forget()
        self._search = None
        self._learn_only_from(start)
        self.active_set.drop_pending()
        self._outbox.state(Phase.COLLECTING, f"{why}: learning restarts")

    def _has_changed(
        self,
        span: tuple[float, float],
        kind: str,
        text: str,
        unexplained: str,
        learn_from: float,
        finding: OnlineFinding | None = None,
    ) -> None:
        """Publishes what happened within `span` [s]; the set in force is out of date, learning begins anew."""
        since, until = map(self._outbox.stamp, span)
        explained = finding is not None and finding.confident
        code = finding.effect if finding is not None and explained else unexplained
        found = (finding,) if finding is not None else ()
        self._outbox.act(OnlineDiagnosis(until, since, until, found, "explained" if explained else "unknown"))
        self._outbox.say(span[1], "warning", kind, text)
        self._outbox.act(*self.active_set.withdraw(text, code))
        self._relearn(learn_from, "the vehicle has changed")

    def _fail(self, t: float, problem: str) -> None:
        """After an unforeseen error at `t` [s]: what was learned may be its cause and is forgotten."""
        self._errors += 1
        left = MOST_ERRORS - self._errors
        what = "learning restarts" if left > 0 else f"{MOST_ERRORS} in a row: no more fits until fit_now or a restart"
        self._changes.restart()
        self._consistency.restart()
        self._estimator.reset()
        self._relearn(t, "an unexpected error")
        if left >= 0:
            self._outbox.say(t, "error", "unexpected", f"{problem}; {what}")
        self._outbox.state(Phase.FAILED, f"{problem}; {what}")


def mass_factor(change: ChangePoint, finding: OnlineFinding | None) -> float:
    """Factor on the mass that a change may be."""
    if finding is not None and finding.effect == "mass_change":
        return max(1.0 + finding.values["fraction"], LEAST)
    sure = finding is not None and finding.confident and finding.effect != PULL
    return 1.0 if sure or change.channel != "thrust" else math.exp(-change.size)
