"""Forty mistakes and more: how each is made, and what the first line that a person sees must name.

python -m tests.cli.mistakes > docs/results/mistakes.md
"""

import contextlib
import io
import re
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import quadid
from quadid.rotation import conjugate, product
from quadid.vehicle import Vehicle

Rows = np.ndarray
SHOWN = 8
"""Words of a finding or fix that the page shows."""
Table = tuple[list[str], Rows]


@dataclass(frozen=True)
class Place:
    """A folder with a flight as CSV (`log`) and as MCAP (`mcap`), and room for the spoilt ones."""

    folder: Path

    @property
    def log(self) -> Path:
        """A flight of 20 s with velocity and position."""
        return self.folder / "flight.csv"

    @property
    def mcap(self) -> Path:
        """The same flight."""
        return self.folder / "flight.mcap"

    def table(self) -> Table:
        """Header and numbers of the flight."""
        names = self.log.read_text(encoding="utf-8").splitlines()[0].split(",")
        return names, np.loadtxt(self.log, delimiter=",", skiprows=1)

    def write(self, names: Sequence[str], rows: Rows, separator: str = ",") -> Path:
        """A log of these columns."""
        path = self.folder / "log.csv"
        np.savetxt(path, rows, delimiter=separator, header=separator.join(names), comments="", fmt="%.10g")
        return path

    def scaled(self, columns: str, factor: float, more: float = 0.0) -> Path:
        """The flight with some columns multiplied, and a number added to them."""
        names, rows = self.table()
        places = [names.index(n) for n in columns.split()]
        rows[:, places] = factor * rows[:, places] + more
        return self.write(names, rows)

    def dated(self) -> Path:
        """The flight with dates in place of seconds."""
        head, *lines = self.scaled("t", 1.0).read_text().splitlines()
        dates = [f"2026-07-01 12:00:{line}" for line in lines]
        return self.bytes("log.csv", "\n".join([head, *dates]).encode())

    def moved(self, columns: str, taken: str) -> Path:
        """The flight with the values of other columns in some columns; ``-q`` for the negative of q."""
        names, rows = self.table()
        new = rows.copy()
        for name, source in zip(columns.split(), taken.split(), strict=True):
            new[:, names.index(name)] = rows[:, names.index(source.lstrip("-"))] * (-1.0 if source[0] == "-" else 1.0)
        return self.write(names, new)

    def without(self, columns: str) -> Path:
        """The flight without some columns."""
        names, rows = self.table()
        keep = [i for i, n in enumerate(names) if n not in columns.split()]
        return self.write([names[i] for i in keep], rows[:, keep])

    def named(self, **names: str) -> Path:
        """The flight with other column names."""
        old, rows = self.table()
        return self.write([names.get(n, n) for n in old], rows)

    def bytes(self, name: str, content: bytes) -> Path:
        """Any file."""
        path = self.folder / name
        path.write_bytes(content)
        return path

    def vehicle(self, **changes: Any) -> Path:
        """A Pelican file with other entries; None leaves one out."""
        data = {**yaml.safe_load(Vehicle.shipped("pelican").to_yaml()), **changes}
        text = yaml.safe_dump({k: v for k, v in data.items() if v is not None})
        return self.bytes("vehicle.yaml", text.encode())

    def arms(self, factor: float) -> Path:
        """A Pelican file with other arms."""
        rotors = yaml.safe_load(Vehicle.shipped("pelican").to_yaml())["rotors"]
        return self.vehicle(rotors=[{**r, "position": [factor * x for x in r["position"]]} for r in rotors])

    def inertia(self, factor: float) -> Path:
        """A Pelican file with other inertias."""
        known = yaml.safe_load(Vehicle.shipped("pelican").to_yaml())["parameters"]
        told = {n: factor * Vehicle.shipped("pelican").parameters[n].initial for n in ("J_xx", "J_yy", "J_zz")}
        return self.vehicle(parameters=known | told)

    def spins(self, *turned: int) -> Path:
        """A Pelican file whose rotors, all or those named (from 0), turn the other way."""
        rotors = yaml.safe_load(Vehicle.shipped("pelican").to_yaml())["rotors"]
        which = turned or range(len(rotors))
        return self.vehicle(
            rotors=[{**r, "spin": -r["spin"] if k in which else r["spin"]} for k, r in enumerate(rotors)]
        )

    def template(self) -> Path:
        """A vehicle file as `quadid init` writes it."""
        text = Vehicle.shipped("pelican").to_yaml()
        return self.bytes("vehicle.yaml", text.replace("mass: 1.3", "mass: 1.3  # FILL IN: weigh it").encode())

    def changed(self, columns: str, change: Callable[[Rows], Rows]) -> Path:
        """The flight with some columns changed."""
        names, rows = self.table()
        places = [names.index(n) for n in columns.split()]
        rows[:, places] = change(rows[:, places])
        return self.write(names, rows)

    def of_rotors(self, change: Callable[[Rows], Rows]) -> Path:
        """The flight with rotor speeds changed."""
        return self.changed("w1 w2 w3 w4", change)

    def late(self, columns: str, count: int) -> Path:
        """The flight with some columns so many rows later."""
        names, rows = self.table()
        places = [names.index(n) for n in columns.split()]
        rows[count:, places] = rows[:-count, places].copy()
        return self.write(names, rows)

    def degrees(self) -> Path:
        """The flight with Euler angles in degrees in place of quaternions."""
        names, rows = self.table()
        w, x, y, z = (rows[:, names.index(n)] for n in ("qw", "qx", "qy", "qz"))
        angles = [
            np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)),
            np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        ]
        keep = [i for i, n in enumerate(names) if n not in ("qw", "qx", "qy", "qz")]
        columns = np.column_stack([rows[:, keep], *np.degrees(angles)])
        return self.write([*(names[i] for i in keep), "phi", "theta", "psi"], columns)

    def euler_rates(self) -> Path:
        """The flight with the rates of roll, pitch and yaw angle in place of those about the body's axes."""
        names, rows = self.table()
        w, x, y, z, p, q, r = (rows[:, names.index(n)] for n in ("qw", "qx", "qy", "qz", "p", "q", "r"))
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
        heading = (q * np.sin(roll) + r * np.cos(roll)) / np.cos(pitch)
        new = rows.copy()
        new[:, names.index("p")] = p + heading * np.sin(pitch)
        new[:, names.index("q")] = q * np.cos(roll) - r * np.sin(roll)
        new[:, names.index("r")] = heading
        return self.write(names, new)

    def differentiated(self) -> Path:
        """The flight with the turn of the attitude from row to row in place of the gyro."""
        names, rows = self.table()
        q = rows[:, [names.index(n) for n in ("qw", "qx", "qy", "qz")]]
        turned = 2.0 * product(conjugate(q[:-1]), np.diff(q, axis=0))[:, 1:] / np.diff(rows[:, :1], axis=0)
        new = rows[:-1].copy()
        new[:, [names.index(n) for n in "pqr"]] = turned
        return self.write(names, new)

    def clipped(self) -> Path:
        """The flight with rates that end at one standard deviation."""
        names, rows = self.table()
        places = [names.index(n) for n in ("p", "q", "r")]
        most = np.std(rows[:, places], axis=0)
        rows[:, places] = np.clip(rows[:, places], -most, most)
        return self.write(names, rows)

    def commas(self) -> Path:
        """The flight with decimal commas, separated by semicolons."""
        text = self.write(*self.table(), separator=";").read_text()
        return self.bytes("log.csv", text.replace(".", ",").encode())

    def still(self) -> Path:
        """Ten seconds on the ground with idling rotors."""
        rng = np.random.default_rng(0)
        rows = np.column_stack([0.02 * np.arange(500), 0.002 * rng.standard_normal((500, 3)), np.full((500, 4), 100.0)])
        return self.write(["t", "p", "q", "r", "w1", "w2", "w3", "w4"], rows)


