"""`make findings`: every input on which the product failed once: what it answers now, and whether that is right.

`made` inputs are made here of those of the folder, as their notes describe; nothing of the folder is changed.
"""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas

from quadid_evaluation.harness import QUADID, options

Answer = tuple[int, str, Mapping[str, Any]]
"""Exit code, what was said (stdout and stderr), and the JSON."""
Call = Callable[[Path, Path], Sequence[str | Path]]
"""Arguments of a command, of the folder of a finding and of one to write into."""


def answer_of(arguments: Sequence[str | Path]) -> Answer:
    """Exit code, words and JSON of a command, or of lines of Bash in which $Q is quadid and $P Python."""
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder, "answer.json")
        program = [] if arguments[0] == "bash" else [QUADID]
        wants = [] if arguments[0] in ("init", "bash") else ["--json", result]
        run = subprocess.run(
            [*map(str, [*program, *arguments, *wants])],
            capture_output=True,
            text=True,
            check=False,
            env={**os.environ, "Q": QUADID, "P": sys.executable, "PYTHONWARNINGS": "ignore"},
        )
        data = json.loads(result.read_text(encoding="utf-8")) if result.exists() else {}
    return run.returncode, f"{run.stderr}{run.stdout}", data


@dataclass(frozen=True)
class Finding:
    """One input.

    Attributes:
        folder: of the findings, below the data.
        what: done wrong, or meant, in a few words.
    """

    folder: str
    what: str
    call: Call
    right: Callable[[Answer], bool]
    numbers: Callable[[Answer], str] = lambda answer: ""


def verdicts(answer: Answer) -> dict[str, str]:
    """Verdicts of an inspection by check."""
    return {check["name"]: check["verdict"] for check in answer[2].get("checks", ())}


def channel(answer: Answer, name: str) -> Mapping[str, Any]:
    """Facts of a channel; empty where it is absent."""
    return next((c for c in answer[2].get("channels", ()) if c["name"] == name), {})


def usable(answer: Answer) -> bool:
    return bool(answer[2].get("usable"))


def says(*words: str) -> Callable[[Answer], bool]:
    """Judges an answer: right if it contains all words and the log is refused."""
    return lambda answer: all(word in answer[1] for word in words) and not usable(answer)


def parameter(answer: Answer, name: str) -> float:
    """A value of identify; NaN without one."""
    found = (p["value"] for p in answer[2].get("parameters", ()) if p["name"] == name)
    return float(next(found, float("nan")))


def inspect(log: str, vehicle: str = "") -> Call:
    """Inspects a file of the folder, with a vehicle file of it, or a shipped one."""
    return lambda folder, out: ["inspect", folder / log, *_vehicle(folder, vehicle)]


def _vehicle(folder: Path, vehicle: str) -> list[str | Path]:
    return ["--vehicle", folder / vehicle if vehicle.endswith(".yaml") else vehicle] if vehicle else []


def initialised(log: str) -> Call:
    """Inspects a log with the vehicle file that `init` makes of it."""

    def call(folder: Path, out: Path) -> Sequence[str | Path]:
        answer_of(["init", "made", "--from", folder / log, "--mass", "1.3", "--arm", "0.21", "--out", out])
        return ["inspect", folder / log, "--vehicle", out / "made.yaml"]

    return call


def changed(log: str, vehicle: str, change: Callable[[pandas.DataFrame], None]) -> Call:
    """Inspects a CSV of the folder whose columns of text `change` alters."""

    def call(folder: Path, out: Path) -> Sequence[str | Path]:
        rows = pandas.read_csv(folder / log, dtype=str)
        change(rows)
        rows.to_csv(out / "log.csv", index=False)
        return ["inspect", out / "log.csv", *_vehicle(folder, vehicle)]

    return call


def script(log: str, vehicle: str) -> Call:
    """Runs the folder's `mk.py`, and inspects what it writes."""

    def call(folder: Path, out: Path) -> Sequence[str | Path]:
        shutil.copy(folder / "mk.py", out)
        subprocess.run([sys.executable, "mk.py"], cwd=out, check=True)
        return ["inspect", out / log, *_vehicle(folder, vehicle)]

    return call


