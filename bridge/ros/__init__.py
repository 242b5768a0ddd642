"""The robot: interface nodes between a ROS 2 graph and the mesh.

``agent`` is the program, ``requests`` and ``parameters`` what it is asked and told. ``nodes`` is what headsets
register: ``interface`` (what all have in common), ``topics``, ``services`` of the robot, those of headsets
(``served``), ``actions``, ``stop``. ``rules`` and ``safety`` (both pure) say what settings and safety make of that.
``qos``, ``types``, ``shapes``, ``graph`` and ``stream`` are what ROS says about names and bytes. ``demo`` is a robot
to try it with.

``side`` is what all of that needs of a ROS graph. By rclpy: ``session`` is the one ROS node and its thread,
``rclpy_side`` what it does; ``installed`` says what to do where there is no rclpy. Without ROS: `bridge.rmw_zenoh`.
"""

from macs_zenoh.errors import MacsError


class RosMissing(MacsError, ImportError):
    """rclpy cannot be imported here."""

    def __init__(self, problem: str) -> None:
        super().__init__(
            f"ROS 2 is not usable here ({problem}); "
            "install it with: pip install 'macs-zenoh[ros]', or source your ROS 2: source /opt/ros/jazzy/setup.bash"
        )
