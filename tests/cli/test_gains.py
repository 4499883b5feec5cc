"""`quadid gains`: the gains, flown by each autopilot's own law around the truth, keep what was promised."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quadid_replay.ulog import allocation
from scipy.signal import butter, lfilter

import quadid
from quadid.app.export import UnprovenError
from quadid.errors import LogError, ParameterError
from quadid.flight import SteppedFlight, TruthParameters
from quadid.report.autopilots import AUTOPILOTS
from quadid.report.programs import export
from quadid.types import FloatArray
from quadid.vehicle import Command, ParameterPrior, Vehicle
from tests.commands import Cli

FULL = 800.0
TRUTH = TruthParameters.of(Vehicle.shipped("pelican"))
LATE = {"motor_lag": {"tau": 0.03}, "command_delay": {"delay": 0.006}}
RATE = {"px4": ("IMU_GYRO_RATEMAX", 400.0), "ardupilot": ("SCHED_LOOP_RATE", 400.0), "betaflight": ("pid_rate", 1000.0)}
STEP = 0.2
"""Asked for [rad/s]: small, so that thrust stays linear."""


def identified(name: str = "pelican", **more: Any) -> Vehicle:
    """A vehicle whose parameters are the truth's, to 2 %."""
    values = {n: ParameterPrior(initial=v, sigma=0.02 * v) for n, v in TRUTH.as_dict().items()}
    vehicle = Vehicle.shipped(name).model_copy(
        update={"command": Command(kind="normalized", max_speed=FULL), "parameters": values, "effects": LATE}
    )
    return vehicle.model_copy(update=more)


Mixer = Callable[[FloatArray, float], FloatArray]
"""From outputs about the axes and the command in hover to motor commands 0..1."""


def px4_mixer(vehicle: Vehicle) -> Mixer:
    """PX4's allocation by what `quadid export` tells it, as the reader of its logs repeats it."""
    rows = [line.split("\t") for line in export(vehicle, "px4", "x")[".params"].splitlines() if line[:1] == "1"]
    mix = allocation({"CA_AIRFRAME": 0.0, **{row[2]: float(row[3]) for row in rows}})
    assert mix is not None
    return lambda out, hover: mix @ np.array([*out, 0.0, 0.0, -hover])


def ardupilot_mixer(vehicle: Vehicle) -> Mixer:
    """Factors of the motors of a plus, from the places of the rotors; thrust to command by MOT_THST_EXPO 1."""
    x, y, _ = vehicle.rotor_positions.T / 0.21
    factors = 0.5 * np.column_stack([-y, x, vehicle.spins])

    def mixed(out: FloatArray, hover: float) -> FloatArray:
        thrust = ((hover - 0.15) / 0.8) ** 2 + factors @ out
        return np.asarray(0.15 + 0.8 * np.sqrt(thrust))

    return mixed


def betaflight_mixer(vehicle: Vehicle) -> Mixer:
    """QUADP, above the idle of 5.5 %."""
    x, y, _ = np.sign(np.round(vehicle.rotor_positions.T, 6))
    return lambda out, hover: hover + 0.945 * np.column_stack([-y, x, vehicle.spins]) @ out


MIXERS = {"px4": px4_mixer, "ardupilot": ardupilot_mixer, "betaflight": betaflight_mixer}