def exchanged(rows: pandas.DataFrame) -> None:
    """Motors 1 and 3 exchanged."""
    rows[["w1", "w3"]] = rows[["w3", "w1"]].to_numpy()


def climbing(rows: pandas.DataFrame) -> None:
    """Vertical velocity upwards."""
    rows["vz"] = (-rows["vz"].astype(float)).astype(str)


def dropped(rows: pandas.DataFrame) -> None:
    """One frame in two hundred without rotor speeds."""
    rows.loc[100::200, [f"w{k}" for k in range(1, 7)]] = "0"


LOGS: tuple[Finding, ...] = (
    Finding(
        "logs/blackbox_high_resolution", "gyro in tenths",
        lambda f, o: ["identify", f / "hires.bbl", "--vehicle", "pelican", "--out", o],
        lambda a: abs(parameter(a, "J_xx") / 0.00996 - 1.0) < 0.05, lambda a: f"J_xx {parameter(a, 'J_xx'):.3g}",
    ),
    Finding(
        "logs/blackbox_throttle_below_min", "40 whole rows, throttle down", inspect("idle.bbl"),
        lambda a: channel(a, "gyro").get("count") == 40 and "damaged" not in a[1],
        lambda a: f"{channel(a, 'gyro').get('count')} rows",
    ),
    Finding(
        "logs/dataflash_esc_index_44", "ESCs counted from 0", initialised("aux44.bin"),
        lambda a: usable(a) and verdicts(a)["motor_order"] == "ok" and channel(a, "rotor_speed")["count"] > 600,
        lambda a: str(channel(a, "rotor_speed").get("source")),
    ),
    Finding("logs/esc_rpm_scale", "a tenth of the speed", initialised("rpm10.bin"), says("ten times too low")),
    Finding(
        "logs/esc_rpm_spikes", "five readings of 65535 rpm", initialised("gl01.bin"),
        lambda a: usable(a) and channel(a, "rotor_speed")["dropped"].get("impossible", 0) >= 4,
        lambda a: str(channel(a, "rotor_speed").get("dropped")),
    ),
    Finding(
        "logs/gravity_check_acrobatic", "climbs of five times hover", script("punches.csv", "bf5.yaml"),
        lambda a: usable(a) and verdicts(a)["gravity"] == "ok", lambda a: f"flying {a[2].get('flying')}",
    ),
    Finding(
        "logs/gravity_check_acrobatic", "on its back", script("on_its_back.csv", ""),
        lambda a: verdicts(a).get("gravity") == "unknown" and not a[2].get("flying"),
    ),
    Finding(
        "logs/heading_reset_hover", "heading reset in hover", inspect("hover_reset5.csv", "pelican"),
        lambda a: usable(a) and verdicts(a)["gyro_attitude"] == "unknown",
    ),
    *(
        Finding(
            "logs/tlog_esc_9_to_12", f"motors on outputs from {k}", inspect(f"esc{k}.tlog", "vo.yaml"),
            lambda a: usable(a) and channel(a, "rotor_speed").get("count") == 750,
            lambda a: str(channel(a, "rotor_speed").get("source")),
        )
        for k in (1, 5, 9)
    ),
    Finding(
        "logs/ulog_dshot_outputs", "DShot outputs", inspect("dshot.ulg", ""),
        lambda a: "of 1999" in channel(a, "motor_command").get("source", "") and bool(a[2].get("flying")),
        lambda a: str(channel(a, "motor_command").get("source")),
    ),
    Finding(
        "logs/usd_event_tables", "three event types", inspect("log00", "crazyflie"),
        lambda a: usable(a) and a[2]["seconds"] < 6.5 and not a[2]["breaks"], lambda a: f"{a[2].get('seconds')} s",
    ),
)  # fmt: skip
_HEXA = "vehicles/2_hexa_wrong_logs"
_X8 = "vehicles/5_x8_feedback_and_health"


def compared(log: str) -> Call:
    """Compares a flight of the folder with its five healthy ones."""
    return lambda folder, out: [
        "health",
        folder / log,
        *(part for k in range(5) for part in ("--baseline", folder / f"healthy{k}.csv")),
        "--vehicle",
        folder / "vehicle.yaml",
    ]


