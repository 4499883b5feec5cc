"""Identifies every recorded flight and sets the result beside what is known of it.

    QUADID_DATA=../shared/data python -m studies.real_logs --out docs/results

Each log goes the way of `quadid identify`.  The last part predicts the rates of Crazyflie flights that were not fitted
and compares with a plain regression.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from quadid.errors import QuadidError
from quadid.workflow.identify import identify
from quadid.workflow.loading import GRID, load_logs, load_vehicle
from studies.page import put_section
from studies.prediction import rate_prediction

CF = "crazyflie_rpm"
TRAIN = tuple(f"{CF}/figure8_{n}.csv" for n in (17, 20, 22, 27, 34))
UNSEEN = tuple(f"{CF}/figure8_{n}.csv" for n in (18, 21, 24, 30, 35))
HERE = Path(__file__).parent / "vehicles"


@dataclass(frozen=True)
class Case:
    """Logs of one vehicle.

    Attributes:
        title: heading.
        train: logs to fit, below the data folder, with spans as on the command line.
        validate: logs to score only.
        vehicle: file below the data folder, or a path of its own.
        known: what is known of a parameter from elsewhere.
        remark: what the figures mean; written by hand after they were seen.
    """

    title: str
    train: tuple[str, ...]
    validate: tuple[str, ...]
    vehicle: str
    known: Mapping[str, str] = field(default_factory=dict)
    remark: str = ""


_NANO = {
    "b": "3.72e-8 (authors)", "d": "7.74e-12 (authors; 1/30 of what other sources have)",
    "J_xx": "2.395e-5 (authors), 2.5e-5 (published)", "J_yy": "2.395e-5 (authors), 2.8e-5 (published)",
    "J_zz": "3.235e-6 (authors, ten times low), 4.9e-5 (published)", "J_r": "3.9e-8 (published)",
}  # fmt: skip
CASES = (
    Case(
        "Crazyflie, measured rotor speeds, figure eights",
        TRAIN,
        UNSEEN,
        f"{CF}/vehicle.yaml",
        {"b": "3.70e-8"},
        """\
Thrust is within 1.2 % of what others found. J_xx and J_yy hold for an arm of 35 mm, which the source does not document;
they are known relative to it. d and J_zz come out wide: these flights hardly yaw. J_r rests on its bound: the nominal
model has no rotor acceleration torque, which is what shows in yaw. The simulation over a whole second misses the rates
by far (fit below 0 %), because moments of the rotors' in-plane force and of an offset centre of gravity are no part of
the nominal model and tip it over within half a second; the last part of this page frees them. The error is as large as
1e5 because motion capture tells position to less than a millimetre.""",
    ),
    Case(
        "Crazyflie, the last of these flights as ROS 2 MCAP",
        ("mcap/crazyflie_figure8_35.mcap",),
        (),
        f"{CF}/vehicle.yaml",
        {"b": "3.70e-8"},
        """\
Five seconds: thrust agrees with the other flights, J_xx too, J_yy is lower than from all flights. d and J_zz are not to
be believed: their ratio is what the flight shows, and the tool says that no rigid body has such a J_zz. The error over
one second is larger than that of the guess, because the fit was made on 0.2 s, where the moments that the model lacks
could be set aside.""",
    ),
    Case(
        "Crazyflie, PWM commands, ROS 2 MCAP",
        ("mcap/crazyflie_rollpitch.mcap",),
        (),
        f"{CF}/vehicle_pwm.yaml",
        {},
        """\
Commands, not speeds: between them and thrust lies a lag of about 40 ms and a curve, and the battery. The nominal model
has neither, so inertias run to their bounds (a slow rotor looks like a heavy vehicle) and are not called identified. b
holds for the assumed 2700 rad/s at full command; J_zz is known relative to d only.""",
    ),
    Case(
        "Nano-drone (Crazyflie 2.1 Brushless)",
        tuple(f"nanodrone/{k}_run{n}.csv" for k in ("random", "chirp", "square") for n in (1, 2)),
        tuple(f"nanodrone/{k}_run3.csv" for k in ("random", "chirp", "square")),
        "nanodrone/vehicle.yaml",
        _NANO,
        """\
Thrust is the authors' to 0.2 %. J_zz agrees with the published value, not with the authors', which is ten times lower.
J_xx and J_yy come out 1.4 and 2.1 times the published ones and outside their intervals: the states of these files were
low-passed at 10 to 25 Hz without delay and shifted by a constant each, and below 2.5 Hz aerodynamic moments rule. What
was filtered away looks like inertia. The intervals were widened up to 21 times for what the model lacks and are still
too narrow for J_xx and J_yy: no residual shows a bias that filtering made.""",
    ),
    Case(
        "ArduCopter DataFlash",
        ("ardupilot/log171.bin@76:146",),
        ("ardupilot/log171.bin@146:216",),
        str(HERE / "log171.yaml"),
        {},
        """\
