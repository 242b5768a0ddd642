"""Bring robots that run ROS 2's own Zenoh middleware onto the mesh, with nothing installed on them.

Their nodes and ours share a router. Each robot is on the mesh while its nodes are there, and headsets use it as any
other robot: topics, services and actions, by id and by group. It needs no ROS:
pip install 'macs-zenoh[rmw-zenoh]'.

examples:
  macs rmw-zenoh --id 7 --group 3 -e tcp/192.168.1.10:7447
  macs rmw-zenoh --id 7 --domain 5 --node-namespace /robot7
  macs rmw-zenoh --settings robots.toml
  macs rmw-zenoh --id 7 --mode router -e tcp/MESH:7447   the robot's own router, in place of rmw_zenohd
  macs rmw-zenoh --all
  macs rmw-zenoh --all --dry-run

what it prints:
  ready: robot 7 (domain 0)

With --all there is one robot for each ROS domain, or for each namespace that ends in a number where nodes are in such,
as they come and go; --dry-run lists those that are there. docs/rmw-zenoh.md says what a program beside a robot can do
for its safety, and what not."""

from __future__ import annotations

import argparse
import logging

from bridge import memory
from bridge.cli import options, output, running
from bridge.settings import RmwZenohRobot, Settings
from macs_zenoh.errors import UsageError
from macs_zenoh.sections import changed

log = logging.getLogger("macs.ros")

STOPPED_WITHIN_S = 10.0
"""So long leaving may take, with every robot of many: one that cannot be left ends with the program."""

SUMMARY = "robots that run rmw_zenoh, with nothing installed on them"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--id", type=int, help="id of the robot, 1 to 65535")
    parser.add_argument("--group", type=int, default=0, help="group of the robot, 1 to 255 (default: 0, none)")
    parser.add_argument("--domain", type=int, default=0, help="its ROS_DOMAIN_ID (default: 0)")
    parser.add_argument(
        "--node-namespace", default="/", metavar="NAMESPACE", help="namespace of its nodes, as /robot7"
    )
    parser.add_argument(
        "--session-namespace", default="", metavar="NAME", help="namespace of its Zenoh sessions, as robot7"
    )
    parser.add_argument("--all", action="store_true", help="every robot that is seen, also later; ids by rule")
    parser.add_argument("--dry-run", action="store_true", help="only list the robots")
    options.add_mesh_options(parser, modes=("client", "router"))


def run(args: argparse.Namespace) -> int:
    settings = options.settings(args)
    if args.id is not None:
        robot = RmwZenohRobot(
            id=args.id,
            group=args.group,
            domain=args.domain,
            node_namespace=args.node_namespace,
            session_namespace=args.session_namespace,
        )
        settings = changed(settings, rmw_zenoh=changed(settings.rmw_zenoh, robots=[robot]))
    if not settings.rmw_zenoh.robots and not args.all:
        raise UsageError("which robots? Give --id, or [[rmw_zenoh.robots]] in --settings, or --all")
    return running.until_stopped(
        lambda: _serve(settings, look=args.all, dry_run=args.dry_run), within_s=STOPPED_WITHIN_S
    )


async def _serve(settings: Settings, *, look: bool, dry_run: bool) -> int:
    from bridge.doctor.first import told_while_waiting
    from bridge.rmw_zenoh import program
    from bridge.router import KEPT_IN, open_to_anybody

    memory.give_back()
    running.switch_soon()
    if dry_run:
        robots = await program.look(settings) if look else settings.rmw_zenoh.robots
        for line in program.shown(robots) or ["no robots: there are no ROS nodes on the router"]:
            output.say(line)
        return 0 if robots else 1

    if settings.mesh.mode == "router":
        for endpoint in open_to_anybody(settings.mesh):
            log.warning("%s is open: whoever reaches it sees all and drives robots; %s", endpoint, KEPT_IN)

    def ready(robots: list[RmwZenohRobot]) -> None:
        running.say_ready(", ".join(f"robot {robot.id} ({robot.place})" for robot in robots) or "no robots yet")

    await program.run(settings, follow=look, on_waiting=told_while_waiting(settings.mesh), on_ready=ready)
    return 0
