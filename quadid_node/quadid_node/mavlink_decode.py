"""A live vehicle's MAVLink messages to samples, at absolute times; the rules are those of telemetry logs."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from quadid_replay.boot_clock import BootClock
from quadid_replay.motors import ESCS
from quadid_replay.tlog_messages import PREFERENCE, READERS, Reading, boot_seconds, boot_stamp

from quadid.window import Sample
from quadid_node.chooser import Chooser
from quadid_node.motor_order import MotorOrder

REBOOT = 1.0
"""The vehicle's clock this far back [s] is one that began anew."""
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
"""Which message a channel is best taken from."""


_MOTORS = {"esc": "rotor_speed", "servo": "motor_command", "actuator": "motor_command"}


@dataclass
class _Round:
    """Values of the messages of one round, by output, how many outputs they tell, where the last one began, and the
    time of the first [s].
    """

    row: list[float] = field(default_factory=lambda: [math.nan] * ESCS)
    width: int = 0
    place: float = math.inf
    t: float = math.nan


class MavlinkDecoder:
    """Messages of one vehicle to samples.

    Attributes:
        counts: messages by name.
        order: of its motors among its outputs.
    """

    def __init__(self, rotors: int, wall: Callable[[], float] = time.time) -> None:
        """Expects a vehicle with `rotors` rotors; `wall` tells the UNIX time [s] at which its clock is put."""
        self.counts: Counter[str] = Counter()
        self.order = MotorOrder(rotors)
        self._chooser = Chooser({channel: 0 for channel, _ in RANKS})
        self._boot_clock: BootClock[list[Reading]] = BootClock()
        self._wall, self._epoch, self._newest = wall, 0.0, math.inf
        self._rounds: dict[str, _Round] = {}

    def samples(self, message: Any, received: float, earliest: float | None = None) -> Iterator[Sample]:
        """Yields the samples that may be used now.

        Args:
            message: decoded message of the vehicle.
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
                for reading in waited:
                    yield from self._channel(self._absolute(t), reading, received)

    def _absolute(self, boot: float) -> float:
        """UNIX time of a time of the vehicle's clock, set by ours when it is first heard and when it reboots."""
        if boot < self._newest - REBOOT:
            self._epoch, self._newest = self._wall() - boot, boot
        self._newest = max(self._newest, boot)
        return boot + self._epoch

    def _channel(self, t: float, reading: Reading, received: float) -> Iterator[Sample]:
        source = reading.source.split(" ")[0]
        channel, values = reading.signal, tuple(float(v) for v in reading.values)
        if channel in ("esc", "servo"):
            t, values = self._joined(t, reading, source)
        if channel in _MOTORS:
            channel, values = _MOTORS[channel], self.order.take(values, source, received)
        rank = RANKS.get((channel, source))
        if rank is None or not values or not all(math.isfinite(v) for v in values):
            return
        if reading.signal in ("esc", "servo"):
            self._rounds[source].row = [math.nan] * ESCS  # it is told once
        yield from self._chooser.take(Sample(t, channel, values), rank)

    def _joined(self, t: float, reading: Reading, source: str) -> tuple[float, tuple[float, ...]]:
        """The row so far of a round of messages (four ESCs or sixteen outputs each), at the time of the first."""
        joined = self._rounds.setdefault(source, _Round())
        if reading.place <= joined.place:
            joined.row, joined.t = [math.nan] * ESCS, t
        joined.place = reading.place
        for k, value in enumerate(reading.values[: max(ESCS - reading.place, 0)]):
            joined.row[reading.place + k] = float(value)
        joined.width = ESCS if reading.signal == "esc" else max(joined.width, reading.place + len(reading.values))
        return joined.t, tuple(joined.row[: joined.width])