Nothing is documented but the frame type; mass, arm and top speed in the vehicle file are assumptions, so values hold
relative to them. Thrust is known to 2.4 %. Inertias are several times what a vehicle of that size has, and J_yy runs to
its bound: pulse widths stand for rotor speeds that follow with a lag, and the thrust curve of ArduPilot
(MOT_THST_EXPO 0.8) is not a square. The simulation follows a_z and no rate over a second.""",
    ),
    Case(
        "PX4 ULog, motors at 10 Hz",
        ("px4/ascend_cubeorange_test.ulg",),
        (),
        str(HERE / "ascend.yaml"),
        {},
        """\
Thrust yes, inertia no, as it must be: ten motor commands a second say nothing about what the rate loop did between
them. b holds for the assumed mass and top speed. The errors over one second are those of the inertias in the vehicle
file.""",
    ),
    Case("PX4 ULog, esc rpm at 4 Hz", ("px4/auterion_esc_status_log.ulg",), (), str(HERE / "ascend.yaml")),
)


def section(case: Case, data: Path) -> str:
    """Identifies one case and describes the result in Markdown."""
    text = [f"## {case.title}", "", "`" + " ".join(command(case)) + "`", ""]
    vehicle = load_vehicle(str(data / case.vehicle))
    try:
        train = load_logs([str(data / n) for n in case.train], vehicle, GRID)
        held = load_logs([str(data / n) for n in case.validate], vehicle, GRID)
        done = identify(train, held)
    except QuadidError as error:
        return "\n".join([*text, f"Refused with exit code {error.exit_code}: {error}", "", case.remark]).rstrip()
    text += [*parameter_rows(done.result["parameters"], case.known), "", *score_rows(done.result["sets"]), ""]
    notes = [
        w for w in done.result["warnings"] if not any(w.startswith(f"{log.path.name}:") for log in (*train, *held))
    ]
    return "\n".join([*text, *(f"* {w}" for w in notes), "", case.remark]).rstrip()


def command(case: Case) -> list[str]:
    """The command line that gives the same result."""
    vehicle = case.vehicle if "/vehicles/" not in case.vehicle else f"studies/vehicles/{Path(case.vehicle).name}"
    held = [word for name in case.validate for word in ("--validate", name)]
    return ["quadid", "identify", *case.train, *held, "--vehicle", vehicle]


def parameter_rows(parameters: Sequence[Mapping[str, Any]], known: Mapping[str, str]) -> list[str]:
    """Table of parameters with intervals, status, and what is known."""
    rows = ["| parameter | value | 95 % interval | unit | status | known |", "|---|---|---|---|---|---|"]
    for p in parameters:
        low, high = p["ci95"]
        status = p["status"] + (f" to {p['relative_to']}" if "relative_to" in p else "")
        interval = f"{low:.3g} … {high:.3g}"
        rows.append(
            f"| {p['name']} | {p['value']:.4g} | {interval} | {p['unit']} | {status} | {known.get(p['name'], '–')} |"
        )
    return rows


def score_rows(sets: Sequence[Mapping[str, Any]]) -> list[str]:
    """Table of errors over one second, per log."""
    names = ("p", "q", "r", "a_z")
    rows = ["| log | role | error before | after | " + " | ".join(f"fit {n} %" for n in names) + " |", "|---" * 8 + "|"]
    for s in sets:
        fits = " | ".join(f"{max(s['fit_percent'].get(n, float('nan')), -999.0):.0f}" for n in names)
        rows.append(f"| {s['log']} | {s['role']} | {s['mse']['initial']:.3g} | {s['mse']['fitted']:.3g} | {fits} |")
    return rows


def main() -> None:
    """Command line of the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default=os.environ.get("QUADID_DATA", "../shared/data"))
    parser.add_argument("--out", default="")
    options = parser.parse_args()
    data = Path(options.data)
    for name, make in {"identify": identified, "prediction": predicted}.items():
        text = make(data)
        print(text, flush=True)
        if options.out:
            put_section(Path(options.out) / "real_logs.md", "Recorded flights", name, text)


def identified(data: Path) -> str:
    """Section on every log."""
    return "\n\n".join([INTRODUCTION, *(section(c, data) for c in CASES)])


def predicted(data: Path) -> str:
    """Section on rates of unseen flights."""
    return rate_prediction(data, TRAIN, UNSEEN, f"{CF}/vehicle.yaml")


INTRODUCTION = """\
`python -m studies.real_logs --out docs/results`

Every log is identified as it comes, with the nominal model of the paper and a vehicle file that holds what its source
documents. "Error" is the squared simulation error over one second in noise variances (1 is the noise floor); "fit" is
100 % for a perfect simulation over that second and 0 % for the mean. Paths are below the data folder."""


if __name__ == "__main__":
    main()
