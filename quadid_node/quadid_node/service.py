"""One vehicle's service, whatever carries its samples: session, worker and history wired together.

The ROS node, the MAVLink link and the replay push samples, call `step` often, and carry out what it returns.
"""

from __future__ import annotations

import math
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from quadid.data.window import Block, Sample
from quadid.online import Job, Session, SessionSettings
from quadid.online.active_set import Answer
from quadid.online.records import Action, Event, OnlineSet, SessionStatus, SetState
from quadid.vehicle import Vehicle
from quadid_node.failures import keep
from quadid_node.history import Restored, Store
from quadid_node.publication import Output, Publication
from quadid_node.worker import Trouble, Worker

SILENT_WARNING, SILENT_ERROR = 1.0, 5.0
"""A channel that was there and is silent for this long [s] is worth a warning, an error."""
DECISION_SECONDS = 2.0
"""How long a person's decision waits to be on the disk before it is answered [s]."""
PATIENCE = 1.0
"""A session this far behind its data [s] waits no longer for a fit that takes as long, and begins no other,"""
BEHIND = 2.0
"""... and from here on people are told, at every doubling."""
RATE_MEMORY = 2.0
"""Time over which data rates are measured [s]."""


def lag(seconds: float) -> str:
    """Message about a session that is so far behind its data [s]; empty where it is not."""
    if seconds < BEHIND:
        return ""
    return f"{seconds:.0f} s behind the data, the machine is too slow: fits are left out, changes come first"


@dataclass(frozen=True)
class Feed:
    """How one channel arrives.

    Attributes:
        rate: samples a second over the last two seconds [Hz].
        silence: since its last sample, up to when the service looked for samples last [s].
    """

    rate: float
    silence: float


@dataclass(frozen=True)
class Health:
    """Everything a monitor wants: session, channels, worker, history, how long the last fit took [s]."""

    status: SessionStatus
    feeds: dict[str, Feed]
    worker: str
    restarts: int
    history: str
    fit_seconds: float


