"""Documents: commands run as they stand, equations become MathML, and nothing is named that is not there."""

import importlib.util
import json
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quadid_evaluation.studies.health.flights import Wrong, hover

from quadid.cli.commands import COMMANDS, load
from quadid.flight import TruthParameters, fly
from quadid.vehicle import GRAVITY, Vehicle
from tests.cli.followed_page import commands, follow
from tests.commands import Cli
from tests.replay import blackbox_writer as writer
from tests.replay.px4_flight import px4_ulog

# --- The documentation: its commands run, its equations become MathML, and it names nothing that is not there


@pytest.mark.slow
def test_the_tutorial_runs_as_written(quadid: Cli, repository: Path, tmp_path: Path) -> None:
    found = commands(repository / "docs" / "tutorial.md")
    assert len(found) == 10
    said = []
    for arguments in found:
        run = quadid(*arguments, cwd=tmp_path)
        assert run.code == 0, (arguments, run.err)
        said.append(run.out)
    amber, _, green, poor, good = said[4:9]
    assert "the simulation misses" in amber
    assert "All 6 parameters identified; the simulation of the validation flight misses nothing of importance" in green
    assert "Not to be used" in poor
    assert "at the noise floor" in good
    page = (repository / "docs" / "tutorial.md").read_text(encoding="utf-8")
    printed = [" ".join(out.split()) for out in said]
    quoted = re.findall(r"^> (.+)$", page, re.MULTILINE)
    assert len(quoted) == 4
    for sentence in quoted:
        assert any(sentence in out for out in printed), sentence
    for file in ("report.html", "diagnosis.html", "pelican+weak_rotor+rotor_drag.yaml"):
        assert (tmp_path / file).is_file()


def test_every_command_that_a_page_names_exists(repository: Path) -> None:
    for page in (repository / "docs").rglob("*.md"):
        text = page.read_text(encoding="utf-8")
        for name in re.findall(r"`quadid ([a-z]+)\b", text):
            assert name in COMMANDS, (page.name, name)
        for example in re.findall(r"`(examples/[\w./]+)`", text):
            assert (repository / example).exists(), (page.name, example)
        for module in re.findall(r"`python -m ([\w.]+)", text):
            assert importlib.util.find_spec(module) is not None, (page.name, module)


def test_every_option_that_a_page_or_a_help_text_quotes_is_known(repository: Path) -> None:
    pages = [repository / "README.md", repository / "SECURITY.md", *(repository / "docs").rglob("*.md")]
    lines = [(page.name, line) for page in pages for line in commands(page)]
    lines += [("--help", shlex.split(line)[1:]) for command in COMMANDS.values() for line in command.examples]
    assert len(lines) > 60
    for where, (name, *arguments) in lines:
        # Parsed as when called: options, their values, and what must be given.
        assert load(name).make_context(name, list(arguments)), (where, name, arguments)


def test_every_option_quoted_in_a_sentence_is_known(repository: Path) -> None:
    for page in [repository / "README.md", *(repository / "docs").rglob("*.md")]:
        text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
        for name, rest in re.findall(r"`quadid ([a-z]+)\b([^`]*)`", text):
            known = {option for parameter in load(name).params for option in parameter.opts}
            for option in re.findall(r"(?<!\S)--[a-z-]+", rest):
                assert option in known, (page.name, name, option)


def test_every_picture_of_a_page_exists(repository: Path) -> None:
    shown = [
        (page.name, picture, (page.parent / picture).is_file())
        for page in [repository / "README.md", *(repository / "docs").rglob("*.md")]
        for picture in re.findall(r"!\[[^\]]*\]\(([^:)]+)\)", page.read_text(encoding="utf-8"))
    ]
    assert len(shown) >= 4
    assert [picture for picture in shown if not picture[2]] == []


