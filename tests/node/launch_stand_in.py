"""Stand-in for ROS' `launch` and `launch_ros`, which are on no package index: enough to carry out the launch files.

Arguments that are declared take their defaults where they are not given, functions are called with the context, and
what would be started or included is kept with its arguments.
"""

import importlib.util
import sys
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest


class LaunchContext:
    """Arguments by name."""

    def __init__(self, given: dict[str, str]) -> None:
        self.launch_configurations: dict[str, Any] = dict(given)


class LaunchConfiguration:
    """The value of an argument; one that nobody declared is an error, as in ROS."""

    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, context: LaunchContext) -> Any:
        return context.launch_configurations[self.name]


class Kept:
    """Anything that is only kept: its arguments by position and by name."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        self.arguments, self.named = arguments, named


class Node(Kept): ...


class GroupAction(Kept): ...


class IncludeLaunchDescription(Kept): ...


class LaunchDescription(Kept): ...


class DeclareLaunchArgument(Kept):
    """An argument."""

    def visit(self, context: LaunchContext) -> Iterable[Any]:
        if "default_value" in self.named:
            context.launch_configurations.setdefault(self.arguments[0], self.named["default_value"])
        assert self.arguments[0] in context.launch_configurations, f"required: {self.arguments[0]}"
        return ()


class OpaqueFunction(Kept):
    """A function of the context."""

    def visit(self, context: LaunchContext) -> Iterable[Any]:
        made: Iterable[Any] = self.named["function"](context)
        return made


MODULES: dict[str, tuple[type, ...]] = {
    "launch": (LaunchContext, LaunchDescription),
    "launch.actions": (DeclareLaunchArgument, GroupAction, IncludeLaunchDescription, OpaqueFunction),
    "launch.substitutions": (LaunchConfiguration,),
    "launch_ros.actions": (Node,),
}
KEPT = {
    "launch.substitutions": "PathJoinSubstitution",
    "launch_ros.substitutions": "FindPackageShare",
    "launch.launch_description_sources": "PythonLaunchDescriptionSource",
    "launch_ros": "launch_ros",
}


def launched(file: Path, given: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> list[Kept]:
    """Nodes and files that a launch file starts or includes with these arguments."""
    for name in (*MODULES, *KEPT):
        module = ModuleType(name)
        for kind in MODULES.get(name, ()):
            setattr(module, kind.__name__, kind)
        if name in KEPT:
            setattr(module, KEPT[name], Kept)
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location(file.stem.replace(".", "_"), file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    context = LaunchContext(given)
    (entities,) = module.generate_launch_description().arguments
    return [made for entity in entities for made in entity.visit(context)]
