"""Looks at a log before anything is fitted: what is there, whether it can be true, and what it allows."""

from collections.abc import Callable
from functools import partial

from quadid.checks.findings import ERROR, missing_signals, parameter_outlook
from quadid.checks.findings import Check as Check
from quadid.checks.findings import CheckResult as CheckResult
from quadid.checks.findings import Inspection as Inspection
from quadid.checks.frames import attitude_check, gravity_check, gyro_source_check, position_check, velocity_check
from quadid.checks.motion import Log, channel_facts, timing_checks
from quadid.checks.motion import flying_spans as flying_spans
from quadid.checks.motion import proposed_cuts as proposed_cuts
from quadid.checks.rotors import (
    accel_timing_check,
    balance_check,
    geometry_check,
    gyro_filter_check,
    hover_check,
    mass_check,
    order_checks,
    readings_check,
)
from quadid.data.window import Recording, in_body_axes
from quadid.vehicle import Vehicle

Question = Callable[[Log], Check | None]
"""Asks something of a log and answers with verdict and sentence; None: there is nothing to say."""


def _motors(name: str, log: Log) -> Check | None:
    return log.once(order_checks).get(name)


LIVE: tuple[Question, ...] = gravity_check, attitude_check, velocity_check
"""Units and frames that are asked of the windows of a stream, too (`quadid.online.checks`)."""
STAGES: tuple[tuple[Question, ...], ...] = (
    # units and frames, without any rotor; all that follow need a vehicle
    (*LIVE, position_check, gyro_source_check),
    # rotors that read nothing, or always the same; then the unit of their speeds
    (readings_check,),
    (hover_check,),
    # order and spins of the motors, their time, and rotors one by one
    tuple(partial(_motors, name) for name in ("motor_order", "rotor_timing", "rotor_speed")),
    # the accelerometer beside them, and what the vehicle file says: none of these is an error
    (accel_timing_check, mass_check, geometry_check, balance_check, gyro_filter_check),
)
"""Checks in order.  Each stage builds on the ones before it: what comes after an error is not asked."""


def inspect(recording: Recording, vehicle: Vehicle | None = None) -> Inspection:
    """Inspects a recording; what its motion excites is computed elsewhere (`quadid.identify`).

    Nothing may be fitted to a log of which a check is an error.

    Args:
        recording: a log in core units and frames, as the reader believes.
        vehicle: with it, hover thrust, motor order and rotor columns are checked too.
    """
    turned = recording if vehicle is None else in_body_axes(recording, vehicle)
    spans = flying_spans(turned, vehicle)
    facts = channel_facts(recording, spans)
    checks = timing_checks(recording, facts)
    log = Log(turned, vehicle, spans, recording)
    for stage in STAGES if vehicle is not None else STAGES[:1]:
        found = [check for question in stage if (check := log.once(question)) is not None]
        checks += found
        if any(check.verdict is ERROR for check in found):
            break
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
