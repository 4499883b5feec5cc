"""`ros2 run quadid_node bridge`: sets parameters of a controller node from accepted parameter sets.

Every set is checked as docs/using-with-ros.md asks of a controller; what passes is mapped to parameters of one named
node, held against limits and a largest step, and set in one transaction.  With `dry_run`, the default, the bridge only
logs what it would set.
"""

import math
import re
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import rclpy
import rclpy.parameter
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from quadid.errors import QuadidError
from quadid.sanitise import one_line
from quadid_node import messages
from quadid_node.inputs import message_class, service_class, to_message
from quadid_node.messages import PARAMETER_SET, SCHEMA_VERSION, TOPICS
from quadid_node.process import SPIN_SECONDS, StopSignal, end_middleware, without_shared_memory
from quadid_node.publish import LATCHED_QOS

SAME_MASS = 0.02
"""Relative difference of masses [1] within which a set belongs to the controller's vehicle."""
RETRY_SECONDS = 1.0
"""A controller that does not answer is asked again after this time [s]; health is reported as often."""
ANSWER_SECONDS = 5.0
"""A question that the controller has not answered after this time [s] is given up: it died, or hangs."""
_NUMBER = r"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?"
_ENTRY = re.compile(rf"(\S+) = (?:({_NUMBER}) \* )?(\w+) in ({_NUMBER}) \.\. ({_NUMBER})")
OPTIONS = {
    "controller": ("", "Name of the node whose parameters are set, as ros2 node list shows it."),
    "map": ([""], "Entries 'gains.roll.p = 11.0 * J_xx in 0.01 .. 1.0': parameter, factor, name in the set, limits."),
    "dry_run": (True, "Only log what would be set; false applies the newest set. A rollback sets it to true."),
    "step": (0.5, "Largest relative change of a parameter of the controller by one set."),
    "mass": (0.0, "[kg] of the controller's vehicle; 0: sets of any mass."),
    "vehicle_id": ("", "Only sets of this vehicle; '': any on the topic."),
    "restore_out_of_date": (False, "When a set is withdrawn, put back the values from before the first set."),
}
"""Parameters: default and description."""


class MapEntry(NamedTuple):
    """One parameter of the controller: `factor` times the value `source` of a set, within `low` to `high`."""

    target: str
    factor: float
    source: str
    low: float
    high: float


class ParameterPlan(NamedTuple):
    """Values to set by parameter, and what is left as it is, for people; or why nothing is set."""

    values: dict[str, float]
    left: str = ""
    refused: str = ""


def entry(text: str) -> MapEntry:
    """Reads an entry of `map`; raises QuadidError."""
    found = _ENTRY.fullmatch(text.strip())
    if found is None:
        raise QuadidError(
            f"map: '{text}'", "'parameter = factor * name in low .. high', as in the option's description"
        )
    target, factor, source, low, high = found.groups()
    made = MapEntry(target, float(factor or 1.0), source, float(low), float(high))
    if not made.low < made.high:
        raise QuadidError(f"map: '{text}'", "a lower limit below the upper one")
    return made


def objection(message: Any, vehicle: str, mass: float, newest: int) -> str:
    """Reason why a set is not for this controller, or not in force; empty when it may be applied."""
    if message.schema_version != SCHEMA_VERSION:
        return f"schema {message.schema_version}, this bridge supports {SCHEMA_VERSION}"
    if not len(message.names) == len(message.values) == len(message.status):
        return f"{len(message.names)} names, {len(message.values)} values and {len(message.status)} status"
    if vehicle and message.vehicle_id != vehicle:
        return f"it belongs to {message.vehicle_id}"
    if message.state not in (message.STATE_ACCEPTED, message.STATE_ROLLED_BACK):
        return f"not in force: {message.reason}"
    if message.sequence <= newest:
        return f"set {message.sequence} is not newer than {newest}"
    if message.out_of_date:
        return f"out of date ({message.out_of_date_code}): {message.out_of_date_reason}"
    if mass and not abs(message.mass / mass - 1.0) <= SAME_MASS:
        return f"it rests on a mass of {message.mass:.3g} kg, the controller's vehicle has {mass:.3g} kg"
    return ""


