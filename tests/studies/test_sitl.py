"""The study that flies a running ArduCopter: skipped without one; its plan, flown against a stand-in."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from quadid_evaluation.studies import sitl

from quadid.flight.pilot import AXES


def test_without_a_binary_it_says_so_and_does_nothing() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "quadid_evaluation.studies.sitl"], capture_output=True, text=True, check=True
    )
    assert done.stdout == "skipped: no ArduCopter binary is named (--binary)\n"


def test_sticks_move_three_axes_out_of_step_and_leave_the_throttle() -> None:
    moved = sitl.sticks(60.0, 1)
    assert moved.shape == (3000, len(AXES))
    assert np.abs(moved).max() <= 1.0
    assert not moved[:, AXES.index("throttle")].any()
    together = np.corrcoef(moved[:, :3].T) - np.eye(3)
    assert np.abs(together).max() < 0.2


@dataclass
class Autopilot:
    """What `fly` needs of a link: it climbs once it was told to, and refuses to arm at first."""

    flightmode: str = "STABILIZE"
    height: float = 0.0
    asked: list[str] = field(default_factory=list)
    sticks: list[tuple[int, ...]] = field(default_factory=list)
    target_system: int = 1
    target_component: int = 1

    def __post_init__(self) -> None:
        self.mav = SimpleNamespace(command_long_send=self._command, rc_channels_override_send=self._sticks)

    def wait_heartbeat(self, timeout: float) -> None:
        self.asked.append("heartbeat")

    def mode_mapping(self) -> dict[str, str]:
        return {name: name for name in ("GUIDED", "LOITER", "LAND")}

    def set_mode(self, number: str) -> None:
        self.asked.append(number)
        self.flightmode = number

    def _command(self, system: int, component: int, number: int, *_: float) -> None:
        self.asked.append(str(number))

    def _sticks(self, system: int, component: int, *values: int) -> None:
        self.sticks.append(values)

    def recv_match(self, type: str = "", blocking: bool = False, timeout: float = 0.0) -> Any:
        if type == "COMMAND_ACK":
            return SimpleNamespace(result=0 if self.asked.count(self.asked[-1]) > 1 else 4)
        if type == "GLOBAL_POSITION_INT":
            self.height += 5000.0
            return SimpleNamespace(lat=1, relative_alt=self.height)
        return SimpleNamespace() if type else None


def test_the_plan_is_flown_and_ends_with_a_landing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sitl, "HOVER", 0.1)
    autopilot = Autopilot()
    sitl.fly(autopilot, 7.0, 1)
    assert [a for a in autopilot.asked if a.isalpha()] == ["heartbeat", "GUIDED", "LOITER", "LAND"]
    assert autopilot.asked.index("400") < autopilot.asked.index("22")  # armed, then taken off
    channels = np.array(autopilot.sticks)
    assert np.ptp(channels[:, 0]) > 100
    assert np.ptp(channels[:, 3]) > 100
    assert np.all(channels[:, 2] == 1500)
    assert np.all(channels[-1, :4] == 1500)
