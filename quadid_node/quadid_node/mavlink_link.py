"""The service on a MAVLink link: asks for messages, measures what comes, and tells its results as component 191."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quadid_replay.tlog_messages import READERS

from quadid.health.watch import HealthReport
from quadid.online.records import OnlineSet
from quadid.window import Sample
from quadid_node.mavlink_decode import MavlinkDecoder
from quadid_node.mavlink_parameters import parameters_of
from quadid_node.mavlink_peers import Source
from quadid_node.mavlink_requests import Requests
from quadid_node.mavlink_wire import LinkError, Wire, dialect, message_id, sender
from quadid_node.publication import Output

COMPONENT = 191
"""MAV_COMP_ID_ONBOARD_COMPUTER."""
MOTORS = 80.0
"""Sticks come in steps, mostly of 20 or 40 ms, and the rate loop answers each.  Snapshots of motors in step with them
err alike: slow torque by 6 % where at this rate [Hz] it is 0.4 % (`python -m studies.autopilot.readings`)."""
REQUESTED = {
    "HIGHRES_IMU": 100.0, "RAW_IMU": 100.0, "ATTITUDE_QUATERNION": 50.0, "SERVO_OUTPUT_RAW": MOTORS,
    "ACTUATOR_OUTPUT_STATUS": MOTORS, "ESC_STATUS": MOTORS, "ATTITUDE_TARGET": 50.0,
    "LOCAL_POSITION_NED": 20.0, "BATTERY_STATUS": 1.0,
}  # fmt: skip
"""Messages asked for, with their rates [Hz]."""
FRAMES_A_SECOND, OTHERS_A_SECOND = 4000, 1000
"""More frames of the vehicle, or of all others together, are a flood: the rest is dropped unread."""
FLOODED = 10.0
"""A flood is a problem for so long after its last frame [s]."""
LIST_EVERY = 1.0
"""All our parameters are told so often at most [s]: one short request asks for seventeen frames."""
SEVERITY = {"error": 3, "warning": 4, "info": 6}
_READ_ONLY, _UNKNOWN = dialect.MAV_PARAM_ERROR_READ_ONLY, dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST
_REAL32 = 9
_TEXT = 50
_IDS = {m.msgname: n for n, m in dialect.mavlink_map.items()}
_ANSWERED = ("HEARTBEAT", "PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET")
_OF_OTHERS = frozenset(_IDS[n] for n in _ANSWERED)
_WANTED = _OF_OTHERS | {_IDS[n] for n in (*READERS, "COMMAND_ACK", "PARAM_VALUE") if n in _IDS}


@dataclass(frozen=True)
class Traffic:
    """What comes over the link: measured rates [Hz] by message, requests denied, frames refused, bytes dropped.

    Attributes:
        behind: a stream signed with our key is refused because its stamps are this far behind [s]; 0 for none.
        problems: what speaks against the link, sentences for people.
    """

    rates: dict[str, float]
    denied: tuple[str, ...]
    refused: int
    dropped: int
    behind: float = 0.0
    problems: tuple[str, ...] = ()


class MavlinkLink:
    """The service's end of a MAVLink link.

    Attributes:
        vehicle_system: system id of the vehicle; 0 before it was heard.
    """

    def __init__(
        self, url: str, rotors: int, system: int = 0, key: bytes | None = None,
        clock: Callable[[], float] = time.monotonic, memory: Path | None = None,
    ) -> None:  # fmt: skip
        """Opens the link.

        Args:
            url: any URL of pymavlink.
            rotors: of the vehicle.
            system: system id of the vehicle; 0 takes the first autopilot heard.
            key: signing key.
            clock: seconds, monotonic.
            memory: file that keeps the time stamps of signatures over a restart.

        Raises:
            LinkError: the link cannot be opened.
        """
        if not 0 <= system <= 255:
            raise LinkError(f"system id {system}", "1 to 255, or 0 for the first one heard")
        self._wire, self._key = Wire(url, system or 1, COMPONENT, key, memory), key is not None
        self._source = Source()
        self._decoder = MavlinkDecoder(rotors)
        self._clock = clock
        self.vehicle_system = 0
        self._only, self._target = system, 0
        self._beat, self._tell, self._listed, self._measured = -1e9, -1e9, -1e9, clock()
        self._list_due = False
        self._begin = self._empty = clock()
        self._before: dict[str, int] = {}
        self._rates: dict[str, float] = {}
        self._requests = Requests()
        self._set: OnlineSet | None = None
        self._text = 0
        self._left, self._second = {True: FRAMES_A_SECOND, False: OTHERS_A_SECOND}, 0
        self._flooded = {True: -math.inf, False: -math.inf}

    # --- in

    def receive(self) -> Iterator[Sample]:
        """Yields the samples that have arrived; answers what was asked of us."""
        now = last = self._clock()
        if int(now) != self._second:
            self._second, self._left = int(now), {True: FRAMES_A_SECOND, False: OTHERS_A_SECOND}
        for message in self._wire.receive(_WANTED, self._admits, now, None if self._key else self._count):
            last, kind = self._clock(), message.get_type()
            if kind == "HEARTBEAT":
                self._find(message)
            if self._is_vehicle(message):
                if not self._source.take(self._wire.source, self._wire.listened):
                    continue
                self._wire.follow(self._wire.source)
            if kind == "HEARTBEAT":
                self._on_heartbeat(message)
            elif kind in ("PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET"):
                self._on_parameter(kind, message)
            elif kind == "COMMAND_ACK" and self._is_vehicle(message):
                self._on_ack(message)
            elif self._is_vehicle(message):
                yield from self._decoder.samples(message, last, self._empty)
        if self._wire.drained:
            self._empty = last

    def _admits(self, frame: bytes) -> bool:
        """Whether a frame is worth its decoding: the vehicle's have a budget of their own, others' floods leave it."""
        _, *who = sender(frame)
        is_named = (*who,) == (self.vehicle_system, self._target)
        own = is_named and self._source.is_from(self._wire.source)
        if self.vehicle_system and not is_named and message_id(frame) not in _OF_OTHERS:
            return False
        self._left[own] -= 1
        if self._left[own] < 0:
            self._flooded[own] = self._clock()
        return self._left[own] >= 0

    def _count(self, frame: bytes) -> None:
        """Without a key every frame of the vehicle's ids is looked at: two senders have two rows of numbers."""
        number, system, component = sender(frame)
        if (system, component) == (self.vehicle_system, self._target):
            self._source.count(self._wire.source, number, self._wire.listened, frame)

    def _is_vehicle(self, message: Any) -> bool:
        return bool(
            self.vehicle_system
            and message.get_srcSystem() == self.vehicle_system
            and message.get_srcComponent() == self._target
        )

    def _find(self, message: Any) -> None:
        """The first autopilot heard is our vehicle; we speak under its system id."""
        if self.vehicle_system or message.autopilot == dialect.MAV_AUTOPILOT_INVALID:
            return
        if self._only in (0, message.get_srcSystem()):
            self.vehicle_system, self._target = message.get_srcSystem(), message.get_srcComponent()
            self._wire.mav.srcSystem = self.vehicle_system
            self._decoder.order.ardupilot = message.autopilot == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA

    def _on_heartbeat(self, message: Any) -> None:
        """Notes who is heard again and again and will be answered; asks the vehicle for the parameters we lack."""
        self._wire.peers.hello(self._wire.source, self._wire.listened, self._is_vehicle(message))
        if self._is_vehicle(message):
            for name in self._decoder.order.lacking():
                wanted = self.vehicle_system, self._target, name.encode(), -1
                self._send(dialect.MAVLink_param_request_read_message(*wanted))

    def _on_ack(self, message: Any) -> None:
        """Notes a refused request for a message."""
        if message.command != dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            return
        if message.result in (dialect.MAV_RESULT_ACCEPTED, dialect.MAV_RESULT_IN_PROGRESS):
            self._requests.answered("")
        else:
            known = dialect.enums["MAV_RESULT"].get(message.result)
            self._requests.answered(known.name if known is not None else f"result {message.result}")

    def _for_us(self, message: Any) -> bool:
        return message.target_system in (0, self._wire.mav.srcSystem) and message.target_component in (0, COMPONENT)

    def _on_parameter(self, kind: str, message: Any) -> None:
        if not self._for_us(message):
            return
        entries = parameters_of(self._set)
        if kind == "PARAM_REQUEST_LIST":
            self._list_due = True
            return
        names = [name for name, _ in entries]
        wanted = str(message.param_id)
        index = getattr(message, "param_index", -1)
        if kind == "PARAM_REQUEST_READ" and 0 <= index < len(names):
            self._send_parameter(index, answer=True)
        elif wanted in names and kind == "PARAM_REQUEST_READ":
            self._send_parameter(names.index(wanted), answer=True)
        elif wanted in names or message.target_component == COMPONENT:
            self._refuse(message, wanted, _READ_ONLY if wanted in names else _UNKNOWN)
            if wanted in names:
                self._send_parameter(
                    names.index(wanted), self._wire.source
                )  # for ground stations that do not know PARAM_ERROR

    def _refuse(self, message: Any, name: str, error: int) -> None:
        index = getattr(message, "param_index", -1)
        who = message.get_srcSystem(), message.get_srcComponent()
        self._send(dialect.MAVLink_param_error_message(*who, name.encode()[:16], index, error), answer=True)

    # --- out

    def step(self) -> None:
        """What is due: heartbeat, requests, measured rates, the numbers again for who came late."""
        now = self._clock()
        if now - self._beat >= 1.0:
            self._beat = now
            self._send(dialect.MAVLink_heartbeat_message(
                dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_AUTOPILOT_INVALID, 0, 0, dialect.MAV_STATE_ACTIVE, 3
            ))  # fmt: skip
        if now - self._measured >= 2.0:
            self._measure(now)
        if self._list_due and now - self._listed >= LIST_EVERY:
            self._list_due, self._listed = False, now
            for index in range(len(parameters_of(self._set))):
                self._send_parameter(index)
        if self.vehicle_system:
            self._ask(now)
        if self._set is not None and now - self._tell >= 5.0:
            self._tell = now
            self._send_values()

    def publish(self, output: Output) -> None:
        """Tells a result: numbers of a set in force, a line of text for what people should know."""
        if output.topic == "parameters":
            self._set = output.item
            self._tell = self._clock()
            for index in range(len(parameters_of(self._set))):
                self._send_parameter(index)
            self._send_values()
            self._say(6, f"quadid: set {output.item.sequence} {output.item.state.value}")
        elif output.topic == "diagnosis":
            for finding in output.findings:
                numbers = " ".join(f"{n} {v:.3g}" for n, v in finding.values.items() if n != "time")
                self._say(4, f"quadid: {finding.effect} {numbers}{'' if finding.confident else ' (?)'}")
        elif output.topic == "vehicle_health":
            self._send_health(output)
        elif output.topic == "event" and output.level != "info":
            self._say(SEVERITY[output.level], f"quadid: {output.text}")

    def traffic(self) -> Traffic:
        """What comes over the link."""
        wire = self._wire
        problems = [self._source.problem, self._decoder.order.problem, wire.memory_problem]
        for own, most, whose in ((True, FRAMES_A_SECOND, "the vehicle"), (False, OTHERS_A_SECOND, "others")):
            if self._clock() - self._flooded[own] < FLOODED:
                problems.append(f"a flood: more than {most} frames of {whose} in a second, the rest is dropped unread")
        if self._clock() - wire.held_back < FLOODED:
            problems.append("more is asked for than may be sent: answers are held back")
        if not self._key and wire.signed:
            problems.append("the frames are signed, but there is no key to check them: use --key")
        if self._key and wire.refused and not self.vehicle_system and not wire.signed:
            problems.append("a key is set, but the frames are not signed: send the key to the vehicle (SETUP_SIGNING)")
        said = tuple(p for p in problems if p)
        return Traffic(dict(self._rates), self._requests.denied, wire.refused, wire.dropped, wire.mav.behind, said)

    def close(self) -> None:
        """Closes the link."""
        self._wire.close()

    def _ask(self, now: float) -> None:
        """Asks for the messages that do not come at 60 % of their rate."""
        wanted = REQUESTED | dict.fromkeys(self._decoder.order.esc_groups(), MOTORS)
        lacking = [n for n, rate in wanted.items() if n in _IDS and self._rates.get(n, 0.0) < 0.6 * rate]
        for name in self._requests.due(lacking, now):
            self._send(dialect.MAVLink_command_long_message(
                self.vehicle_system, self._target, dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0,
                float(_IDS[name]), 1e6 / wanted[name], 0.0, 0.0, 0.0, 0.0, 0.0,
            ))  # fmt: skip

    def _measure(self, now: float) -> None:
        counts = self._decoder.counts
        span = now - self._measured
        self._rates = {n: (c - self._before.get(n, 0)) / span for n, c in counts.items()}
        self._before, self._measured = dict(counts), now

    def _send(self, message: Any, answer: bool = False) -> None:
        self._wire.send(message, self._clock(), answer)

    def _send_parameter(self, index: int, answer: bool = False) -> None:
        entries = parameters_of(self._set)
        name, value = entries[index]
        self._send(dialect.MAVLink_param_value_message(name.encode(), value, _REAL32, len(entries), index), answer)

    def _send_values(self) -> None:
        self._send_named([(name, value) for name, value in parameters_of(self._set) if len(name) <= 10])

    def _send_health(self, report: HealthReport) -> None:
        """Score and loss of each rotor [%] as named values; what changed is a line of text of its own."""
        losses = [(f"QI_LOSS{j + 1}", 100 * v) for j, v in enumerate(report.rotor_loss)]
        self._send_named([("QI_HEALTH", report.score), *losses])
        if not report.has_baseline:
            self._say(5, f"quadid: {report.text}")

    def _send_named(self, values: Sequence[tuple[str, float]]) -> None:
        ms = int((self._clock() - self._begin) * 1e3) % 2**32
        for name, value in values:
            self._send(dialect.MAVLink_named_value_float_message(ms, name.encode(), value))

    def _say(self, severity: int, text: str) -> None:
        plain = "".join(c if 32 <= ord(c) < 127 else "?" for c in text).encode()
        if len(plain) <= _TEXT:
            self._send(dialect.MAVLink_statustext_message(severity, plain))
            return
        self._text = self._text % 65535 + 1
        for k in range(min(len(plain) // _TEXT + 1, 256)):  # the last one is short, be it empty
            piece = plain[k * _TEXT : (k + 1) * _TEXT]
            self._send(dialect.MAVLink_statustext_message(severity, piece, self._text, k))
