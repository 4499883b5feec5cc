"""One vehicle's service, independent of transport: session, worker and history wired together.

The ROS node, the MAVLink link and the replay push messages, call `step` often, and carry out what it returns.
"""

import math
import time
import uuid
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from pydantic import ValidationError

from quadid.data.window import Block
from quadid.errors import QuadidError, nearest
from quadid.online import GateSettings, Job, Session, SessionSettings
from quadid.online.change_job import ChangeRequest
from quadid.online.gate import Answer
from quadid.online.records import Action, Event, JobReply, OnlineSet, Publish
from quadid.vehicle import Vehicle
from quadid_node.history import UNREADABLE, Restored, Store, StoreError, read_history
from quadid_node.messages import (
    BEHIND,
    NO_HISTORY,
    Feed,
    Message,
    Output,
    ServiceHealth,
    lag,
    parameter_set,
    set_from_dict,
)
from quadid_node.process import PARAMETERS
from quadid_node.wire_format import keep
from quadid_node.worker import Trouble, Worker

# --- On the disk before on the wire: numbered sets, and what is said of them, wait until their row is committed


OF_SETS = ("accepted", "rollback")
"""Kinds of events that say which set is in force."""
MOST_WAITING = 64
"""Outputs that wait for the disk; beyond, the oldest are never published, but the newest set in force always is."""


class Publication:
    """Hands outputs out, in order, once they may be published.

    Attributes:
        in_force: the set that was handed out last for the parameter topic; None before the first.
    """

    def __init__(self, store: Store | None) -> None:
        """Asks `store` which sets are on the disk; without one nothing waits."""
        self._store = store
        self._waiting: list[Output] = []
        self.in_force: OnlineSet | None = None

    def take(self, outputs: list[Output]) -> list[Output]:
        """Takes further outputs; returns those that may be published now."""
        store, out, free = self._store, list[Output](), list[Output]()
        for output in outputs:
            waits = isinstance(output, Publish) and output.item.sequence > 0
            waits |= output.topic == "event" and output.kind in OF_SETS and bool(self._waiting)
            (self._waiting if waits and store is not None else free).append(output)
        # Up to the first set that is not on the disk yet; one that never will be holds up no other.
        while store is not None and self._waiting:
            output = self._waiting[0]
            if not isinstance(output, Publish) or output.item.sequence in store.written:
                out.append(output)
            elif output.item.sequence not in store.lost:
                break
            del self._waiting[0]
        # Of too many the oldest go, but not the newest set in force.
        while len(self._waiting) > MOST_WAITING:
            newest = next((o for o in reversed(self._waiting) if o.topic == "parameters"), None)
            self._waiting.remove(next(o for o in self._waiting if o is not newest))
        for output in [*out, *free]:
            if output.topic == "parameters":
                self.in_force = output.item
        return [*out, *free]


# --- The service of one vehicle


DECISION_SECONDS = 2.0
"""Time that a person's decision waits to be on the disk before it is answered [s]."""
PATIENCE = 1.0
"""A fit that is waited for longer [s] is late; a session this far behind its data [s] begins none."""
STATUS_SECONDS = 1.0
"""The backlog of a status is the largest of this time [s]: a status comes once a second, after any round of it."""
RATE_MEMORY = 2.0
"""Time over which data rates are measured [s]."""