class Service:
    """The service of one vehicle.

    Attributes:
        vehicle: as given.
        restored: what an earlier run had left.
        session: the session.
        boot_id: of this run; with a set's number it never repeats, whatever becomes of history and clock.
    """

    def __init__(
        self, vehicle: Vehicle, settings: SessionSettings, worker: Worker, store: Store | None = None,
        clock: Callable[[], float] = time.monotonic, restored: Restored | None = None, live: bool = True,
    ) -> None:  # fmt: skip
        """Starts where the last run of this vehicle ended.

        Args:
            vehicle: geometry, mass, first guess.
            settings: of the session.
            worker: does the fits.
            store: history; None for none.
            clock: seconds, monotonic; only rates and silences are measured with it.
            restored: what an earlier run had left; default: what the history says.
            live: data come at their own pace, so that work is shed when behind; a replay waits for every fit.
        """
        if restored is None:
            restored = store.restore(settings.gate, vehicle) if store is not None else Restored(None, 1)
        self.vehicle, self.restored = vehicle, restored
        self.boot_id = store.boot_id if store is not None else uuid.uuid4().hex
        self.session = Session(
            vehicle, settings, restored.item, restored.next_sequence, restored.baseline, restored.healthy
        )
        self._configured: str = settings.gate.approval
        self._approval: str = self._configured
        self._publication = Publication(store)
        self._decided: list[Output] = []
        self._worker, self._store, self._clock, self._live = worker, store, clock, live
        self._studying: Worker | None = None
        self._jobs: dict[bool, Job] = {}
        self._arrived: dict[str, float] = {}
        self._counted: dict[str, tuple[float, int]] = {}
        self._rates: dict[str, float] = {}
        self._noted = 0
        self._problem = ""
        self._fit_began, self._fit_seconds = 0.0, math.nan
        self._looked, self._unfinished, self._tell_at = clock(), False, BEHIND

        if restored.approval not in ("", self._configured):
            self.session.active_set.approval = self._approval = restored.approval
            text = f"approval is {restored.approval}, not {self._configured}: {restored.decided}"
            self._decided = self._journalled([Event(math.nan, "warning", "approval", text)])

    @property
    def published(self) -> OnlineSet | None:
        """The set that the parameter topic holds: in force, and on the disk where a history is kept."""
        return self._publication.in_force

    @property
    def approval(self) -> str:
        """Approval in force: ``auto`` or ``manual``; a rollback, or a decision of an earlier run, changes it."""
        return self.session.active_set.approval

    @property
    def history(self) -> Path | None:
        """File of the history; None: none is kept."""
        return self._store.path if self._store is not None else None

    @property
    def ready(self) -> bool:
        """Whether fits can begin at once."""
        return self._worker.ready

    def push(self, messages: Block | Sample) -> None:
        """Takes messages; their portions change nothing."""
        now, block = self._clock(), messages if isinstance(messages, Block) else messages.block
        for name, _ in block.columns:
            self._arrived[name] = now
        self.session.push(block)

    def step(self, seconds: float = math.inf) -> list[Output]:
        """Moves everything on by what there is to do; never waits.

        Args:
            seconds: no piece of the session's work begins later than this [s]; one always does.

        Returns:
            What to publish and tell; numbered sets are on the disk by then, or come with a later step.
        """
        outputs, begin = list[Output](), self._clock()
        for piece in self.pieces():
            outputs += piece
            if self._clock() - begin >= seconds:
                break
        return outputs

    def pieces(self) -> Iterator[list[Output]]:
        """As `step`, and gives control back, with what is to be published and told, after each piece of the work."""
        outputs, self._looked = [*self._tidy(), *self._keep_up()], self._clock()
        while True:
            outputs += self._carried_out(self.session.poll(1))
            self._unfinished = self.session.busy
            yield self._journalled(outputs)
            if not self.session.busy:
                return
            outputs = []

    def _carried_out(self, actions: list[Action]) -> list[Output]:
        """Gives requests to the workers; returns the rest."""
        outputs: list[Output] = []
        for action in actions:
            if not isinstance(action, Job):
                outputs.append(action)
                continue
            self._jobs[action.background] = action
            if action.background:
                self._studying = self._studying or self._worker.sibling()
                self._studying.submit(action)
            else:
                self._fit_began = self._clock()
                self._worker.submit(action)
        return outputs

    def idle(self) -> list[Output]:
        """Looks after worker and history only, while nobody could hear what the session says."""
        self._looked = self._clock()
        return self._journalled(self._tidy())

    def _tidy(self) -> list[Output]:
        outputs: list[Output] = self._history_notes()
        studied = self._studying.poll() if self._studying is not None else []
        for item in (*self._worker.poll(), *studied):
            if isinstance(item, Trouble):
                outputs.append(self._trouble(item))
                continue
            if self.session.running is not None and item.number == self.session.running.number:
                self._fit_seconds = self._clock() - self._fit_began
            job = next((job for job in self._jobs.values() if job.number == item.number), None)
            if item.is_unexpected and job is not None:
                kept = keep(self._store.path, job) if self._store is not None else "without a history nothing is kept"
                outputs.append(self._trouble(Trouble("error", f"{item.problem}; {kept}")))
            self.session.deliver(item)
        return [*outputs, *self._history_trouble()]

    def _keep_up(self) -> list[Event]:
        """Lets a live session that is behind its data shed work, and tells so; a replay waits for every fit."""
        if not self._live:
            return []
        session, behind = self.session, self.session.backlog
        waits = session.running is not None and self._clock() - self._fit_began > PATIENCE
        hurried = behind > PATIENCE and (waits or self._unfinished)
        session.hurry(hurried)
        if hurried and waits:
            session.go_on()
        if behind >= self._tell_at:
            self._tell_at = 2.0 * behind
            return [Event(session.status().t, "warning", "behind", lag(behind))]
        if behind < PATIENCE and self._tell_at > BEHIND:
            self._tell_at = BEHIND
            return [Event(session.status().t, "info", "behind", "caught up with the data")]
        return []

    def _journalled(self, outputs: list[Output]) -> list[Output]:
        """Gives everything to the history, decisions before what follows from them; returns what may be published."""
        approval = self.session.active_set.approval
        if approval != self._approval:
            self._approval = approval
            if self._store is not None:
                self._store.decision(self._configured, approval)
        for output in outputs:
            self._journal(output)
        decided, self._decided = self._decided, []
        return [*decided, *self._publication.take(outputs)]

    def approve(self, by: str, sequence: int | None = None) -> Answer:
        """A person approves a set that waits; what follows comes with the next `step`."""
        return self._on_disk(self.session.approve(by, sequence))

    def roll_back(self, by: str) -> Answer:
        """A person takes the set in force back; what follows comes with the next `step`."""
        return self._on_disk(self.session.roll_back(by))

    def decide_approval(self, approval: str) -> Answer:
        """A person makes approval auto or manual from now on, after a restart too."""
        self.session.active_set.approval = approval
        return self._on_disk(Answer(True, f"approval is {approval} from now on"))

    def _on_disk(self, answer: Answer) -> Answer:
        """The answer to a person's decision, once that is on the disk."""
        if not answer.done:
            return answer
        self._decided = self._journalled(self._carried_out(self.session.poll(0)))
        if self._store is None or self._store.flush(DECISION_SECONDS):
            return answer
        text = f"{answer.text}; NOT on the disk, and published only when it is: {self._store.problem or 'slow disk'}"
        return replace(answer, text=text)

    def health(self) -> Health:
        """What a monitor wants to know."""
        now = self._clock()
        feeds = {name: Feed(self._rate(name, now), max(self._looked - at, 0.0)) for name, at in self._arrived.items()}
        restarts = getattr(self._worker, "restarts", 0)
        history = self._store.problem if self._store is not None else "none kept"
        return Health(self.session.status(), feeds, self._worker.state, restarts, history, self._fit_seconds)

    def close(self) -> None:
        """Ends workers and history; what was journalled is on the disk afterwards."""
        for worker in (self._worker, self._studying):
            if worker is not None:
                worker.close()
        if self._store is not None:
            self._store.close()

    def _rate(self, name: str, now: float) -> float:
        count = self.session.resampler.counts[name]
        since, before = self._counted.get(name, (now - RATE_MEMORY, 0))
        if now - since >= RATE_MEMORY:
            self._rates[name] = (count - before) / max(now - since, 1e-3)
            self._counted[name] = (now, count)
        return self._rates.get(name, 0.0)

    def _trouble(self, item: Trouble) -> Event:
        return Event(self.session.status().t, item.level, "worker", item.text)

    def _history_notes(self) -> list[Output]:
        """What the history has told since the last call: a damaged one set aside."""
        notes = self._store.notes[self._noted :] if self._store is not None else []
        self._noted += len(notes)
        return [Event(self.session.status().t, "error", "history", note) for note in notes]

    def _history_trouble(self) -> list[Event]:
        problem = self._store.problem if self._store is not None else ""
        if problem == self._problem:
            return []
        self._problem = problem
        level, text = ("error", problem) if problem else ("info", "the history is written again")
        return [Event(self.session.status().t, level, "history", text)]

    def _journal(self, output: Output) -> None:
        if self._store is None:
            return
        if output.topic == "event":
            self._store.event(output)
        elif output.topic == "diagnosis":
            self._store.diagnosis(output)
        elif output.topic == "healthy_flight":
            self._store.healthy_flight(output.trim)
        elif output.topic == "candidate":
            self._store.candidate(output.item)
        if output.topic == "parameters" or (output.topic == "candidate" and output.item.state is SetState.PENDING):
            self._store.numbered(output.item)
