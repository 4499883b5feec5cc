"""The launch files as `ros2 launch` runs them: every node gets ready, and Ctrl-C ends all of them cleanly."""

import os
import signal
from pathlib import Path
from typing import Any

import pytest

launch: Any = pytest.importorskip("launch", reason="on no package index: runs where ROS is installed")
pytest.importorskip("launch_ros")
pytest.importorskip("quadid_msgs")

SECONDS = 600.0
"""The first start on a machine compiles; a busy one takes minutes to it."""


@pytest.mark.parametrize(
    ("name", "given", "nodes"),
    [
        ("identify", {"namespace": "quad1"}, {"/quad1/quadid"}),
        ("fleet", {"namespaces": "quad1,quad2"}, {"/quad1/quadid", "/quad2/quadid"}),
    ],
)
def test_nodes_get_ready_and_end(
    name: str, given: dict[str, str], nodes: set[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from launch import actions, event_handlers
    from launch.launch_description_sources import PythonLaunchDescriptionSource

    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    said, ended, running = list[str](), list[int](), set[int]()

    def heard(event: Any) -> None:
        said.append(event.text.decode())
        running.add(event.pid)
        if sum(line.count("ready: identifies") for line in said) == len(nodes):
            while running:  # not launch's own end, which kills what has not ended after some seconds
                os.kill(running.pop(), signal.SIGINT)

    def exited(event: Any, context: Any) -> Any:
        ended.append(event.returncode)
        over = len(ended) == len(nodes) or event.returncode
        return [actions.EmitEvent(event=launch.events.Shutdown())] if over else []

    file = Path(__file__).resolve().parents[1] / "launch" / f"{name}.launch.py"
    arguments = {**given, "vehicle": "pelican", "history": "none"}
    service = launch.LaunchService(argv=[], noninteractive=True)
    service.include_launch_description(
        launch.LaunchDescription(
            [
                actions.IncludeLaunchDescription(
                    PythonLaunchDescriptionSource(str(file)), launch_arguments=arguments.items()
                ),
                actions.RegisterEventHandler(event_handlers.OnProcessIO(on_stdout=heard, on_stderr=heard)),
                actions.RegisterEventHandler(event_handlers.OnProcessExit(on_exit=exited)),
                actions.TimerAction(period=SECONDS, actions=[actions.EmitEvent(event=launch.events.Shutdown())]),
            ]
        )
    )
    assert service.run() == 0
    text = "".join(said)
    assert ended == [0] * len(nodes), text
    assert all(f"[{node.strip('/').replace('/', '.')}]" in text for node in nodes), text