VEHICLES: tuple[Finding, ...] = (
    Finding(_HEXA, "as it flew", inspect("clean.csv", "vehicle.yaml"), usable),
    Finding(_HEXA, "position upwards", inspect("position_up.csv", "vehicle.yaml"), says("points up")),
    Finding(_HEXA, "velocity upwards", changed("clean.csv", "vehicle.yaml", climbing), says("points up")),
    Finding(
        _HEXA, "rotors 30 ms late", inspect("rotors_30ms_late.csv", "vehicle.yaml"),
        lambda a: says("lags its effect")(a) and "reorder" not in a[1],
    ),
    Finding(_HEXA, "spins reversed", inspect("clean.csv", "vehicle_spins_reversed.yaml"), says("negate the spins")),
    Finding(_HEXA, "motors 1 and 3 exchanged", changed("clean.csv", "vehicle.yaml", exchanged),
            says("columns 3, 2, 1, 4, 5, 6")),
    Finding(_HEXA, "frames of zeros", changed("clean.csv", "vehicle.yaml", dropped),
            lambda a: usable(a) and channel(a, "rotor_speed")["dropped"].get("impossible", 0) > 10),
    Finding(
        _X8, "rotor 6 of 8 weak, hover", compared("damaged_hover.csv"),
        lambda a: a[2].get("verdict") == "changed" and "rotor 6: 14 % less" in a[1],
    ),
    Finding(
        _X8, "the same, flown hard", compared("damaged_agile.csv"),
        lambda a: a[2].get("verdict") == "unknown" and "rotor 2 or 6" in a[1] and bool(a[2]["unfamiliar"]),
        lambda a: str(a[2].get("unfamiliar")),
    ),
    *(
        Finding(f"vehicles/{name}", "as it flew", inspect("train.csv", "vehicle.yaml"), usable)
        for name in ("1_nano_lag_beside_delay", "3_hexb_intervals", "5_x8_feedback_and_health", "6_bob_gyro_scale")
    ),
)  # fmt: skip
ARDUPILOT: tuple[Finding, ...] = tuple(
    Finding(
        "ardupilot",
        what,
        inspect(log, "mine_pwm.yaml"),
        lambda a: usable(a) and verdicts(a)["motor_order"] == "ok" and verdicts(a)["rotor_timing"] == "ok",
    )
    for what, log in (
        ("first sticks after a hover", "first_sticks_57s_false_pitch_step.tlog"),
        ("weak motors and a payload in hover", "payload_hover_378s_no_alarm.tlog"),
    )
)
FINDINGS = (*LOGS, *VEHICLES, *ARDUPILOT)
MOVED = {"push_block": "push", "resampler._due": "resampler._stretches"}
"""Names that the attacks' scripts call by an old one; old paths of modules are known once quadid is imported."""


def attack(lines: str) -> Call:
    """Runs lines of Bash in a copy of the folder, beside copies of the other attacks."""

    def call(folder: Path, out: Path) -> Sequence[str | Path]:
        for source in folder.parent.glob("**/*.*"):
            copy = out / source.relative_to(folder.parent)
            text = source.read_text()
            for old, new in MOVED.items():
                text = text.replace(old, new)
            copy.parent.mkdir(exist_ok=True)
            copy.write_text(f"import quadid\n{text}" if source.suffix == ".py" else text)
        return ["bash", "-c", f'cd "{out / folder.name}"; mkdir -p out; {lines}']

    return call


def refused(*words: str) -> Callable[[Answer], bool]:
    """Judges an answer: right if it contains all words and the exit code is not 0."""
    return lambda answer: answer[0] != 0 and all(word in answer[1] for word in words)


def worst(answer: Answer) -> float:
    """Largest error [%] of b, J_xx and J_yy among accepted sets, as the scripts of the attacks print them."""
    sets = (line for line in answer[1].splitlines() if re.search(r"set \d+ accepted", line))
    return max((abs(float(x)) for line in sets for x in re.findall(r"'([-+][\d.]+)% \(sd", line)), default=0.0)


def gate(folder: str, what: str, lines: str) -> Finding:
    """A faulty flight: no set that is more than 5 % off is accepted."""
    return Finding(
        f"attacks/{folder}",
        what,
        attack(lines),
        lambda a: a[0] == 0 and worst(a) <= 5.0,
        lambda a: f"{worst(a)} % off" if "accepted" in a[1] else "none accepted",
    )


