"""Which outputs of a live vehicle are motors: as the autopilot says, and nothing once that changes in use."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from quadid_node.mavlink_link import ASKED, MOST_ROUNDS, PATIENCE, MavlinkDecoder, MavlinkLink, MotorOrder
from quadid_node.mavlink_wire import dialect
from quadid_replay.motors import RPM

from tests.faults.evidence import Happened
from tests.node.mavlink_ends import Sender, decoded, free_port, samples

PULSES = tuple(1000.0 + 10.0 * k for k in range(1, 17))


@pytest.fixture
def order() -> MotorOrder:
    """Of an ArduPilot with four rotors."""
    made = MotorOrder(4)
    made.ardupilot = True
    return made


def tell(order: MotorOrder, *told: int) -> None:
    for output, function in enumerate(told, 1):
        order.tell(f"SERVO{output}_FUNCTION", float(function))


def take(order: MotorOrder, now: float = 0.0) -> tuple[float, ...]:
    return order.take(PULSES, "SERVO_OUTPUT_RAW", now)


def test_nothing_is_taken_for_a_motor_before_an_ardupilot_has_told_which_are(order: MotorOrder) -> None:
    """The first outputs were taken until the answers came, and other ones afterwards."""
    assert take(order, 100.0) == ()
    tell(order, 34, 33)
    assert take(order, 100.2) == ()
    assert order.problem == ""
    tell(order, 34, 33, 36, 35)
    assert take(order, 100.4) == (1020.0, 1010.0, 1040.0, 1030.0)
    assert order.problem == ""


def test_an_ardupilot_that_never_tells_has_its_motors_on_the_first_outputs_and_that_is_said(order: MotorOrder) -> None:
    assert take(order, 100.0) == ()
    assert take(order, 100.0 + PATIENCE) == PULSES[:4]
    assert "has not told which outputs are motors" in order.problem
    tell(order, 33, 34, 35, 36)
    assert take(order, 110.0) == PULSES[:4]


@pytest.mark.parametrize(("first", "esc"), [(1, 1), (5, 5), (9, 9), (9, 1), (29, 29)])
def test_rotor_speeds_go_with_the_outputs_of_their_motors(first: int, esc: int) -> None:
    """Motors 4 1 2 3 on four outputs; ESCs are counted by output, or up to ArduPilot 4.4 from the first of them."""
    decoder, motors, got = MavlinkDecoder(4), (4, 1, 2, 3), []
    decoder.order.ardupilot = True
    for k, motor in enumerate(motors):
        decoder.order.tell(f"SERVO{first + k}_FUNCTION", 32.0 + motor)
    assert f"ESC_TELEMETRY_{esc}_TO_{esc + 3}" in decoder.order.esc_groups()
    pulses = [1000 + 100 * motors[n - first] if 0 <= n - first < 4 else 0 for n in range(1, 33)]
    for k in range(80):  # a better source may still come for a second
        us, none = 2_000_000 + 20_000 * k, [0] * 4
        sent = [
            dialect.MAVLink_servo_output_raw_message(us, port, *pulses[16 * port : 16 * port + 16]) for port in range(2)
        ]
        for group in (1, 5, 9, 29):
            made = getattr(dialect, f"MAVLink_esc_telemetry_{group}_to_{group + 3}_message")
            sent.append(made(none, none, none, none, [1000 * m if group == esc else 0 for m in motors], none))
        for message in sent:
            got += list(decoder.samples(decoded(message), us * 1e-6))
    rows = {s.channel: s.values for s in got}
    np.testing.assert_allclose(np.array(rows["rotor_speed"]) / RPM, [1000, 2000, 3000, 4000])
    assert rows["motor_command"] == (1100.0, 1200.0, 1300.0, 1400.0)


@pytest.mark.parametrize(("kind", "motors"), [(2, True), (13, True), (0, True), (1, False), (4, False), (22, False)])
def test_outputs_of_a_plane_are_no_rotors_on_a_live_link_either(order: MotorOrder, kind: int, motors: bool) -> None:
    """The test of the logs: a plane's ailerons passed for rotors."""
    order.kind = kind
    tell(order, 33, 34, 35, 36)
    assert take(order) == (PULSES[:4] if motors else ())
    assert ("no multirotor" in order.problem) is not motors


def test_another_autopilot_is_not_waited_for() -> None:
    assert take(MotorOrder(3)) == PULSES[:3]


