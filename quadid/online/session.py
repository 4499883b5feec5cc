"""The online session of one vehicle: samples and commands in, actions out; the same input gives the same output.

    push(sample)            buffer it
    poll() -> actions       every tick of the data's own time, in order:
        watch for sudden changes                -> ChangeRequest, OnlineDiagnosis
        compare with healthy flights            -> HealthReport, HealthyFlight
        diagnose the last minute, now and then  -> DiagnosisRequest, OnlineDiagnosis; nothing waits for it
        cut a window, judge its quality         -> what is missing, not flying, broken
        FitRequest                              -> stops here until `deliver` brings the reply
        fuse, ask the gate                      -> Publish(candidate), Publish(parameters)

A session stands still while a fit runs and catches up afterwards, so that nothing depends on how long a fit takes.
Where the machine is too slow for that, whoever drives the session says so (`hurry`, `go_on`): then it goes on without
the reply, which is taken when it comes, no further fit begins until it has caught up, and changes are looked for.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from quadid.condition.trim import FlightTrim
from quadid.data.window import Block, Sample
from quadid.online.active_set import ActiveSet, Answer
from quadid.online.background_diagnosis import DIAGNOSED_SECONDS, BackgroundDiagnosis
from quadid.online.change_supervisor import ChangeSupervisor
from quadid.online.checks import LEAD, Consistency, Quality
from quadid.online.estimator import Estimator
from quadid.online.fault_isolation import ChangeReply, ChangeRequest
from quadid.online.grid_buffer import GridBuffer, Rows
from quadid.online.health_supervisor import HealthSupervisor
from quadid.online.records import (
    MOST_ERRORS,
    Action,
    Job,
    JobReply,
    OnlineSet,
    Outbox,
    Phase,
    Publish,
    SessionStatus,
    SetState,
    unexpected,
)
from quadid.online.settings import SessionSettings
from quadid.online.stream import LEADER, Resampler
from quadid.online.supervisor import Supervisor
from quadid.online.window_fit import FitReply, FitRequest, is_excited
from quadid.online.window_supervisor import WindowSupervisor
from quadid.vehicle import Vehicle

_EPS = 1e-6
_DONE = object()


class Session:
    """Session of one vehicle.

    Attributes:
        resampler: the samples; its `counts`, `last` and `faults` tell what arrives.
        active_set: which set is in force.
        settings: as given.
        skipped: fits that were due and left out in a hurry.
    """

    def __init__(
        self, vehicle: Vehicle, settings: SessionSettings | None = None, restored: OnlineSet | None = None,
        next_sequence: int = 1, baseline: OnlineSet | None = None, healthy: Sequence[FlightTrim] = (),
    ) -> None:  # fmt: skip
        """Starts a session.

        Args:
            vehicle: geometry, mass, first guess.
            settings: default `SessionSettings()`.
            restored: last accepted set of an earlier run; in force, but stale, until this flight confirms it.
            next_sequence: first number not yet given to a set.
            baseline: set from which creeping is measured; default `restored`.
            healthy: trims of the vehicle's healthy flights, the oldest first.
        """
        self.settings = settings or SessionSettings()
        self.resampler = Resampler(vehicle, self.settings.rate)
        self.active_set = ActiveSet(self.settings.gate.approval, restored, next_sequence, baseline)
        self._outbox = Outbox(self.resampler.time.stamp)
        studied = DIAGNOSED_SECONDS if self.settings.diagnose else 0.0
        self._store = GridBuffer(self.settings.rate, max(self.settings.window, studied) + 10.0)
        self._consistency = Consistency()
        self._change_supervisor = ChangeSupervisor(vehicle, self._store)
        self._health = HealthSupervisor(vehicle, self._store, self._outbox, healthy)
        self._diagnosis = BackgroundDiagnosis(
            vehicle, self._store, self.settings.diagnose, self.settings.seed, self._outbox.stamp
        )
        self._estimator = Estimator(vehicle, self.settings.memory, self.settings.seed)
        self._supervisor = Supervisor(
            self._estimator, self.active_set, self._outbox, self.settings.gate, self._consistency, self._diagnosis
        )
        self._windows = WindowSupervisor(vehicle, self._store, self.settings, self._outbox, self._supervisor)
        self._waiting: Job | None = None
        self._reply: JobReply | None = None
        self._late: Job | None = None
        self._hurried, self.skipped = False, 0
        self._outdated = 0
        self._now, self._tick_at = -math.inf, math.nan
        self._work: Iterator[None] | None = None
        self._number = 0
        if self.active_set.in_force is not None:
            self._estimator.start_from(self.active_set.in_force)
            self._outbox.act(Publish("parameters", self.active_set.in_force))

    # --- input

    def push(self, messages: Block | Sample) -> None:
        """Takes messages: stamps [s], channels in core units and frames; their portions change nothing."""
        self.resampler.push(messages if isinstance(messages, Block) else messages.block)
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
        elif self._late is not None and reply.number == self._late.number and self._waiting is None:
            self._waiting, self._reply, self._late = self._late, reply, None
        else:
            self._diagnosis.deliver(reply)

    def hurry(self, needed: bool) -> None:
        """Says whether the machine is too slow at the moment: then changes come first, and no fit begins."""
        self._hurried = needed

    def go_on(self) -> None:
        """Waits no longer for the running job: the reply to a fit is taken when it comes, a change keeps no cause."""
        if isinstance(self._waiting, FitRequest) and self._reply is None:
            self._waiting, self._late = None, self._waiting
        elif self._waiting is not None and self._reply is None:
            self._reply = self._waiting.failed("the machine is too slow for a fit in time")

    def approve(self, by: str, sequence: int | None = None) -> Answer:
        """A person approves the set that waits."""
        answer = self.active_set.approve(self._outbox.stamp(self._now), by, sequence)
        self._outbox.act(*answer.actions)
        return answer

    def roll_back(self, by: str) -> Answer:
        """A person takes the set in force back; from then on sets wait for approval."""
        answer = self.active_set.roll_back(self._outbox.stamp(self._now), by)
        if answer.done:
            self._outdated, self._work = self._number, None
            self._change_supervisor.restart()
            self._supervisor.relearn(self._now, f"rolled back by {by}")
            self._outbox.act(*answer.actions)
        return answer

    def fit_now(self) -> Answer:
        """Fits what there is at the next tick, without waiting for a full window."""
        self._windows.fit_now()
        return Answer(True, "a fit follows at the next tick of the data")

    # --- output

    @property
    def running(self) -> Job | None:
        """The job whose reply the session waits for."""
        return self._waiting

    @property
    def backlog(self) -> float:
        """Data that have arrived and were not worked through yet [s]."""
        return max(self.resampler.time.newest - self._now, 0.0) if math.isfinite(self._now) else 0.0

    @property
    def busy(self) -> bool:
        """Whether there is a piece of work that waits for nothing."""
        if self._work is None and self._waiting is not None:
            return self._reply is not None
        return self._work is not None or self._tick_due or self.resampler.busy

    def poll(self, most: int | None = None) -> list[Action]:
        """Works through what has arrived and returns what to do, in order.

        Args:
            most: pieces of work at most, of a millisecond or two each, so that a caller with other duties gets control
                back.
        """
        done = 0
        while self.busy and (most is None or done < most):
            try:
                self._piece()
            except Exception as error:  # noqa: BLE001 - whatever it is, the flight goes on, and it is told
                self._work = None
                self._fail(self._now, unexpected(error))
            done += 1
        return self._outbox.take()

    def status(self) -> SessionStatus:
        """What the session is doing now."""
        newest, active_set = self.resampler.time.newest, self.active_set
        windows, cut = self._estimator.fusion.windows, self._windows.cut
        force, pending = active_set.in_force, active_set.pending
        return SessionStatus(
            t=self._outbox.stamp(newest),
            phase=Phase.FITTING if self._waiting is not None else self._outbox.phase,
            reason=self._outbox.reason,
            excitation=self._estimator.excitation,
            samples=sum(len(w) for w in cut.windows),
            window_seconds=cut.seconds,
            gaps=cut.gaps,
            mse=windows[-1].mse if windows else math.nan,
            fits=self._supervisor.fits,
            rejected=self._supervisor.rejected,
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

    @property
    def _tick_due(self) -> bool:
        return not math.isnan(self._tick_at) and self._now >= self._tick_at - _EPS

    def _piece(self) -> None:
        """The next piece of work: of an answer, a tick, or a block of rows."""
        if self._work is None:
            if self._waiting is not None:
                self._work = self._apply()
            elif self._tick_due:
                tick, self._tick_at = self._tick_at, self._tick_at + self._tick
                self._work = self._at(tick)
        if self._work is None:
            rows = self.resampler.work()
            if rows is not None:
                self._take(rows)
        elif next(self._work, _DONE) is _DONE:
            self._work = None

    def _take(self, rows: Rows) -> None:
        if rows.fresh:
            first = float(rows.t[0])
            self._tick_at = math.floor(first / self._tick + 1.0) * self._tick
        if rows.new_clock:
            self._supervisor.interrupted(first)
            self._consistency.restart()
            self._change_supervisor.restart()
            self._outbox.say(first, "info", "stream", "a stream of data begins")
        self._store.add(rows)
        self._now = float(rows.t[-1]) + 1.0 / self.settings.rate

    def _at(self, tick: float) -> Iterator[None]:
        """One tick, piece by piece: first look for sudden changes; then a fit."""
        self._consistency.add(self._store.span(tick - self._tick - LEAD - _EPS, tick - _EPS), self._tick)
        if self._consistency.fault:
            yield
            # A unit, frame or motor order that is wrong has a name; which two channels it sets apart is less of a help.
            self._supervisor.distrust(tick, self._windows.mistake(tick) or self._consistency.fault)
            self._change_supervisor.restart()
            return
        yield
        seen = yield from self._change_supervisor.look(tick, self._tick, self._estimator)
        if seen is not None:
            self._outbox.state(Phase.CANDIDATE, f"a change of {seen.change.channel} is being looked into")
            what = f"{seen.change.channel} stepped by {seen.change.size:+.1%} at {self._outbox.stamp(seen.at):.2f} s"
            self._outbox.say(tick, "warning", "change", f"{what} ({seen.change.errors:.0f} standard errors)")
        self._health.look(tick)
        self._diagnose(tick)
        yield
        if self._change_supervisor.seen is not None:
            self._isolate(tick)
        elif self._windows.due(tick):
            if self._hurried or self._late is not None or self._waiting is not None:
                self.skipped += 1
            else:
                yield from self._fit(tick)

    def _diagnose(self, tick: float) -> None:
        """Tells what a diagnosis brought, and asks for the next one when the vehicle is known and moves."""
        estimator, supervisor = self._estimator, self._supervisor
        told = self._diagnosis.answer(tick, supervisor.learn_from)
        if told is not None:
            self._outbox.act(told)
        moving = estimator.learned and is_excited(estimator.excitation) and not self._hurried
        if moving and self._change_supervisor.seen is None and self._windows.quality == Quality():
            since = max(supervisor.learn_from, estimator.start)
            request = self._diagnosis.ask(self._number + 1, tick, since)
            if request is not None:
                self._number = request.number
                self._outbox.act(request)

    def _isolate(self, tick: float) -> None:
        assert self._change_supervisor.seen is not None
        stamp = self._outbox.stamp(self._change_supervisor.seen.at)
        request = self._change_supervisor.ask(self._number + 1, tick, self._estimator, stamp)
        if request is None:
            return
        self._number, self._waiting, self._late = request.number, request, None
        self._reply = self._change_supervisor.answer_without_fit(request, self._estimator)
        if self._reply is None:
            self._outbox.act(request)

    def _fit(self, tick: float) -> Iterator[None]:
        request = yield from self._windows.ask(self._number + 1, tick, self._estimator)
        if request is not None:
            self._number, self._waiting = request.number, request
            self._outbox.act(request)

    def _apply(self) -> Iterator[None]:
        request, reply = self._waiting, self._reply
        self._waiting = self._reply = None
        if request is None or request.number <= self._outdated or not request.is_answered_by(reply):
            return
        if isinstance(request, FitRequest) and (
            self._change_supervisor.seen is not None or request.start < self._supervisor.learn_from - _EPS
        ):
            return  # a late one, of a time before what has happened since
        if reply.is_unexpected:
            self._fail(request.stop, reply.problem)
            return
        self._windows.errors = 0
        if isinstance(request, FitRequest) and isinstance(reply, FitReply):
            yield from self._supervisor.fitted(request, reply)
        elif isinstance(request, ChangeRequest) and isinstance(reply, ChangeReply):
            self._change_supervisor.restart()
            self._supervisor.changed(request, reply)

    def _fail(self, t: float, problem: str) -> None:
        """After an error that nobody foresaw, at `t` [s]: what was learned may be its cause and is forgotten."""
        self._windows.errors += 1
        left = MOST_ERRORS - self._windows.errors
        what = "learning restarts" if left > 0 else f"{MOST_ERRORS} in a row: no more fits until fit_now or a restart"
        self._change_supervisor.restart()
        self._consistency.restart()
        self._estimator.reset()
        self._supervisor.relearn(t, "an unexpected error")
        if left >= 0:
            self._outbox.say(t, "error", "unexpected", f"{problem}; {what}")
        self._outbox.state(Phase.FAILED, f"{problem}; {what}")
