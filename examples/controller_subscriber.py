"""A controller that takes its model from quadid's parameter topic. Copy it, keep the checks.

    ros2 run quadid_node identify                          # somewhere on the vehicle
    python controller_subscriber.py                        # your controller
    python controller_subscriber.py --show-tracking        # also fly a simulation with old and new gains

What a controller should check before it applies a set, in this order (docs/using-with-ros.md):
1. the schema version is one it knows, and the vehicle is its own;
2. the sequence number is higher than that of the set in use: numbers rise, also over rollbacks and restarts;
3. the state is ACCEPTED or ROLLED_BACK (STALE is from before a restart, not yet confirmed by this flight), the set is
   not known to be out of date, and the mass it rests on is the controller's;
4. units and values are what its formulas expect, and the step from what it uses now is one it can bear, the first too;
5. what it uses is identified: a value that the data do not determine stays as it is.
It then computes its own gains: quadid never sends gains and never touches a flight controller.
"""

from __future__ import annotations

import argparse
import math
import sys
from typing import Any

import rclpy
from quadid_msgs.msg import ParameterSet
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

SCHEMA = 3
UNITS = {
    "b": "N s^2/rad^2",
    "d": "N m s^2/rad^2",
    "J_xx": "kg m^2",
    "J_yy": "kg m^2",
    "J_zz": "kg m^2",
    "J_r": "kg m^2",
}
NEEDED = ("b", "J_xx", "J_yy")
"""Without these the set is of no use; the others may stay as they are."""
SLOPE = "b_tangent"
"""Where thrust has a curve: torques come from differences of speed, so from its slope; b alone carries the weight."""
IN_FORCE = (ParameterSet.STATE_ACCEPTED, ParameterSet.STATE_ROLLED_BACK)
LARGEST_STEP = 1.0
"""This controller bears parameters that change by a factor of two, as its first guess may be off; yours may not."""
SAME_MASS = 0.02
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE)


class Model:
    """The parameters in use, and the mass [kg] they belong to; 0: any."""

    def __init__(self, values: dict[str, float], mass: float = 0.0) -> None:
        self.values, self.mass, self.sequence = values, mass, 0

    def objection(self, message: Any, vehicle: str) -> str:
        """Says why a set is not applied; empty when it may be."""
        return self._not_ours(message, vehicle) or self._not_valid_now(message) or self._not_usable(message)

    def apply(self, message: Any) -> None:
        """Takes the values that the data determine; the others stay."""
        self.values.pop(SLOPE, None)
        for name, value, status in zip(message.names, message.values, message.status, strict=True):
            if (name in UNITS or name == SLOPE) and status == ParameterSet.STATUS_IDENTIFIED:
                self.values[name] = value
        self.sequence = message.sequence

    def _not_ours(self, message: Any, vehicle: str) -> str:
        if message.schema_version != SCHEMA:
            return f"schema {message.schema_version}, this controller knows {SCHEMA}"
        if vehicle and message.vehicle_id != vehicle:
            return f"it belongs to {message.vehicle_id}"
        if message.sequence <= self.sequence:
            return f"set {message.sequence} is not newer than {self.sequence}"
        return ""

    def _not_valid_now(self, message: Any) -> str:
        if message.state == ParameterSet.STATE_STALE:
            return "it is from before a restart"
        if message.state not in IN_FORCE:
            return f"its state is {message.state}"
        if message.out_of_date:
            return f"it is out of date: {message.out_of_date_reason}"
        if self.mass and not abs(message.mass / self.mass - 1.0) <= SAME_MASS:
            return f"it rests on a mass of {message.mass:.3g} kg, the vehicle has {self.mass:.3g} kg"
        return ""

    def _not_usable(self, message: Any) -> str:
        if not len(message.names) == len(message.values) == len(message.units) == len(message.status):
            return "its arrays differ in length"
        found = dict(zip(message.names, zip(message.values, message.units, message.status, strict=True), strict=True))
        for name, unit in UNITS.items():
            value, given, status = found.get(name, (math.nan, "", ParameterSet.STATUS_PRIOR_DOMINATED))
            if status != ParameterSet.STATUS_IDENTIFIED:
                if name in NEEDED:
                    return f"the data do not determine {name}"
                continue
            if given != unit:
                return f"{name} is in '{given}', wanted '{unit}'"
            if not (math.isfinite(value) and value > 0.0):
                return f"{name} = {value}"
            if abs(math.log(value / self.values[name])) > math.log1p(LARGEST_STEP):
                return f"{name} would change from {self.values[name]:.3g} to {value:.3g}"
        return ""