class Service:
    """The service of one vehicle.

    Attributes:
        restored: what an earlier run had left.
        boot_id: of this run; with a set's number it never repeats, whatever becomes of history and clock.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        settings: SessionSettings,
        worker: Worker,
        store: Store | None = None,
        clock: Callable[[], float] = time.monotonic,
        restored: Restored | None = None,
        live: bool = True,
    ) -> None:
        """Starts where the last run of this vehicle ended.

        Args:
            clock: seconds, monotonic; only rates and silences are measured with it.
            restored: what an earlier run had left; default: that of the history.
            live: data come at their own pace, so that work is shed when behind; a replay waits for every fit.
        """
        if restored is None:
            restored = store.restore(settings.gate, vehicle) if store is not None else Restored(None, 1)
        self.vehicle, self.restored = vehicle, restored
        self.boot_id = store.boot_id if store is not None else uuid.uuid4().hex
        self.session = Session(
            vehicle,
            settings,
            restored.item,
            restored.next_sequence,
            restored.baseline,
            restored.healthy,
            restored.mass / vehicle.mass if restored.mass else 1.0,
            PATIENCE if live else math.inf,
        )
        self._load = self.session.active_set.load
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
        self._looked = self._waits_since = clock()
        self._behind, self._tell_at = deque[tuple[float, float]](), BEHIND

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
    def ready(self) -> bool:
        """Checks whether fits can begin at once."""
        return self._worker.ready

    def push(self, messages: Block) -> None:
        """Takes messages; their portions change nothing."""
        self._arrived |= dict.fromkeys((name for name, _ in messages.columns), self._clock())
        self.session.push(messages)

    def step(self) -> list[Output]:
        """Does all there is to do, and waits for nothing.

        Returns:
            What to publish and log; numbered sets are on the disk by then, or come with a later step.
        """
        before, self._looked = self._looked, self._clock()
        outputs = self._tidy()
        if not self.session.waits:
            self._waits_since = self._looked
        elif self._live and self._looked - self._waits_since > PATIENCE:
            self.session.go_on()
        outputs += self._carried_out(self.session.poll())
        # How old the data were that results rested on: what waits, and all the time since the step before.
        now = self._clock()
        self._behind.append((now, self.session.backlog + (now - before) * self._live))
        while now - self._behind[0][0] > STATUS_SECONDS:
            self._behind.popleft()
        return self._journalled([*outputs, *self._lag()])

    def _carried_out(self, actions: list[Action]) -> list[Output]:
        """Answers questions about changes, gives other requests to the workers; returns the rest."""
        outputs: list[Output] = []
        for action in actions:
            if not isinstance(action, Job):
                outputs.append(action)
                continue
            if isinstance(action, ChangeRequest):  # less work than its wait for a fit that runs
                outputs += self._delivered(action.run(), action)
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
        """Looks after worker and history only, while nothing is published."""
        self._looked = self._clock()
        return self._journalled(self._tidy())

    def _tidy(self) -> list[Output]:
        outputs = list[Output]()
        if self._store is not None:  # a damaged history set aside, a row refused
            notes = self._store.notes[self._noted :]
            self._noted += len(notes)
            outputs += [self._event("error", "history", note) for note in notes]
        studied = self._studying.poll() if self._studying is not None else []
        for item in (*self._worker.poll(), *studied):
            if isinstance(item, Trouble):
                outputs.append(self._event(item.level, "worker", item.text))
                continue
            if self.session.running is not None and item.number == self.session.running.number:
                self._fit_seconds = self._clock() - self._fit_began
            job = next((job for job in self._jobs.values() if job.number == item.number), None)
            outputs += self._delivered(item, job)
        if self._store is not None and self._store.problem != self._problem:
            self._problem = self._store.problem
            level = "error" if self._problem else "info"
            outputs.append(self._event(level, "history", self._problem or "the history is written again"))
        return outputs

    def _delivered(self, reply: JobReply, job: Job | None) -> list[Event]:
        """Hands a reply to the session; keeps the input of a job that failed by an error of this program."""
        self.session.deliver(reply)
        if not reply.is_unexpected or job is None:
            return []
        kept = keep(self._store.path, job) if self._store is not None else "without a history nothing is kept"
        return [self._event("error", "worker", f"{reply.problem}; {kept}")]

    def _lag(self) -> list[Event]:
        """Reports a live session that falls behind its data, and that it has caught up."""
        behind = self._behind[-1][1] if self._live else 0.0
        if behind >= self._tell_at:
            self._tell_at = 2.0 * behind
            return [self._event("warning", "behind", lag(behind))]
        if behind < PATIENCE and self._tell_at > BEHIND:
            self._tell_at = BEHIND
            return [self._event("info", "behind", "caught up with the data")]
        return []

    def _journalled(self, outputs: list[Output]) -> list[Output]:
        """Gives everything to the history, decisions before what follows from them; returns what may be published."""
        sets, store = self.session.active_set, self._store
        if store is not None and sets.approval != self._approval:
            store.decision(self._configured, sets.approval)
        if store is not None and sets.load != self._load:
            store.mass(sets.load * self.vehicle.mass if sets.load != 1.0 else 0.0)
        self._approval, self._load = sets.approval, sets.load
        for output in outputs:
            if store is not None:
                store.journal(output)
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
        self._decided = self._journalled(self._carried_out(self.session.poll()))
        if self._store is None or self._store.flush(DECISION_SECONDS):
            return answer
        text = f"{answer.text}; NOT on the disk, and published only when it is: {self._store.problem or 'slow disk'}"
        return replace(answer, text=text)

    def stored_sets(self, most: int) -> list[Message]:
        """The newest sets of the history as quadid_msgs/ParameterSet; raises StoreError where there is none to read."""
        if self._store is None:
            raise StoreError("no history is kept: history:=none, or an observer")
        path, name = self._store.path, self._store.vehicle
        try:
            rows = read_history(path, name, sets=most)["sets"]
            return [parameter_set(set_from_dict(row), name, str(row.get("boot_id", ""))) for row in rows]
        except UNREADABLE as error:
            raise StoreError(f"the history {path} cannot be read ({error})") from error

    def health(self) -> ServiceHealth:
        """Snapshot for monitoring."""
        now = self._clock()
        feeds = {name: Feed(self._rate(name, now), max(self._looked - at, 0.0)) for name, at in self._arrived.items()}
        history = self._store.problem if self._store is not None else NO_HISTORY
        status = replace(self.session.status(), backlog=max((s for _, s in self._behind), default=0.0))
        return ServiceHealth(status, feeds, self._worker.state, self._worker.restarts, history, self._fit_seconds)

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

    def _event(self, level: str, kind: str, text: str) -> Event:
        return Event(self.session.status().t, level, kind, text)


# --- Settings as the service's front ends give them, checked once, with errors a person can act on


class SettingsError(QuadidError):
    """A setting outside its range, or an unknown one."""


def session_settings(approval: str = "auto", gate: Mapping[str, Any] | None = None, **given: Any) -> SessionSettings:
    """Session settings from loose arguments.

    Args:
        gate: further fields of `GateSettings`; given: of `SessionSettings`.

    Raises:
        SettingsError: naming the setting, what was found and what is allowed.
    """
    of_gate = {"approval": approval, **(gate or {})}
    for model, values in ((GateSettings, of_gate), (SessionSettings, given)):
        for name in values.keys() - model.model_fields.keys():
            raise SettingsError(f"unknown setting '{name}'", fix=nearest(name, list(model.model_fields)))
    try:
        return SessionSettings(gate=GateSettings.model_validate(of_gate), **given)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise SettingsError(f"{place} = {first['input']!r}", first["msg"]) from error


# --- The node's parameters as settings


def read_settings(values: dict[str, Any]) -> SessionSettings:
    """Settings of the session from parameter values; raises QuadidError."""
    given = {n: values[n] for n in ("approval", "window", "refit", "rate", "memory", "diagnose", "seed")}
    gate = {n.removeprefix("gate."): v for n, v in values.items() if n.startswith("gate.")}
    return session_settings(**given, gate=gate)


def vehicle_id(given: str, namespace: str, vehicle: Vehicle) -> str:
    """Name of one vehicle of a fleet."""
    return given or namespace.strip("/") or vehicle.name


def check_change(name: str, value: Any) -> str:
    """Reason why a parameter may not be changed to this now; empty when it may."""
    known = {p.name: p for p in PARAMETERS}
    if name not in known:
        return ""  # not ours: use_sim_time, QoS overrides
    if not known[name].live:
        return f"{name} is read when the node is configured: set it before, or clean up and configure again"
    try:
        session_settings(approval=value)
    except QuadidError as error:
        return str(error)
    return ""
