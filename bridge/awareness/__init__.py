"""Collective awareness: ROS modules of several robots exchange typed messages by agent name (as in as2_ca).

``gateway`` is the program `macs awareness`: ``node`` is its ROS side, a managed node, ``link`` its place on the mesh.
``client`` and ``afferent`` are for modules: they register with a gateway, and receive and send typed messages.
"""

from __future__ import annotations

import bridge.ros.installed  # noqa: F401 - says what to do where there is no rclpy
from macs_zenoh.errors import MacsError


class InterfacesMissing(MacsError, ImportError):
    """The interfaces of as2_ca cannot be imported here."""

    def __init__(self, problem: str) -> None:
        super().__init__(
            f"the ROS package as2_ca_msgs is not installed ({problem}); with ROS from pip: "
            "macs interfaces build as2_ca_msgs --install, else build the folder interfaces/as2_ca_msgs with colcon"
        )


try:
    import as2_ca_msgs  # noqa: F401 - fails here, once, with advice, instead of somewhere below
except ImportError as error:
    raise InterfacesMissing(str(error).splitlines()[0]) from error
