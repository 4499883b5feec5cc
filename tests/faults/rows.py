"""The faults that quadid must withstand, and what it promises for each: the one list that tests and page share."""

from __future__ import annotations

from typing import NamedTuple


class Fault(NamedTuple):
    """One row of the table: what goes wrong, and what is promised then."""

    fault: str
    promise: str


FAULTS: dict[int, Fault] = {
    1: Fault(
        "MCAP cut at any byte; chunk CRC wrong",
        "everything before the cut is used, the loss is stated; corrupted chunks are refused (CRC on), the rest used",
    ),
    2: Fault("writer killed with -9 while recording", "at most one chunk lost"),
    3: Fault("tlog or DataFlash with garbage, corrupted FMT", "resynchronise, state how much was lost"),
    4: Fault("ULog cut at 50 % (the library reports no corruption)", "detected by our own check of gaps and ending"),
    5: Fault(
        "decompression bomb, huge declared sizes, path tricks, 10 GB log",
        "memory and time limits in a child; clear refusal",
    ),
    6: Fault(
        "NaN, Inf, stuck sensor, saturated sensor",
        "dropped and counted; never reaches an estimate; stuck and saturated named",
    ),
    7: Fault(
        "time backwards, reboot inside a log, clock step, 32-bit wrap at 71.6 min",
        "new segment or unwrapped; nothing mixed",
    ),
    8: Fault(
        "duplicates, reordering, jitter, 30 % dropout",
        "same estimate within its wider interval, or refusal with the reason",
    ),
    9: Fault(
        "topic silent, publisher restarts, QoS mismatch",
        "WARN then ERROR in diagnostics naming it; last good set held",
    ),
    10: Fault(
        "wrong units or frame, swapped motors, wrong mass by 20 %, wrong geometry",
        "named, with the permutation or factor that would fit",
    ),
    11: Fault("worker killed, hung, out of memory", "service lives, back-off, said"),
    12: Fault(
        "disk full, database locked or corrupted, read-only home",
        "keeps serving, says so, existing data readable; a corrupted database is set aside, not deleted",
    ),
    13: Fault(
        "SIGINT or SIGTERM at any moment, power cut in the middle of a commit",
        "exit < 2 s; last accepted set returns as stale",
    ),
    14: Fault(
        "MAVLink unsigned, forged, replayed, far-future timestamp, flood",
        "nothing changes; the true sender is not locked out; CPU bounded",
    ),
    15: Fault(
        "second publisher on the same topics; rogue publisher of parameters",
        "ERROR and pause; our topic's source checkable",
    ),
    16: Fault("Zenoh: unknown certificate, wrong name, spying, flood", "refused; bounded"),
    17: Fault(
        "parameter set that would destabilise a controller (inertia × 4, sign flip, b × 2)",
        "gate refuses, reason recorded; also when it creeps there in small steps",
    ),
    18: Fault(
        "on the ground, taxiing, carried by hand, crash in the log", "not flying is recognised; never learned from"
    ),
    19: Fault("rollback while a fit is running; approve twice; approve of an old sequence", "consistent, idempotent"),
    20: Fault("hostile strings in logs (HTML, ANSI, NUL, megabyte names)", "harmless in report, terminal, SQL"),
    21: Fault("two services on one vehicle, on one database", "second one refuses or becomes observer"),
    22: Fault(
        "soak: 24 h equivalent at accelerated time, and 1 h in real time in a `make soak`",
        "flat memory, flat files, flat latency, no lost sample",
    ),
    23: Fault(
        "kill -9 before, at, after the commit of a set; disk full; history lost, damaged, none",
        "nothing is published that is not on the disk, and said; a number never repeats",
    ),
    24: Fault(
        "restart after a rollback, an approval, a change of the mode",
        "a person's decision is on the disk before it is answered, and stands after the restart",
    ),
    25: Fault(
        "history with an impossible set, used-up numbers, odd bytes; held exclusively at the start",
        "not taken up, set aside, left out and said; the writer lives on; the start waits, then refuses",
    ),
    26: Fault(
        "Zenoh parcel of a few bytes that claims gigabytes, names constructors, has other types",
        "data only: declared types and sizes checked before memory is taken; refused by worker, service, ground",
    ),
    27: Fault(
        "second source under the vehicle's own ids, another address or merged into one stream; peers that come once",
        "refused or nothing believed, and said; only who is heard again and again is answered",
    ),
    28: Fault(
        "a sensor wrong by a factor, at once or slowly: gyro, accelerometer, attitude, rotor speeds",
        "while sensors contradict each other nothing is learned or published, and it is said; rotor speeds are bounded",
    ),
    29: Fault(
        "the vehicle changes (mass, thrust) with a set in force, approved by itself or by a person",
        "the set is published again at once, with the reason why it is out of date",
    ),
    30: Fault("fit process that hangs while it warms up", "given up after the promised time, and begun anew"),
    31: Fault(
        "two vehicles on one system id, an FMT defined anew, a motor on an output that is not logged, a motor order "
        "that changes, a shuffled MCAP, `1_0` and a wild first stamp in a CSV",
        "refused, or read as it is meant; said",
    ),
    32: Fault(
        "vehicle file with duplicate keys, merge bombs, deep nesting, 20,000 digits, `1:30`, mass 1e308",
        "one line that names key, cause and mend",
    ),
}
