"""The nominal six of the independent cases when the hidden effect is known, and how gyro and attitude agree there.

    QUADID_DATA=../shared/data python -m studies.case_parameters --out docs/results

Errors in stated standard deviations, of the flight that trains and of the one that validates, each by itself.  The gain
is that of the logged roll and pitch against the logged rates, put through Euler's kinematics, from 0.2 to 2 Hz: 1 where
both are readings of one motion.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from scipy.signal import csd
from scipy.spatial.transform import Rotation

from quadid.effects import EFFECTS
from quadid.identify.fit import FitOptions, fit
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from quadid.window import Window
from studies.cases import windows
from studies.page import put_section

FloatArray = NDArray[np.float64]
BAND = (0.2, 2.0)
"""Band of the gain [Hz]: below it the attitude's slow error tells, above it hardly any motion."""


def kinematic_gains(window: Window) -> FloatArray:
    """Gain of measured roll and pitch against those that the gyro's rates make, shape (2,)."""
    assert window.gyro is not None
    assert window.attitude is not None
    _, pitch, roll = Rotation.from_quat(window.attitude[:, [1, 2, 3, 0]]).as_euler("ZYX").T
    p, q, r = window.gyro.T
    turning = q * np.sin(roll) + r * np.cos(roll)
    made = (p + np.tan(pitch) * turning, q * np.cos(roll) - r * np.sin(roll))
    out = []
    for rate, angle in zip(made, (roll, pitch), strict=True):
        expected = 0.5 * window.dt * (rate[1:] + rate[:-1])
        f, cross = csd(expected, np.diff(angle), fs=1.0 / window.dt, nperseg=512)
        _, power = csd(expected, expected, fs=1.0 / window.dt, nperseg=512)
        used = (f >= BAND[0]) & (f <= BAND[1])
        out.append(float(np.abs(cross[used].sum()) / power.real[used].sum()))
    return np.array(out)


def names_of(answer: dict[str, Any]) -> list[str]:
    """Entries that the hidden effects of a case free."""
    out = []
    for effect in answer["effects"]:
        if effect == "weak_rotor":
            out.append(f"weak_rotor.loss_{answer['truth'][effect]['rotor']}")
        else:
            out += [f"{effect}.{p.name}" for p in EFFECTS[effect].parameters]
    return out


def row(folder: Path, flight: str, answer: dict[str, Any]) -> tuple[str, FloatArray, FloatArray]:
    """Table row of one flight, errors in standard deviations (6,), gains (2,)."""
    vehicle = Vehicle.from_yaml((folder / "vehicle.yaml").read_text(encoding="utf-8"))
    flown = windows(folder / f"{flight}.csv", vehicle)
    found = fit(flown, vehicle, FitOptions(iterations=0), names=[*NOMINAL_NAMES, *names_of(answer)])
    truth = np.log([answer["nominal"][name] for name in NOMINAL_NAMES])
    errors = (np.log(found.theta[: len(truth)]) - truth) / found.uncertainty.sigma[: len(truth)]
    gains = kinematic_gains(flown[0])
    cells = " | ".join([*(f"{z:+.1f}" for z in errors), *(f"{g:.4f}" for g in gains)])
    return f"| {answer['case']} {flight} | {', '.join(answer['effects']) or '–'} | {cells} |", errors, gains


def main() -> None:
    """Command line of the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="", help="folder of cases.md")
    options = parser.parse_args()
    data = Path(os.environ.get("QUADID_DATA", "../shared/data")) / "cases"
    answers = json.loads((data / "answers.json").read_text(encoding="utf-8"))
    known = [a for a in answers if "unknown" not in a["effects"]]
    text = ["`python -m studies.case_parameters --out docs/results`", "", (__doc__ or "").split("\n\n")[2], ""]
    text.append(f"| flight | hidden, known here | {' | '.join(NOMINAL_NAMES)} | roll's gain | pitch's gain |")
    text.append("|---" * (4 + len(NOMINAL_NAMES)) + "|")
    gains = []
    for answer in known:
        for flight in ("train", "validate"):
            line, _, gain = row(data / answer["case"], flight, answer)
            text.append(line)
            gains.append(gain)
            print(line, flush=True)
    mean, error = np.mean(gains, axis=0), np.std(gains, axis=0, ddof=1) / np.sqrt(len(gains))
    text += ["", f"Mean gain: roll {mean[0]:.4f} ± {error[0]:.4f}, pitch {mean[1]:.4f} ± {error[1]:.4f}."]
    print(text[-1])
    if options.out:
        put_section(Path(options.out) / "cases.md", "Independent cases", "parameters", "\n".join(text))


if __name__ == "__main__":
    main()
