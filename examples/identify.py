"""Identifies a vehicle in ten lines: python examples/identify.py FLIGHT [VEHICLE]."""

import sys

from quadid_replay import open_log

from quadid.grid import to_windows
from quadid.identify.fit import fit
from quadid.vehicle import Vehicle

vehicle = Vehicle.shipped(sys.argv[2] if len(sys.argv) > 2 else "pelican")
windows = to_windows(open_log(sys.argv[1]), vehicle)  # any kind of log, onto a 50 Hz grid, cut at gaps
found = fit(windows, vehicle)
for p in found.parameters:
    print(f"{p.name:5} {p.value:10.4g}  [{p.ci95[0]:.4g}, {p.ci95[1]:.4g}]  {p.unit:15} {p.status.value}")
