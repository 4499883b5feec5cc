"""A short manoeuvre that the tests of its forms share."""

from dataclasses import asdict

from quadid.flight import Segment
from quadid.report.manoeuvres import ManoeuvrePlan

SECONDS = 13.0
SEGMENTS = [
    *(
        Segment(axis, "multisine", 0.0, 6.0, size, 0.8, 2.0)
        for axis, size in (("roll", 0.2), ("pitch", 0.15), ("yaw", 0.6), ("throttle", 0.1))
    ),
    Segment("roll", "multisine", 6.5, 6.0, 0.1, 0.3, 1.0),
    Segment("yaw", "multisine", 6.5, 6.0, 0.35, 0.3, 1.0),
]
PLAN = ManoeuvrePlan(
    vehicle="pelican",
    seconds=SECONDS,
    segments=[asdict(s) for s in SEGMENTS],
    sweeps=[
        asdict(Segment("roll", "sweep", 0.0, 14.5, 0.2, 0.5, 3.5)),
        asdict(Segment("throttle", "sweep", 15.0, 14.5, 0.1, 0.5, 3.5)),
    ],
    envelope={
        "lowest_m": 10.0,
        "highest_m": 40.0,
        "radius_m": 20.0,
        "tilt_deg": 25.0,
        "abort_tilt_deg": 33.0,
        "battery_percent": 40.0,
    },
    promise={"b": 0.0007, "J_xx": 0.0013, "J_r": 0.02},
    promise_sweeps={"b": 0.0008, "J_xx": 0.002, "J_r": 9.0},
)
