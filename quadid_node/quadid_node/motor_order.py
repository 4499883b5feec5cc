"""Which output drives which rotor of a live vehicle: asked of the autopilot, taken over once, never changed in use."""

from __future__ import annotations

import math

from quadid_replay.motors import ESCS, MOTOR_FUNCTION, Outputs, changed_functions, esc_columns, motor_outputs
from quadid_replay.tlog_messages import ESC_GROUPS

ASKED = tuple(f"SERVO{n}_FUNCTION" for n in range(1, ESCS + 1))
"""Parameters of ArduPilot that are asked for, once with each heartbeat …"""
MOST_ROUNDS = 5
"""... and so often at most."""
_ESC_MESSAGES = ("ESC_STATUS", "ESC_TELEMETRY")
PATIENCE = 6.0
"""What an ArduPilot has not told so long after its first outputs [s] is taken to go without saying."""


class MotorOrder:
    """The outputs that are motors.

    Attributes:
        ardupilot: whether the autopilot is one.
        problem: what speaks against its outputs; empty for nothing.
    """

    def __init__(self, rotors: int) -> None:
        """Knows nothing yet of a vehicle with `rotors` rotors."""
        self.ardupilot = False
        self.problem = ""
        self._rotors = rotors
        self._parameters: dict[str, float] = {}
        self._used: dict[tuple[str, int], list[int]] = {}
        self._first = math.nan
        self._rounds = 0
        self._moved = False
        self._turning = [False] * ESCS

    def lacking(self) -> list[str]:
        """The parameters to ask for now; none where all are told, or it does not answer."""
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
        """The values of the rotors, one by one; empty where it is not known which they are, or no more.

        Args:
            values: of all outputs of a message.
            message: its name.
            now: when it came [s].
        """
        if self._moved:
            return ()
        if message in _ESC_MESSAGES:
            self._turning = [turns or value > 0.0 for turns, value in zip(self._turning, values, strict=True)]
        columns = self._used.get((message, len(values)))
        if columns is None:
            columns = self._found(values, message, now)
        return tuple(values[i] for i in columns)

    def _found(self, values: tuple[float, ...], message: str, now: float) -> list[int]:
        """Columns to use from now on; none as long as an ArduPilot may still tell more, or where there is a problem."""
        self._first = now if math.isnan(self._first) else self._first
        found = self._columns(message, len(values))
        silent = self.ardupilot and not found.told
        if silent and now - self._first < PATIENCE:
            return []
        self.problem = found.problem
        if silent and not found.problem:
            outputs = ", ".join(str(k + 1) for k in found.columns)
            self.problem = f"the autopilot has not told which outputs are motors (SERVOn_FUNCTION): {outputs} are used"
        if found.columns and (message not in _ESC_MESSAGES or any(self._turning)):
            self._used[message, len(values)] = found.columns
        return found.columns

    def _columns(self, message: str, width: int) -> Outputs:
        if message in _ESC_MESSAGES:
            return esc_columns(self._parameters, self._rotors, self._turning, message, self.ardupilot)
        return motor_outputs(self._parameters, self._rotors, width, message, self.ardupilot)

    def esc_groups(self) -> list[str]:
        """ArduPilot's messages of ESCs that may be motors: those on their outputs, and the first ones."""
        columns = motor_outputs(self._parameters, self._rotors, ESCS, "ESC", self.ardupilot).columns
        return [ESC_GROUPS[k] for k in sorted({k // 4 for k in (*columns, *range(self._rotors))})]
