"""The ROS parameters of the existing robot program, for launch files that set them. What they say wins.

``router_ip_address`` (string, 127.0.0.1) and ``router_port`` (integer, 7447) become the endpoint
``tcp/ADDRESS:PORT`` of a Zenoh router, in place of all others; ``group_id`` (integer, 0) is the robot's group. New is
``agent_id`` (integer), the robot's id. One that is not set changes nothing.
"""

from __future__ import annotations

from typing import Any

from rclpy.exceptions import InvalidParameterTypeException, ParameterUninitializedException
from rclpy.parameter import Parameter

from bridge.settings import Settings
from macs_zenoh.errors import ConfigError
from macs_zenoh.protocol import endpoints
from macs_zenoh.protocol.addresses import bare
from macs_zenoh.sections import changed

ADDRESS, PORT = "127.0.0.1", 7447
TYPES = {
    "router_ip_address": Parameter.Type.STRING,
    "router_port": Parameter.Type.INTEGER,
    "group_id": Parameter.Type.INTEGER,
    "agent_id": Parameter.Type.INTEGER,
}


def apply(node: Any, settings: Settings) -> Settings:
    """The settings, changed by the parameters that are set. In the ROS thread. Raises ConfigError."""
    given = {name: _value(node, name, kind) for name, kind in TYPES.items()}
    robot = changed(settings.robot, id=given["agent_id"], group=given["group_id"])
    mesh = settings.mesh
    address, port = given["router_ip_address"], given["router_port"]
    if address is not None or port is not None:
        if port is not None and not 0 < port <= 0xFFFF:
            raise ConfigError("ROS parameter router_port", f"{port} is no port")
        address = address or ADDRESS
        try:
            mesh = changed(mesh, connect=[endpoints.written("tcp", bare(address), port or PORT)])
        except ValueError as error:
            raise ConfigError("ROS parameter router_ip_address", str(error)) from None
    return changed(settings, mesh=mesh, robot=robot)


def _value(node: Any, name: str, kind: Any) -> Any:
    try:
        if not node.has_parameter(name):
            node.declare_parameter(name, kind)
        return node.get_parameter(name).value
    except ParameterUninitializedException:
        return None
    except InvalidParameterTypeException as error:
        raise ConfigError(f"ROS parameter {name}", str(error)) from error