def flown(
    found: Any, vehicle: Vehicle, form: str, axis: int, truth: TruthParameters = TRUTH,
    effects: dict[str, dict[str, float]] = LATE, seconds: float = 1.5,
) -> tuple[float, FloatArray]:  # fmt: skip
    """Rate of one axis after a step of what is asked for, over it, at the controller's rate; its period first [s]."""
    hz, autopilot = RATE[form][1], AUTOPILOTS[form]
    p, i, d = (np.asarray([found.values[names[k]] for names in autopilot.names]) for k in range(3))
    if form == "betaflight":  # sums of thousandths, errors in degrees
        p, i, d = (np.degrees(k * g) / 1000.0 for k, g in ((0.032029, p), (0.244381, i), (0.000529, d)))
    flight, mixed = SteppedFlight(vehicle, truth, effects=effects), MIXERS[form](vehicle)
    hover = float(flight.rotor_speed[0]) / FULL
    filters = [butter(2, autopilot.gyro[1], fs=hz), butter(1, autopilot.derivative[1], fs=hz)]
    if form == "ardupilot":
        filters.append(butter(1, autopilot.yaw_error[1], fs=hz))
    memory = [np.zeros((len(f[0]) - 1, 3)) for f in filters]
    asked: FloatArray = STEP * np.eye(3)[axis]
    integral, last, out = np.zeros(3), np.zeros(3), []

    def passed(k: int, values: FloatArray) -> FloatArray:
        result, memory[k] = lfilter(*filters[k], values[None], axis=0, zi=memory[k])
        return np.asarray(result[0])

    for _ in range(round(seconds * hz)):
        out.append(flight.rate[axis] / STEP)
        gyro = passed(0, flight.rate)
        error = asked - gyro
        if form == "ardupilot":
            error[2] = passed(2, error)[2]
        seen = error if autopilot.on_error else -gyro
        change, last = (seen - last) * hz, seen
        integral = integral + error / hz
        demand = p * error + i * integral + d * passed(1, change)
        flight.step(FULL * np.clip(mixed(demand, hover), 0.0, 1.0), 1.0 / hz)
    return 1.0 / hz, np.array(out)


def bandwidth(period: float, response: FloatArray) -> float:
    """Frequency at which the response has fallen by 3 dB for good [Hz], from that to a step."""
    hz = np.arange(0.2, 12.0, 0.01)
    t = period * (np.arange(len(response) - 1) + 0.5)
    size = np.abs(np.exp(-2j * np.pi * np.outer(hz, t)) @ np.diff(response))
    return float(hz[np.flatnonzero(size >= math.sqrt(0.5))[-1]])


@pytest.mark.parametrize("form", AUTOPILOTS)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_loop_around_the_truth_is_as_promised(form: str, axis: int) -> None:
    vehicle = identified()
    found = quadid.gains(vehicle, form, current={RATE[form][0]: RATE[form][1]})
    promised = found.result["axes"][axis]["rate"]
    period, response = flown(found, vehicle, form, axis, seconds=2.5)
    assert bandwidth(period, response) == pytest.approx(promised["bandwidth"], rel=0.06)
    assert response.max() - 1.0 == pytest.approx(promised["overshoot"], abs=0.04)
    t, steps = found.loops[found.result["axes"][axis]["axis"]].step()
    np.testing.assert_allclose(np.interp(t, period * np.arange(len(response)), response), steps[0], atol=0.06)
    assert response[-1] == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("form", AUTOPILOTS)
def test_margins_hold_over_the_intervals_and_end_where_they_are_said_to(form: str) -> None:
    vehicle = identified()
    found = quadid.gains(vehicle, form, current={RATE[form][0]: RATE[form][1]})
    promised = found.result["axes"][0]["rate"]
    used = {u["name"]: u["ci95"] for u in found.result["used"]}
    assert promised["phase_margin_least"] >= 54.0
    worst = TruthParameters(**{**TRUTH.as_dict(), "J_xx": used["J_xx"][0], "b": used["b"][1]})
    late = {"motor_lag": {"tau": used["motor lag"][1]}, "command_delay": {"delay": used["command delay"][1]}}
    _, response = flown(found, vehicle, form, 0, worst, late)
    assert response.max() - 1.0 <= promised["overshoot_most"] + 0.05
    # Delay that takes the phase margin at the crossover: a little less is stable, a little more is not.
    loops = found.loops["roll"].margins()
    spare = float(loops.phase[0] / 360.0 / loops.crossover[0])
    for share, grows in ((0.85, False), (1.15, True)):
        more = {**LATE, "command_delay": {"delay": LATE["command_delay"]["delay"] + share * spare}}
        _, response = flown(found, vehicle, form, 0, effects=more, seconds=3.0)
        swing = np.abs(response - 1.0)
        third = len(swing) // 3
        assert (swing[-third:].max() > swing[third : 2 * third].max()) == grows, share


