"""The ROS 2 lifecycle node of `identify` (node name `quadid`): topics and services around one `Service`.

Callbacks convert, call and publish; everything else is in `service` and in the core.
"""

from __future__ import annotations

import contextlib
import gc
import math
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock as RosClock
from rclpy.clock_type import ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import HistoryPolicy, QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from rclpy.subscription import Subscription

from quadid.errors import QuadidError
from quadid.online import Publish
from quadid.online.gate import Answer
from quadid.sanitise import one_line
from quadid.vehicle import Vehicle
from quadid_node import messages
from quadid_node.history import Store, default_path
from quadid_node.inputs import (
    DEPTH,
    Decoder,
    InputPreset,
    Intake,
    MessageTypeError,
    SourceSelector,
    best_ranks,
    deserializer,
    message_class,
    service_class,
    source,
    to_message,
)
from quadid_node.process import PARAMETERS, READ_BACK, as_declared, descriptor
from quadid_node.publish import NO_SUBSCRIPTION_EVENTS, Bond, GraphMonitor, Offer, Publishers
from quadid_node.recording import Beginning, Recorder
from quadid_node.service import Service, check_change, read_settings, vehicle_id
from quadid_node.zenoh import ZenohLink, fit_worker

ROUND_SECONDS = 0.1
"""A round is done this often [s]: rows of the grid wait five times as long for late channels."""
REPORT_SECONDS = 1.0
"""Status and health are published this often [s]."""
TOLD_SECONDS = 5.0
"""So often [s] `configure` logs that it waits for the fit process."""
MOST_SETS = 100
"""Sets that one answer of `get_history` holds at most."""
INACTIVE = "the node is not active; fix: activate it (ros2 lifecycle set)"
SENSOR_QOS = QoSProfile(depth=DEPTH, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)
COMMANDS: dict[str, tuple[str, Callable[[Service, Any], Answer]]] = {
    "fit_now": ("std_srvs/Trigger", lambda service, _: service.session.fit_now()),
    "rollback": ("std_srvs/Trigger", lambda service, _: service.roll_back("ros service")),
    "approve": ("quadid_msgs/Approve", lambda service, request: service.approve("ros service", request.sequence)),
}
"""Services a person may call, by name: type, and the action taken."""
Return = TransitionCallbackReturn
IDLE = {
    "unconfigured": "not configured yet; next: ros2 lifecycle set {name} configure",
    "configuring": "the fit process warms up; a first start compiles for a minute",
    "inactive": "takes no samples; next: ros2 lifecycle set {name} activate",
    "finalized": "shut down for good; next: start the process again",
}
"""Messages of a node that is not active, by its state."""


