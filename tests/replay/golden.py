"""Contents of every real log, in numbers.  Write them anew with ``python -m tests.replay.golden``."""

import json
import os
import sys
from pathlib import Path
from typing import Any

from quadid_replay import open_log

from quadid.data.window import Recording, sample_period

GOLDEN = Path(__file__).with_name("golden.json")
PATTERNS = (
    "nanodrone/*.csv",
    "crazyflie_rpm/*.csv",
    "cases/*/train.csv",
    "ardupilot/*.*",
    "ardupilot_sitl/*.bin",
    "ardupilot_sitl/*.tlog",
    "px4/*",
    "mcap/*",
    "tlog/*",
)


def real_logs(folder: Path) -> list[str]:
    """Names of the logs below the data folder."""
    return sorted(str(p.relative_to(folder)) for pattern in PATTERNS for p in folder.glob(pattern))


def summary(recording: Recording) -> dict[str, Any]:
    """Counts, rates, sources and moments of a recording, rounded."""
    channels = {}
    for name, channel in recording.channels.items():
        channels[name] = {
            "source": channel.source,
            "count": len(channel.t),
            "rate": _rounded(1.0 / sample_period(channel.t)),
            "span": [_rounded(channel.t[0], 9), _rounded(channel.t[-1], 9)],
            "mean": [_rounded(v) for v in channel.values.mean(axis=0)],
            "std": [_rounded(v) for v in channel.values.std(axis=0)],
            "faults": dict(channel.faults),
        }
    return {
        "format": recording.format,
        "breaks": len(recording.breaks),
        "warnings": len(recording.warnings),
        "channels": channels,
    }


def _rounded(value: float, digits: int = 6) -> float:
    return float(f"{float(value) + 0.0:.{digits}g}") if abs(value) > 1e-9 else 0.0


def write(folder: Path) -> None:
    """Writes the golden file from the logs as they are read now."""
    found = {name: summary(open_log(folder / name)) for name in real_logs(folder)}
    lines = [f"{json.dumps(name)}: {json.dumps(entry)}" for name, entry in found.items()]
    GOLDEN.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    print(f"{len(found)} logs written to {GOLDEN.name}")


if __name__ == "__main__":
    default = Path(__file__).resolve().parents[3] / "shared" / "data"
    write(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(os.environ.get("QUADID_DATA", default)))
