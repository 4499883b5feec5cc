"""MAVLink link of the service: requests and decodes messages, sends results as component 191, and serves."""

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from quadid_replay.mavlink_messages import ESC_GROUPS, PREFERENCE, READERS, BootClock, Reading, boot_seconds, boot_stamp
from quadid_replay.motors import (
    ESCS,
    MOTOR_FUNCTION,
    Outputs,
    changed_functions,
    esc_columns,
    motor_outputs,
    no_multirotor,
)

from quadid.data.window import Block
from quadid.online.records import OnlineSet
from quadid.online.stream import CONFIRMATIONS
from quadid_node.inputs import SourceSelector
from quadid_node.mavlink_wire import LinkError, VehicleSender, Wire, dialect, is_autopilot, message_id, sender
from quadid_node.messages import Output, ServiceHealth
from quadid_node.service import Service

# --- Which output drives which rotor of a live vehicle: asked of the autopilot, taken over once, never changed in use


ASKED = tuple(f"SERVO{n}_FUNCTION" for n in range(1, ESCS + 1))
"""Parameters of ArduPilot that are asked for, once with each heartbeat …"""
MOST_ROUNDS = 5
"""... and so often at most."""
_ESC_MESSAGES = ("ESC_STATUS", "ESC_TELEMETRY")
PATIENCE = 6.0
"""Time after its first outputs [s] from which defaults stand for what an ArduPilot has not answered."""


