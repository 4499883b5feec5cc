"""A live vehicle's MAVLink messages to samples, at absolute times; the rules are those of telemetry logs."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

from quadid_replay.boot_clock import BootClock
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
        self._rotors = rotors
        self._chooser = Chooser({channel: 0 for channel, _ in RANKS})
        self._boot_clock: BootClock[list[Reading]] = BootClock()
        self._wall, self._epoch, self._newest = wall, 0.0, math.inf
        self._row: list[float] = []
        self._row_time = math.nan

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
        if reading.signal == "esc":
            yield from self._escs(t, reading, source)
            return
        channel, values = reading.signal, tuple(float(v) for v in reading.values)
        if channel in ("servo", "actuator"):
            channel = "motor_command"
            values = self.order.take(values, source, received)
        rank = RANKS.get((channel, source))
        if rank is not None and values and all(math.isfinite(v) for v in values):
            yield from self._chooser.take(Sample(t, channel, values), rank)

    def _escs(self, t: float, reading: Reading, source: str) -> Iterator[Sample]:
        """Joins the messages of one round to a row at the time of the first."""
        if reading.place == 0:
            self._row, self._row_time = [math.nan] * self._rotors, t
        if not self._row:
            return
        for i, value in enumerate(reading.values[: max(self._rotors - reading.place, 0)]):
            self._row[reading.place + i] = float(value)
        if all(math.isfinite(v) for v in self._row):
            row, self._row = tuple(self._row), []
            yield from self._chooser.take(Sample(self._row_time, "rotor_speed", row), RANKS["rotor_speed", source])