@dataclass(frozen=True)
class Mistake:
    """A mistake: its name, the call, and words of which its first line must hold one.

    With `vague` the line does not name the cause yet: the page says so, and the test only wants one line.
    """

    what: str
    call: Callable[[Place], Sequence[str | Path]]
    names: str
    code: int = 2
    vague: bool = False


def fit(log: Callable[[Place], Path | str]) -> Callable[[Place], Sequence[str | Path]]:
    """A call of identify with a spoilt log."""
    return lambda p: ("identify", log(p), "--vehicle", "pelican", "--out", p.folder)


def of(vehicle: Callable[[Place], Path | str]) -> Callable[[Place], Sequence[str | Path]]:
    """A call of identify with a spoilt vehicle."""
    return lambda p: ("identify", p.log, "--vehicle", vehicle(p), "--out", p.folder)


MISTAKES = (
    Mistake("gyro in degrees a second", fit(lambda p: p.scaled("p q r", 57.29578)), "deg/s"),
    Mistake("Euler angles in degrees", fit(lambda p: p.degrees()), "degrees"),
    Mistake("time in milliseconds", fit(lambda p: p.scaled("t", 1e3)), "ms|millisecond"),
    Mistake("time in microseconds", fit(lambda p: p.scaled("t", 1e6)), "us|µs|microsecond"),
    Mistake("rotor speeds in rpm", fit(lambda p: p.scaled("w1 w2 w3 w4", 9.549297)), "rpm"),
    Mistake("acceleration in g", fit(lambda p: p.scaled("ax ay az", 1 / 9.80665)), " g"),
    Mistake("two motors exchanged", fit(lambda p: p.moved("w1 w2", "w2 w1")), "2, 1, 3, 4"),
    Mistake("motors numbered from another arm", fit(lambda p: p.moved("w1 w2 w3 w4", "w2 w3 w4 w1")), "order"),
    Mistake("body axes forward, left, up", fit(lambda p: p.moved("q r ay az", "-q -r -ay -az")), "FLU"),
    Mistake(
        "world axes east, north, up",
        fit(lambda p: p.moved("x y z vx vy vz qw qx qy qz", "y x -z vy vx -vz qw qy qx -qz")),
        "ENU",
    ),
    Mistake("quaternion with its scalar last", fit(lambda p: p.moved("qw qx qy qz", "qx qy qz qw")), "qw|scalar|order"),
    Mistake("normalised commands as rad/s", fit(lambda p: p.scaled("w1 w2 w3 w4", 1e-3)), "normali[sz]ed|command"),
    Mistake("times as dates", fit(lambda p: p.dated()), "column t holds '2026"),
    Mistake("rows in the wrong order", fit(lambda p: p.write(p.table()[0], p.table()[1][::-1])), "column t falls"),
    Mistake("time that stands still", fit(lambda p: p.scaled("t", 0.0)), "column t stays"),
    Mistake("rotor speeds that never change", fit(lambda p: p.scaled("w1 w2 w3 w4", 0.0, 400.0)), "stuck"),
    Mistake("gravity taken out", fit(lambda p: p.scaled("az", 1.0, 9.81)), "gravity is missing"),
    Mistake("attitude the other way round", fit(lambda p: p.scaled("qx qy qz", -1.0)), "world to body"),
    Mistake("a table saved as UTF-16", fit(lambda p: p.bytes("log.csv", p.log.read_text().encode("utf-16"))), "UTF-8"),
    Mistake("decimal commas", fit(lambda p: p.commas()), "comma"),
    Mistake("other column names", fit(lambda p: p.named(p="gyro_x", q="gyro_y", r="gyro_z")), "gyro_x"),
    Mistake("time column called time", fit(lambda p: p.named(t="time")), "time=t"),
    Mistake("one column of three missing", fit(lambda p: p.without("r")), "lacks column r"),
    Mistake("no rotor signal", fit(lambda p: p.without("w1 w2 w3 w4")), "no rotor speeds"),
    Mistake("no gyro", fit(lambda p: p.without("p q r")), "no gyro"),
    Mistake("a rotor column left out", fit(lambda p: p.without("w2")), "without a hole"),
    Mistake("an empty file", fit(lambda p: p.bytes("log.bin", b"")), "empty"),
    Mistake("a picture as a log", fit(lambda p: p.bytes("log.bin", b"\x89PNG\r\n" * 30)), "unknown format"),
    Mistake("a packed log", fit(lambda p: p.bytes("log.gz", b"\x1f\x8b\x08" + bytes(99))), "gunzip"),
    Mistake("no such file", fit(lambda p: p.folder / "no.csv"), "no file"),
    Mistake("a folder as a log", fit(lambda p: p.folder), "directory"),
    Mistake("a log cut at its beginning", fit(lambda p: p.bytes("cut.mcap", p.mcap.read_bytes()[:3000])), "cut.mcap"),
    Mistake("a span outside the log", fit(lambda p: f"{p.log}@50:60"), "nothing"),
    Mistake("a span backwards", fit(lambda p: f"{p.log}@9:3"), "swap"),
    Mistake("a second of flight", fit(lambda p: f"{p.log}@3:4.8"), "2 s", 3),
    Mistake("never off the ground", fit(lambda p: p.still()), "did it fly", 3),
    Mistake(
        "the fitted log as validation", lambda p: (*fit(lambda p: p.log)(p), "--validate", p.log), "cannot validate"
    ),
    Mistake(
        "the same flight in another format",
        lambda p: (*fit(lambda p: p.log)(p), "--validate", p.mcap),
        "cannot validate",
    ),
    Mistake("mass in grams", of(lambda p: p.vehicle(mass=1300.0)), "gram|mass"),
    Mistake("inertia in g m^2", of(lambda p: p.inertia(1e3)), "is it in g m"),
    Mistake("mass half as much again", of(lambda p: p.vehicle(mass=1.95)), "mass 1.95 kg", 0),
    Mistake("arms in millimetres", of(lambda p: p.arms(1000.0)), "arm|mm|position"),
    Mistake("arms ten times too short", of(lambda p: p.arms(0.1)), "rotors 0.021 m"),
    Mistake("arms in centimetres", of(lambda p: p.arms(100.0)), "centimetres"),
    Mistake("vertical velocity upwards", fit(lambda p: p.scaled("vz", -1.0)), "points up"),
    Mistake("height in place of z", fit(lambda p: p.scaled("z", -1.0)), "points up"),
    Mistake("spins reversed", of(lambda p: p.spins()), "negate the spins"),
    Mistake("spin of one rotor reversed", of(lambda p: p.spins(2)), "spin of rotor 3"),
    Mistake("rotor speeds of the electrical field", fit(lambda p: p.scaled("w1 w2 w3 w4", 7.0)), "electrical"),
    Mistake(
        "a rotor sensor that is dead", fit(lambda p: p.of_rotors(lambda w: w * [1, 0, 1, 1])), "rotor 2 reads nothing"
    ),
    Mistake("rotor speeds 60 ms late", fit(lambda p: p.late("w1 w2 w3 w4", 3)), "lags its effect"),
    Mistake(
        "gyro 160 ms late", fit(lambda p: p.late("p q r", 8)), "gyro comes 1(5[789]|6[0123]) ms after the attitude"
    ),
    Mistake(
        "attitude 160 ms late",
        fit(lambda p: p.late("qw qx qy qz", 8)),
        "attitude comes 1(5[789]|6[0123]) ms after the gyro",
    ),
    Mistake("rates of Euler angles as gyro", fit(lambda p: p.euler_rates()), "rates of roll, pitch and yaw"),
    Mistake("turns of the attitude as gyro", fit(lambda p: p.differentiated()), "differentiated"),
    Mistake(
        "attitude in steps", fit(lambda p: p.changed("qw qx qy qz", lambda q: 0.02 * np.round(q / 0.02))), "in steps", 0
    ),
    Mistake("one axis of the gyro in degrees", fit(lambda p: p.scaled("r", 57.3)), "about z"),
    Mistake("one axis of the gyro not logged", fit(lambda p: p.scaled("q", 0.0)), "does not turn about y"),
    Mistake("an accelerometer that reads 30 % too much", fit(lambda p: p.scaled("ax ay az", 1.3)), "scale or zero"),
    Mistake("a gyro that is clipped", fit(lambda p: p.clipped()), "limit of its range"),
    Mistake("one rotor column four times", fit(lambda p: p.moved("w2 w3 w4", "w1 w1 w1")), "the same"),
    Mistake("squared rotor speeds", fit(lambda p: p.of_rotors(np.square)), "squared"),
    Mistake("rotor speeds in steps", fit(lambda p: p.of_rotors(lambda w: 50.0 * np.round(w / 50.0))), "steps of 50", 0),
    Mistake("motor columns called pwm1", fit(lambda p: p.named(w1="pwm1", w2="pwm2", w3="pwm3", w4="pwm4")), "pwm1=u1"),
    Mistake("a template that was not filled in", of(lambda p: p.template()), "FILL IN"),
    Mistake("no mass", of(lambda p: p.vehicle(mass=None)), "no 'mass'"),
    Mistake("tabs in a vehicle file", of(lambda p: p.bytes("vehicle.yaml", b"name: x\n\tmass: 1\n")), "line 2"),
    Mistake("a vehicle file of another size", of(lambda p: "crazyflie"), "vehicle file of this log"),
    Mistake("a key misspelt", of(lambda p: p.vehicle(mass=None, mas=1.3)), "did you mean 'mass'"),
    Mistake(
        "a key in another unit",
        of(lambda p: p.vehicle(command={"kind": "normalized", "max_rpm": 7640})),
        "did you mean 'max_speed', in SI units, not rpm",
    ),
    Mistake("a vehicle name misspelt", of(lambda p: "pelicn"), "pelican"),
    Mistake("a vehicle file that is not there", of(lambda p: p.folder / "none.yaml"), "no vehicle file"),
    Mistake("another airframe", of(lambda p: "hexacopter"), "rotor columns"),
    Mistake("the log as the vehicle", of(lambda p: p.mcap), "not text"),
    Mistake(
        "an inertia that no body has",
        of(
            lambda p: p.vehicle(
                parameters={"b": 2e-5, "d": 4e-7, "J_xx": 1e-3, "J_yy": 1e-3, "J_zz": 1e-1, "J_r": 3e-5}
            )
        ),
        "triangle",
    ),
    Mistake("an effect misspelt", lambda p: ("simulate", p.folder / "x.csv", "--effect", "rotor_drg"), "rotor_drag"),
    Mistake(
        "a column named that is not there",
        lambda p: (*fit(lambda p: p.log)(p), "--columns", "gyrox=p"),
        "no column gyrox",
    ),
    Mistake(
        "a column named as nothing is",
        lambda p: (*fit(lambda p: p.mcap)(p), "--columns", "gyro_x=pp"),
        "unknown name 'pp'",
    ),
    Mistake(
        "health of a flight that did not fly",
        lambda p: ("health", p.still(), "--baseline", p.log, "--vehicle", "pelican"),
        "steady flight",
        3,
    ),
    Mistake("no vehicle given", lambda p: ("identify", p.log), "--vehicle"),
    Mistake("a search misspelt", lambda p: (*fit(lambda p: p.log)(p), "--optimizer", "psoo"), "did you mean 'pso'"),
    Mistake(
        "results into no folder",
        lambda p: (*fit(lambda p: p.log)(p), "--json", p.folder / "no" / "r.json"),
        "no folder",
    ),
    Mistake("a report as PDF", lambda p: (*fit(lambda p: p.log)(p), "--report", p.folder / "r.pdf"), "HTML page"),
    Mistake("a horizon of 0", lambda p: ("score", p.log, "--vehicle", "pelican", "--horizons", "0"), "horizons"),
    Mistake("a port of 99999", lambda p: ("serve", "--vehicle", "pelican", "--mavlink", "udpin:0.0.0.0:99999"), "port"),
    Mistake("a command misspelt", lambda p: ("identfy", p.log), "identify|No such command"),
    Mistake(
        "a poor fit exported",
        lambda p: ("export", "--vehicle", p.vehicle(proof={"verdict": "poor"}), "--format", "px4"),
        "--anyway",
    ),
)


