"""Diagnoses every recorded flight whose motor signal allows it, and measures what the findings gain on other flights.

    QUADID_DATA=../shared/data python -m studies.real_diagnosis --out docs/results

Each log goes the way of `quadid diagnose`.  The extended vehicle of the nano-drone is then scored from the true state,
as `quadid score` does, on flights that neither the fit nor the selection saw.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from quadid_cli.identify import GRID
from quadid_cli.loading import load_logs, load_vehicle

from quadid.diagnose import Diagnosis, Workings, diagnose
from quadid.errors import QuadidError
from quadid.identify.horizon import QUANTITIES, horizon_scores
from quadid.model.layout import Layout
from quadid.vehicle import Vehicle
from quadid.window import Window
from studies.page import put_section
from studies.real_logs import HERE

CF = "crazyflie_rpm"
HORIZONS = (1, 10, 50)
UNITS = ("m", "m/s", "rad", "rad/s")


@dataclass(frozen=True)
class Flights:
    """Logs of one vehicle.

    Attributes:
        name: of the section, and on the command line.
        title: heading.
        train: logs to diagnose; held: logs to measure the gain on; scored: logs for the score from the true state.
        vehicle: file below the data folder, or a path of its own.
        remark: what the figures mean; written by hand after they were seen.
    """

    name: str
    title: str
    train: tuple[str, ...]
    held: tuple[str, ...]
    vehicle: str
    remark: str = ""
    scored: tuple[str, ...] = ()


FLIGHTS = (
    Flights(
        "crazyflie", "Crazyflie, measured rotor speeds, figure eights",
        tuple(f"{CF}/figure8_{n}.csv" for n in (22, 27, 34)), tuple(f"{CF}/figure8_{n}.csv" for n in (24, 30)),
        f"{CF}/vehicle.yaml",
        """\
Rotor drag, and the moment that comes with it, rule these flights: without them nothing follows for a second. Drag of
0.34 to 0.37 1/s is what others measured on vehicles of this size; the inertia that turns the yaw when rotors speed up,
1.2e-7 kg m², is the rotors' own within the published 0.4 to 1e-7. Thrust is the known 3.70e-8. J_xx comes to 2.0e-5,
where the nominal model alone ran to 3.7e-5. The arm of the moment, 4 to 6 cm above the centre of gravity, is more than
the airframe has: flapping and the moment of the blades are in it. What remains is eight times the noise, because motion
capture knows the position to less than a millimetre; no single entry of the catalogue takes it away. Small entries at
the end of the list (scale, misalignment, filter) are what such a flight cannot tell from one another, and are to be
read as one remainder rather than as findings of worth.""",
    ),
    Flights(
        "crazyflie-pwm", "Crazyflie, the same flights with the command instead of the speed",
        (f"{CF}/figure8_22_pwm.csv", f"{CF}/figure8_27_pwm.csv"), (f"{CF}/figure8_35_pwm.csv",),
        f"{CF}/vehicle_pwm.yaml",
        """\
The same flights through the command: now a motor lag of 20 ms and a delay of 17 ms come on top, 37 ms together, where a
regression of rotor speed on command gives about 40 ms; their sum is known far better than the split. The thrust curve
bends because thrust is not the square of a pulse width. Drag, its moment and the inertia of the rotors are found again,
from other flights and another signal.""",
    ),
    Flights(
        "nanodrone", "Nano-drone (Crazyflie 2.1 Brushless)",
        ("nanodrone/random_run1.csv", "nanodrone/square_run1.csv"), ("nanodrone/random_run3.csv",),
        "nanodrone/vehicle.yaml",
        """\
Rotor drag and its moment again carry nearly all. The verdict stays `unknown`, as it should: the states of these files
were low-passed without delay, shifted by a constant each, and rows are missing; no entry of the catalogue says that.
J_xx and J_yy come out well above the published 2.5e-5 and 2.8e-5, because what was filtered away looks like inertia.
Three weak rotors at once are a thrust scale that the fourth does not share, which an offset of the centre of gravity
explains nearly as well. With a chirp flight among the training logs the search does not get out of the nominal basin
at all. Published models of this benchmark were scored on a flight that is not here, so the table is not set beside
theirs; at 50 samples its errors are not better than theirs.""",
        scored=("nanodrone/random_run4.csv", "nanodrone/square_run4.csv"),
    ),
    Flights(
        "ardupilot", "ArduCopter DataFlash", ("ardupilot/log171.bin@76:146",), ("ardupilot/log171.bin@146:216",),
        str(HERE / "log171.yaml"),
        """\
Mass, arm and top speed are assumptions here, and the thrust curve of the autopilot is not a square. Causes are listed,
none is confident: the inertias run to their bounds and structure is left in all channels. An honest answer, and not yet
a useful one.""",
    ),
    Flights(
        "mcap-rpm", "Crazyflie figure eight as ROS 2 MCAP", ("mcap/crazyflie_figure8_35.mcap",), (),
        f"{CF}/vehicle.yaml",
        """\