class MotorOrder:
    """The outputs that are motors.

    Attributes:
        kind: MAV_TYPE of its heartbeats; 0 for unknown.
        problem: what speaks against its outputs; empty for nothing.
    """

    def __init__(self, rotors: int) -> None:
        """Starts empty, for a vehicle with `rotors` rotors."""
        self.ardupilot, self.kind = False, 0
        self.problem = ""
        self._rotors = rotors
        self._parameters: dict[str, float] = {}
        self._used: dict[tuple[str, int], list[int]] = {}
        self._first = math.nan
        self._rounds = 0
        self._moved = False
        self._turning = [False] * ESCS

    def lacking(self) -> list[str]:
        """Parameters to ask for now; none where all are known, or it does not answer."""
        names = [name for name in ASKED if self.ardupilot and name not in self._parameters]
        self._rounds += 1
        return names if self._rounds <= MOST_ROUNDS else []

    def tell(self, name: str, value: float) -> None:
        """Takes a parameter of the autopilot; one that moves a motor while outputs are in use ends their use.

        An output is still wired to the rotor that it drove before: no order is right from then on.
        """
        if not MOTOR_FUNCTION.fullmatch(name):  # any other name would only take memory
            return
        changed = changed_functions([name, name], [self._parameters.get(name, value), value])
        self._parameters[name] = value
        against = any(
            self._columns(message, width).columns != columns for (message, width), columns in self._used.items()
        )
        if against or (changed and self._used):
            self._moved = True
            self.problem = (
                f"the motor order changes in use: {changed or f'{name} {value:g}'}; no output is used any more: put it "
                "back as the vehicle file has it and start the service again"
            )

    def take(self, values: tuple[float, ...], message: str, now: float) -> tuple[float, ...]:
        """The values of the rotors, one by one; empty where it is not known which they are, or no more."""
        if self._moved:
            return ()
        if message in _ESC_MESSAGES:
            self._turning = [turns or value > 0.0 for turns, value in zip(self._turning, values, strict=True)]
        columns = self._used.get((message, len(values)))
        if columns is None:  # none is used for good as long as an ArduPilot may tell more, or where there is a problem
            self._first = now if math.isnan(self._first) else self._first
            found = self._columns(message, len(values))
            silent = self.ardupilot and not found.told
            if silent and now - self._first < PATIENCE:
                return ()
            columns, self.problem = found.columns, found.problem
            if silent and not found.problem:
                outputs = ", ".join(str(k + 1) for k in columns)
                self.problem = (
                    f"the autopilot has not sent SERVOn_FUNCTION, which names the motor outputs: {outputs} are used"
                )
            if columns and (message not in _ESC_MESSAGES or any(self._turning)):
                self._used[message, len(values)] = columns
        return tuple(values[i] for i in columns)

    def _columns(self, message: str, width: int) -> Outputs:
        if other := no_multirotor({}, self.kind):
            return Outputs([], other, told=True)
        if message in _ESC_MESSAGES:
            return esc_columns(self._parameters, self._rotors, self._turning, message, self.ardupilot)
        return motor_outputs(self._parameters, self._rotors, width, message, self.ardupilot)

    def esc_groups(self) -> list[str]:
        """Messages of ArduPilot's ESCs that may be motors: those on their outputs, and the first ones."""
        columns = motor_outputs(self._parameters, self._rotors, ESCS, "ESC", self.ardupilot).columns
        return [ESC_GROUPS[k] for k in sorted({k // 4 for k in (*columns, *range(self._rotors))})]


# --- A live vehicle's MAVLink messages as blocks, at absolute times; the rules are those of telemetry logs


REBOOT = 1.0
"""The vehicle's clock this far back [s] is one that began anew, once further stamps of the gyro agree."""
MOTOR_PREFERENCE = {
    "rotor_speed": ("ESC_STATUS", "ESC_TELEMETRY"),
    "motor_command": ("ACTUATOR_OUTPUT_STATUS", "SERVO_OUTPUT_RAW"),
}
RANKS = {
    (channel, name): rank
    for table in (PREFERENCE, MOTOR_PREFERENCE)
    for channel, names in table.items()
    for rank, name in enumerate(names)
}
"""Best message for each channel."""


_MOTORS = {"esc": "rotor_speed", "servo": "motor_command", "actuator": "motor_command"}


@dataclass
class _Round:
    """Values of one round's messages by output, their number, begin of the last message, time of the first [s]."""

    row: list[float] = field(default_factory=lambda: [math.nan] * ESCS)
    width: int = 0
    place: float = math.inf
    t: float = math.nan


class MavlinkDecoder:
    """MAVLink messages of one vehicle as blocks."""

    def __init__(self, rotors: int, wall: Callable[[], float] = time.time) -> None:
        """Expects a vehicle with `rotors` rotors; `wall` returns the UNIX time [s] to which its clock is set."""
        self.counts: Counter[str] = Counter()
        self.order = MotorOrder(rotors)
        self._chooser = SourceSelector({channel: 0 for channel, _ in RANKS})
        self._boot_clock: BootClock[list[Reading]] = BootClock()
        self._wall, self._epoch, self._newest, self._back = wall, math.nan, -math.inf, 0
        self._rounds: dict[str, _Round] = {}

    def blocks(self, message: Any, received: float, earliest: float | None = None) -> Iterator[Block]:
        """Yields what may be used now.

        Args:
            received: when it was read [s, any clock that runs on].
            earliest: it came after this [s, same clock]; default: when it was read.
        """
        name = message.get_type()
        self.counts[name] += 1
        if name == "PARAM_VALUE":
            self.order.tell(str(message.param_id), float(message.param_value))
            return
        if name not in READERS or (name == "RAW_IMU" and not self.order.ardupilot):
            return
        readings = [r for r in READERS[name](message) if r.known]
        if not readings:
            return
        clock = self._boot_clock
        boot = boot_stamp(float(boot_seconds(message)), name == "SERVO_OUTPUT_RAW", clock.newest)
        came = received if earliest is None else earliest
        placed = clock.unstamped(readings, came) if boot is None else clock.stamped(readings, boot, received)
        for waited, t in placed:
            if t is not None:
                # UNIX time: the vehicle's clock is set by ours when it is first heard and when the gyro shows a reboot
                if any(reading.signal == "gyro" for reading in waited):
                    self._back = self._back + 1 if t < self._newest - REBOOT else 0
                    self._newest = max(self._newest, t)
                anew = self._back > CONFIRMATIONS
                if anew:
                    self._newest, self._back = t, 0
                if math.isnan(self._epoch) or (anew and abs(t + self._epoch - self._wall()) > REBOOT):
                    self._epoch = self._wall() - t
                for reading in waited:
                    yield from self._channel(t + self._epoch, reading, received)

    def _channel(self, t: float, reading: Reading, received: float) -> Iterator[Block]:
        source = reading.source.split(" ")[0]
        channel, values = reading.signal, tuple(float(v) for v in reading.values)
        if channel in ("esc", "servo"):
            # The row so far of a round of messages (four ESCs or sixteen outputs each), at the time of the first
            joined = self._rounds.setdefault(source, _Round())
            if reading.place <= joined.place:
                joined.row, joined.t = [math.nan] * ESCS, t
            joined.place = reading.place
            for k, value in enumerate(reading.values[: max(ESCS - reading.place, 0)]):
                joined.row[reading.place + k] = float(value)
            joined.width = ESCS if reading.signal == "esc" else max(joined.width, reading.place + len(reading.values))
            t, values = joined.t, tuple(joined.row[: joined.width])
        if channel in _MOTORS:
            channel, values = _MOTORS[channel], self.order.take(values, source, received)
        rank = RANKS.get((channel, source))
        if rank is None or not values or not all(math.isfinite(v) for v in values):
            return
        if reading.signal in ("esc", "servo"):
            self._rounds[source].row = [math.nan] * ESCS  # it is told once
        yield from self._chooser.take(Block.one(t, channel, values), rank)


# --- A parameter set as read-only MAVLink parameters


PARAMETERS = {
    "b": "QI_B",
    "d": "QI_D",
    "J_xx": "QI_J_XX",
    "J_yy": "QI_J_YY",
    "J_zz": "QI_J_ZZ",
    "J_r": "QI_J_R",
    "b_tangent": "QI_B_TAN",
}

REFERENCES = {"none": 0.0, "vehicle_file": 1.0, "history": 2.0}
"""Reference of a set, as a number."""


def parameters_of(item: OnlineSet | None) -> list[tuple[str, float]]:
    """Names and values: number, state, reference of the set; the parameters and their deviations."""
    if item is None:
        return [("QI_SEQ", 0.0)]
    high, low = divmod(item.sequence, 1 << 24)  # a float holds 24 bits
    out = [("QI_SEQ", float(low)), ("QI_SEQ_HI", float(high)), ("QI_MASS", item.mass)]
    out += [("QI_STALE", float(item.state.value == "stale")), ("QI_OLD", float(bool(item.outdated)))]
    out += [("QI_REF", REFERENCES[item.reference])]
    for p in item.parameters:
        if p.name in PARAMETERS:
            out += [(PARAMETERS[p.name], p.value), (f"{PARAMETERS[p.name]}_SD", p.sigma)]
    return out


# --- Which messages to ask a vehicle for, and which it has refused: those are not asked for again


REPEAT = 10.0
"""Messages that do not come as asked are asked for again after this long [s],"""
MOST_TRIES = 4
"""... so many times in all,"""
ANSWER = 1.0
"""... from the second time on one by one, this long [s] apart: an answer does not say which message it is about."""


class Requests:
    """Requests for messages of one vehicle."""

    def __init__(self) -> None:
        self._tries: Counter[str] = Counter()
        self._refused: dict[str, str] = {}
        self._queue: list[str] = []
        self._asked: str | None = None
        self._asked_at = self._round_at = -1e9

    @property
    def denied(self) -> tuple[str, ...]:
        """Messages that the vehicle refuses, each with its answer."""
        return tuple(f"{name} ({answer})" for name, answer in sorted(self._refused.items()))

    def due(self, lacking: Sequence[str], now: float) -> list[str]:
        """The messages to ask for now [s], of those that do not come."""
        first = not self._tries
        if now - self._round_at >= REPEAT:
            self._round_at = now
            self._queue = [n for n in lacking if n not in self._refused and self._tries[n] < MOST_TRIES]
        if not first and (now - self._asked_at < ANSWER or not self._queue):
            return []
        many, self._queue = (self._queue, []) if first else (self._queue[:1], self._queue[1:])
        self._tries.update(many)
        self._asked, self._asked_at = None if first or not many else many[0], now
        return many

    def answered(self, refusal: str) -> None:
        """The vehicle's answer to what was asked last; empty when it accepts."""
        if self._asked is not None and refusal:
            self._refused[self._asked] = refusal
        self._asked = None


# --- The service on a MAVLink link: asks for messages, measures what comes, and sends its results as component 191


COMPONENT = 191
"""MAV_COMP_ID_ONBOARD_COMPUTER."""
MOTORS = 80.0
"""Sticks come in steps, mostly of 20 or 40 ms, and the rate loop answers each.  Snapshots of motors in step with them
err alike: slow torque by 6 % where at this rate [Hz] it is 0.4 % (`python -m
quadid_evaluation.studies.readings`)."""
REQUESTED = {
    "HIGHRES_IMU": 100.0,
    "RAW_IMU": 100.0,
    "ATTITUDE_QUATERNION": 50.0,
    "SERVO_OUTPUT_RAW": MOTORS,
    "ACTUATOR_OUTPUT_STATUS": MOTORS,
    "ESC_STATUS": MOTORS,
    "ATTITUDE_TARGET": 50.0,
    "LOCAL_POSITION_NED": 20.0,
    "BATTERY_STATUS": 1.0,
}
"""Messages asked for, with their rates [Hz]."""
FRAMES_A_SECOND, OTHERS_A_SECOND = 4000, 1000
"""More frames of the vehicle, or of all others together, are a flood: the rest is dropped unread."""
FLOODED = 10.0
"""A flood is a problem for so long after its last frame [s]."""
LIST_EVERY = 1.0
"""All our parameters are sent so often at most [s]: one short request asks for seventeen frames."""
SEVERITY = {"error": 3, "warning": 4, "info": 6}
_READ_ONLY, _UNKNOWN = dialect.MAV_PARAM_ERROR_READ_ONLY, dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST
_ACCEPTED = (dialect.MAV_RESULT_ACCEPTED, dialect.MAV_RESULT_IN_PROGRESS)
_REAL32 = 9
_TEXT, _NAME = 50, 10
_IDS = {m.msgname: n for n, m in dialect.mavlink_map.items()}
_ANSWERED = ("HEARTBEAT", "PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET")
_OF_OTHERS = frozenset(_IDS[n] for n in _ANSWERED)
_WANTED = _OF_OTHERS | {_IDS[n] for n in (*READERS, "COMMAND_ACK", "PARAM_VALUE") if n in _IDS}


@dataclass(frozen=True)
class Traffic:
    """Traffic of the link: measured rates [Hz] by message, requests denied, frames refused, bytes dropped.

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
        self,
        url: str,
        rotors: int,
        system: int = 0,
        key: bytes | None = None,
        clock: Callable[[], float] = time.monotonic,
        memory: Path | None = None,
    ) -> None:
        """Opens the link.

        Args:
            system: system id of the vehicle; 0 takes the first autopilot heard.
            memory: file that keeps the time stamps of signatures over a restart.

        Raises:
            LinkError: the link cannot be opened.
        """
        if not 0 <= system <= 255:
            raise LinkError(f"system id {system}", "1 to 255, or 0 for the first one heard")
        self._wire, self._key = Wire(url, system or 1, COMPONENT, key, memory), key is not None
        self._source = VehicleSender()
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
        self._parameters = parameters_of(None)
        self._text = 0
        self._left, self._second = {True: FRAMES_A_SECOND, False: OTHERS_A_SECOND}, 0
        self._flooded = {True: -math.inf, False: -math.inf}

    # --- in

    def receive(self) -> Iterator[Block]:
        """Yields the measurements that have arrived; answers what was asked of us."""
        now = last = self._clock()
        if int(now) != self._second:
            self._second, self._left = int(now), {True: FRAMES_A_SECOND, False: OTHERS_A_SECOND}
        for message in self._wire.receive(_WANTED, self._admits, now, None if self._key else self._count):
            last, kind = self._clock(), message.get_type()
            who = message.get_srcSystem(), message.get_srcComponent()
            autopilot = kind == "HEARTBEAT" and message.autopilot != dialect.MAV_AUTOPILOT_INVALID
            if autopilot and not self.vehicle_system and self._only in (0, who[0]):
                # The first autopilot heard is our vehicle; we speak under its system id.
                self.vehicle_system, self._target = who
                self._wire.mav.srcSystem = self.vehicle_system
                self._decoder.order.ardupilot = message.autopilot == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA
                self._decoder.order.kind = message.type
            ours = self.vehicle_system > 0 and who == (self.vehicle_system, self._target)
            if ours:
                if not self._source.take(self._wire.source, self._wire.listened):
                    continue
                self._wire.follow(self._wire.source)
            if kind == "HEARTBEAT":
                # Notes who is heard again and again and will be answered; asks the vehicle for the parameters we lack.
                self._wire.peers.hello(self._wire.source, self._wire.listened, ours)
                if ours:
                    for name in self._decoder.order.lacking():
                        wanted = self.vehicle_system, self._target, name.encode(), -1
                        self._send(dialect.MAVLink_param_request_read_message(*wanted))
            elif kind in ("PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET"):
                self._on_parameter(kind, message)
            elif kind == "COMMAND_ACK" and ours:
                if message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
                    known = dialect.enums["MAV_RESULT"].get(message.result)
                    refusal = known.name if known is not None else f"result {message.result}"
                    self._requests.answered("" if message.result in _ACCEPTED else refusal)
            elif ours:
                yield from self._decoder.blocks(message, last, self._empty)
        if self._wire.drained:
            self._empty = last

    def _admits(self, frame: bytes) -> bool:
        """True if a frame is worth its decoding: what may be the vehicle's has a budget of its own."""
        _, *who = sender(frame)
        if self.vehicle_system:
            is_named = (*who,) == (self.vehicle_system, self._target)
            own = is_named and self._source.may_be(self._wire.source, self._wire.listened)
            if not is_named and message_id(frame) not in _OF_OTHERS:
                return False
        else:
            own = who[0] == (self._only or who[0]) and is_autopilot(frame)
        self._left[own] -= 1
        if self._left[own] < 0:
            self._flooded[own] = self._clock()
        return self._left[own] >= 0

    def _count(self, frame: bytes) -> None:
        """Without a key every frame of the vehicle's ids is looked at: two senders have two rows of numbers."""
        number, system, component = sender(frame)
        if (system, component) == (self.vehicle_system, self._target):
            self._source.count(self._wire.source, number, self._wire.listened, frame)

    def _on_parameter(self, kind: str, message: Any) -> None:
        """Lists and reads our parameters, and refuses to set them."""
        ours = message.target_system in (0, self._wire.mav.srcSystem) and message.target_component in (0, COMPONENT)
        if not ours:
            return
        if kind == "PARAM_REQUEST_LIST":
            self._list_due = True
            return
        names = [name for name, _ in self._parameters]
        wanted, index = str(message.param_id), getattr(message, "param_index", -1)
        if kind == "PARAM_REQUEST_READ" and 0 <= index < len(names):
            self._send_parameter(index, answer=True)
        elif wanted in names and kind == "PARAM_REQUEST_READ":
            self._send_parameter(names.index(wanted), answer=True)
        elif wanted in names or message.target_component == COMPONENT:
            who = message.get_srcSystem(), message.get_srcComponent()
            error = _READ_ONLY if wanted in names else _UNKNOWN
            self._send(dialect.MAVLink_param_error_message(*who, wanted.encode()[:16], index, error), answer=True)
            if wanted in names:
                self._send_parameter(names.index(wanted), answer=True)  # for stations that do not know PARAM_ERROR

    # --- out

    def step(self) -> None:
        """Messages that are due: heartbeat, requests, measured rates, the numbers again for who came late."""
        now = self._clock()
        if now - self._beat >= 1.0:
            self._beat = now
            kind, none = dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_AUTOPILOT_INVALID
            self._send(dialect.MAVLink_heartbeat_message(kind, none, 0, 0, dialect.MAV_STATE_ACTIVE, 3))
        if now - self._measured >= 2.0:
            counts, span = self._decoder.counts, now - self._measured
            self._rates = {n: (c - self._before.get(n, 0)) / span for n, c in counts.items()}
            self._before, self._measured = dict(counts), now
        if self._list_due and now - self._listed >= LIST_EVERY:
            self._list_due, self._listed = False, now
            self._send_parameters()
        if self.vehicle_system:
            # Asks for the messages that do not come at 60 % of their rate
            wanted = REQUESTED | dict.fromkeys(self._decoder.order.esc_groups(), MOTORS)
            lacking = [n for n, rate in wanted.items() if n in _IDS and self._rates.get(n, 0.0) < 0.6 * rate]
            for name in self._requests.due(lacking, now):
                command = dialect.MAV_CMD_SET_MESSAGE_INTERVAL
                numbers = float(_IDS[name]), 1e6 / wanted[name], 0.0, 0.0, 0.0, 0.0, 0.0
                to = self.vehicle_system, self._target
                self._send(dialect.MAVLink_command_long_message(*to, command, 0, *numbers))
        if len(self._parameters) > 1 and now - self._tell >= 5.0:
            self._tell = now
            self._send_named(self._parameters)

    def publish(self, output: Output) -> None:
        """Tells a result: numbers of a set in force, a line of text for what people should know."""
        if output.topic == "parameters":
            self._parameters, self._tell = parameters_of(output.item), self._clock()
            self._send_parameters()
            self._send_named(self._parameters)
            self._say(6, f"quadid: set {output.item.sequence} {output.item.state.value}")
        elif output.topic == "diagnosis":
            for finding in output.findings:
                numbers = " ".join(f"{n} {v:.3g}" for n, v in finding.values.items() if n != "time")
                self._say(4, f"quadid: {finding.effect} {numbers}{'' if finding.confident else ' (?)'}")
        elif output.topic == "vehicle_health":
            # Score and loss of each rotor [%] as named values; what changed is a line of text of its own
            losses = [(f"QI_LOSS{j + 1}", 100 * v) for j, v in enumerate(output.rotor_loss)]
            self._send_named([("QI_HEALTH", output.score), *losses])
            if not output.has_baseline:
                self._say(5, f"quadid: {output.text}")
        elif output.topic == "event" and output.level != "info":
            self._say(SEVERITY[output.level], f"quadid: {output.text}")

    def traffic(self) -> Traffic:
        """Messages of the link."""
        wire = self._wire
        problems = [self._source.problem, self._decoder.order.problem, wire.mav.problem]
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

    def _send(self, message: Any, answer: bool = False) -> None:
        self._wire.send(message, self._clock(), answer)

    def _send_parameters(self) -> None:
        for index in range(len(self._parameters)):
            self._send_parameter(index)

    def _send_parameter(self, index: int, answer: bool = False) -> None:
        (name, value), count = self._parameters[index], len(self._parameters)
        self._send(dialect.MAVLink_param_value_message(name.encode(), value, _REAL32, count, index), answer)

    def _send_named(self, values: Sequence[tuple[str, float]]) -> None:
        """Sends values by names that the message has room for."""
        ms = int((self._clock() - self._begin) * 1e3) % 2**32
        for name, value in values:
            if len(name) <= _NAME:
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


# --- The service without ROS: a MAVLink link in, MAVLink and Zenoh out, until it is stopped


IDLE = 0.005
"""Pause when nothing arrives [s]."""


class Outlet(Protocol):
    """Somewhere results go."""

    def publish(self, output: Output) -> None:
        """Tells a result."""

    def report(self, health: ServiceHealth) -> None:
        """Tells once a second how things are."""

    def attend(self) -> None:
        """Carries out what was asked through it."""


def run(
    service: Service,
    link: MavlinkLink,
    outlets: list[Outlet],
    stop: Callable[[], bool],
    clock: Callable[[], float] = time.monotonic,
) -> None:
    """Serves until `stop` returns True."""
    reported = clock()
    while not stop():
        busy = False
        for block in link.receive():
            busy = True
            service.push(block)
        for output in service.step():
            link.publish(output)
            for outlet in outlets:
                outlet.publish(output)
        link.step()
        for outlet in outlets:
            outlet.attend()
        if clock() - reported >= 1.0:
            reported = clock()
            health = service.health()
            for outlet in outlets:
                outlet.report(health)
        if not busy:
            time.sleep(IDLE)
