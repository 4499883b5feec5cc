"""Looks at a log before anything is fitted: what is there, whether it can be true, and what it allows."""

from __future__ import annotations

from quadid.inspection.airborne import Spans
from quadid.inspection.airborne import flying_spans as flying_spans
from quadid.inspection.airborne import proposed_cuts as proposed_cuts
from quadid.inspection.conventions import attitude_check, gravity_check, velocity_check
from quadid.inspection.findings import FATAL as FATAL
from quadid.inspection.findings import Check as Check
from quadid.inspection.findings import CheckResult as CheckResult
from quadid.inspection.findings import Inspection as Inspection
from quadid.inspection.geometry import geometry_check, mass_check
from quadid.inspection.motor_checks import Lagged, hover_check, lagged_motion, motor_order_check
from quadid.inspection.outlook import missing_signals, parameter_outlook
from quadid.inspection.position import position_checks
from quadid.inspection.rotor_checks import rotor_speed_check
from quadid.inspection.rotor_timing import rotor_timing_check
from quadid.inspection.timing import channel_facts, timing_checks
from quadid.mounting import in_body_axes
from quadid.vehicle import Vehicle
from quadid.window import Recording


def inspect(recording: Recording, vehicle: Vehicle | None = None) -> Inspection:
    """Inspects a recording; what its motion excites is computed elsewhere (`quadid.identify`).

    Args:
        recording: a log in core units and frames, as the reader believes.
        vehicle: with it, hover thrust, motor order and rotor columns are checked too.
    """
    turned = recording if vehicle is None else in_body_axes(recording, vehicle)
    spans = flying_spans(turned, vehicle)
    facts = channel_facts(recording, spans)
    checks = timing_checks(recording, facts)
    checks += [
        gravity_check(turned, spans),
        attitude_check(turned),
        velocity_check(turned),
        *position_checks(recording),
    ]
    if vehicle is not None:
        checks += _against_vehicle(turned, vehicle, spans, lagged_motion(recording, vehicle, spans))
    return Inspection(
        name=recording.name,
        format=recording.format,
        sha256=recording.sha256,
        seconds=max(f.last for f in facts) - min(f.first for f in facts) if facts else 0.0,
        channels=facts,
        breaks=recording.breaks,
        flying=spans,
        checks=tuple(checks),
        missing=missing_signals(recording.format, facts),
        parameters=parameter_outlook(facts),
        warnings=recording.warnings,
        zero=recording.first_imu_time,
    )


def _against_vehicle(recording: Recording, vehicle: Vehicle, spans: Spans, lagged: Lagged | str) -> list[Check]:
    """What only a vehicle file lets check; mass and geometry are judged where the motors themselves are in order."""
    speeds = rotor_speed_check(recording, vehicle, spans)
    if speeds.verdict is CheckResult.ERROR:
        return [speeds]
    hover, order = hover_check(recording, vehicle, spans), motor_order_check(lagged, vehicle)
    time = rotor_timing_check(recording, vehicle, spans)
    checks = [speeds, hover, order, time]
    if CheckResult.ERROR not in (hover.verdict, order.verdict, time.verdict):
        mass = mass_check(recording, vehicle, spans, hover.numbers.get("b_from_hover"))
        checks += [check for check in (mass, geometry_check(lagged, vehicle)) if check is not None]
    return checks
