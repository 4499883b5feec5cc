"""Start one identification node a vehicle, each in its own namespace.

ros2 launch quadid_node fleet.launch.py namespaces:=quad1,quad2 vehicle:=pelican source:=mavros
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

PASSED_ON = ("vehicle", "source", "approval", "use_sim_time")


def _nodes(context: LaunchContext) -> list[IncludeLaunchDescription]:
    one = PathJoinSubstitution([FindPackageShare("quadid_node"), "launch", "identify.launch.py"])
    names = [n.strip() for n in LaunchConfiguration("namespaces").perform(context).split(",") if n.strip()]
    if not names or len(set(names)) < len(names):
        raise ValueError(f"namespaces:={','.join(names)}: give each vehicle its own, as namespaces:=quad1,quad2")
    common = {key: LaunchConfiguration(key) for key in PASSED_ON}
    return [
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(one), launch_arguments={"namespace": n, **common}.items()
        )
        for n in names
    ]


def generate_launch_description() -> LaunchDescription:
    """As many nodes as there are namespaces; the other arguments hold for all of them."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespaces", description="comma-separated, one a vehicle"),
            DeclareLaunchArgument("vehicle", default_value="pelican", description="shipped name or vehicle file"),
            DeclareLaunchArgument("source", default_value="canonical", description="preset of topic names and types"),
            DeclareLaunchArgument("approval", default_value="auto", description="auto or manual"),
            DeclareLaunchArgument("use_sim_time", default_value="false", description="take the time from /clock"),
            OpaqueFunction(function=_nodes),
        ]
    )