def plan(message: Any, entries: Sequence[MapEntry], now: Mapping[str, Any], step: float) -> ParameterPlan:
    """Values to set, from a set and the controller's values now; all of them or none."""
    found = dict(zip(message.names, zip(message.values, message.status, strict=True), strict=True))
    values, left = dict[str, float](), []
    for target, factor, source, low, high in entries:
        if source not in found:
            return ParameterPlan({}, refused=f"{target}: the set has no {source}")
        estimate, status = found[source]
        value, before = factor * estimate, now.get(target)
        if status != message.STATUS_IDENTIFIED:
            left.append(f"{target} (the data do not determine {source})")
        elif not isinstance(before, float):
            kind = "not declared" if before is None else "no double"
            return ParameterPlan({}, refused=f"{target} is {kind} in the controller")
        elif not (math.isfinite(value) and low <= value <= high):
            return ParameterPlan({}, refused=f"{target} = {value:.4g}, allowed: {low:g} .. {high:g}")
        elif not abs(value - before) <= step * abs(before):
            return ParameterPlan(
                {}, refused=f"{target} would change from {before:.4g} to {value:.4g}: more than {step:.0%}"
            )
        else:
            values[target] = value
    return ParameterPlan(values, ", ".join(left), "" if values else f"nothing to set: {', '.join(left)}")


