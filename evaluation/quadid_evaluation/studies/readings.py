"""Allowed interval of rotor readings: snapshots of one rate loop, taken at other intervals.

    python -m quadid_evaluation.studies.readings

prints what snapshots of the loop's output (RATE.ROut and POut at 400 Hz of x.bin and quad_sq.bin) make of slow torque.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from pymavlink.DFReader import DFReader_binary

from quadid.data.window import Channel, Recording
from quadid.types import FloatArray
from quadid_evaluation.harness import DATA, table

LOOP = 0.0025
"""Time between two runs of the loop [s]."""
SLOW = 20
"""Slow torque is what three running means over so many runs of the loop leave."""
INTERVALS = ((4, 0), (5, 0), (6, 0), (7, 0), (8, 0), (8, 2), (9, 0), (10, 0))
"""Between snapshots, and to a second one after each (0: none), in runs of the loop: ArduPilot's motor outputs are two
runs newer than the rotor speeds of the same round of messages."""
PARTS = ((30.0, 75.0), (75.0, 95.0), (95.0, 200.0))
"""Of the log [s]; the excited flight begins 41 s after its first row."""
MOTION = {"gyro": 0.01, "accel": 0.01, "attitude": 0.02}
"""Time between messages, as `quadid serve` asks for them [s]."""
REACH = 8
"""Logged readings on each side that one between them is made of."""
IDLE, SPEED_OF_PULSE = 1150.0, 7200.0 / 800.0 * np.pi / 30.0
"""Pulse at rest [us] and rotor speed of one more [rad/s]: the simulator's motors follow their pulses at once."""


def telemetry(recording: Recording, interval: float, pulses: bool = False) -> Recording:
    """A DataFlash flight as a live link would bring it.

    Args:
        recording: its rotor readings are evenly spaced.
        interval: between two rotor readings [s]; those between logged ones are band-limited (Lanczos).
        pulses: motor outputs in whole microseconds instead of rotor speeds.
    """
    channels = dict(recording.channels)
    for name, step in MOTION.items():
        channels[name] = _every(channels[name], step)
    rotors = channels["rotor_speed"]
    period = float(np.median(np.diff(rotors.t)))
    at = np.arange(rotors.t[REACH], rotors.t[-REACH - 1], interval)
    near = np.searchsorted(rotors.t, at)[:, None] + np.arange(-REACH, REACH)
    away = (at[:, None] - rotors.t[near]) / period
    weight = np.where(np.abs(away) < REACH, np.sinc(away) * np.sinc(away / REACH), 0.0)
    values = np.einsum("nk,nkr->nr", weight / weight.sum(axis=1, keepdims=True), rotors.values[near])
    values = np.maximum(values, 0.0)  # between readings the band-limited curve may pass below rest; no motor does
    if pulses:
        del channels["rotor_speed"]
        pulse = np.round(IDLE + values / SPEED_OF_PULSE)
        channels["motor_command"] = Channel("motor_command", at, pulse, rotors.source)
    else:
        channels["rotor_speed"] = replace(rotors, t=at, values=values)
    return replace(recording, channels=channels)


def _every(channel: Channel, step: float) -> Channel:
    rows = slice(None, None, max(round(step / float(np.median(np.diff(channel.t)))), 1))
    return replace(channel, t=channel.t[rows], values=channel.values[rows])


def _slow(torque: FloatArray) -> FloatArray:
    for _ in range(3):
        torque = np.convolve(torque, np.full(SLOW, 1.0 / SLOW), "same")
    return torque[5 * SLOW : -5 * SLOW]


def errors(torque: FloatArray, runs: int, second: int = 0) -> list[float]:
    """Size of slow torque by lines between snapshots over the true one, minus 1, by where the snapshots begin.

    Args:
        torque: of each run of the loop, shape (n,).
        runs: between two snapshots.
        second: runs to another snapshot after each; 0: none.
    """
    true, out = _slow(torque), []
    for first in range(runs):
        at = np.arange(first, len(torque) - second, runs)
        at = np.union1d(at, at + second)
        seen = _slow(np.interp(np.arange(len(torque)), at, torque[at]))
        out.append(float(seen @ true / (true @ true)) - 1.0)
    return out


def loop_output(log: Path) -> FloatArray:
    """Roll and pitch output of the rate loop, on a grid of `LOOP`, shape (n, 2)."""
    reader, rows = DFReader_binary(str(log)), []
    while (row := reader.recv_match(type="RATE")) is not None:
        rows.append((row.TimeUS * 1e-6, row.ROut, row.POut))
    t, *outputs = np.array(rows).T
    return np.column_stack([np.interp(np.arange(t[0], t[-1], LOOP), t, output) for output in outputs])


if __name__ == "__main__":
    rows = []
    for name in ("x.bin", "quad_sq.bin"):
        output = loop_output(DATA / "ardupilot_sitl" / name)
        for runs, second in INTERVALS:
            apart = f"{runs * LOOP * 1e3:g}" + (f", and {second * LOOP * 1e3:g} later" if second else "")
            cells = [name, apart]
            for a, b in PARTS:  # rms error of slow torque in parts of the flight
                part = output[round(a / LOOP) : round(b / LOOP)]
                found = errors(part[:, 0], runs, second) + errors(part[:, 1], runs, second)
                cells.append(f"{np.sqrt(np.mean(np.square(found))):.1%}")
            rows.append(cells)
    heads = ("flight", "between readings [ms]", *(f"{a:g} to {b:g} s" for a, b in PARTS))
    print(*table(heads, rows), sep="\n")
