"""Looks at a log before anything is fitted: what is there, whether it can be true, and what it allows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

from quadid.checks.findings import FATAL as FATAL
from quadid.checks.findings import Check as Check
from quadid.checks.findings import CheckResult as CheckResult
from quadid.checks.findings import Inspection as Inspection
from quadid.checks.findings import missing_signals, parameter_outlook
from quadid.checks.motion import (
    Spans,
    attitude_check,
    channel_facts,
    gravity_check,
    gyro_source_check,
    position_checks,
    timing_checks,
    velocity_check,
)
from quadid.checks.motion import flying_spans as flying_spans
from quadid.checks.motion import proposed_cuts as proposed_cuts
from quadid.checks.rotors import (
    Lagged,
    better_description,
    geometry_check,
    hover_check,
    lagged_motion,
    mass_check,
    motor_order_check,
    readings_check,
    rotor_speed_check,
    rotor_timing_check,
)
from quadid.data.window import Recording, in_body_axes
from quadid.vehicle import Vehicle


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
    log = Log(turned, vehicle, spans, recording)
    for stage in STAGES:  # each builds on the ones before it: what comes after an error is not asked
        found = [check for check in stage(log) if check is not None]
        checks += found
        if any(check.verdict is CheckResult.ERROR for check in found):
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


@dataclass(frozen=True)
class Log:
    """Subject of the checks: the recording in body axes, the vehicle, times of flight [s], the recording as read."""

    recording: Recording
    vehicle: Vehicle | None
    spans: Spans
    read: Recording

    @cached_property
    def hover(self) -> Check:
        """Thrust at hover against the weight; needs the vehicle."""
        assert self.vehicle is not None
        return hover_check(self.recording, self.vehicle, self.spans)

    @cached_property
    def lagged(self) -> Lagged | str:
        """Torque and angular acceleration at several lags, or why there are none; needs the vehicle."""
        assert self.vehicle is not None
        return lagged_motion(self.read, self.vehicle, self.spans)


Stage = Callable[[Log], Sequence[Check | None]]


def _kinematics(log: Log) -> list[Check | None]:
    """Units and frames, without any rotor."""
    return [
        gravity_check(log.recording, log.spans), attitude_check(log.recording), velocity_check(log.recording),
        *position_checks(log.read), gyro_source_check(log.recording),
    ]  # fmt: skip


def _readings(log: Log) -> list[Check | None]:
    """Rotors that read nothing, or always the same; the unit of their speeds."""
    if log.vehicle is None:
        return []
    dead = readings_check(log.recording, log.vehicle, log.spans)
    if dead is not None and dead.verdict is CheckResult.ERROR:
        return [dead]
    return [dead, log.hover]


def _time_order_balance(log: Log) -> list[Check]:
    """Time, order and spins of the motors, and rotors one by one.

    Another order is only judged, and advised, of a signal that is in time with it and in balance: else the time is
    wrong, or a rotor.
    """
    if log.vehicle is None:
        return []
    recording, vehicle, spans, lagged = log.recording, log.vehicle, log.spans, log.lagged
    time, other = rotor_timing_check(recording, vehicle, spans), better_description(lagged, vehicle)
    balance = rotor_speed_check(recording, vehicle, spans)
    if other is not None:
        again = rotor_timing_check(recording, other.vehicle, spans)
        own, its = (check.numbers.get("correlation", 0.0) for check in (time, again))
        fits = again.verdict is CheckResult.OK and its >= own - 1e-9
        if fits and rotor_speed_check(recording, other.vehicle, spans).verdict is not CheckResult.ERROR:
            return [motor_order_check(lagged, vehicle, other)]
    if CheckResult.ERROR in (time.verdict, balance.verdict):
        return [check for check in (time, balance) if check.verdict is CheckResult.ERROR][:1]
    if other is not None:
        strange = "no order of the motors explains the motion at one lag"
        return [Check("motor_order", CheckResult.UNKNOWN, strange), time, balance]
    return [motor_order_check(lagged, vehicle, None), time, balance]


def _vehicle_file(log: Log) -> list[Check | None]:
    """Mass and rotor positions."""
    if log.vehicle is None:
        return []
    b = log.hover.numbers.get("b_from_hover")
    mass = mass_check(log.recording, log.vehicle, log.spans, b)
    return [mass, geometry_check(log.lagged, log.vehicle)]


STAGES: tuple[Stage, ...] = (_kinematics, _readings, _time_order_balance, _vehicle_file)
