"""A simulated flight as PX4 logs it: a ULog with geometry, sensors, and motors or setpoints at full rate."""

import numpy as np
from quadid_replay.ulog import allocation

from quadid.data.window import Channel
from quadid.flight import Flight
from quadid.vehicle import Vehicle
from tests.replay.test_ulog import Ulog

FORMATS = {
    "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;"
    "int32_t accelerometer_timestamp_relative;float[3] accelerometer_m_s2;uint32_t accelerometer_integral_dt;",
    "vehicle_attitude": "uint64_t timestamp;float[4] q;",
    "actuator_motors": "uint64_t timestamp;uint64_t timestamp_sample;float[12] control;",
    "vehicle_torque_setpoint": "uint64_t timestamp;uint64_t timestamp_sample;float[3] xyz;",
    "vehicle_thrust_setpoint": "uint64_t timestamp;uint64_t timestamp_sample;float[3] xyz;",
}
BOOT = 5.0
"""Time of the autopilot at the recording's time 0 [s]."""


def px4_ulog(
    flight: Flight, vehicle: Vehicle, max_speed: float, thinned: int = 1, mixed_otherwise: float = 0.0
) -> bytes:
    """The ULog of a flight.

    Args:
        flight: gyro, accelerometer, attitude and rotor speeds.
        vehicle: its geometry becomes `CA_ROTOR…`.
        max_speed: rotor speed at full command [rad/s].
        thinned: one row of motors in so many is logged, as without `SDLOG_PROFILE` 17.
        mixed_otherwise: what motors have beside what the setpoints ask for.
    """
    log, channels = Ulog(), flight.recording.channels
    for name, fields in FORMATS.items():
        log.format(name, fields)
    parameters = {"CA_AIRFRAME": 0.0, "CA_ROTOR_COUNT": float(len(vehicle.rotors))}
    for n, rotor in enumerate(vehicle.rotors):
        for key, value in zip(("PX", "PY", "PZ", "KM"), (*rotor.position, 0.05 * rotor.spin), strict=True):
            parameters[f"CA_ROTOR{n}_{key}"] = value
    for name, value in parameters.items():
        log.parameter(name, value)
    for name in FORMATS:
        log.subscribe(name)
    gyro, accel = channels["gyro"], channels["accel"]
    # An empty interval of integration: the gyro is an instant, and the accelerometer's mean is centred on its stamp.
    for t, rate, force in zip(stamps(gyro), gyro.values, accel.values, strict=True):
        log.add("sensor_combined", "Q3fIi3fI", t, *rate, 0, 0, *force, 0)
    for t, q in zip(stamps(channels["attitude"]), channels["attitude"].values, strict=True):
        log.add("vehicle_attitude", "Q4f", t, *q)
    rotors = channels["rotor_speed"]
    rest = [float("nan")] * (12 - len(vehicle.rotors))
    mix = allocation(parameters)
    assert mix is not None
    controls = rotors.values / max_speed
    setpoints = controls @ np.linalg.pinv(mix).T
    for k, (t, control, wanted) in enumerate(zip(stamps(rotors), controls, setpoints, strict=True)):
        log.add("vehicle_torque_setpoint", "QQ3f", t, t, *wanted[:3])
        log.add("vehicle_thrust_setpoint", "QQ3f", t, t, *wanted[3:])
        if k % thinned == 0:
            log.add("actuator_motors", "QQ12f", t, t, *(control + mixed_otherwise * (-1.0) ** k), *rest)
    return bytes(log.data)


def stamps(channel: Channel) -> list[int]:
    """Times as PX4 stamps them [us]."""
    return [round(t) for t in ((channel.t + BOOT) * 1e6).tolist()]
