"""Make this machine's ROS 2 graph a robot on the mesh.

Headsets name the topics and services they want; this agent subscribes, publishes and calls for
them, and passes ROS messages on as they are. It needs rclpy: from a sourced ROS 2 installation,
or from pip install 'macs-zenoh[ros]'.

examples:
  macs agent --id 7 --group 3 -e tcp/192.168.1.10:7447
  macs agent --id 7 --ros-args -r __ns:=/robot7
  ROS_DOMAIN_ID=5 macs agent --id 7

what it prints:
  ready: robot 7"""

from __future__ import annotations

import argparse

from bridge import memory
from bridge.cli import options, running
from bridge.settings import Settings
from macs_zenoh.sections import changed

SUMMARY = "a robot: this machine's ROS 2 graph"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--id", type=int, help="id of this robot, 1 to 65535 (default: the first free one)")
    parser.add_argument("--group", type=int, help="group of this robot, 1 to 255 (default: 0, none)")
    options.add_metrics_option(parser)
    options.add_mesh_options(parser)
    options.add_ros_args(parser)


def run(args: argparse.Namespace) -> int:
    settings = options.settings(args)
    settings = changed(settings, robot=changed(settings.robot, id=args.id, group=args.group))
    ros_args = options.ros_args(args)
    return running.until_stopped(lambda: _serve(settings, ros_args, args.metrics))


async def _serve(settings: Settings, ros_args: list[str], metrics: str | None) -> int:
    from bridge.doctor.first import told_while_waiting
    from bridge.ros import program

    memory.give_back()
    running.switch_soon()
    await program.run(
        settings,
        ros_args=ros_args,
        on_waiting=told_while_waiting(settings.mesh),
        on_ready=lambda robot: running.say_ready(f"robot {robot.id}"),
        metrics=metrics,
    )
    return 0
