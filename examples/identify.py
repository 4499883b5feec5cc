"""Identifies a vehicle in a few lines: python examples/identify.py FLIGHT [VEHICLE]."""

import sys

import quadid

log = quadid.load(sys.argv[1], vehicle=sys.argv[2] if len(sys.argv) > 2 else "pelican")  # any kind of log, checked
fit = quadid.identify(log)
print(fit)
fit.vehicle.save("fitted.yaml")
