"""The robot: interface nodes between a ROS 2 graph and the mesh. The only package that needs rclpy, with awareness.

``agent`` is the program, ``nodes`` what headsets register, ``session`` the one ROS node and its thread, ``qos``,
``types`` and ``graph`` what ROS says about topics, ``demo`` a robot to try it with.
"""

from macs_zenoh.errors import MacsError


class RosMissing(MacsError, ImportError):
    """rclpy cannot be imported here."""

    def __init__(self, problem: str) -> None:
        super().__init__(
            f"ROS 2 is not usable here ({problem}); "
            "install it with: pip install 'macs-zenoh[ros]', or source your ROS 2: source /opt/ros/jazzy/setup.bash"
        )


try:
    import rclpy  # noqa: F401 - fails here, once, with advice, instead of somewhere below
except ImportError as error:
    raise RosMissing(str(error).splitlines()[0]) from error
