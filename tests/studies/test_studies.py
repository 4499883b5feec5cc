"""Studies: pages, recorded results, peers, stand-ins and judgements keep what they promise."""

import ast
import importlib.util
import json
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from quadid_evaluation.benchmarks.online import flown
from quadid_evaluation.harness import judged
from quadid_evaluation.studies import coverage, findings, sitl
from quadid_evaluation.studies.flight_sets import SETS, of_set
from quadid_evaluation.studies.foreign import outside_table
from quadid_evaluation.studies.peers import online, simulated
from quadid_evaluation.studies.readings import LOOP, errors
from quadid_evaluation.studies.soak import BATCH, batches, slope
from quadid_evaluation.studies.truth import poor_guess
from quadid_node.mavlink_link import MOTORS as RATE
from quadid_node.mavlink_link import REQUESTED

from quadid.flight import SensorNoise, fly
from quadid.flight.pilot import AXES
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from tests.commands import Cli
from tests.faults.evidence import Happened

# --- Numbers beside their truth on the page of vehicles of others


IRIS = SETS["iris"]


def answered(b: float, status: str, *effects: str) -> dict[str, Any]:
    """An answer with b known to 5 % and these findings."""
    number = {"name": "b", "value": b, "ci95": [0.95 * b, 1.05 * b], "status": status}
    return {"parameters": [number], "findings": [{"effect": e} for e in effects]}


def test_b_beside_a_thrust_curve_has_a_truth_of_its_own() -> None:
    """Rotors at pwm - 900 rad/s, in a file that has 1.1 (pwm - 1000): less 110 rad/s, of speeds 1.1 times as large."""
    low, high = IRIS.beside_curve["b"]
    assert low < high == pytest.approx(5.84e-6 / 1.21)
    (curved,) = of_set("iris", IRIS, {"diagnose": answered(4.8e-6, "identified", "thrust_curve")})
    (plain,) = of_set("iris", IRIS, {"diagnose": answered(4.8e-6, "identified")})
    assert curved.inside
    assert not plain.inside


def test_the_share_counts_identified_numbers_and_names_those_outside() -> None:
    answers = {"identify": answered(6.1e-6, "identified"), "diagnose": answered(9.0e-6, "identified")}
    unused = of_set("iris", IRIS, {"diagnose": answered(9.0e-6, "unreliable")})
    text = outside_table([*of_set("iris", IRIS, answers), *unused])
    assert "Of 2 identified values with known truth, 1 have it inside" in text
    assert text.count("**+") == 1


def test_refused_data_have_no_numbers() -> None:
    assert list(of_set("iris", IRIS, {"identify": None, "diagnose": None})) == []
    assert outside_table([]) == ""


# --- Judgements of mutants: of functions that are there and that are spoilt


ROOT = Path(__file__).parents[2]


def functions(source: str) -> set[str]:
    """Names of functions and methods as the judgements have them, without the underscores around them."""
    found = set()
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef):
            found.add(node.name.strip("_"))
        elif isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{f.name}".strip("_") for f in node.body if isinstance(f, ast.FunctionDef)}
    return found


def test_every_judgement_is_of_a_function_that_is_spoilt() -> None:
    judged = yaml.safe_load(
        (ROOT / "evaluation" / "quadid_evaluation" / "studies" / "mutation" / "judged.yaml").read_text(encoding="utf-8")
    )
    there: set[str] = set()
    for module in ("gate", "session"):
        spec = importlib.util.find_spec(f"quadid.online.{module}")
        assert spec is not None
        assert spec.origin is not None
        there |= functions(Path(spec.origin).read_text(encoding="utf-8"))
    assert set(judged) <= there


# --- Pages that commands write: what people judged outlives the next run, and nothing is counted that was not there