Five seconds with an inertial unit alone: structure is seen in all rates, and nothing can be named from so little.""",
    ),
    Flights(
        "mcap-pwm", "Crazyflie, PWM commands, ROS 2 MCAP", ("mcap/crazyflie_rollpitch.mcap",), (),
        f"{CF}/vehicle_pwm.yaml",
        """\
A delay of 36 ms stands for the lag of about 40 ms between command and speed. The vertical accelerometer bias of -5 m/s²
is none: it makes up for a thrust coefficient that the curve of the pulse width drove away. It is beyond what any
accelerometer has, so nothing is called confident; `thrust_curve` is among the look-alikes that lost to it.""",
    ),
)  # fmt: skip


def section(flights: Flights, data: Path) -> str:
    """Diagnoses one vehicle and describes the result in Markdown."""
    vehicle = load_vehicle(str(data / flights.vehicle))
    text = [f"## {flights.title}", "", "`" + " ".join(command(flights)) + "`", ""]
    try:
        train = windows(flights.train, data, vehicle)
        held = windows(flights.held, data, vehicle)
        began = time.perf_counter()
        found, workings = diagnose(train, vehicle, held)
    except QuadidError as error:
        return "\n".join([*text, f"Refused with exit code {error.exit_code}: {error}", "", flights.remark]).rstrip()
    text += described(found, workings, time.perf_counter() - began)
    if flights.scored:
        text += ["", *scores(found, vehicle, flights.scored, data)]
    return "\n".join([*text, "", flights.remark]).rstrip()


def windows(names: Sequence[str], data: Path, vehicle: Vehicle) -> list[Window]:
    """Windows of logs below the data folder on the paper's grid."""
    return [w for log in load_logs([str(data / n) for n in names], vehicle, GRID) for w in log.windows]


def command(flights: Flights) -> list[str]:
    """The command line that gives the same result."""
    own = flights.vehicle.startswith("/")
    vehicle = f"studies/vehicles/{Path(flights.vehicle).name}" if own else flights.vehicle
    held = [word for name in flights.held for word in ("--validate", name)]
    return ["quadid", "diagnose", *flights.train, *held, "--vehicle", vehicle]


def described(found: Diagnosis, workings: Workings, seconds: float) -> list[str]:
    """Verdict, findings with their gain, nominal parameters, and what remains."""
    v = found.validation
    out = [
        f"Verdict `{found.verdict.value}`. Error on {v.on}: {v.nominal:.4g} without and {v.extended:.4g} with the "
        f"findings, in noise variances. {seconds:.0f} s.",
        "",
        "| finding | numbers | gain | losing look-alikes |",
        "|---|---|---|---|",
    ]
    for f in found.findings:
        numbers = ", ".join(
            f"{p.name} {p.value:.3g} {p.unit} ({p.ci95[0]:.3g} … {p.ci95[1]:.3g})" for p in f.parameters
        )
        gain = f.gain.mse_before - f.gain.mse_after
        out.append(f"| {f.effect} | {numbers} | {gain:.3g} | {', '.join(a.effect for a in f.alternatives) or '–'} |")
    theta = workings.search.model.theta
    nominal = ", ".join(f"{n} {x:.3g}" for n, x in zip(("b", "d", "J_xx", "J_yy", "J_zz", "J_r"), theta, strict=False))
    rest = ", ".join(f"{c} {s:.0%}" for c, s in found.unexplained.items()) or "nothing"
    out += ["", f"Nominal parameters beside them: {nominal}.", "", f"Structure left, by channel: {rest}."]
    return [*out, *("* " + w for w in found.warnings)]


def scores(found: Diagnosis, vehicle: Vehicle, names: Sequence[str], data: Path) -> list[str]:
    """Prediction error from the true state after some samples, for the vehicle file as it was and as extended."""
    rows = ["| model | samples | " + " | ".join(f"{q} [{u}]" for q, u in zip(QUANTITIES, UNITS, strict=True)) + " |"]
    rows.append("|---|---|---|---|---|---|")
    for name, model in (("vehicle file", vehicle), ("extended", Vehicle.from_yaml(found.vehicle_yaml))):
        logs = load_logs([str(data / n) for n in names], model, None)
        pooled, _ = horizon_scores([log.windows for log in logs], model, Layout(model).initial(model), HORIZONS)
        for h in HORIZONS:
            rows.append(f"| {name} | {h} | " + " | ".join(f"{pooled.at(h)[q]:.4f}" for q in QUANTITIES) + " |")
    return rows


def main() -> None:
    """Diagnoses the flights asked for and writes their sections."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", default=[f.name for f in FLIGHTS])
    parser.add_argument("--out", default="", help="folder of the page")
    options = parser.parse_args()
    data = Path(os.environ.get("QUADID_DATA", "../shared/data"))
    for flights in FLIGHTS:
        if flights.name in options.only:
            text = section(flights, data)
            print(text, flush=True)
            if options.out:
                put_section(Path(options.out) / "real_diagnosis.md", "Recorded flights, diagnosed", flights.name, text)


if __name__ == "__main__":
    main()