def prepare(folder: Path) -> Place:
    """Flies the flight that the mistakes are made with."""
    flown = quadid.simulate(seconds=20.0, seed=12, extras=("velocity", "position"))
    folder.mkdir(exist_ok=True)
    place = Place(folder)
    flown.save(place.log)
    flown.save(place.mcap)
    return place


def first_line(mistake: Mistake, place: Place) -> tuple[int, str]:
    """Exit code, and the first line of stderr, else of what was printed; folders left out."""
    from quadid.cli.main import app_main

    out, err, kept = io.StringIO(), io.StringIO(), sys.argv
    sys.argv = ["quadid", *map(str, mistake.call(place))]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = app_main()
    finally:
        sys.argv = kept
    lines = [line for line in err.getvalue().splitlines() if line.strip()] or out.getvalue().splitlines()[:1]
    return code, re.sub(r"/\S*/(?=[^/\s]*)", "", lines[0])


def shown(line: str, names: str) -> str:
    """The finding of the line, without program, log and what is allowed; without the fix where it names the mistake."""
    short = re.sub(r"^quadid: (log\.\w+: )?|, or insist with --unchecked", "", line)
    found = re.split("; allowed: |; fix: ", short)[0]
    short = found if re.search(names, found) else re.sub("; allowed: [^;]{26,}(?=; fix)", "", short)
    return "; fix: ".join(_around(part, names) for part in short.split("; fix: ")).replace("|", "/").replace("`", "")


def _around(text: str, names: str) -> str:
    """`SHOWN` words of a text: its first ones, or those up to what `names` finds behind them."""
    words = text.split()
    if len(words) <= SHOWN + 2:
        return text
    found = re.search(names, text)
    last = max(SHOWN, len(text[: found.end()].split())) if found else SHOWN
    return "… " * (last > SHOWN) + " ".join(words[last - SHOWN : last]) + " …" * (last < len(words))


def page() -> str:
    """The table of docs/results/mistakes.md."""
    head = [
        "# Mistakes and their first line",
        "",
        "Written by `python -m tests.cli.mistakes`; a test makes each mistake. Lines begin with `quadid:` and the log "
        "and end with the fix, both left out here. `--unchecked` overrules checks of units, frames and motors. *: does "
        "not name the cause yet.",
        "",
        "| mistake | first line |",
        "|---|---|",
    ]
    with tempfile.TemporaryDirectory() as folder:
        place = prepare(Path(folder, "flights"))
        rows = [f"| {m.what}{' *' * m.vague} | `{shown(first_line(m, place)[1], m.names)}` |" for m in MISTAKES]
    return "\n".join([*head, *rows]) + "\n"


if __name__ == "__main__":
    sys.stdout.write(page())