def spoilt(folder: str, what: str, change: str, simulate: str = "") -> Finding:
    """A first flight whose columns `c` a statement changes."""
    before = f"mkdir out/gc; $Q simulate out/gc/h.csv --seconds 60 --seed 3 {simulate} >/dev/null; " if simulate else ""
    return gate(folder, what, f"{before}bash ../gate_cli.sh '{what}' '{change}'")


_SDF = "import glob,xml.etree.ElementTree as E; print(E.parse(*glob.glob('o/*.sdf')).getroot()[0].attrib)"
_PAYLOAD = "bash ../gate-payload/run.sh"
ATTACKS: tuple[Finding, ...] = (
    *(
        Finding(
            "attacks/lua-python-injection", f"a name as {language}",
            attack(f"$Q excite --vehicle {log} --seconds 12 --format {program} --out o && cat o/*"),
            refused("line break"),
        )
        for language, log, program in (("Lua", "evil-lua.yaml", "ardupilot-lua"), ("Python", "evil-python.yaml", "px4"))
    ),
    *(
        Finding(
            "attacks/gazebo-attribute-injection", f"the name of {log}",
            attack(f'$Q export --vehicle {log} --format gazebo --out o >/dev/null && $P -c "{_SDF}"'),
            lambda a: a[0] == 0 and set(ast.literal_eval(a[1].splitlines()[-1])) <= {"name", "canonical_link"},
            lambda a: a[1].splitlines()[-1],
        )
        for log in ("g1.yaml", "g2.yaml")
    ),
    Finding(
        "attacks/fleet-imports-working-folder", "html.py beside the logs",
        attack("mkdir -p out/flt; $Q simulate f.csv --seconds 20 >/dev/null; "
               "$Q fleet . --vehicle pelican --workers 1 --out fleet && ! cat out/flt/PWNED 2>/dev/null"),
        lambda a: a[0] == 0 and "1 of 1 logs gave" in a[1],
    ),
    Finding(
        "attacks/mcap-index-hang", "24,000 entries to one chunk",
        attack("$P make.py 2000000 24000 z.mcap >/dev/null; $Q inspect z.mcap --vehicle pelican"), refused("refused"),
    ),
    Finding(
        "attacks/db3-shared-overflow", "2,400 messages, one payload",
        attack("$P make.py 2400 200000 b.db3 >/dev/null; $Q inspect b.db3 --vehicle pelican"), refused("b.db3"),
    ),
    Finding(
        "attacks/export-of-an-outdated-set", "a withdrawn set",
        attack(f"{_PAYLOAD} >/dev/null; $P make.py >/dev/null; "
               "$Q export --vehicle pelican --history out/od.sqlite --format rotorpy"), refused("--anyway"),
    ),
    gate("gate-weak-rotor-1", "rotor 1 is 12 % weak", "ROT=1 bash run.sh"),
    spoilt("gate-weak-rotor-1", "rotor 1 rpm x 0.95", 'c["w1"]*=.95'),
    gate("gate-payload", "+20 % at 60 s", _PAYLOAD),
    *(
        spoilt("gate-tether", f"support {share:.0%}",
               f'[c.update({{n: np.sqrt(c[n]**2-{share}*1.3*9.80665/4/2.33e-5)}}) for n in ("w1","w2","w3","w4")]')
        for share in (0.08, 0.15)
    ),
    spoilt("gate-tether", "thrust curve, lag, filter", "pass", "--effect motor_lag:tau=0.05 "
           "--effect thrust_curve:dead_speed=60 --effect imu_lag:cutoff=6"),
    *(
        spoilt("gate-accel-scale-hidden-by-bias", f"scale {scale}",
               f'[c.update({{n: c[n].mean()+{scale}*(c[n]-c[n].mean())}}) for n in ("ax","ay","az")]')
        for scale in (1.12, 1.3)
    ),
    spoilt("gate-gyro", "smoothed at 3 Hz", 'from scipy.signal import butter,sosfiltfilt\n'
           '[c.update({n: sosfiltfilt(butter(2,3,fs=50,output="sos"),c[n])}) for n in "pqr"]'),
    spoilt("gate-gyro", "15 % of p in q", 'c["q"]+=.15*c["p"]'),
    *(
        Finding(f"attacks/{folder}", what, attack(f"cd ../gate-inprocess; mkdir -p out; $P {script}"),
                lambda a: a[0] == 0 and "***" not in a[1] and "EXC" not in a[1],
                lambda a: f"{a[1].count('sets')} cases")
        for folder, what, script in (
            ("gate-three-small-faults", "with a history", "cases3.py A"),
            ("gate-inprocess", "gyro, clocks, orders", "cases3.py B"),
        )
    ),
    Finding("attacks/velocity-begins-in-flight", "GPS lock at 32 s", attack("bash run.sh"), lambda a: "exit 0" in a[1]),
    Finding(
        "attacks/velocity-begins-in-flight", "channels end, wild values",
        attack("PYTHONPATH=../gate-inprocess $P lost.py"),
        lambda a: a[0] == 0 and "CRASH" not in a[1], lambda a: f"{a[1].count('ok  ')} cases",
    ),
    *(
        Finding("attacks/one-early-stamp", script, attack(f"$P {script}"),
                lambda a: a[0] == 0 and "sets 0" not in a[1], lambda a: f"{a[1].count('sets')} cases")
        for script in ("stamp.py", "stamp2.py")
    ),
    Finding("attacks/stamp-race", "2,000 stamps 29 s apart", attack("$P race.py 2000"),
            lambda a: "CPU: 0 blocks wait" in a[1]),
    Finding(
        "attacks/mavlink-stall-takeover", "stall of 3.5 s", attack("$P stall.py"),
        lambda a: a[0] == 0 and a[1].count("'impostor': 0}") == 2 and "'vehicle': 0" not in a[1],
    ),
    Finding(
        "attacks/mavlink-flood-locks-out", "heartbeats of another", attack("$P flood.py 190"),
        lambda a: min(map(int, re.findall(r"taken \d+ \((\d+)%", a[1])), default=0) >= 95,
    ),
    Finding(
        "attacks/mavlink-param-storm", "PARAM_SET", attack("$P storm.py"),
        lambda a: "out" in a[1] and float(re.findall(r"x([\d.]+) bytes", a[1])[0]) <= 1.0,
    ),
    *(
        Finding("attacks/history-hard-link", what, attack(f"$P {script} 2>&1 | tail -n 1"), says("has 2 names (hard"))
        for script, what in (("race.py", "two services at once"), ("store2.py", "two services in turn"))
    ),
    Finding(
        "attacks/history-future-schema", "lock file lost, version 99", attack("$P store1.py"),
        refused("has 2 names", "another service writes the history", "has version 99"),
    ),
)  # fmt: skip