def test_what_people_judged_outlives_the_next_run(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    assert judged(page) == ""
    page.write_text("# Title\n\n1 %\n\n## Judged by hand\n\n* It is enough.\n")
    page.write_text("# Title\n\n2 %\n" + judged(page))
    assert page.read_text() == "# Title\n\n2 %\n\n## Judged by hand\n\n* It is enough.\n"


def test_compiled_functions_are_counted_apart(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("@nb.njit(**jit)\ndef f(x):\n    y = x\n    return y\n\n\ndef g():\n    return 1\n")
    assert coverage.compiled(tmp_path) == 2


def test_coverage_is_told_by_room() -> None:
    files = {
        "quadid/data/window.py": Counter(statements=90, run=90, branches=10, taken=0),
        "quadid/online/gate.py": Counter(statements=10, run=5, branches=10, taken=5),
    }
    text = coverage.page(files, 7)
    assert "**83.3 % of statements and branches**" in text
    assert "| `quadid/online` | 5/10 | 5/10 | **50.0 %** |" in text


def test_batches_hold_every_sample_once_and_no_channel_runs_ahead() -> None:
    recording = flown(3.0, 3).recording
    made = batches(recording)
    told = Counter((name, t) for batch in made for b in batch for name, _ in b.columns for t in b.t.tolist())
    assert told == Counter((name, t) for name, c in recording.channels.items() for t in c.t.tolist())
    for batch in made:
        assert max(b.t[-1] for b in batch) - min(b.t[0] for b in batch) <= BATCH


# --- The peers are used fairly: each finds the truth of a flight that holds nothing but its own model


PELICAN = Vehicle.shipped("pelican")


@pytest.mark.parametrize("program", ["mujoco.sysid", "output error"])
def test_the_truth_of_a_flight_without_noise_is_found(program: str) -> None:
    truth = simulated.body(1)
    numbers = truth.as_dict()
    window = fly(PELICAN, truth, 8.0, 1, noise=SensorNoise().scaled(1e-6)).window
    found, _ = simulated.PROGRAMS[program](window, poor_guess(PELICAN, numbers, 1))
    error = found.values - np.log([numbers[n] for n in NOMINAL_NAMES])
    assert np.all(np.abs(error[:5]) < 0.01), "b, d and the inertias"
    assert abs(error[5]) < 0.05, "J_r"


def test_kalman_filters_come_to_the_truth_and_follow_a_change_of_mass() -> None:
    truth = {n: p.initial for n, p in PELICAN.parameters.items()}
    flight = fly(PELICAN, seconds=20.0, seed=1, effects={"mass_change": {"time": 12.0, "fraction": 0.15}})
    vehicle = poor_guess(PELICAN, truth, 1)
    start = np.concatenate([np.zeros(3), np.log([vehicle.parameters[n].initial for n in online.NAMES])])
    true = np.log([flight.truth.parameters.as_dict()[n] for n in online.NAMES])
    for run in online.FILTERS.values():
        path = np.array(list(run(flight.window, vehicle, start)))
        assert np.all(np.abs(path[580] - true) < (0.01, 0.03, 0.01, 0.01, 0.03))
        assert path[-1, 0] < true[0] - 0.1, "a heavier vehicle looks like weaker rotors"


# --- Motor readings of a live link are asked for out of step with sticks that move in steps


MOTORS = ("SERVO_OUTPUT_RAW", "ACTUATOR_OUTPUT_STATUS", "ESC_STATUS", "ESC_TELEMETRY_1_TO_4")
RING, DAMPING = 2.0 * np.pi * 22.0, 0.1


def ringing(step: float, seconds: float = 60.0) -> FloatArray:
    """Torque of a loop that rings at 22 Hz and follows slow sticks, which come every `step` [s]."""
    t, runs = np.arange(round(seconds / LOOP)) * LOOP, round(step / LOOP)
    sticks = sum(a * np.sin(2.0 * np.pi * f * t + p) for a, f, p in ((1.0, 0.3, 0.0), (0.6, 0.7, 1.0), (0.4, 1.3, 2.0)))
    out, place, speed = np.empty(len(t)), 0.0, 0.0
    for k in range(len(t)):
        speed += LOOP * (RING**2 * (sticks[k - k % runs] - place) - 2.0 * DAMPING * RING * speed)
        place += LOOP * speed
        out[k] = speed
    return out


@pytest.mark.parametrize("step", [0.02, 0.04])
@pytest.mark.parametrize("message", MOTORS)
def test_snapshots_as_asked_for_give_slow_torque_where_those_in_step_do_not(message: str, step: float) -> None:
    torque = ringing(step)
    ours = round(1.0 / REQUESTED.get(message, RATE) / LOOP)
    in_step, asked = (np.abs(errors(torque, runs)).max() for runs in (8, ours))
    assert in_step > 0.2
    assert asked < 0.01


# --- The recorded soak: what docs/results/soak.json says must keep the promises of a long run


def test_the_recorded_hour_lost_nothing_and_stayed_flat(repository: Path, happened: Happened) -> None:
    found = json.loads((repository / "docs/results/soak.json").read_text())["live"]
    r = found["result"]
    sent, taken = r["sent"], r["minutes"][-1]["messages"]
    assert sent == {topic: taken.get(topic, 0) for topic in sent}
    assert not r["minutes"][-1]["dropped"]
    assert r["exit_code"] == 0
    hours, grown = r["points"][-1]["hours"], slope(r["points"], "memory_mib")
    assert hours >= 1.0
    assert grown < 4.0
    assert r["points"][-1]["handles"] <= r["points"][1]["handles"]
    p99 = np.median([m["p99"] for m in r["minutes"] if m["p99"] is not None])
    load, count = r["points"][-1]["load"], sum(sent.values())
    happened(
        22,
        f"{hours:.1f} h of the node in real time, recorded {found['measured']}: {count:,} messages, none "
        f"lost; memory {grown:+.1f} MiB/h, handles constant; IMU latency p99 {p99:.0f} ms at a load of {load:.0f}",
    )


def test_the_recorded_accelerated_flight_lost_nothing_and_stayed_flat(repository: Path, happened: Happened) -> None:
    found = json.loads((repository / "docs/results/soak.json").read_text())["accelerated"]
    points, asked = found["result"]["points"], found["result"]["asked_hours"]
    last = points[-1]
    assert last["sent"] == last["taken"] + last["dropped"]
    grown = slope(points, "memory_mib")
    assert grown < 4.0
    happened(
        22,
        f"{last['hours']:.1f} h of flight at accelerated time of the {asked:.0f} wanted, recorded "
        f"{found['measured']}: {last['sent']:,} samples, none lost; memory {grown:+.1f} MiB/h",
    )


# --- Every input on which the product failed once is answered rightly


@pytest.mark.parametrize("finding", findings.FINDINGS, ids=lambda f: f"{f.folder}: {f.what}")
def test_each_finding_is_answered_rightly(
    finding: findings.Finding, data_dir: Path, inside: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def answer_of(arguments: Sequence[str | Path]) -> findings.Answer:
        result = tmp_path / f"{arguments[0]}.json"
        run = inside(*arguments, *([] if arguments[0] == "init" else ["--json", result]))
        data = json.loads(result.read_text(encoding="utf-8")) if result.exists() else {}
        return run.code, f"{run.err}{run.out}", data

    monkeypatch.setattr(findings, "answer_of", answer_of)
    right, line, numbers = findings.judged(finding, data_dir)
    assert right, (line, numbers)


@pytest.mark.slow
@pytest.mark.parametrize("attack", findings.ATTACKS, ids=lambda f: f"{f.folder}: {f.what}")
def test_each_attack_is_answered_rightly(attack: findings.Finding, data_dir: Path) -> None:
    right, line, numbers = findings.judged(attack, data_dir)
    assert right, (line, numbers)


# --- The study that flies a running ArduCopter: skipped without one; its plan, flown against a stand-in


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
    """Stand-in for the link that `fly` needs: it climbs once it was told to, and refuses to arm at first."""

    flightmode: str = "STABILIZE"
    height: float = 0.0
    asked: list[str] = field(default_factory=list)
    answers: int = 0
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
            self.answers += 1
            own, asked = self.answers % 2 == 0, int(self.asked[-1])  # first a late answer to something else
            return SimpleNamespace(
                command=asked if own else 0, result=0 if not own or self.asked.count(str(asked)) > 1 else 4
            )
        if type == "GLOBAL_POSITION_INT" and "511" in self.asked:  # nothing comes that was not asked for
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
