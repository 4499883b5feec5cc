"""`ros2 run quadid_node identify`: runs the node until SIGINT or SIGTERM, which it heeds while it still loads."""

import contextlib
import importlib
import sys

from quadid_node.process import SPIN_SECONDS, StopSignal, end_middleware, one_thread, without_shared_memory


def main(args: list[str] | None = None) -> int:
    """Runs the node; returns the exit code: 0 done, 2 bad parameters, or a folder to run nothing in."""
    one_thread()
    try:
        importlib.import_module("quadid")  # refuses a folder that would run foreign code
    except ImportError as error:
        print(f"identify: {error}", file=sys.stderr)  # noqa: T201 - a command's last word
        return 2
    code = _run(args, StopSignal(nothing_open=True))
    end_middleware()
    return code


def _run(args: list[str] | None, stop: StopSignal) -> int:
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from rclpy.experimental.events_executor import EventsExecutor
    from rclpy.signals import SignalHandlerOptions
    from rclpy.task import Future

    from quadid.errors import QuadidError
    from quadid_node.node import IdentifyNode

    stop.opens()
    without_shared_memory()
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = IdentifyNode(stop)
    except QuadidError as error:  # quadid_msgs is not installed, or of another version
        print(f"identify: {error}", file=sys.stderr)  # noqa: T201
        return 2
    executor = EventsExecutor()
    executor.add_node(node)
    try:
        code = 0 if node.start() else 2
        while not stop() and code == 0:
            # Works off all that arrives until the time is over; `spin_once` would come back after every message.
            executor.spin_until_future_complete(Future(), timeout_sec=SPIN_SECONDS)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        stop.ignore_more()
        executor.shutdown()  # first: it must not watch what the node takes down
        with contextlib.suppress(Exception):
            node.trigger_shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    return code


if __name__ == "__main__":
    sys.exit(main())