class IdentifyNode(LifecycleNode):
    """Identifies one vehicle from its topics and publishes the parameter sets that passed the gate."""

    def __init__(self, stopping: Callable[[], bool] = lambda: False) -> None:
        """Declares the parameters; everything else waits for `configure`.

        Args:
            stopping: True once the process is asked to end, so that nothing is waited for any more.
        """
        self._polled: list[Subscription[Any]] = []
        self._broken_at: dict[str, float] = {}
        super().__init__("quadid")
        self._stopping = stopping
        for p in PARAMETERS:
            self.declare_parameter(p.name, p.default, descriptor(p))
        self.add_on_set_parameters_callback(self._on_set)
        self._given: dict[str, Any] = {}
        self._id, self._problem, self._reads_back = "", "", False
        self._service: Service | None = None
        self._recorder: Recorder | None = None
        self._graph: GraphMonitor | None = None
        self._intake = Intake()
        self._bond: Bond | None = None
        self._zenoh: ZenohLink | None = None
        self._opened = contextlib.ExitStack()
        self._outputs = Publishers(self)
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._on_change_state
        self._report_at, self._active = 0.0, False
        self.create_timer(ROUND_SECONDS, self._round, clock=RosClock(clock_type=ClockType.STEADY_TIME))

    def start(self) -> bool:
        """Configures and activates a node that has no lifecycle manager (`autostart`); False: it cannot be."""
        if not self.get_parameter("autostart").value:
            return True
        return all(trigger() == Return.SUCCESS for trigger in (self.trigger_configure, self.trigger_activate))

    # --- life cycle

    def _on_change_state(self, request: Any, response: Any) -> Any:
        """Refuses what cannot be done in this state: rclpy raises there, which would end the process."""
        wanted, possible = request.transition, {t[0]: t[1] for t in self._state_machine.available_transitions}
        if wanted.label in possible.values() if wanted.label else wanted.id in possible:
            return self._change_state(request, response)
        allowed = ", ".join(f"{label} ({number})" for number, label in possible.items()) or "nothing"
        self._log("warning", f"transition {wanted.label or wanted.id} cannot be made when {self._state}: {allowed} can")
        response.success = False
        return response

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Reads parameters and vehicle, opens the history, subscribes, waits until fits can begin."""
        self._problem = ""
        try:
            self._configure()
        except QuadidError as error:
            self._problem = str(error)
        except Exception as error:  # noqa: BLE001 - rclpy would drop it without a word
            self._problem = f"configure failed: {error!r} ({traceback.extract_tb(error.__traceback__)[-1]})"
        if self._problem:
            self._log("error", self._problem)
            self.on_cleanup(state)
            return Return.FAILURE
        gc.collect()
        gc.freeze()  # what there is now need not be looked through in flight
        return Return.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begins to take samples and to publish, and the bond where a lifecycle manager activates."""
        result = super().on_activate(state)
        self._active = True
        self._claim_topic()
        if not self._given["autostart"]:
            with contextlib.suppress(MessageTypeError):  # without the package `bond` a manager needs bond_timeout: 0.0
                self._bond = Bond(self)
        self._log("info", f"ready: identifies '{self._id}'")
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stops taking samples and publishing; what was learned is kept."""
        self._active = False
        self._break_bond()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Puts away what `configure` opened; also at the end and after an error: it can be configured again."""
        self._active = False
        gc.unfreeze()
        self._break_bond()
        self._opened.close()
        self._service = self._recorder = self._zenoh = None
        return Return.SUCCESS

    on_shutdown = on_error = on_cleanup

    @property
    def _state(self) -> str:
        label: str = self._state_machine.current_state[1]
        return label

    def _configure(self) -> None:
        values = {p.name: as_declared(p, self.get_parameter(p.name).value) for p in PARAMETERS}
        vehicle, settings = Vehicle.named(values["vehicle"]), read_settings(values)
        preset = source(values["source"])
        self._id = vehicle_id(values["vehicle_id"], self.get_namespace(), vehicle)
        self._observer = bool(values["observer"])
        inputs = {self.resolve_topic_name(entry.topic): entry.type.replace("/", "/msg/") for entry in preset.inputs}
        self._graph = GraphMonitor(inputs, self._offers_on, self.unbroken, lambda text: self._log("error", text))
        self._given, opened = values, self._opened.callback
        opened(self._poll_no_more)
        opened(self._intake.clear)
        self._subscribe(preset, vehicle)
        keeps = not self._observer and values["history"] != "none"
        store = Store(Path(values["history"] or default_path()), self._id) if keeps else None
        if store is not None:
            opened(store.close)
        fits = fit_worker(vehicle, self._id, values["ground_worker"], values["worker_memory"])
        opened(self._read_back, {name: values[name] for name in READ_BACK})
        self._service = Service(vehicle, settings, fits, store)
        opened(self._service.close)
        if values["record"]:
            beginning = Beginning(vehicle, settings, values["source"], self._service.restored)
            self._recorder = Recorder(Path(values["record"]), beginning, preset.inputs)
            opened(self._recorder.close)
        self._hint = preset.motor_hint
        if values["zenoh"]:
            self._zenoh = ZenohLink(values["zenoh"], self._id, self._service)
            opened(self._zenoh.close)
        opened(self._outputs.close)
        self._outputs.open(self._observer)
        answers = {name: (kind, self._command(do)) for name, (kind, do) in COMMANDS.items()}
        answers["get_history"] = ("quadid_msgs/GetHistory", self._on_get_history)
        for name, (kind, answer) in answers.items():
            opened(self.destroy_service, self.create_service(service_class(kind), f"quadid/{name}", answer))
        self._warm_up(self._service, values["warm_up"])
        history = str(store.path) if store is not None else "none"
        self._read_back({**values, "vehicle_id": self._id, "history": history, "approval": self._service.approval})

    def _warm_up(self, service: Service, seconds: float) -> None:
        """Waits until a fit could begin at once; raises QuadidError after so many seconds."""
        begin = time.monotonic()
        told = begin
        while not service.ready and not self._stopping():
            self._put(service.idle())
            now = time.monotonic()
            if now - begin > seconds:
                fix = "run 'quadid warmup' once, which compiles for every later start, or set warm_up higher"
                raise QuadidError(
                    f"the fit process is not warm after {seconds:g} s ({service.health().worker})", fix=fix
                )
            if now - told >= TOLD_SECONDS:
                told = now
                self._log("info", f"{IDLE['configuring']}: {now - begin:.0f} s of {seconds:g} s")
            self._report_if_due()
            time.sleep(0.02)
        self._log("info", f"the fit process is warm after {time.monotonic() - begin:.1f} s")

    def _read_back(self, values: dict[str, Any]) -> None:
        """Sets parameters to what is in force."""
        self._reads_back = True
        now = {name: self.get_parameter(name).value for name in values}
        self.set_parameters(
            [Parameter(n, value=v) for n, v in values.items() if v != now[n] or type(v) is not type(now[n])]
        )
        self._reads_back = False

    def _subscribe(self, preset: InputPreset, vehicle: Vehicle) -> None:
        mounted = "mounting" in vehicle.model_fields_set
        chooser = SourceSelector(best_ranks(preset.inputs))
        for entry in preset.inputs:
            decoder = Decoder(entry, chooser, len(vehicle.rotors), deserializer(entry.type), mounted)
            topic = self.resolve_topic_name(entry.topic)
            take = self.poll(message_class(entry.type), entry.topic, SENSOR_QOS)
            self._intake.open(entry, topic, decoder, take)

    def _offers_on(self, topic: str) -> list[Offer]:
        found = self.get_publishers_info_by_topic(topic)
        fits = [qos_check_compatible(info.qos_profile, SENSOR_QOS)[0] != QoSCompatibility.ERROR for info in found]
        return [Offer(info.topic_type, heard) for info, heard in zip(found, fits, strict=True)]

    def _break_bond(self) -> None:
        if self._bond is not None:
            self._bond.close()
            self._bond = None

    # --- topics whose messages are taken when they are wanted, instead of the node being woken for each

    @property
    def subscriptions(self) -> Iterator[Subscription[Any]]:
        """Entities for which the executor waits: all but the polled ones."""
        return (s for s in super().subscriptions if s not in self._polled)

    def poll(self, kind: Any, topic: str, qos: Any) -> Callable[[], bytes | None]:
        """Subscribes to a topic; returns what gives its next serialized message that waits, None when there is none."""
        subscription = self.create_subscription(
            kind, topic, lambda message: None, qos, raw=True, event_callbacks=NO_SUBSCRIPTION_EVENTS
        )
        self._polled.append(subscription)
        handle, name, last = subscription.handle, subscription.topic_name, None

        def take() -> bytes | None:
            nonlocal last
            with handle:
                taken = handle.take_message(kind, True)
            if taken is None:
                return None
            number = taken[1]["publication_sequence_number"]
            if number is None or last is None or number != last + 1:
                self._broken_at[name] = time.monotonic()
            last = number
            return bytes(taken[0])

        return take

    def _poll_no_more(self) -> None:
        while self._polled:
            self.destroy_subscription(self._polled.pop())
        self._broken_at.clear()

    def unbroken(self, topic: str) -> float:
        """For how long [s] the messages of a polled topic have been one publisher's, each numbered one above the last.

        Publishers number their own messages, so two that are heard break each other's row; so does a loss.
        """
        return time.monotonic() - self._broken_at.get(topic, -math.inf)

    # --- callbacks

    def _round(self) -> None:
        """All there is to do again and again: take in what has arrived, write it down, work on it, report."""
        service, graph, recorder = self._service, self._graph, self._recorder
        # What has arrived since the last round, topic by topic; while two publish an input it is forgotten.
        waiting = self._intake.take()
        if graph is not None:
            for polled in self._polled:  # a publisher is counted before its first message can be taken
                graph.count(polled.topic_name, polled.get_publisher_count())
        if service is not None and graph is not None and self._active and not graph.paused:
            for block in self._intake.read(waiting, recorder.take if recorder is not None else None):
                service.push(block)
        if service is not None:
            self._put(service.step() if self._active else service.idle())
        self._report_if_due()

    def _put(self, outputs: list[messages.Output]) -> None:
        """Publishes what the service hands out, and logs its events."""
        for output in outputs:
            if output.topic == "event":
                self._log(output.level, output.text)
            elif self._service is not None and not self._outputs.silent and output.topic in messages.RESULTS:
                tell = messages.RESULTS[output.topic].message
                self._send(output.topic, tell(output, self._id, self._service.boot_id))
                if self._zenoh is not None:
                    self._zenoh.publish(output)
        if self._service is not None and self._service.approval != self.get_parameter("approval").value:
            self._read_back({"approval": self._service.approval})

    def _send(self, topic: str, fields: messages.Message) -> None:
        """Publishes a message, with the time by the node's clock where it has a field for it."""
        published = {"published": self._now()} if topic in messages.PUBLISHED else {}
        self._outputs.publish(topic, {**fields, **published})

    def _now(self) -> messages.Message:
        stamp = self.get_clock().now().to_msg()
        return {"sec": stamp.sec, "nanosec": stamp.nanosec}

    def _claim_topic(self) -> None:
        """Looks after the topic of parameter sets; once it is ours, publishes what is in force."""
        if not self._outputs.step(self._active) or self._service is None:
            return
        if self._service.published is not None:
            self._put([Publish("parameters", self._service.published)])
        elif self._service.session.active_set.in_force is None:
            self._send("parameters", messages.no_set(self._id, self._service.boot_id))

    def _log(self, level: str, text: str) -> None:
        """One call a level: rclpy remembers the level of each line of code and refuses another."""
        log, text = self.get_logger(), one_line(text)
        if level == "info":
            log.info(text)
        elif level == "warning":
            log.warning(text)
        else:
            log.error(text)

    def _report_if_due(self) -> None:
        """Once a second, in every state: status, health, who else publishes inputs or parameter sets of our vehicle."""
        now = time.monotonic()
        if now < self._report_at:
            return
        self._report_at = max(self._report_at, now - ROUND_SECONDS) + REPORT_SECONDS
        name, idle = self.get_fully_qualified_name(), ""
        if not self._active:
            idle = f"{self._state}: {IDLE.get(self._state, 'changes its state').format(name=name)}"
        status: messages.Message = {"vehicle_id": self._id, "reason": idle, "cost": math.nan, "seconds": math.nan}
        health, notes = None, dict[str, str]()
        if self._service is not None and self._graph is not None:
            self._graph.look(self._outputs.deaf())
            self._claim_topic()
            self._graph.note(self._outputs.ours, self._outputs.problem)
            health = self._service.health()
            if self._zenoh is not None:
                self._zenoh.report(health)
                self._graph.note("zenoh", self._zenoh.problem)
                if self._active:
                    self._zenoh.attend()
            notes = dict(self._graph.notes)
            if self._active:
                status = messages.fit_status(health.status, self._id, health.fit_seconds)
            if "no rotor speeds" in status["reason"]:
                status["reason"] += f"; here: {self._hint}"
            status["in_force"] = health.status.in_force
        self._send("status", status)
        hints = self._intake.troubles()
        report = messages.diagnostics(health, name, self._id, self._now(), notes, hints, idle, self._problem)
        self._send("diagnostics", report)

    def _command(self, do: Callable[[Service, Any], Answer]) -> Callable[[Any, Any], Any]:
        """A callback of a ROS service that carries out what a person asks of the service."""

        def carry_out(request: Any, response: Any) -> Any:
            service = self._service if self._active else None
            if service is None:
                response.success, response.message = False, INACTIVE
                return response
            answer = do(service, request)
            response.success, response.message = answer.done, answer.text
            self._put(service.step())
            if hasattr(response, "in_force"):
                response.in_force = service.session.status().in_force
            return response

        return carry_out

    def _on_get_history(self, request: Any, response: Any) -> Any:
        if self._service is None or not self._active:
            response.message = INACTIVE
            return response
        try:
            found = self._service.stored_sets(min(request.most or MOST_SETS, MOST_SETS))
        except QuadidError as error:
            response.message = str(error)
            return response
        response.sets = [to_message(messages.PARAMETER_SET, fields) for fields in found]
        response.success = True
        response.message = f"the newest {len(found)} sets of {self.get_parameter('history').value}"
        return response

    def _on_set(self, changes: list[Any]) -> SetParametersResult:
        if self._service is None or self._reads_back:
            return SetParametersResult(successful=True)
        problem = next(filter(None, (check_change(change.name, change.value) for change in changes)), "")
        decided = [change.value for change in changes if change.name == "approval" and not problem]
        said = "; ".join(self._service.decide_approval(value).text for value in decided)
        return SetParametersResult(successful=not problem, reason=problem or said)
