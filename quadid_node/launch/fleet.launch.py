"""Start one identification node a vehicle, each in its own namespace, with its own vehicle file and configuration.

ros2 launch quadid_node fleet.launch.py namespaces:=quad1,quad2 vehicle:=a.yaml,b.yaml config:=a_node.yaml,b_node.yaml
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare
from quadid_node.process import ARGUMENTS, NODE_ARGUMENTS, fleet

EACH = {**ARGUMENTS, "config": "parameter file", **{name: text for name, (_, text) in NODE_ARGUMENTS.items()}}


def _nodes(context: LaunchContext) -> list[GroupAction]:
    one = PathJoinSubstitution([FindPackageShare("quadid_node"), "launch", "identify.launch.py"])
    given = {name: LaunchConfiguration(name).perform(context) for name in EACH}
    said = {name: text for name, text in given.items() if text}
    # Without forwarding, or the empty arguments of this file would stand where the other has defaults.
    return [
        GroupAction(
            [IncludeLaunchDescription(PythonLaunchDescriptionSource(one), launch_arguments=arguments.items())],
            forwarding=False,
        )
        for arguments in fleet(LaunchConfiguration("namespaces").perform(context), said)
    ]


def generate_launch_description() -> LaunchDescription:
    """As many nodes as there are namespaces; every other argument once for all, or one a vehicle."""
    declared = [DeclareLaunchArgument("namespaces", description="comma-separated, one a vehicle")]
    for name, text in EACH.items():
        declared.append(DeclareLaunchArgument(name, default_value="", description=f"{text}; one for all, or one each"))
    return LaunchDescription([*declared, OpaqueFunction(function=_nodes)])
