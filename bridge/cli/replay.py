"""Play a recording as robots: online with their ids, groups, topics and latched values, so that headsets and pages
need not know that it is one. These robots do nothing: commands, services and actions are refused with the reason.
Ctrl-C leaves nothing behind.

With --to ros the topics are behind /replay/robot_7, where no robot listens.

With --commands-to ROBOT it sends what headsets sent to that robot once more, which MOVES IT: it asks first, and
wants the robot's id a second time, from a terminal or with --confirm. The robot's rules and its emergency stop
hold. It sends wants those of one headset (--sender), with those that were refused then, never an emergency stop or
what is 0.2 s late, and ends when the robot leaves or refuses one.

--own-names ROBOT, which may move any robot of the ROS graph, asks in the same way: that robot's topics then keep their
names, but for its emergency stop and those that its nodes listened to, unless --topics has the whole name of one.

Exit code 0: played, or stopped with Ctrl-C; 1: a file cannot be read, or nobody is there; 2: wrong usage, as when a
robot of that id is online.

examples:
  macs replay monday.mcap -e tcp/192.168.1.10:7447
  macs replay monday.mcap --start 10m --rate 0.5 --loop --topics '/camera/**' --as-robot 7:17
  macs replay monday.mcap --to ros
  macs replay monday.mcap --to ros --own-names 7 --confirm 7
  macs replay monday.mcap --to gateway 192.168.1.10:7000
  macs replay monday.mcap --commands-to 7

what it prints:
  ready: playing monday.mcap as robots 7, 8 to mesh
  98231 messages, 99 % of them at most 0.4 ms late"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from bridge import memory
from bridge.cli import options, output, running
from bridge.cli.amounts import pattern, seconds
from bridge.settings import Settings
from macs_zenoh.errors import UsageError
from macs_zenoh.plain import plain
from macs_zenoh.protocol.addresses import parse

if TYPE_CHECKING:
    from bridge.replay.program import Order

SUMMARY = "play a recording as robots, or its commands to one"

GATEWAY_PORT = 7000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE", help="an MCAP file of `macs record`")
    parser.add_argument("--rate", type=_rate, default=1.0, metavar="X", help="so many times as fast (default: 1)")
    parser.add_argument("--loop", action="store_true", help="again and again")
    parser.add_argument("--start", type=seconds, default=0.0, metavar="TIME", help="so long after the beginning")
    parser.add_argument(
        "--topics", type=pattern, action="append", default=[], metavar="PATTERN", help="as '/camera/**'; repeat"
    )
    parser.add_argument("--robot", type=_robot, action="append", default=[], metavar="ID", help="this one; repeat")
    parser.add_argument("--as-robot", type=_as_robot, action="append", default=[], metavar="7:17", help="7 as 17")
    parser.add_argument(
        "--to", nargs="+", default=["mesh"], metavar=("mesh|ros|gateway", "HOST:PORT"), help="where to (default: mesh)"
    )
    parser.add_argument(
        "--own-names", type=_robot, metavar="ID", help="to ros: this one's topics under their own names"
    )
    parser.add_argument("--commands-to", type=_robot, metavar="ID", help="send recorded commands to this robot")
    parser.add_argument("--sender", default="", metavar="unity/256", help="whose recorded commands, if several's")
    parser.add_argument("--confirm", type=_robot, metavar="ID", help="its id again, instead of being asked")
    options.add_as_option(parser)
    options.add_mesh_options(parser)


def run(args: argparse.Namespace) -> int:
    from bridge.recording import need_mcap

    need_mcap()
    order = _order(args)
    if order.commands_to or order.own_names:
        _confirm(order.commands_to or order.own_names, args.confirm, order.to)
    settings = options.settings(args)
    memory.give_back()
    return running.until_stopped(lambda: _replay(order, settings))


def _order(args: argparse.Namespace) -> Order:
    from bridge.replay.program import Order

    kind, *rest = args.to
    if kind not in ("mesh", "ros", "gateway") or len(rest) != (kind == "gateway"):
        raise UsageError("--to mesh, --to ros or --to gateway HOST:PORT")
    names = dict(args.as_robot)
    if len(set(names.values())) != len(names):
        raise UsageError("--as-robot gives two robots one id")
    if args.principal is not None and not (args.commands_to and args.principal.joins):
        raise UsageError("--as says who sends commands, as unity/5 does, with --commands-to")
    if args.commands_to and kind != "mesh":
        raise UsageError("commands are sent over the mesh")
    if args.commands_to and args.robot:
        raise UsageError("--robot chooses what robots are played; commands to robot 7 go to 17 by --as-robot 7:17")
    if args.sender and not args.commands_to:
        raise UsageError("--sender says whose commands are sent, with --commands-to")
    if args.own_names and kind != "ros":
        raise UsageError("--own-names says how topics are called in ROS, with --to ros")
    return Order(
        path=args.file,
        to=kind,
        place=_place(rest[0]) if rest else ("", 0),
        robots=frozenset(args.robot),
        names=names,
        topics=tuple(args.topics),
        rate=args.rate,
        loop=args.loop,
        start_s=args.start,
        own_names=args.own_names or 0,
        commands_to=args.commands_to or 0,
        sender=args.sender,
        agent=args.principal.agent if args.principal is not None else None,
    )


def _place(text: str) -> tuple[str, int]:
    try:
        return parse(text, GATEWAY_PORT)
    except ValueError as error:
        raise UsageError(f"--to gateway: {error}") from error


def _confirm(robot: int, again: int | None, to: str) -> None:
    """Have the robot's id a second time. Raises UsageError."""
    if again is None:
        if not sys.stdin.isatty():
            raise UsageError(f"this may move robot {robot}: name it again with --confirm {robot}")
        if to == "ros":
            output.note(f"This publishes topics of robot {robot} under their own names into the ROS graph here.")
            output.note("What listens to them there may move. Look that nobody is near a robot.")
        else:
            output.note(f"This sends recorded commands to robot {robot}, which may move. Look that nobody is near it.")
        output.note("Type its id again to go on:")
        text = sys.stdin.readline().strip()
        again = int(text) if text.isascii() and text.isdigit() and len(text) < 6 else 0
    if again != robot:
        raise UsageError(f"robot {robot} was not named twice; nothing was sent")