def judged(finding: Finding, data: Path) -> tuple[bool, str, str]:
    """Judgement of an answer, its first line that names what is wrong, and the numbers shown."""
    with tempfile.TemporaryDirectory() as folder:
        answer = answer_of(finding.call(data.absolute() / "findings" / finding.folder, Path(folder)))
    checks = answer[2].get("checks", ())
    first = next((c["message"] for c in checks if c["verdict"] == "error"), "")
    line = first or (answer[1].strip().splitlines() or [""])[0]
    try:
        return bool(finding.right(answer)), line.replace("|", "/"), finding.numbers(answer).replace("|", "/")
    except (KeyError, TypeError):  # the answer lacks what is looked for
        return False, line.replace("|", "/"), ""


def main() -> int:
    """Prints the table; the number of wrong rows is the exit code."""
    given, wrong = options(__doc__, words="parts of folder names; all without"), 0
    print("| input | meant | first line | numbers | |\n|---|---|---|---|---|")
    for finding in (*FINDINGS, *ATTACKS):
        if given.words and not any(name in finding.folder for name in given.words):
            continue
        right, line, numbers = judged(finding, given.data)
        wrong += not right
        shown = f"| {finding.folder} | {finding.what} | {line[:90]} | {numbers[:60]} |"
        print(f"{shown} {'right' if right else '**wrong**'} |", flush=True)
    return wrong


if __name__ == "__main__":
    sys.exit(main())
