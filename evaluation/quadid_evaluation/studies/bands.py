"""Bands of predictions on recorded flights that nobody fitted: share of outcomes inside them a tenth of a second ahead.

    python -m quadid_evaluation.studies.bands --data ../shared/data "brushed rpm" "crazyflie rpm"
    python -m quadid_evaluation.studies.bands --out docs/results

Files are those of `diagnose` on the training flights of `quadid_evaluation.studies.foreign`, scored on its other
flights; sets without another flight are left out.
"""

import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import quadid
from quadid.chi_square import Z95
from quadid.errors import QuadidError
from quadid.identification.predict import BANDS, PHASES, Forecast
from quadid.model.layout import Layout
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import options, put, table
from quadid_evaluation.studies.flight_sets import SETS, FlightSet

AHEAD = 0.1
"""Horizon [s]."""
RATE = 100.0
"""Grid [Hz]."""
WANTED = {"50": (0.40, 0.60), "95": (0.90, 0.99)}
"""Shares that a band must hold, by per cent."""
COLUMNS = ("data", "of", "50 % band", "80 % band", "95 % band", "outcomes", "missing removed")


def main() -> None:
    """Diagnoses and scores the sets that were asked for, or all, and prints a row a quantity."""
    given = options(__doc__, words=", ".join(n for n, one in SETS.items() if one.unseen))
    if unknown := [n for n in given.words if n not in SETS]:
        sys.exit(f"no set called {unknown[0]}; there are {', '.join(SETS)}")
    found: list[Sequence[str]] = []
    for name in given.words or [n for n, one in SETS.items() if one.unseen]:
        begin = time.perf_counter()
        found += (new := rows(name, SETS[name], given.data))
        print(*new, f"{time.perf_counter() - begin:.0f} s", sep="\n", flush=True)
    told = (
        f"`make bands`: files of `diagnose`, scored {AHEAD:g} s ahead on flights that were not fitted, from the "
        "filtered state and the logged rotor speeds. Random forces are those of the file; sensor noise, trim and "
        "biases come from the first third of each flight, outcomes from the rest. Brackets: 95 % interval, "
        f"predictions as if one in {PHASES} were independent; bold: outside what is wanted (50 % bands 40 to 60, "
        "95 % bands 90 to 99). Last column: what the findings take off the squared missing force and moment there."
    )
    put(given, "bands.md", "Bands of predictions", "bands", [told, "", *table(COLUMNS, found)])


def rows(name: str, one: FlightSet, data: Path) -> list[Sequence[str]]:
    """Rows of one set, a quantity each."""
    vehicle = Vehicle.named(data / one.vehicle)
    try:
        train = [quadid.load(str(data / log), vehicle) for log in one.train]
        unseen = [quadid.load(str(data / log), vehicle) for log in one.unseen]
        found = quadid.diagnose(train, unseen)
        file = found.vehicle
        total: dict[str, FloatArray] = {}
        for log in one.unseen:
            windows = quadid.load(str(data / log), vehicle, rate=RATE).windows
            samples = round(AHEAD / windows[0].dt)
            forecast = Forecast(windows, file, Layout(file).initial(file), file.random)
            for quantity, counts in forecast.covered([samples])[samples].items():
                total[quantity] = total.get(quantity, 0.0) + counts
    except QuadidError as error:
        return [(name, f"refused: {error.found}", *[""] * 5)]
    removed = found.result["removed"]
    told = "–" if removed is None else f"{100.0 * removed:.0f} %"
    return [
        (name, quantity, *(_cell(c, i) for i in range(len(BANDS))), f"{c[-1]:.0f}", told)
        for quantity, c in total.items()
        if c[-1]
    ]


def _cell(counts: Sequence[float] | FloatArray, i: int) -> str:
    """Share inside one band with its interval (Wilson 1927)."""
    n, share, band = counts[-1] / PHASES, counts[i] / counts[-1], list(BANDS)[i]
    middle = (share + 0.5 * Z95**2 / n) / (1.0 + Z95**2 / n)
    half = Z95 * np.sqrt(share * (1.0 - share) / n + 0.25 * Z95**2 / n**2) / (1.0 + Z95**2 / n)
    low, high = WANTED.get(band, (0.0, 1.0))
    text = f"{100.0 * share:.0f}"
    text = text if low <= share <= high else f"**{text}**"
    return f"{text} [{100.0 * (middle - half):.0f}, {100.0 * (middle + half):.0f}]"


if __name__ == "__main__":
    main()