async def _replay(order: Order, settings: Settings) -> int:
    from bridge.doctor.first import told_while_waiting
    from bridge.replay.program import replay

    played = await replay(
        order, settings.mesh, on_waiting=told_while_waiting(settings.mesh), on_ready=running.say_ready
    )
    lost = f", {played.lost} lost on the way to the gateway" if played.lost else ""
    late = f"99 % of them at most {played.late_p99_s * 1000:.1f} ms late"
    left_out = f", {played.left_out} left out, as they were too late to be sent" if played.left_out else ""
    output.say_if_possible(f"{played.messages} messages, {late}{lost}{left_out}")
    for reason, count in played.refused.items():
        output.say_if_possible(plain(f"ended, robot {order.commands_to} refused ({count} times): {reason}"))
    return int(bool(played.refused))


def _rate(text: str) -> float:
    try:
        found = float(text)
    except ValueError:
        found = 0.0
    if not 0.01 <= found <= 1000:
        raise argparse.ArgumentTypeError(f"{text!r} is no rate from 0.01 to 1000")
    return found


def _robot(text: str) -> int:
    number = int(text) if text.isascii() and text.isdigit() and len(text) < 6 else 0
    if not 1 <= number <= 0xFFFF:
        raise argparse.ArgumentTypeError(f"{text!r} is no number from 1 to 65535")
    return number


def _as_robot(text: str) -> tuple[int, int]:
    old, colon, new = text.partition(":")
    if not colon:
        raise argparse.ArgumentTypeError(f"{text!r} is not OLD:NEW, as 7:17")
    return _robot(old), _robot(new)
