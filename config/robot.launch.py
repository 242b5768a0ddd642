"""Launch file for a robot: ros2 launch robot.launch.py agent_id:=7 router_ip_address:=192.168.1.10

For a ROS installation in which `macs` is on the path. Arguments have the names of the existing robot program's
parameters; everything else is in a settings file.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

ARGUMENTS = {
    "router_ip_address": ("127.0.0.1", "where a Zenoh router listens"),
    "router_port": ("7447", "and on which port"),
    "agent_id": ("1", "number of this robot"),
    "group_id": ("0", "group of this robot; 0 is none"),
    "namespace": ("/", "of the agent's ROS node: relative topic names of headsets begin there"),
    "settings": ("/etc/macs/robot.toml", "settings file"),
}


def generate_launch_description() -> LaunchDescription:
    """The arguments, and the agent with them."""
    value = LaunchConfiguration
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in ARGUMENTS.items()
            ),
            ExecuteProcess(
                cmd=[
                    *("macs", "agent", "--settings", value("settings"), "--ros-args"),
                    *("-r", ["__ns:=", value("namespace")]),
                    *("-p", ["router_ip_address:=", value("router_ip_address")]),
                    *("-p", ["router_port:=", value("router_port")]),
                    *("-p", ["agent_id:=", value("agent_id")]),
                    *("-p", ["group_id:=", value("group_id")]),
                ],
                output="screen",
                sigterm_timeout="5",
                respawn=True,
                respawn_delay=2.0,
            ),
        ]
    )