def test_a_wanted_bandwidth_is_kept_or_refused_with_the_largest() -> None:
    found = quadid.gains(identified(), bandwidth=1.5)
    roll, pitch, _ = (a["rate"]["bandwidth"] for a in found.result["axes"])
    assert roll == pytest.approx(1.5, rel=0.03)
    assert pitch == pytest.approx(1.5, rel=0.03)
    largest = quadid.gains(identified()).result["axes"][0]["largest_bandwidth"]
    with pytest.raises(ParameterError, match=rf"bandwidth of 50 Hz; allowed: up to {largest:.3g} Hz.*less motor lag"):
        quadid.gains(identified(), bandwidth=50.0)
    slower = quadid.gains(identified(effects={**LATE, "command_delay": {"delay": 0.04}}))
    assert slower.result["axes"][0]["largest_bandwidth"] < largest
    assert slower.result["axes"][0]["limited_by"] == "delay"


def test_what_is_not_known_is_said() -> None:
    with pytest.raises(UnprovenError, match="neither motor_lag nor command_delay is in the file"):
        quadid.gains(identified(effects={}))
    assert quadid.gains(identified(effects={}), motor_lag=0.03, delay=0.006).values == quadid.gains(identified()).values
    values = identified().parameters
    guessed = {n: ParameterPrior(initial=p.initial) if n[0] == "J" else p for n, p in values.items()}
    with pytest.raises(UnprovenError, match="J_xx, J_yy, J_zz: not identified"):
        quadid.gains(identified(parameters=guessed))
    with pytest.raises(ParameterError, match=r"no command\.max_speed"):
        quadid.gains(identified(command=Command()))
    with pytest.raises(ParameterError, match="unknown format 'px5'; allowed: px4"):
        quadid.gains(identified(), "px5")
    with pytest.raises(ParameterError, match="phase margin of 85"):
        quadid.gains(identified(), phase_margin=85.0)


def test_the_command_compares_with_present_gains(tmp_path: Path, inside: Cli) -> None:
    file = identified().save(tmp_path / "mine.yaml")
    now = tmp_path / "now.params"
    lines = ("MC_ROLLRATE_P\t0.5\t9", "MC_ROLLRATE_I\t0.2\t9", "MC_ROLLRATE_D\t0.0\t9", "MC_ROLL_P\t6.5\t9")
    now.write_text("# of a flight\n" + "".join(f"1\t1\t{line}\n" for line in lines) + "1\t1\tIMU_GYRO_CUTOFF\t30\t9\n")
    page, out = tmp_path / "gains.html", tmp_path / "gains.json"
    run = inside("gains", "--vehicle", file, "--from", now, "--report", page, "--json", out, "--out", tmp_path)
    assert run.code == 0, run.err
    result = json.loads(out.read_text())
    assert result["schema"] == "quadid.gains/1"
    assert result["report"] == str(page)
    assert quadid.gains(file, current=now).values == quadid.gains(file, current={"IMU_GYRO_CUTOFF": 30.0}).values
    written = Path(result["file"]).read_text(encoding="utf-8")
    assert written.startswith(f"1\t1\tMC_ROLLRATE_P\t{result['gains'][0]['value']}\t9\n")
    assert {g["name"]: g["current"] for g in result["gains"]}["MC_ROLLRATE_P"] == 0.5
    assert result["axes"][0]["before"]["rate"]["phase_margin_least"] < 20.0
    assert "roll: the present gains are unstable" in " ".join(result["warnings"])
    assert {u["name"]: u["source"] for u in result["used"]}["gyro filter"] == "IMU_GYRO_CUTOFF"
    text = page.read_text(encoding="utf-8")
    assert "What limits the bandwidth" in text
    assert "MC_ROLLRATE_P" in text
    now.write_text("ATC_RAT_RLL_P,0.1\n")
    run = inside("gains", "--vehicle", file, "--from", now)
    assert run.code == 2
    with pytest.raises(LogError):
        quadid.gains(file, current=now)