class BridgeNode(Node):
    """Applies sets to one controller; one set at a time, the newest wins."""

    def __init__(self) -> None:
        """Reads the options; raises QuadidError."""
        super().__init__("quadid_bridge")
        for name, (default, text) in OPTIONS.items():
            self.declare_parameter(name, default, ParameterDescriptor(description=text))
        controller = self._option("controller")
        if not controller:
            raise QuadidError("controller is not given", fix="-p controller:=/name, as ros2 node list shows it")
        self._entries = [entry(text) for text in self._option("map") if text]
        if not self._entries:
            raise QuadidError("map is empty", fix="give a parameter file, as quadid_node/config/bridge.yaml")
        # One set at a time: who works waits for answers of the controller, which come meanwhile, as do reports.
        meanwhile, work = ReentrantCallbackGroup(), MutuallyExclusiveCallbackGroup()
        self._client = AsyncParameterClient(self, controller, callback_group=meanwhile)
        self._newest: Any = None
        self._applied, self._said, self._level = 0, "no set yet", b"\x00"
        self._asked, self._asked_at = Future(), 0.0
        self._original: dict[str, float] = {}
        self._before: dict[str, float] = {}
        self._tried = 0
        self.add_post_set_parameters_callback(self._on_option)
        kind, topic = message_class(PARAMETER_SET), TOPICS["parameters"][0]
        self.create_subscription(kind, topic, self._on_set, LATCHED_QOS, callback_group=work)
        trigger = service_class("std_srvs/Trigger")
        self.create_service(trigger, "~/rollback", self._on_rollback, callback_group=work)
        self._health = self.create_publisher(message_class(TOPICS["diagnostics"][1]), TOPICS["diagnostics"][0], 10)
        self.create_timer(RETRY_SECONDS, self._report, callback_group=meanwhile)
        self.create_timer(RETRY_SECONDS, self._work, callback_group=work)

    def _option(self, name: str) -> Any:
        return self.get_parameter(name).value

    def _say(self, text: str, level: bytes = b"\x00") -> None:
        text = one_line(text)
        if text != self._said:
            self._said, self._level = text, level
            if level == b"\x00":
                self.get_logger().info(text)
            else:
                self.get_logger().warning(text)

    def _report(self) -> None:
        """Once a second: health; a question without an answer is given up."""
        if time.monotonic() > self._asked_at + ANSWER_SECONDS:
            self._asked.cancel()
        stamp = self.get_clock().now().to_msg()
        status = messages.entry(
            self.get_fully_qualified_name(),
            "controller",
            self._option("vehicle_id"),
            self._level,
            self._said,
            {"applied set": self._applied},
        )
        fields = {"header": {"stamp": {"sec": stamp.sec, "nanosec": stamp.nanosec}}, "status": [status]}
        self._health.publish(to_message(TOPICS["diagnostics"][1], fields))

    async def _on_set(self, message: Any) -> None:
        self._newest = message
        await self._work()

    def _on_option(self, changed: Sequence[Any]) -> None:
        """A plan that was only shown is carried out once `dry_run` is false: within a second."""
        if any(option.name == "dry_run" for option in changed):
            self._said = ""

    async def _work(self) -> None:
        """Applies the newest set, if that is asked for and possible; once a second as long as it is not."""
        if self._newest is not None:
            await self._apply(self._newest)

    async def _ask(self, question: Callable[[Any], Future], about: Any) -> Any:
        """The controller's answer; None, and said, where none comes."""
        answer = None
        if self._client.services_are_ready():
            self._asked, self._asked_at = question(about), time.monotonic()
            answer = await self._asked
        if answer is None:
            self._say(f"{self._option('controller')} does not answer", b"\x01")
        return answer

    async def _apply(self, message: Any) -> None:
        if message.sequence == self._applied:
            return
        why = objection(message, self._option("vehicle_id"), self._option("mass"), self._applied)
        if why:
            own = self._option("vehicle_id") in ("", message.vehicle_id)
            wanted = self._option("restore_out_of_date") and not self._option("dry_run")
            if not (own and wanted and message.out_of_date and self._original):
                self._say(f"set {message.sequence} not applied: {why}", b"\x01")
            elif await self._set(self._original, f"set {message.sequence} is out of date: first values put back"):
                self._original, self._applied = {}, message.sequence
            return
        targets = [e.target for e in self._entries]
        read = await self._ask(self._client.get_parameters, targets)
        if read is None:
            return
        now = dict(zip(targets, (rclpy.parameter.parameter_value_to_python(v) for v in read.values), strict=False))
        made = plan(message, self._entries, now, self._option("step"))
        if self._tried == message.sequence and now.items() >= made.values.items():
            now |= self._before  # it was set, only the answer was lost
        shown = ", ".join(f"{name} {now[name]:.4g} -> {value:.4g}" for name, value in made.values.items())
        if made.refused:
            self._say(f"set {message.sequence} not applied: {made.refused}", b"\x01")
        elif self._option("dry_run"):
            self._say(f"dry run: set {message.sequence} would set {shown}{made.left and f'; stays: {made.left}'}")
        else:
            done = await self._set(made.values, f"set {message.sequence} applied: {shown}")
            if done is not False:
                self._before, self._tried = {name: now[name] for name in made.values}, message.sequence
                self._original = {**self._before, **self._original}
            if done:
                self._applied = message.sequence

    async def _set(self, values: Mapping[str, float], done: str) -> bool | None:
        """Sets parameters of the controller, all or none; logs `done`, or why not.  None: no answer, perhaps set."""
        asked = [Parameter(name, value=value) for name, value in values.items()]
        answer = await self._ask(self._client.set_parameters_atomically, asked)
        if answer is None:
            return None
        result: SetParametersResult = answer.result
        if result.successful:
            self._say(done)
        else:
            self._say(f"nothing is set, {self._option('controller')} refuses: {result.reason}", b"\x01")
        return bool(result.successful)

    async def _on_rollback(self, request: Any, response: Any) -> Any:
        """Puts the values from before the last set back; from then on the bridge only shows what it would set."""
        self.set_parameters([Parameter("dry_run", value=True)])
        if not self._before:
            response.success, response.message = False, "no set was applied"
            return response
        response.success = bool(await self._set(self._before, "rolled back: dry_run is true from now on"))
        response.message = self._said
        if response.success:
            self._before, self._applied = {}, 0
        return response


def main(args: list[str] | None = None) -> int:
    """Runs the bridge until SIGINT or SIGTERM; returns the exit code: 0 done, 2 bad options."""
    code = _run(args, StopSignal())
    end_middleware()
    return code


def _run(args: list[str] | None, stop: StopSignal) -> int:
    without_shared_memory()
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = BridgeNode()
    except QuadidError as error:
        print(f"bridge: {error}", file=sys.stderr)  # noqa: T201 - a command's last word
        return 2
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        while not stop():
            executor.spin_once(timeout_sec=SPIN_SECONDS)
    except ExternalShutdownException:
        pass
    finally:
        stop.ignore_more()
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
