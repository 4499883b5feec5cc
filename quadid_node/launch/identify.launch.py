"""Start the identification node.

ros2 launch quadid_node identify.launch.py vehicle:=pelican namespace:=quad1 source:=mavros
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare
from quadid_node.process import ARGUMENTS, NODE_ARGUMENTS, parameters, truth


def _node(context: LaunchContext) -> list[Node]:
    given = {name: LaunchConfiguration(name).perform(context) for name in (*ARGUMENTS, *NODE_ARGUMENTS)}
    level = given["log_level"]
    return [
        Node(
            package="quadid_node",
            executable="identify",
            name="quadid",
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("config"), parameters(given)],
            ros_arguments=["--log-level", level] if level else [],
            respawn=truth("respawn", given["respawn"]),
            respawn_delay=2.0,
            output="screen",
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """One node named quadid; the arguments that are given override the configuration file."""
    default_config = PathJoinSubstitution([FindPackageShare("quadid_node"), "config", "quadid.yaml"])
    declared = [
        DeclareLaunchArgument("namespace", default_value="", description="of this vehicle; all names are relative"),
        DeclareLaunchArgument("config", default_value=default_config, description="parameter file"),
        *(DeclareLaunchArgument(k, default_value="", description=text) for k, text in ARGUMENTS.items()),
        *(DeclareLaunchArgument(k, default_value=v, description=text) for k, (v, text) in NODE_ARGUMENTS.items()),
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=_node)])
