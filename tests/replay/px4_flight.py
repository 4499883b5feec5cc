"""A simulated flight as PX4 logs it with `SDLOG_PROFILE` 17: a ULog with geometry, sensors and motors at full rate."""

from __future__ import annotations

from quadid.flight import Flight
from quadid.vehicle import Vehicle
from quadid.window import Channel
from tests.replay.test_ulog import Ulog

FORMATS = {
    "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;"
    "int32_t accelerometer_timestamp_relative;float[3] accelerometer_m_s2;uint32_t accelerometer_integral_dt;",
    "vehicle_attitude": "uint64_t timestamp;float[4] q;",
    "actuator_motors": "uint64_t timestamp;uint64_t timestamp_sample;float[12] control;",
}
BOOT = 5.0
"""Time of the autopilot at the recording's time 0 [s]."""


def px4_ulog(flight: Flight, vehicle: Vehicle, max_speed: float) -> bytes:
    """The ULog of a flight.

    Args:
        flight: gyro, accelerometer, attitude and rotor speeds.
        vehicle: its geometry becomes `CA_ROTOR…`.
        max_speed: rotor speed at full command [rad/s].
    """
    log, channels = Ulog(), flight.recording.channels
    for name, fields in FORMATS.items():
        log.format(name, fields)
    log.parameter("CA_ROTOR_COUNT", len(vehicle.rotors))
    for n, rotor in enumerate(vehicle.rotors):
        for key, value in zip(("PX", "PY", "PZ", "KM"), (*rotor.position, 0.05 * rotor.spin), strict=True):
            log.parameter(f"CA_ROTOR{n}_{key}", value)
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
    for t, control in zip(stamps(rotors), rotors.values / max_speed, strict=True):
        log.add("actuator_motors", "QQ12f", t, t, *control, *rest)
    return bytes(log.data)


def stamps(channel: Channel) -> list[int]:
    """Times as PX4 stamps them [us]."""
    return [round(t) for t in ((channel.t + BOOT) * 1e6).tolist()]
