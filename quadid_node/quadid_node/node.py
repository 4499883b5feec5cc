"""The ROS 2 lifecycle node of `identify` (node name `quadid`): topics and services around one `Service`.

Callbacks convert, call and publish; everything else is in `service` and in the core.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock as RosClock
from rclpy.clock_type import ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import HistoryPolicy, QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible

from quadid.errors import QuadidError
from quadid.online import Publish
from quadid_node import messages
from quadid_node.chooser import Chooser
from quadid_node.commands import Commands
from quadid_node.convert import Decoder, best_ranks, deserializer, message_class
from quadid_node.intake import DEPTH, Intake
from quadid_node.neighbours import Neighbours, Offer
from quadid_node.node_parameters import (
    PARAMETERS,
    as_declared,
    check_change,
    descriptor,
    read_settings,
    read_vehicle,
    vehicle_id,
)
from quadid_node.polling import PollingNode
from quadid_node.presets import Source, source
from quadid_node.publication import Output
from quadid_node.recorder import WRITTEN, Beginning, Recorder
from quadid_node.rounds import ROUND_SECONDS, STEP_SECONDS, WORK_SECONDS, Rounds
from quadid_node.service import Service
from quadid_node.speaker import Speaker
from quadid_node.store import Store, default_path
from quadid_node.worker import ProcessWorker
from quadid_node.workers import with_ground

CATCHING_UP, BACKLOG = 10.0, 2.0
"""A step lasts longer in proportion, up to so many times, when there is a backlog of more than this much data [s]."""
REPORT_SECONDS = 1.0
"""Status and health are told this often [s]."""
WARM_UP_SECONDS = 8.0
"""How long `configure` waits for warm kernels [s]; a first start after an update compiles for longer."""
SENSOR_QOS = QoSProfile(depth=DEPTH, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)
SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class IdentifyNode(PollingNode, LifecycleNode):
    """Identifies one vehicle from its topics and publishes the parameter sets that passed the gate."""

    def __init__(self, stopping: Callable[[], bool] = lambda: False) -> None:
        """Declares the parameters; everything else waits for `configure`.

        Args:
            stopping: says that the process is asked to end, so that nothing is waited for any more.
        """
        super().__init__("quadid")
        self._stopping = stopping
        for p in PARAMETERS:
            self.declare_parameter(p.name, p.default, descriptor(p))
        self.add_on_set_parameters_callback(self._on_set)
        self._service: Service | None = None
        self._recorder: Recorder | None = None
        self._intake = Intake()
        self._speaker: Speaker | None = None
        self._open: list[tuple[Callable[[Any], Any], Any]] = []
        self._steady = RosClock(clock_type=ClockType.STEADY_TIME)
        self._rounds, self._report_at = Rounds(self._round), 0.0
        self._active = False

    @property
    def warm(self) -> bool:
        """Whether fits could begin at once."""
        return self._service is not None and self._service.ready

    # --- life cycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Reads parameters and vehicle, opens the history, starts the fit process, subscribes."""
        try:
            self._configure()
        except QuadidError as error:
            self.get_logger().error(str(error))
            self._tear_down()
            return FAILURE
        gc.collect()
        gc.freeze()  # what there is now need not be looked through in flight, which takes as long as three steps
        return SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begins to take samples and to publish, once the kernels are warm."""
        assert self._service is not None
        if not self._service.ready:
            self.get_logger().warning("the fit process is warming up (a first start compiles): activate again shortly")
            return FAILURE
        result = super().on_activate(state)
        self._active = True
        if self._speaker is not None:
            self._speaker.step()
        self.get_logger().info(f"ready: identifies '{self._id}'")
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stops taking samples and publishing; what was learned is kept."""
        self._active = False
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Ends fit process and history."""
        self._tear_down()
        return SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """As `on_cleanup`."""
        self._tear_down()
        return SUCCESS

    def _configure(self) -> None:
        values = {p.name: as_declared(p, self.get_parameter(p.name).value) for p in PARAMETERS}
        vehicle, settings = read_vehicle(values["vehicle"]), read_settings(values)
        preset = source(values["source"])
        self._id = vehicle_id(values["vehicle_id"], self.get_namespace(), vehicle)
        self._observer = bool(values["observer"])
        inputs = {self.resolve_topic_name(entry.topic): entry.type.replace("/", "/msg/") for entry in preset.inputs}
        self._neighbours = Neighbours(inputs, self._offers_on, self.unbroken, lambda text: self._log("error", text))
        self._subscribe(preset, len(vehicle.rotors))
        keeps = not self._observer and values["history"] != "none"
        store = Store(Path(values["history"] or default_path()), self._id) if keeps else None
        worker = ProcessWorker(vehicle, values["worker_memory"])
        self._service = Service(vehicle, settings, with_ground(worker, values["ground_worker"], self._id), store)
        if values["record"]:
            beginning = Beginning(vehicle, settings, values["source"], self._service.restored)
            self._recorder = Recorder(Path(values["record"]), beginning, preset.inputs)
        self._hint = preset.motor_hint
        self._offer()
        deadline = time.monotonic() + WARM_UP_SECONDS
        while not self._service.ready and time.monotonic() < deadline and not self._stopping():
            worker.poll_ready()
            time.sleep(0.02)

    def _subscribe(self, preset: Source, rotors: int) -> None:
        chooser = Chooser(best_ranks(preset.inputs))
        for entry in preset.inputs:
            decoder = Decoder(entry, chooser, rotors, deserializer(entry.type))
            topic = self.resolve_topic_name(entry.topic)
            take = self.poll(message_class(entry.type), entry.topic, SENSOR_QOS)
            self._intake.open(entry, topic, decoder, take)

    def _offers_on(self, topic: str) -> list[Offer]:
        found = self.get_publishers_info_by_topic(topic)
        fits = [qos_check_compatible(info.qos_profile, SENSOR_QOS)[0] != QoSCompatibility.ERROR for info in found]
        return [Offer(info.topic_type, heard) for info, heard in zip(found, fits, strict=True)]

    def _offer(self) -> None:
        self._speaker = Speaker(self, self._observer)
        commands = Commands(self._id, lambda: self._service if self._active else None, self._put)
        for name, kind, answer in commands.offered():
            self._open.append((self.destroy_service, self.create_service(kind, f"quadid/{name}", answer)))
        self._open.append((self.destroy_timer, self.create_timer(STEP_SECONDS, self._step, clock=self._steady)))

    def _tear_down(self) -> None:
        self._active = False
        gc.unfreeze()
        self._rounds.drop()
        self._intake.clear()
        self.destroy_polled()
        for destroy, item in reversed(self._open):
            destroy(item)
        self._open.clear()
        if self._speaker is not None:
            self._speaker.close()
            self._speaker = None
        if self._service is not None:
            self._service.close()
            self._service = None
        if self._recorder is not None:
            self._recorder.close()
            self._recorder = None

    # --- callbacks

    def _step(self) -> None:
        """Goes on with the round, for longer when the session is far behind its data."""
        if self._service is not None:
            behind = self._service.session.backlog / BACKLOG
            self._rounds.step(WORK_SECONDS * min(max(behind, 1.0), CATCHING_UP))

    def _round(self) -> Iterator[None]:
        """All there is to do again and again: take in what has arrived, write it down, report, work on it."""
        assert self._service is not None
        assert self._speaker is not None
        yield from self._take_in(self._service)
        while self._recorder is not None and self._recorder.write(WRITTEN):
            yield
        now = time.monotonic()
        if now >= self._report_at:
            self._report_at = max(self._report_at, now - ROUND_SECONDS) + REPORT_SECONDS
            yield from self._report(self._service, self._speaker)
        yield from self._work(self._service)

    def _take_in(self, service: Service) -> Iterator[None]:
        """Gives the service what has arrived since the last round, topic by topic."""
        waiting = self._intake.take()
        for topic, publishers in self.publisher_counts().items():
            self._neighbours.count(topic, publishers)
        yield
        if not self._active or self._neighbours.paused:
            return
        for items in self._intake.read(waiting, self._recorder.take if self._recorder is not None else None):
            service.push_all(items)
            yield
            if not self._active:
                return

    def _work(self, service: Service) -> Iterator[None]:
        """Works on what was taken in, until that is done or the round lasts too long."""
        for outputs in service.pieces() if self._active else [service.idle()]:
            for output in outputs:
                self._put(output)
            yield
            if self._rounds.overdue or not self._active:
                return

    def _put(self, output: Output) -> None:
        if output.topic == "event":
            self._log(output.level, output.text)
        elif self._service is None or self._speaker is None or self._speaker.silent:
            return
        elif output.topic in messages.RESULTS:
            fields = messages.RESULTS[output.topic](output, self._id, self._service.boot_id)
            self._speaker.publish(output.topic, fields)

    def _log(self, level: str, text: str) -> None:
        """One call a level: rclpy remembers the level of each line of code and refuses another."""
        log = self.get_logger()
        if level == "info":
            log.info(text)
        elif level == "warning":
            log.warning(text)
        else:
            log.error(text)

    def _report(self, service: Service, speaker: Speaker) -> Iterator[None]:
        """Once a second: status, health, and who else publishes inputs or the parameter sets of our vehicle."""
        deaf = speaker.deaf()
        yield
        self._neighbours.look(deaf)
        yield
        if speaker.step(self._active) and service.published is not None:
            self._put(Publish("parameters", service.published))
        self._neighbours.note(speaker.ours, speaker.problem)
        yield
        health = service.health()
        fields = messages.fit_status(health.status, self._id, health.fit_seconds)
        if "no rotor speeds" in fields["reason"]:
            fields["reason"] += f"; here: {self._hint}"
        speaker.publish("status", fields)
        yield
        notes, hints = dict(self._neighbours.notes), self._intake.troubles()
        stamp = self.get_clock().now().to_msg()
        now = {"sec": stamp.sec, "nanosec": stamp.nanosec}
        report = messages.diagnostics(health, self.get_fully_qualified_name(), self._id, now, notes, hints)
        speaker.publish("diagnostics", report)

    def _on_set(self, changes: list[Any]) -> SetParametersResult:
        if self._service is None:
            return SetParametersResult(successful=True)
        problem = next(filter(None, (check_change(change.name, change.value) for change in changes)), "")
        decided = [change.value for change in changes if change.name == "approval" and not problem]
        said = "; ".join(self._service.decide_approval(value).text for value in decided)
        return SetParametersResult(successful=not problem, reason=problem or said)
