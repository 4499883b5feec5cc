"""`ros2 run quadid_node replay LOG`: plays any log onto the canonical topics, at its own pace or faster."""

from __future__ import annotations

import argparse
import importlib
import sys

from quadid_node.stopping import Stop, end_middleware


def parse(args: list[str]) -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(prog="replay", description=__doc__)
    parser.add_argument("log", help="flight log: MCAP, .tlog, DataFlash, ULog, CSV")
    parser.add_argument("--speed", type=float, default=1.0, help="times the log's pace; 0: as fast as possible")
    parser.add_argument("--stamps", choices=("now", "log"), default="now", help="stamps from now on, or the log's own")
    parser.add_argument("--wait", type=float, default=2.0, help="seconds for subscribers to find the topics")
    parser.add_argument("--preset", default="auto", help="topic names of a ROS log")
    return parser.parse_args(args)


def main(args: list[str] | None = None) -> int:
    """Plays a log; returns the exit code: 0 done, 2 a log that cannot be read, or a folder to run nothing in."""
    try:
        importlib.import_module("quadid")  # refuses a folder that would run foreign code
    except ImportError as error:
        print(f"replay: {error}", file=sys.stderr)  # noqa: T201 - a command's last word
        return 2
    from quadid_replay import open_log
    from rclpy.utilities import remove_ros_args

    from quadid.errors import QuadidError
    from quadid_node.topic_player import play

    given = parse(remove_ros_args(args or sys.argv)[1:])
    stop = Stop()
    try:
        recording = open_log(given.log, given.preset)
    except QuadidError as error:
        print(f"replay: {error}", file=sys.stderr)  # noqa: T201 - a command's last word
        return 2
    play(recording, given.speed, given.stamps, given.wait, args, stop)
    end_middleware()
    return 0


if __name__ == "__main__":
    sys.exit(main())
