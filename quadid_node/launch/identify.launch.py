"""Start the identification node.

ros2 launch quadid_node identify.launch.py vehicle:=pelican namespace:=quad1 source:=mavros
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    "namespace": ("", "namespace of this vehicle; all topics and services are relative to it"),
    "vehicle": ("pelican", "a shipped vehicle, or the path of a vehicle file"),
    "source": ("canonical", "whose topic names and types: canonical, mavros, px4, ardupilot, rotors"),
    "approval": ("auto", "auto, or manual: a set waits for quadid/approve"),
    "use_sim_time": ("false", "take the time from /clock"),
}


def generate_launch_description() -> LaunchDescription:
    """One node named quadid; the launch arguments override the configuration file."""
    default_config = PathJoinSubstitution([FindPackageShare("quadid_node"), "config", "quadid.yaml"])
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(k, default_value=v, description=text) for k, (v, text) in ARGUMENTS.items()),
            DeclareLaunchArgument("config", default_value=default_config, description="parameter file"),
            Node(
                package="quadid_node",
                executable="identify",
                name="quadid",
                namespace=LaunchConfiguration("namespace"),
                parameters=[
                    LaunchConfiguration("config"),
                    {
                        "vehicle": ParameterValue(LaunchConfiguration("vehicle"), value_type=str),
                        "source": ParameterValue(LaunchConfiguration("source"), value_type=str),
                        "approval": ParameterValue(LaunchConfiguration("approval"), value_type=str),
                        "use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool),
                    },
                ],
                output="screen",
            ),
        ]
    )
