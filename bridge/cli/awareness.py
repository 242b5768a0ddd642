"""Let this robot's ROS 2 modules exchange typed messages with other robots by name (collective awareness).

A ROS 2 managed node: service register_module, topics gateway_out and TYPE_in, as in as2_ca. The shared
inter-agent topic is the Zenoh mesh: a message goes to its receiver only, whichever domain, network or
ROS installation that robot has. It needs rclpy and as2_ca_msgs (see macs interfaces --help).

examples:
  macs awareness --name drone0 -e tcp/192.168.1.10:7447
  macs awareness --name drone0 --beside 7                    where `macs agent --id 7` runs already
  macs awareness --transport topic --ros-args -p agent_id:=drone0
  macs awareness --name drone0 --no-autostart                then: ros2 lifecycle set /ca_gateway_node configure

what it prints:
  ready: awareness of drone0 in /ca_gateway_node, active"""

from __future__ import annotations

import argparse

from bridge.cli import options, running
from bridge.settings import Settings
from macs_zenoh.sections import changed

SUMMARY = "a robot among robots: typed messages by name"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--name", help="this robot's name among robots, the parameter agent_id (default: drone0)")
    identity = parser.add_mutually_exclusive_group()
    identity.add_argument("--id", type=int, help="its id on the mesh, 1 to 65535 (default: the first free one)")
    identity.add_argument("--beside", type=int, metavar="ID", help="the robot agent with this id already runs here")
    parser.add_argument(
        "--transport", choices=["mesh", "topic", "both"], help="how robots are reached (default: mesh)"
    )
    parser.add_argument("--no-autostart", action="store_true", help="wait to be configured and activated")
    options.add_metrics_option(parser)
    options.add_mesh_options(parser)
    options.add_ros_args(parser)


def run(args: argparse.Namespace) -> int:
    settings = options.settings(args)
    awareness = changed(
        settings.awareness,
        name=args.name,
        id=args.beside if args.id is None else args.id,
        beside=None if args.beside is None else True,
        transport=args.transport,
    )
    settings = changed(settings, awareness=awareness)
    ros_args = options.ros_args(args)
    return running.until_stopped(
        lambda: _serve(settings, ros_args, autostart=not args.no_autostart, metrics=args.metrics)
    )


async def _serve(settings: Settings, ros_args: list[str], *, autostart: bool, metrics: str | None) -> int:
    from bridge.awareness import gateway
    from bridge.doctor.first import told_while_waiting

    await gateway.run(
        settings,
        ros_args=ros_args,
        autostart=autostart,
        metrics=metrics,
        on_waiting=told_while_waiting(settings.mesh),
        on_ready=running.say_ready,
    )
    return 0