@pytest.mark.parametrize(
    ("before", "name", "value"),
    [
        ((33, 34, 35, 36), "SERVO1_FUNCTION", 34.0),
        ((33, 34, 35, 36), "SERVO3_FUNCTION", 0.0),
        ((33, 34, 35, 36), "SERVO4_FUNCTION", 37.0),
        ((), "SERVO1_FUNCTION", 36.0),  # told at last, and not as was taken to go without saying
    ],
)
def test_a_motor_that_moves_in_use_ends_the_use_of_all_outputs(
    before: tuple[int, ...], name: str, value: float, order: MotorOrder, happened: Happened
) -> None:
    """Two motors changed in flight were followed silently: each rotor was taken for the other."""
    tell(order, *before)
    take(order, 0.0)
    assert take(order, PATIENCE) == PULSES[:4]
    order.tell(name, value)
    assert take(order, 11.0) == ()
    assert order.problem.startswith("the motor order changes in use")
    assert name in order.problem
    tell(order, 33, 34, 35, 36)
    assert take(order, 12.0) == (), "what came between is of other rotors"
    happened(31, f"{name} told as {value:g} in flight: no output is used from then on, said")


@pytest.mark.parametrize("told", [[102.0], [101.0, 0.0]])
def test_a_motor_of_px4_that_is_elsewhere_or_moves_ends_the_use_of_all_outputs(told: list[float]) -> None:
    order = MotorOrder(4)
    assert take(order) == PULSES[:4]
    for value in told:
        order.tell("PWM_MAIN_FUNC1", value)
    assert take(order) == ()
    assert "PWM_MAIN_FUNC1" in order.problem


def test_parameters_that_move_no_motor_change_nothing(order: MotorOrder) -> None:
    tell(order, 33, 34, 35, 36, 0, 0)
    assert take(order) == PULSES[:4]
    tell(order, 33, 34, 35, 36, 70, 0)
    order.tell("SERVO1_MIN", 1100.0)
    order.tell("SERVO9_FUNCTION", 35.0)  # drives motor 3 too
    order.tell("SERVO5_FUNCTION", float("nan"))
    assert take(order) == PULSES[:4]
    assert order.problem == ""


def test_a_tricopter_and_a_vehicle_of_more_rotors_than_the_file_has() -> None:
    tricopter, six = MotorOrder(3), MotorOrder(4)
    tell(tricopter, 33, 34, 0, 36, 0, 0, 39)
    assert take(tricopter) == (1010.0, 1020.0, 1040.0)
    tell(six, 33, 34, 35, 36, 37, 38)
    assert take(six) == (), "the first four of six were taken once"
    assert "no order of 4 motors" in six.problem


def test_a_message_with_fewer_outputs_than_the_one_before_ends_nothing() -> None:
    order = MotorOrder(4)
    tell(order, 33, 34, 35)
    order.tell("SERVO17_FUNCTION", 36.0)
    assert order.take((*PULSES, *PULSES), "ACTUATOR_OUTPUT_STATUS", 0.0)[3] == PULSES[0]
    assert take(order) == ()
    assert "motor 4 on output 17" in order.problem


@pytest.fixture
def link() -> Iterator[tuple[MavlinkLink, Sender]]:
    """A service's link, and an ArduPilot on it."""
    port = free_port()
    made = MavlinkLink(f"udpin:127.0.0.1:{port}", 4)
    yield made, Sender(port)
    made.close()


def test_functions_are_asked_for_again_until_they_are_told_but_not_for_ever(link: tuple[MavlinkLink, Sender]) -> None:
    """They were asked for once: one lost frame, and the first outputs were taken."""
    service, vehicle = link
    asked = []
    for k in range(MOST_ROUNDS + 2):
        vehicle.heartbeat(autopilot=3)
        samples(service, 0.05)
        asked.append([m.param_id for m in vehicle.heard(0.1) if m.get_type() == "PARAM_REQUEST_READ"])
        if k == 0:
            told = dialect.MAVLink_param_value_message(b"SERVO1_FUNCTION", 33.0, 9, 900, 1)
            vehicle.send(told)
    assert asked[0] == list(ASKED)
    assert asked[1] == list(ASKED[1:])
    assert asked[MOST_ROUNDS - 1] == list(ASKED[1:])
    assert asked[MOST_ROUNDS] == []
