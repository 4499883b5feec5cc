"""Looks at a log before anything is fitted: what is there, whether it can be true, and what it allows."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from quadid.checks.findings import Check as Check
from quadid.checks.findings import CheckResult as CheckResult
from quadid.checks.findings import Inspection as Inspection
from quadid.checks.findings import missing_signals, parameter_outlook
from quadid.checks.frames import (
    Response,
    attitude_check,
    gravity_check,
    gyro_source_check,
    position_check,
    response,
    velocity_check,
)
from quadid.checks.motion import FEWEST_SAMPLES, Spans, channel_facts, timing_checks
from quadid.checks.motion import flying_spans as flying_spans
from quadid.checks.motion import proposed_cuts as proposed_cuts
from quadid.checks.rotors import (
    Lagged,
    accel_timing_check,
    balance_check,
    better_description,
    geometry_check,
    gyro_filter_check,
    hover_check,
    lagged_motion,
    mass_check,
    motor_order_check,
    readings_check,
    rotor_speed_check,
    rotor_timing_check,
    rotors_earlier,
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
        asked = [question.test(log) for question in stage if vehicle is not None or not question.vehicle]
        found = [check for check in asked if check is not None]
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

    @property
    def known(self) -> Vehicle:
        """The vehicle, where there is one."""
        assert self.vehicle is not None
        return self.vehicle

    @cached_property
    def response(self) -> Response | None:
        """Gyro beside the turning of the attitude."""
        gyro, attitude = self.recording.channels.get("gyro"), self.recording.channels.get("attitude")
        if gyro is None or attitude is None or min(len(gyro.t), len(attitude.t)) < FEWEST_SAMPLES:
            return None
        return response(gyro, attitude)

    @cached_property
    def readings(self) -> Check | None:
        """Rotors that read nothing, always the same, or coarse steps."""
        return readings_check(self.recording, self.known, self.spans)

    @cached_property
    def hover(self) -> Check:
        """Thrust at hover against the weight."""
        return hover_check(self.recording, self.known, self.spans)

    @cached_property
    def lagged(self) -> Lagged | str:
        """Torque and angular acceleration at several lags, or why there are none."""
        return lagged_motion(self.read, self.known, self.spans)

    @cached_property
    def motors(self) -> dict[str, Check]:
        """Time, order and spins of the motors, and rotors one by one.

        Another order is only judged, and advised, of a signal that is in time with it and in balance: else the time is
        wrong, or a rotor.  Where no order is in time, the same is asked of an earlier signal: then both are wrong.
        """
        recording, vehicle, spans, lagged = self.recording, self.known, self.spans, self.lagged
        time, balance = rotor_timing_check(recording, vehicle, spans), rotor_speed_check(recording, vehicle, spans)
        first = better_description(lagged, vehicle)
        for early in (0.0, 0.05, 0.1) if first is not None else ():
            moved = rotors_earlier(recording, early)
            other = (
                first
                if not early
                else better_description(lagged_motion(rotors_earlier(self.read, early), vehicle, spans), vehicle)
            )
            if other is None:
                break
            again = rotor_timing_check(moved, other.vehicle, spans)
            own, its = (check.numbers.get("correlation", 0.0) for check in (time, again))
            fits = again.verdict is CheckResult.OK and its >= own - 1e-9
            out_of_balance = (CheckResult.ERROR, CheckResult.WARNING)
            if fits and rotor_speed_check(moved, other.vehicle, spans).verdict not in out_of_balance:
                late = rotor_timing_check(recording, other.vehicle, spans)
                order = motor_order_check(lagged, vehicle, other)
                return {"motor_order": order} | ({"rotor_timing": late} if early else {})
        if self.readings is not None and time.verdict is CheckResult.ERROR:  # coarse steps have lags of their own
            time = Check(
                time.name, CheckResult.UNKNOWN, f"{time.message}; its steps are too coarse to be sure", "", time.numbers
            )
        wrong = [check for check in (time, balance) if check.verdict is CheckResult.ERROR]
        if wrong:
            return {wrong[0].name: wrong[0]}
        order = motor_order_check(lagged, vehicle, None)
        if first is not None:
            strange = "no order of the motors explains the motion at one lag"
            order = Check("motor_order", CheckResult.UNKNOWN, strange)
        return {check.name: check for check in (order, time, balance)}


class Question(NamedTuple):
    """One line of the table of checks.

    Attributes:
        name: of the check.
        test: answers with verdict and sentence; None: there is nothing to say.
        vehicle: it needs a vehicle.
        fatal: its error means that nothing may be fitted to the log.
        live: it is asked of the windows of a stream, too (`quadid.online.checks`).
    """

    name: str
    test: Callable[[Log], Check | None]
    vehicle: bool = True
    fatal: bool = True
    live: bool = False


STAGES: tuple[tuple[Question, ...], ...] = (
    (  # units and frames, without any rotor
        Question("gravity", lambda log: gravity_check(log.recording, log.spans), vehicle=False, live=True),
        Question("gyro_attitude", lambda log: attitude_check(log.recording, log.response), vehicle=False, live=True),
        Question("velocity_attitude", lambda log: velocity_check(log.recording), vehicle=False, live=True),
        Question("position_velocity", lambda log: position_check(log.read), vehicle=False),
        Question("gyro_source", lambda log: gyro_source_check(log.recording, log.vehicle, log.response), vehicle=False),
    ),
    # rotors that read nothing, or always the same; then the unit of their speeds
    (Question("rotor_speed", lambda log: log.readings),),
    (Question("hover", lambda log: log.hover),),
    (  # time, order and spins of the motors, and rotors one by one
        Question("motor_order", lambda log: log.motors.get("motor_order")),
        Question("rotor_timing", lambda log: log.motors.get("rotor_timing")),
        Question("rotor_speed", lambda log: log.motors.get("rotor_speed")),
    ),
    (  # the accelerometer beside them, and what the vehicle file says
        Question(
            "accel_timing",
            lambda log: accel_timing_check(log.recording, log.known, log.spans, log.motors.get("rotor_timing")),
            fatal=False,
        ),
        Question(
            "mass",
            lambda log: mass_check(log.recording, log.known, log.spans, log.hover.numbers.get("b_from_hover")),
            fatal=False,
        ),
        Question(
            "geometry",
            lambda log: geometry_check(log.lagged, log.known, log.hover.numbers.get("b_from_hover")),
            fatal=False,
        ),
        Question("balance", lambda log: balance_check(log.recording, log.known, log.spans), fatal=False),
        Question("gyro_source", lambda log: gyro_filter_check(log.recording, log.known, log.spans), fatal=False),
    ),
)
FATAL = {"saturated", *(question.name for stage in STAGES for question in stage if question.fatal)}
"""Checks whose error means that nothing may be fitted to the log."""
