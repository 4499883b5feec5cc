"""`quadid gains`: the gains, flown by each autopilot's own law around the truth, keep what was promised."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quadid_evaluation.studies.gains import LATE, RATE, bandwidth, margins, step

import quadid
from quadid.app.export import UnprovenError
from quadid.app.gains import Gains
from quadid.errors import LogError, ParameterError
from quadid.flight import TruthParameters
from quadid.report.autopilots import AUTOPILOTS
from quadid.vehicle import Command, ParameterPrior, Vehicle
from tests.commands import Cli

FULL = 800.0
TRUTH = TruthParameters.of(Vehicle.shipped("pelican"))


def identified(name: str = "pelican", **more: Any) -> Vehicle:
    """A vehicle whose parameters are the truth's, to 2 %."""
    values = {n: ParameterPrior(initial=v, sigma=0.02 * v) for n, v in TRUTH.as_dict().items()}
    vehicle = Vehicle.shipped(name).model_copy(
        update={"command": Command(kind="normalized", max_speed=FULL), "parameters": values, "effects": LATE}
    )
    return vehicle.model_copy(update=more)


@cache
def proposed(form: str) -> Gains:
    """Gains of the identified vehicle for an autopilot whose rate loop runs as the studies fly it."""
    return quadid.gains(identified(), form, current={RATE[form][0]: RATE[form][1]})


@pytest.mark.parametrize("form", AUTOPILOTS)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_loop_around_the_truth_is_as_promised(form: str, axis: int) -> None:
    vehicle, found = identified(), proposed(form)
    promised = found.result["axes"][axis]["rate"]
    period, response = step(found, vehicle, TRUTH, LATE, axis)
    assert bandwidth(period, response) == pytest.approx(promised["bandwidth"], rel=0.06)
    assert response.max() - 1.0 == pytest.approx(promised["overshoot"], abs=0.04)
    t, steps = found.loops[found.result["axes"][axis]["axis"]].step()
    np.testing.assert_allclose(np.interp(t, period * np.arange(len(response)), response), steps[0], atol=0.06)
    assert response[-1] == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("form", AUTOPILOTS)
def test_margins_hold_over_the_intervals_and_end_where_they_are_said_to(form: str) -> None:
    vehicle, found = identified(), proposed(form)
    promised = found.result["axes"][0]["rate"]
    used = {u["name"]: u["ci95"] for u in found.result["used"]}
    assert promised["phase_margin_least"] >= 54.0
    worst = TruthParameters(**{**TRUTH.as_dict(), "J_xx": used["J_xx"][0], "b": used["b"][1]})
    late = {"motor_lag": {"tau": used["motor lag"][1]}, "command_delay": {"delay": used["command delay"][1]}}
    _, response = step(found, vehicle, worst, late, 0, seconds=1.5)
    assert response.max() - 1.0 <= promised["overshoot_most"] + 0.05
    # Delay that takes the phase margin at the crossover: a little less is stable, a little more is not.
    loops = found.loops["roll"].margins()
    spare = float(loops.phase[0] / 360.0 / loops.crossover[0])
    for share, grows in ((0.85, False), (1.15, True)):
        more = {**LATE, "command_delay": {"delay": LATE["command_delay"]["delay"] + share * spare}}
        _, response = step(found, vehicle, TRUTH, more, 0, seconds=3.0)
        swing = np.abs(response - 1.0)
        third = len(swing) // 3
        assert (swing[-third:].max() > swing[third : 2 * third].max()) == grows, share


@pytest.mark.parametrize("form", AUTOPILOTS)
@pytest.mark.parametrize("loop", ["rate", "attitude"])
def test_open_loops_that_tones_show_have_the_margins_of_the_promise(form: str, loop: str) -> None:
    vehicle, found = identified(), proposed(form)
    flew = margins(found, vehicle, TRUTH, LATE, loop == "attitude")
    for axis, (phase, gain) in zip(found.result["axes"], flew, strict=True):
        if form == "betaflight" and (axis["axis"], loop) == ("yaw", "attitude"):
            assert axis[loop] is None, "Betaflight holds no heading"
            continue
        assert phase == pytest.approx(axis[loop]["phase_margin"], abs=3.0)
        assert gain == pytest.approx(axis[loop]["gain_margin"], abs=1.5)


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
