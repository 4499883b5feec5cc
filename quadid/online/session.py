"""The online session of one vehicle: samples and commands in, actions out; the same input gives the same output.

    push(sample)            buffer it
    poll() -> actions       every tick of the data's own time, in order:
        watch for sudden changes                -> ChangeRequest, Diagnosed
        diagnose the last minute, now and then  -> StudyRequest, Diagnosed; nothing waits for it
        cut a window, judge its quality         -> what is missing, not flying, broken
        FitRequest                              -> stops here until `deliver` brings the reply
        fuse, ask the gate                      -> Publish(candidate), Publish(parameters)

A session stands still while a fit runs and catches up afterwards, so that nothing depends on how long a fit takes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from quadid.online.buffer import Buffer, Rows
from quadid.online.changes import ChangeReply, ChangeRequest
from quadid.online.desk import Desk
from quadid.online.fitting import FitReply, FitRequest, is_excited
from quadid.online.learner import Learner
from quadid.online.ledger import Answer, Ledger
from quadid.online.quality import Quality, judge
from quadid.online.records import OnlineSet, Phase, Publish, SetState
from quadid.online.rows import Cut, RowStore
from quadid.online.sentry import Sentry
from quadid.online.settings import SessionSettings
from quadid.online.status import SessionStatus
from quadid.online.study import STUDIED, Student, StudyReply
from quadid.online.voice import Action, Voice
from quadid.vehicle import Vehicle
from quadid.window import Block, Sample

LEAD = 0.22
"""Flight before a window in which filters and delays settle [s]."""
SHORT_WINDOW = 4.0
"""Least data for a fit that a person asked for [s]."""
_EPS = 1e-6
_DONE = object()


class Session:
    """Session of one vehicle.

    Attributes:
        buffer: the samples; its `counts`, `last` and `faults` tell what arrives.
        ledger: which set is in force.
        settings: as given.
    """

    def __init__(
        self, vehicle: Vehicle, settings: SessionSettings | None = None, restored: OnlineSet | None = None,
        next_sequence: int = 1, baseline: OnlineSet | None = None,
    ) -> None:  # fmt: skip
        """Starts a session.

        Args:
            vehicle: geometry, mass, first guess.
            settings: default `SessionSettings()`.
            restored: last accepted set of an earlier run; in force, but stale, until this flight confirms it.
            next_sequence: first number not yet given to a set.
            baseline: set from which creeping is measured; default `restored`.
        """
        self.settings = settings or SessionSettings()
        self.buffer = Buffer(vehicle, self.settings.rate)
        self.ledger = Ledger(self.settings.gate.approval, restored, next_sequence, baseline)
        self._vehicle = vehicle
        self._voice = Voice(self.buffer.time.stamp)
        studied = STUDIED if self.settings.diagnose else 0.0
        self._store = RowStore(self.settings.rate, max(self.settings.window, studied) + 10.0)
        self._sentry = Sentry(vehicle, self._store)
        self._student = Student(vehicle, self._store, self.settings.diagnose, self.settings.seed)
        self._learner = Learner(vehicle, self.settings.memory, self.settings.seed)
        self._desk = Desk(self._learner, self.ledger, self._voice, self.settings.gate)
        self._cut = Cut((), 0.0, 0)
        self._waiting: FitRequest | ChangeRequest | None = None
        self._reply: FitReply | ChangeReply | None = None
        self._outdated = 0
        self._now, self._tick_at, self._last_fit = -math.inf, math.nan, -math.inf
        self._work: Iterator[None] | None = None
        self._asked_now = False
        self._number = 0
        if self.ledger.in_force is not None:
            self._learner.start_from(self.ledger.in_force)
            self._voice.act(Publish("parameters", self.ledger.in_force))

    # --- input

    def push(self, sample: Sample) -> None:
        """Takes one sample: stamp [s], channel, values in core units and frames."""
        self.buffer.push(sample)

    def push_block(self, block: Block) -> None:
        """Takes messages as if their samples were pushed one by one."""
        self.buffer.push_block(block)

    def deliver(self, reply: FitReply | ChangeReply | StudyReply) -> None:
        """Takes the answer to the running request or study; an answer to any other is ignored."""
        if isinstance(reply, StudyReply):
            self._student.deliver(reply)
        elif self._waiting is not None and reply.number == self._waiting.number:
            self._reply = reply

    def approve(self, by: str, sequence: int | None = None) -> Answer:
        """A person approves the set that waits."""
        answer = self.ledger.approve(self._voice.stamp(self._now), by, sequence)
        self._voice.act(*answer.actions)
        return answer

    def roll_back(self, by: str) -> Answer:
        """A person takes the set in force back; from then on sets wait for approval."""
        answer = self.ledger.roll_back(self._voice.stamp(self._now), by)
        if answer.done:
            self._outdated, self._work = self._number, None
            self._sentry.restart()
            self._desk.relearn(self._now, f"rolled back by {by}")
            self._voice.act(*answer.actions)
        return answer

    def fit_now(self) -> Answer:
        """Fits what there is at the next tick, without waiting for a full window."""
        self._asked_now = True
        return Answer(True, "a fit follows at the next tick of the data")

    # --- output

    @property
    def running(self) -> FitRequest | ChangeRequest | None:
        """The request whose reply the session waits for."""
        return self._waiting

    @property
    def backlog(self) -> float:
        """Data that have arrived and were not worked through yet [s]."""
        return max(self.buffer.time.newest - self._now, 0.0) if math.isfinite(self._now) else 0.0

    @property
    def busy(self) -> bool:
        """Whether there is a piece of work that waits for nothing."""
        if self._work is None and self._waiting is not None:
            return self._reply is not None
        return self._work is not None or self._tick_due or self.buffer.busy

    def poll(self, most: int | None = None) -> list[Action]:
        """Works through what has arrived and returns what to do, in order.

        Args:
            most: pieces of work at most, of a millisecond or two each, so that a caller with other duties gets control
                back.
        """
        done = 0
        while self.busy and (most is None or done < most):
            self._piece()
            done += 1
        return self._voice.take()

    def status(self) -> SessionStatus:
        """What the session is doing now."""
        newest, ledger = self.buffer.time.newest, self.ledger
        windows = self._learner.fusion.windows
        force, pending = ledger.in_force, ledger.pending
        return SessionStatus(
            t=self._voice.stamp(newest),
            phase=Phase.FITTING if self._waiting is not None else self._voice.phase,
            reason=self._voice.reason,
            excitation=self._learner.excitation,
            samples=sum(len(w) for w in self._cut.windows),
            window_seconds=self._cut.seconds,
            gaps=self._cut.gaps,
            mse=windows[-1].mse if windows else math.nan,
            fits=self._desk.fits,
            rejected=self._desk.rejected,
            in_force=force.sequence if force else 0,
            pending=pending.sequence if pending else 0,
            stale=force is not None and force.state is SetState.STALE,
            approval=ledger.approval,
            faults=dict(self.buffer.faults),
            backlog=self.backlog,
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
            rows = self.buffer.work()
            if rows is not None:
                self._take(rows)
        elif next(self._work, _DONE) is _DONE:
            self._work = None

    def _take(self, rows: Rows) -> None:
        if rows.fresh:
            first = float(rows.t[0])
            self._tick_at = math.floor(first / self._tick + 1.0) * self._tick
            self._desk.interrupted(first)
            self._sentry.restart()
            self._voice.say(first, "info", "stream", "a stream of data begins")
        self._store.add(rows)
        self._now = float(rows.t[-1]) + 1.0 / self.settings.rate

    def _at(self, tick: float) -> Iterator[None]:
        """One tick, piece by piece: first look for sudden changes; then a fit."""
        seen = yield from self._sentry.look(tick, self._tick, self._learner)
        if seen is not None:
            self._voice.state(Phase.CANDIDATE, f"a change of {seen.change.channel} is being looked into")
            what = f"{seen.change.channel} stepped by {seen.change.size:+.1%} at {self._voice.stamp(seen.at):.2f} s"
            self._voice.say(tick, "warning", "change", f"{what} ({seen.change.errors:.0f} standard errors)")
        self._study(tick)
        yield
        if self._sentry.seen is not None:
            self._explain(tick)
        elif self._asked_now or tick - self._last_fit >= self.settings.refit - _EPS:
            yield from self._fit(tick)

    def _study(self, tick: float) -> None:
        """Tells what a diagnosis brought, and asks for the next one when the vehicle is known and moves."""
        since = self._desk.learn_from
        told = self._student.answer(tick, since, self._voice.stamp)
        if told is not None:
            self._voice.act(told)
        moving = self._learner.learned and is_excited(self._learner.excitation)
        if moving and self._sentry.seen is None and self._desk.quality == Quality():
            request = self._student.ask(tick, since)
            if request is not None:
                self._voice.act(request)

    def _explain(self, tick: float) -> None:
        assert self._sentry.seen is not None
        stamp = self._voice.stamp(self._sentry.seen.at)
        request = self._sentry.ask(self._number + 1, tick, self._learner, stamp)
        if request is None:
            return
        self._number, self._waiting = request.number, request
        self._reply = self._sentry.answer_without_fit(request, self._learner)
        if self._reply is None:
            self._voice.act(request)

    def _fit(self, tick: float) -> Iterator[None]:
        wanted = self.settings.window
        if self._asked_now:
            self._asked_now, wanted = False, min(SHORT_WINDOW, wanted)
        start = max(tick - self.settings.window - LEAD, self._desk.learn_from)
        self._cut = self._store.cut(start - _EPS, tick - _EPS)
        if self._cut.reason or tick - start < wanted - 0.5:
            self._incomplete(tick, start)
            return
        yield
        quality = judge(self._cut.windows, self._vehicle, self._learner.value("b"), self._learner.learned)
        self._desk.quality = quality
        if quality != Quality():
            phase = Phase.BLOCKED if quality.fault else Phase.NOT_FLYING
            self._voice.note(tick, phase, quality.fault or quality.grounded)
            return
        yield
        self._number, self._last_fit = self._number + 1, tick
        start = max(start, tick - self.settings.window)
        self._waiting = self._learner.request(self._number, self._cut.windows, start, tick)
        self._voice.act(self._waiting)

    def _incomplete(self, tick: float, start: float) -> None:
        if self._cut.blocked:
            self._voice.note(tick, Phase.BLOCKED, self._cut.reason)
            return
        have = f"{max(tick - start, 0.0):.0f} of {self.settings.window:g} s of flight"
        self._voice.state(Phase.COLLECTING, f"{have}; {self._cut.reason or 'no gaps'}")

    def _apply(self) -> Iterator[None]:
        request, reply = self._waiting, self._reply
        self._waiting = self._reply = None
        if request is None or request.number <= self._outdated:
            return
        if isinstance(request, ChangeRequest) and isinstance(reply, ChangeReply):
            self._sentry.restart()
            self._desk.changed(request, reply)
        elif isinstance(request, FitRequest) and isinstance(reply, FitReply):
            yield from self._desk.fitted(request, reply)
