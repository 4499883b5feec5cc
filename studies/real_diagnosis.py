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
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from quadid.diagnose import Diagnosis, Workings, diagnose
from quadid.errors import QuadidError
from quadid.identify.open_loop import QUANTITIES, mean_errors, no_change
from quadid.identify.prediction import horizon_scores
from quadid.model.layout import Layout
from quadid.vehicle import Vehicle
from quadid.window import Window
from quadid.workflow.loading import GRID, load_logs, load_vehicle
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


SCORED = tuple(f"nanodrone/{n}_run4.csv" for n in ("random", "chirp", "square"))
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
bends because thrust is not the square of a pulse width. Drag and its moment are found again, from other flights and
another signal; drag comes out larger, because thrust and speed are known only through the command.""",
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
explains nearly as well. The file is refitted to predict: its inertias are no inertias any more.""",
        scored=SCORED,
    ),
    Flights(
        "nanodrone-chirp", "Nano-drone, with a chirp flight among those to learn from",
        tuple(f"nanodrone/{n}_run1.csv" for n in ("random", "chirp", "square")),
        tuple(f"nanodrone/{n}_run3.csv" for n in ("random", "chirp", "square")),
        "nanodrone/vehicle.yaml",
        """\
With the chirp drag, its moment and inflow are found with the numbers of the flights without it. Beside the published
models, as shares of "no change", all four errors on the random flight (0.13, 0.25, 0.50, 0.59) and on the chirp are
better than those of every one of them. On the square flight, six to eight times livelier, only the rate is: what drives
the fastest rotation was filtered out of these files after the fact, so half a second ahead the slow flights are
predicted best as if rotors hardly turned the vehicle, and the square ones are not. The file has to choose; every run
counts in shares of the motion of its own flight.""",
        scored=SCORED,
    ),
    Flights(
        "ardupilot", "ArduCopter DataFlash", ("ardupilot/log171.bin@76:146",), ("ardupilot/log171.bin@146:216",),
        str(HERE / "log171.yaml"),
        """\
Mass, arm and top speed are assumptions here, and the thrust curve of the autopilot is not a square. Causes are listed,
none is confident: a vertical accelerometer bias of -5 m/s² stands for that curve, the inertias run to their bounds and
structure is left in all channels. As a physical description this is not yet useful. As a prediction it is: refitted,
the rate half a second ahead is missed by little more than half of what the findings' own parameters miss it by.""",
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
A delay of 35 ms stands for the lag of about 40 ms between command and speed, and gains nearly all that is gained.
Thrust is no square of the pulse width, which shows in what is left of a_z; a damping that drives the motion is none.
Nothing is called confident.""",
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
    """Prediction error from the true state of each flight: of no change, the vehicle file as it was, as extended."""
    rows = ["| flight | model | samples | " + " | ".join(f"{q} [{u}]" for q, u in zip(QUANTITIES, UNITS, strict=True))]
    rows[0] += " |"
    rows.append("|---|---|---|---|---|---|---|")
    models = (("vehicle file", vehicle), ("extended", Vehicle.from_yaml(found.vehicle_yaml)))
    shares = []
    for name in names:
        (log,) = load_logs([str(data / name)], vehicle, None)
        still = {h: list(no_change(log.windows, vehicle, h, HORIZONS[-1]).values()) for h in HORIZONS}
        rows += [_score_row(Path(name).stem, "no change", h, still[h]) for h in HORIZONS]
        for label, model in models:
            pooled, _ = horizon_scores([log.windows], model, Layout(model).initial(model), HORIZONS)
            rows += [_score_row(Path(name).stem, label, h, list(pooled.at(h).values())) for h in HORIZONS]
        last = list(pooled.at(HORIZONS[-1]).values())
        shares.append((f"ours, {Path(name).stem}", [e / s for e, s in zip(last, still[HORIZONS[-1]], strict=True)]))
    return [*rows, "", *_beside_published(shares)]


def _score_row(flight: str, model: str, horizon: int, errors: Sequence[float]) -> str:
    return f"| {flight} | {model} | {horizon} | " + " | ".join(f"{e:.4f}" for e in errors) + " |"


PUBLISHED = {
    "naive": (0.6797, 1.4749, 0.3041, 0.8837), "physics": (0.1269, 0.5781, 0.2544, 0.8837),
    "MLP": (0.1712, 0.5720, 0.2268, 0.9005), "hybrid": (0.1119, 0.5556, 0.2306, 0.5979),
    "LSTM": (0.2572, 0.7407, 0.2325, 1.2407),
}  # fmt: skip
"""Published errors after 50 samples on a flight of the same vehicle that is not here, by quantity."""


def _beside_published(shares: Sequence[tuple[str, Sequence[float]]]) -> list[str]:
    """Errors after the last horizon as shares of those of no change, beside the published models'."""
    naive = PUBLISHED["naive"]
    published = [(f"{k}, published", [e / n for e, n in zip(v, naive, strict=True)]) for k, v in PUBLISHED.items()]
    out = [
        f"Error after {HORIZONS[-1]} samples as a share of that of no change. The published models were scored on a",
        "flight that is not here; the share is what can be set beside theirs.", "",
        "| model | " + " | ".join(QUANTITIES) + " |", "|---|---|---|---|---|",
    ]  # fmt: skip
    rows = [*shares, *published[1:]]
    return [*out, *(f"| {name} | " + " | ".join(f"{x:.2f}" for x in row) + " |" for name, row in rows)]


LEARNT_FROM = (
    ("random_run1",), ("chirp_run1",), ("random_run1", "chirp_run1"), ("random_run1", "square_run1"),
    ("chirp_run1", "square_run1"), ("random_run1", "chirp_run1", "square_run1"),
    ("square_run1", "square_run2", "square_run3"),
    tuple(f"{kind}_run{run}" for kind in ("random", "chirp", "square") for run in (1, 2, 3)),
)  # fmt: skip
LEARNT = "nanodrone-learnt-from"


def learnt_from(data: Path) -> str:
    """Which flights a diagnosis of the nano-drone has to see for its file to predict which others."""
    vehicle = load_vehicle(str(data / "nanodrone" / "vehicle.yaml"))
    held = {Path(n).stem: load_logs([str(data / n)], vehicle, None)[0].windows for n in SCORED}
    last = HORIZONS[-1]
    still = {name: no_change(flight, vehicle, last) for name, flight in held.items()}
    out = [
        "## Nano-drone: which flights to learn from", "",
        f"Every file is that of a diagnosis of the flights on the left. Errors after {last} samples of the flights on",
        "the right, which none of them saw, as shares of those of no change: position, velocity, rotation, rate.", "",
        "| diagnosed | verdict | " + " | ".join(held) + " |", "|---|---|" + "---|" * len(held),
    ]  # fmt: skip
    for names in LEARNT_FROM:
        found, _ = diagnose(windows([f"nanodrone/{n}.csv" for n in names], data, vehicle), vehicle)
        extended = Vehicle.from_yaml(found.vehicle_yaml)
        theta, cells = Layout(extended).initial(extended), []
        for name, flight in held.items():
            errors = mean_errors(flight, extended, theta, last)
            cells.append(", ".join(f"{errors[q] / still[name][q]:.2f}" for q in QUANTITIES))
        row = f"| {' '.join(names)} | {found.verdict.value} | {' | '.join(cells)} |"
        print(row, flush=True)
        out.append(row)
    return "\n".join([*out, "", LEARNT_REMARK])


LEARNT_REMARK = """\
On the random flight all four errors are smaller than those of every published model on its own (0.16, 0.38, 0.75,
0.68), whatever holds a random or a chirp flight was learnt from; on the chirp as well, but for position (0.17) from the
first and fourth set and rotation (0.81) from the fourth. Square flights alone teach nothing about the others, and the
others little about them."""


def main() -> None:
    """Diagnoses the flights asked for and writes their sections."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", default=[*(f.name for f in FLIGHTS), LEARNT])
    parser.add_argument("--out", default="", help="folder of the page")
    options = parser.parse_args()
    data = Path(os.environ.get("QUADID_DATA", "../shared/data"))
    parts = {f.name: partial(section, f) for f in FLIGHTS} | {LEARNT: learnt_from}
    for name, part in parts.items():
        if name in options.only:
            text = part(data)
            print(text, flush=True)
            if options.out:
                put_section(Path(options.out) / "real_diagnosis.md", "Recorded flights, diagnosed", name, text)


if __name__ == "__main__":
    main()
