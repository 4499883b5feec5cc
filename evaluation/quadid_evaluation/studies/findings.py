"""`make findings`: every input on which the product failed once: what it answers now, and whether that is right.

`made` inputs are made here of those of the folder, as their notes describe; nothing of the folder is changed.
"""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quadid_evaluation.harness import options

Answer = tuple[int, str, Mapping[str, Any]]
"""Exit code, what was said (stdout and stderr), and the JSON."""
QUADID = Path(sys.executable).with_name("quadid")


def answer_of(arguments: Sequence[str | Path]) -> Answer:
    """Exit code, words and JSON of a command."""
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder, "answer.json")
        wants = [] if arguments[0] == "init" else ["--json", result]
        run = subprocess.run(
            [str(QUADID), *map(str, [*arguments, *wants])], capture_output=True, text=True, check=False
        )
        data = json.loads(result.read_text(encoding="utf-8")) if result.exists() else {}
    return run.returncode, f"{run.stderr}{run.stdout}", data


@dataclass(frozen=True)
class Finding:
    """One input.

    Attributes:
        folder: of the findings, below the data.
        what: done wrong, or meant, in a few words.
        call: arguments of the command, of the folder and of one to write into.
        right: whether the answer is right.
        numbers: what the table shows of it.
    """

    folder: str
    what: str
    call: Callable[[Path, Path], Sequence[str | Path]]
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


def inspect(log: str, vehicle: str = "") -> Callable[[Path, Path], Sequence[str | Path]]:
    """Inspects a file of the folder, with a vehicle file of it, or a shipped one."""
    return lambda folder, out: ["inspect", folder / log, *_vehicle(folder, vehicle)]


def _vehicle(folder: Path, vehicle: str) -> list[str | Path]:
    return ["--vehicle", folder / vehicle if vehicle.endswith(".yaml") else vehicle] if vehicle else []


def initialised(log: str) -> Callable[[Path, Path], Sequence[str | Path]]:
    """Inspects a log with the vehicle file that `init` makes of it."""

    def call(folder: Path, out: Path) -> Sequence[str | Path]:
        answer_of(["init", "made", "--from", folder / log, "--mass", "1.3", "--arm", "0.21", "--out", out])
        return ["inspect", folder / log, "--vehicle", out / "made.yaml"]

    return call


def changed(
    log: str, vehicle: str, change: Callable[[list[str], int, Mapping[str, int]], None]
) -> Callable[[Path, Path], Sequence[str | Path]]:
    """Inspects a CSV of the folder whose rows `change` alters: row, its number, and places of the columns."""

    def call(folder: Path, out: Path) -> Sequence[str | Path]:
        with (folder / log).open(newline="") as source, (out / "log.csv").open("w", newline="") as written:
            rows, to = csv.reader(source), csv.writer(written)
            head = next(rows)
            to.writerow(head)
            for number, row in enumerate(rows):
                change(row, number, {name: k for k, name in enumerate(head)})
                to.writerow(row)
        return ["inspect", out / "log.csv", *_vehicle(folder, vehicle)]

    return call


def script(log: str, vehicle: str) -> Callable[[Path, Path], Sequence[str | Path]]:
    """Runs the folder's `mk.py`, and inspects what it writes."""

    def call(folder: Path, out: Path) -> Sequence[str | Path]:
        shutil.copy(folder / "mk.py", out)
        subprocess.run([sys.executable, "mk.py"], cwd=out, check=True)
        return ["inspect", out / log, *_vehicle(folder, vehicle)]

    return call


def exchanged(row: list[str], number: int, at: Mapping[str, int]) -> None:
    """Motors 1 and 3 exchanged."""
    row[at["w1"]], row[at["w3"]] = row[at["w3"]], row[at["w1"]]


def climbing(row: list[str], number: int, at: Mapping[str, int]) -> None:
    """Vertical velocity upwards."""
    row[at["vz"]] = str(-float(row[at["vz"]]))


def dropped(row: list[str], number: int, at: Mapping[str, int]) -> None:
    """One frame in two hundred without rotor speeds."""
    if number % 200 == 100:
        for k in range(1, 7):
            row[at[f"w{k}"]] = "0"


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
        lambda a: usable(a) and channel(a, "rotor_speed")["dropped"].get("impossible_rotor_speed", 0) >= 4,
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


def compared(log: str) -> Callable[[Path, Path], Sequence[str | Path]]:
    """Compares a flight of the folder with its five healthy ones."""
    return lambda folder, out: [
        "health", folder / log, *(part for k in range(5) for part in ("--baseline", folder / f"healthy{k}.csv")),
        "--vehicle", folder / "vehicle.yaml",
    ]  # fmt: skip


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
            lambda a: usable(a) and channel(a, "rotor_speed")["dropped"].get("impossible_rotor_speed", 0) > 10),
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
        "ardupilot", what, inspect(log, "mine_pwm.yaml"),
        lambda a: usable(a) and verdicts(a)["motor_order"] == "ok" and verdicts(a)["rotor_timing"] == "ok",
    )
    for what, log in (
        ("first sticks after a hover", "first_sticks_57s_false_pitch_step.tlog"),
        ("weak motors and a payload in hover", "payload_hover_378s_no_alarm.tlog"),
    )
)  # fmt: skip
FINDINGS = (*LOGS, *VEHICLES, *ARDUPILOT)


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
    for finding in FINDINGS:
        if given.words and not any(name in finding.folder for name in given.words):
            continue
        right, line, numbers = judged(finding, given.data)
        wrong += not right
        shown = f"| {finding.folder} | {finding.what} | {line[:90]} | {numbers[:60]} |"
        print(f"{shown} {'right' if right else '**wrong**'} |", flush=True)
    return wrong


if __name__ == "__main__":
    sys.exit(main())