def gains(values: dict[str, float], start: dict[str, float]) -> dict[str, float]:
    """Gains of a cascaded attitude controller by model inversion: the same bandwidths whatever the inertia.

    `start` are the gains of the first guess; torque gains scale with inertia, the mixer with b and d.
    """
    out = dict(start)
    for axis, inertia, bandwidth, integral in (
        ("roll", "J_xx", 11.0, 14.0),
        ("pitch", "J_yy", 11.0, 14.0),
        ("yaw", "J_zz", 3.0, 1.5),
    ):
        out[f"{axis}_rate_p"] = bandwidth * values[inertia]
        out[f"{axis}_rate_i"] = integral * values[inertia]
    out["thrust_coefficient"], out["drag_coefficient"] = values.get(SLOPE, values["b"]), values["d"]
    return out


def tracking_error(values: dict[str, float], vehicle: str) -> float:
    """RMS error of roll and pitch [rad] against what was asked for, flown in simulation with gains from `values`."""
    import numpy as np

    from quadid.flight import default_gains, fly
    from quadid.vehicle import Vehicle

    described = Vehicle.shipped(vehicle)
    flight = fly(described, seconds=20.0, seed=3, gains=gains(values, default_gains(described)))
    w, x, y, z = flight.truth.quaternion.T
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    error = np.column_stack([roll, pitch]) - flight.references[:, :2]
    return float(np.sqrt(np.mean(error**2)))


class Controller(Node):
    """Listens for sets; everything a flight controller does beside that is yours."""

    def __init__(self, vehicle: str, model: Model) -> None:
        super().__init__("controller")
        self._vehicle, self.model = vehicle, model
        self.create_subscription(ParameterSet, "quadid/parameters", self._on_set, LATCHED)

    def _on_set(self, message: Any) -> None:
        reason = self.model.objection(message, self._vehicle)
        if reason:
            print(f"set {message.sequence} not applied: {reason}", flush=True)
            return
        self.model.apply(message)
        shown = ", ".join(f"{n} = {v:.4g}" for n, v in self.model.values.items())
        print(f"set {message.sequence} applied ({message.reason}): {shown}", flush=True)


def main() -> None:
    """Runs the controller."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--vehicle", default="pelican", help="shipped vehicle whose first guess the controller starts from"
    )
    parser.add_argument("--vehicle-id", default="", help="only sets of this vehicle; default: any on the topic")
    parser.add_argument("--show-tracking", action="store_true", help="fly a simulation before and after, then end")
    given, rest = parser.parse_known_args()

    from quadid.vehicle import Vehicle

    described = Vehicle.shipped(given.vehicle)
    first = {n: p.initial for n, p in described.parameters.items()}
    rclpy.init(args=[sys.argv[0], *rest])
    controller = Controller(given.vehicle_id, Model(dict(first), described.mass))
    try:
        while rclpy.ok():
            rclpy.spin_once(controller, timeout_sec=0.2)
            if given.show_tracking and controller.model.sequence:
                before, after = (
                    tracking_error(first, given.vehicle),
                    tracking_error(controller.model.values, given.vehicle),
                )
                print(f"attitude tracking error: {before:.4f} rad with the first guess, {after:.4f} rad with the set")
                break
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        controller.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