def test_every_test_that_a_wish_names_exists(repository: Path) -> None:
    text = (repository / "docs" / "results" / "wishes.md").read_text(encoding="utf-8")
    named = re.findall(r"`(tests/[\w./]+)`", text)
    assert len(named) >= 12
    for name in named:
        assert (repository / name).exists(), name


def test_equations_become_mathml_and_code_is_left_alone(repository: Path) -> None:
    pytest.importorskip("latex2mathml", reason="pip install .[docs]")
    spec = importlib.util.spec_from_file_location("docs_math", repository / "tools" / "docs_math.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    page = module.on_page_markdown("a $x^2$ b `$HOME and $PATH`\n\n$$ y = 1 $$\n\n```\n$$ z $$\n```\n")
    assert page.count("<math") == 2
    assert "\n<math" not in module.on_page_markdown("in the text\n$x^2$ begins a line")
    assert "`$HOME and $PATH`" in page
    assert "$$ z $$" in page


# --- The page for users of ArduPilot, "From logs": every command as it stands there, on flights of its own simulator


SQUARE = {"mass": 1.8, "b": 1.983e-5, "J_xx": 0.018, "J_yy": 0.024}
X = {"mass": 3.0, "b": 4.24e-5, "J_xx": 0.02297, "J_yy": 0.02297}
"""Truth; b of the default frame is the secant of its thrust curve at hover."""
MAX_SPEED = 754.0


def errors(parameters: list[dict[str, Any]], truth: dict[str, float]) -> dict[str, float]:
    return {p["name"]: abs(p["value"] / truth[p["name"]] - 1.0) for p in parameters if p["name"] in truth}


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("flight", "truth", "arm"), [("quad_sq", SQUARE, 0.25), ("x", X, 0.35)])
def test_first_flight_with_ardupilot(
    flight: str,
    truth: dict[str, float],
    arm: float,
    inside: Cli,
    tmp_path: Path,
    repository: Path,
    data_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(data_dir / "ardupilot_sitl" / f"{flight}.bin", "flight.bin")

    def filled_in(text: str) -> str:
        assert text.count("FILL IN") == 2
        text = re.sub(r"(?m)^mass: \S+", f"mass: {truth['mass']}", text)
        text = text.replace("0.1768", f"{arm / 2**0.5:.4f}")
        return text.replace("sampling: instant}", f"sampling: instant, max_speed: {MAX_SPEED}}}")

    told = follow(repository / "docs" / "using-with-ardupilot.md", inside, filled_in)
    published = told["replay"]["published"]
    assert published
    for item in published:
        off = errors(item["parameters"], truth)
        assert off.keys() == {"b", "J_xx", "J_yy"}
        assert max(off.values()) < 0.03, off
    known = [p for p in told["diagnose"]["parameters"] if p["status"] == "identified" and p["name"] != "b"]
    off = errors(known, truth)
    assert off.keys() == {"J_xx", "J_yy"}
    assert max(off.values()) < 0.03, off
    assert all(Path(file).is_file() for file in told["export"]["files"])


# --- The page for users of PX4, "From logs": every command as it stands there, on logs with motors at full rate


PELICAN = Vehicle.shipped("pelican")
FULL_SPEED = 900.0
"""Rotor speed at full command [rad/s]."""
DRAG = {"rotor_drag": {"k_x": 0.3, "k_y": 0.3}}


def weighed(text: str) -> str:
    """The vehicle file with the mass filled in, all that it asks for."""
    assert text.count("FILL IN") == 1
    return re.sub(r"(?m)^mass: \S+", f"mass: {PELICAN.mass}", text)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_first_flight_with_px4(inside: Cli, tmp_path: Path, repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A made-up log: the shared flights of a real PX4 have motors at 10 Hz only, from which no inertia comes."""
    monkeypatch.chdir(tmp_path)
    for seed, name in ((5, "flight.ulg"), (6, "second.ulg")):
        flight = fly(PELICAN, seconds=90.0, seed=seed, log_rate=100.0, effects=DRAG)
        (tmp_path / name).write_bytes(px4_ulog(flight, PELICAN, FULL_SPEED))
    told = follow(repository / "docs" / "using-with-px4.md", inside, weighed)
    published = told["replay"]["published"]
    assert published
    truth = TruthParameters.of(PELICAN)
    for item in published:
        values = {p["name"]: p["value"] for p in item["parameters"]}
        for name in ("b", "J_xx", "J_yy"):
            assert values[name] == pytest.approx(getattr(truth, name), rel=0.03)
    assert {f["effect"] for f in told["diagnose"]["findings"]} == {"rotor_drag"}
    assert all(Path(file).is_file() for file in told["export"]["files"])


# --- docs/health.md "Is my drone still healthy?": its command as it stands there, on recorded and on Betaflight logs


FLIGHTS = {"today": "controller_055", "a": "controller_067", "b": "controller_068", "c": "motor_144"}
"""Names on the page, and recorded flights: M3 cut, and healthy ones of the same airframe in both kinds of log."""
PELICAN_X = Vehicle.shipped("pelican_x")
BETAFLIGHT = PELICAN_X.model_copy(update={"rotors": tuple(PELICAN_X.rotors[j] for j in (1, 0, 2, 3))})
"""Its motors: 1 rear right, 2 front right, 3 rear left, 4 front left."""
ERPM = 7 * 60.0 / (2.0 * np.pi) / 100.0
"""Of 14 poles, in hundreds, per rad/s."""


def blackbox(vehicle: Vehicle, wrong: Wrong | None, seed: int) -> bytes:
    """A hover as Betaflight logs it: turns of the motors and acceleration, body FLU."""
    flown = hover(vehicle, wrong, seed).channels
    t, accel = flown["accel"].t, flown["accel"].values * (1.0, -1.0, -1.0) * 2048.0 / GRAVITY
    turns = np.rint(flown["rotor_speed"].values * ERPM).astype(int).tolist()
    rows = []
    for k, (force, speeds) in enumerate(zip(np.rint(accel).astype(int).tolist(), turns, strict=True)):
        row = dict.fromkeys(writer.NAMES, 0) | {
            "loopIteration": k,
            "time": round(1e6 * t[k]),
            "vbatLatest": 1590,
            "rcCommand[3]": 1500,
        }
        row |= {f"motor[{j}]": 48 + speed for j, speed in enumerate(speeds)}
        row |= {f"eRPM[{j}]": speed for j, speed in enumerate(speeds)}
        row |= {f"accSmooth[{j}]": one for j, one in enumerate(force)}
        rows.append([row[name] for name in writer.NAMES])
    return writer.header() + b"".join(writer.frames(rows)) + writer.END


def test_the_page_s_command_names_the_cut_propeller(
    inside: Cli, data_dir: Path, repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, flight in FLIGHTS.items():
        shutil.copy(data_dir / "crazypad" / f"{flight}.usd", f"{name}.usd")
    (command,) = commands(repository / "docs" / "health.md")
    run = inside(*command)
    assert run.code == 0, run.err
    assert "The vehicle has changed: rotor 3: " in run.out
    assert 'class="disc damaged"' in Path("health.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("weak", [1, 2, None])
def test_the_same_command_on_betaflight_logs(
    inside: Cli, repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weak: int | None
) -> None:
    monkeypatch.chdir(tmp_path)
    for seed, name in enumerate(FLIGHTS):
        wrong = Wrong({weak: 0.2}, {weak: 0.2}) if weak and name == "today" else None
        Path(f"{name}.bbl").write_bytes(blackbox(BETAFLIGHT, wrong, seed))
    Path("mine.yaml").write_text(BETAFLIGHT.to_yaml(), encoding="utf-8")
    (command,) = commands(repository / "docs" / "health.md")
    filled_in = {"crazyflie": "mine.yaml"} | {f"{name}.usd": f"{name}.bbl" for name in FLIGHTS}
    run = inside(*[filled_in.get(word, word) for word in command])
    assert run.code == 0, run.err
    wanted = f"The vehicle has changed: rotor {weak}: " if weak else "The vehicle flies as it did in the baseline"
    assert wanted in run.out


# --- The second tutorial: every command as it stands there, on a flight of ArduCopter in its own simulator


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_from_a_raw_log_to_an_exported_file(
    inside: Cli, tmp_path: Path, repository: Path, data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(data_dir / "ardupilot_sitl" / "quad_sq.bin", "flight.bin")
    page = (repository / "docs" / "tutorial-flight.md").read_text(encoding="utf-8")
    found: dict[str, Any] = {}
    said, scores = [], []
    for name, *arguments in commands(repository / "docs" / "tutorial-flight.md"):
        file = found.get("vehicle_file", "")
        run = inside(name, *(a.replace("mine+….yaml", file) for a in arguments), "--json", f"{name}.json")
        assert run.code == 0, (name, arguments, run.err)
        said.append(" ".join(run.out.split()))
        result = json.loads(Path(f"{name}.json").read_text(encoding="utf-8"))
        found = result if name == "diagnose" else found
        scores += [result["horizons"]["25"]["velocity"]] if name == "score" else []
    # 1. What the page quotes was printed.
    quoted = re.findall(r"^> (.+)$", page, re.MULTILINE)
    assert len(quoted) == 5
    for sentence in quoted:
        assert any(sentence in out for out in said), sentence
    # 2. Its table holds what was found, and all intervals but the last two contain what the simulator's sources say.
    numbers = {p["name"]: p for p in found["parameters"]}
    numbers |= {f"{f['effect']}.{p['name']}": p for f in found["findings"] for p in f["parameters"]}
    figure = r"([\d.e-]+)"
    rows = re.findall(rf"^\| `([\w.]+)`[^|]* \| {figure} \| {figure} to {figure} \| {figure} \|$", page, re.MULTILINE)
    assert len(rows) == 7
    missed = []
    for name, stated, *rest in rows:
        low, high, truth = map(float, rest)
        assert numbers[name]["value"] == pytest.approx(float(stated), rel=0.01), name
        assert numbers[name]["ci95"] == pytest.approx([low, high], rel=0.02), name
        missed += [] if low <= truth <= high else [name]
    assert missed == ["rotor_drag.k_x", "drag_torque_curve.growth"]
    before, after = re.findall(r"off by (\d\.\d+) m/s.*?it is by (\d\.\d+)", page)[0]
    assert scores == [pytest.approx(float(before), rel=0.02), pytest.approx(float(after), rel=0.1)]
    for written in ("mine.sitl.json", "mine.param", "diagnosis.html", "series/flight.bin.missing.csv"):
        assert Path(written).is_file(), written


# --- The commands that README shows, run as written


def test_commands_of_the_readme_work(
    inside: Cli, repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = commands(repository / "README.md", "Use")
    assert len(found) == 7
    for arguments in found:
        more = ("--json", "found.json", "--report", "why.html") if arguments[0] == "diagnose" else ()
        run = inside(*arguments, *more)
        assert run.code == 0, (arguments, run.err)
    for file in ("report.html", "pelican.fitted.yaml", "pelican.params", "why.html"):
        assert (tmp_path / file).is_file()
    result = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))
    assert {"schema", "verdict", "findings", "validation", "unexplained", "vehicle_file"} <= result.keys()


def test_vehicles_named_in_the_readme_are_shipped(repository: Path) -> None:
    text = (repository / "README.md").read_text(encoding="utf-8")
    named = re.search(r"shipped name \(([^)]*)\)", text)
    assert named is not None
    names = re.findall(r"`(\w+)`", named[1])
    assert sorted(names) == sorted(p.stem for p in (repository / "quadid" / "vehicles").glob("*.yaml"))
    for name in names:
        Vehicle.shipped(name)
