"""Record a mesh into MCAP files, without ROS: what robots publish, and with --commands what is sent to them.

Each topic is a channel /ROBOT/TOPIC with its real schema, so that Foxglove, rosbags and ROS read it; who came and
left, stops, control, refusals and losses are JSON channels /macs/…. A robot sends a topic once, whoever else gets it.
Nothing is lost silently: what did not get into the file is counted there and on stdout. It ends at Ctrl-C, at a limit,
or when the disk is full; after a crash `macs bag repair` keeps all that was on the disk.

--ring keeps the last minute in memory and writes it when asked (kill -USR1, or its agent's verb `record` for those
whom [record] allow names), and by itself at a stop or when a dead-man acts (--on). A program asks by kill -USR2: that
is refused after [record] ring_files files, and a line says what became of it.

With --traces N one in N messages of each robot, and of commands, is marked on its way, and /macs/traces has how long
each hop took, as macs trace prints it.

--serve FOLDER is a recorder that a gateway's page asks ([gateway] recordings = "FOLDER"): start, stop, write the ring,
list, download, replay. It says nothing by itself and records what it is asked to, but for the ring of --ring.

Exit code 0: recorded; 1: no router, or the disk is full; 2: wrong usage.

examples:
  macs record -e tcp/192.168.1.10:7447
  macs record --robot 7 --topics '/camera/**' --commands -o monday.mcap
  macs record --max-size 1GB --split --compress zstd -o long.mcap
  macs record --ring 60s --on stop --on deadman -o incident.mcap
  macs record --serve recordings --ring 60s --on stop --commands

what it prints:
  ready: recording as unity/3 to monday.mcap
  monday.mcap: 98231 messages, 1.2 GB, lost: none"""

from __future__ import annotations

import argparse
import asyncio
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

from bridge import memory
from bridge.cli import amounts, options, output, running
from bridge.cli.amounts import pattern, seconds, size
from bridge.cli.named import number
from bridge.settings import Settings
from macs_zenoh.errors import MissingExtra, UsageError
from macs_zenoh.plain import plain
from macs_zenoh.protocol.trace import MOST_EVERY

if TYPE_CHECKING:
    from bridge.recording.program import Report

SUMMARY = "record a mesh into MCAP files"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    what = parser.add_argument_group("what to record")
    what.add_argument("--robot", type=int, action="append", default=[], metavar="ID", help="this one; repeat (all)")
    what.add_argument(
        "--topics", type=pattern, action="append", default=[], metavar="PATTERN", help="as '/camera/**'; repeat (all)"
    )
    what.add_argument("--commands", action="store_true", help="also commands as sent and carried out, calls, refusals")
    what.add_argument("--headsets", action="store_true", help="also messages between agents")
    what.add_argument(
        "--traces", type=number, default=0, metavar="N", help="also the way of one in N messages, hop by hop"
    )
    where = parser.add_argument_group("where to")
    where.add_argument("-o", "--output", type=Path, metavar="FILE", help="default: macs_DATE.mcap here")
    where.add_argument("--max-size", type=size, default=0, metavar="SIZE", help="end at so much, as 500MB or 2GiB")
    where.add_argument("--max-duration", type=seconds, default=0.0, metavar="TIME", help="end after 90s, 10m, 1h")
    where.add_argument(
        "--max-folder", type=size, default=0, metavar="SIZE", help="and when the recordings of its folder have so much"
    )
    where.add_argument("--split", action="store_true", help="begin another file then, instead of ending")
    where.add_argument("--compress", choices=("zstd", "lz4", "none"), help="chunks (default: lz4)")
    ring = parser.add_argument_group("the last minute")
    ring.add_argument("--ring", type=seconds, metavar="TIME", help="keep this in memory, and write it when asked")
    ring.add_argument("--ring-size", type=size, metavar="SIZE", help="and no more than this (default: 512MiB)")
    ring.add_argument("--on", action="append", choices=("stop", "deadman"), help="write it by itself then; repeat")
    where.add_argument("--serve", type=Path, metavar="FOLDER", help="record what a gateway's page asks for, into it")
    parser.add_argument("--json", action="store_true", help="for programs: the lines on stdout as JSON")
    parser.add_argument("--progress", action="store_true", help="with --json: a line each second")
    options.add_as_option(parser)
    options.add_mesh_options(parser)


def run(args: argparse.Namespace) -> int:
    from bridge.recording import need_mcap

    need_mcap()
    if args.split and not (args.max_size or args.max_duration):
        raise UsageError("--split when? say --max-size or --max-duration")
    if args.ring is None and (args.on or args.ring_size):
        raise UsageError("--on and --ring-size are for --ring TIME")
    if args.ring is not None and (args.split or args.max_size or args.max_duration):
        raise UsageError("a ring is as long as --ring says; --split, --max-size and --max-duration are for files")
    if args.traces > MOST_EVERY:
        raise UsageError(f"--traces: at least one in {MOST_EVERY}")
    if args.principal is not None and not args.principal.joins:
        raise UsageError("a recording is online: --as unity/5, or another agent with an id")
    settings = options.settings(args)
    if args.serve is not None:
        return _serve(args, settings)
    memory.give_back()
    memory.collect_seldom()
    os.nice(settings.record.nice)  # before there are threads: each has its own
    return running.until_stopped(lambda: _record(args, settings))


def _serve(args: argparse.Namespace, settings: Settings) -> int:
    if args.output or args.split or args.max_size or args.max_folder or args.max_duration:
        raise UsageError("--serve chooses names and sizes itself: [record] folder_bytes is how much it may keep")
    try:
        from bridge.recording.serving.server import Recorder, Service
    except ModuleNotFoundError as error:
        raise MissingExtra("a recorder for a page", "aiohttp", "web") from error
    if args.ring is not None and args.principal is not None:
        raise UsageError("two recordings cannot be one agent: --serve with --as has no --ring")
    mesh, said = options.mesh_words(args), settings.record
    what = [word for robot in args.robot for word in ("--robot", str(robot))]
    what += [word for topic in args.topics for word in ("--topics", topic)]
    what += [f"--{name}" for name in ("commands", "headsets") if getattr(args, name)]
    what += ["--traces", str(args.traces)] if args.traces else []
    what += ["--compress", args.compress] if args.compress else []
    what += ["--as", str(args.principal)] if args.principal is not None else []
    ring = []
    if args.ring is not None:
        ring = [*what, "--ring", f"{args.ring}s", *(word for on in args.on or () for word in ("--on", on))]
        ring += ["--ring-size", str(args.ring_size)] if args.ring_size else []
    service = Service(args.serve, mesh, what, ring, said.folder_bytes, said.replay_first_id)

    async def serve() -> int:
        recorder = Recorder(service)
        try:
            await recorder.open()
            running.say_ready(f"recorder of {args.serve}")
            await asyncio.Event().wait()
        finally:
            await asyncio.shield(recorder.close())
        return 0

    return running.until_stopped(serve)


async def _record(args: argparse.Namespace, settings: Settings) -> int:
    from bridge.doctor.first import told_while_waiting
    from bridge.recording.program import Order, record
    from bridge.recording.recorder import Wanted

    said = settings.record
    path: Path = args.output or Path(time.strftime("macs_%Y-%m-%d_%H-%M-%S.mcap"))
    order = Order(
        path=path,
        wanted=Wanted(frozenset(args.robot), tuple(args.topics), args.commands, args.headsets, args.traces),
        compression=args.compress or said.compress,
        max_bytes=args.max_size,
        max_s=args.max_duration,
        split=args.split,
        folder_bytes=args.max_folder,
        ring_s=args.ring or 0.0,
        ring_bytes=args.ring_size or said.ring_bytes,
        on=tuple(args.on or said.on),
        after_s=said.after_s,
        ring_files=said.ring_files,
        allow=tuple(said.allow),
        agent=args.principal.agent if args.principal is not None else None,
    )
    with output.status_line() as line:

        def tell(report: Report) -> None:
            line(
                f"{amounts.in_time(report.seconds)}  {report.robots} robots, {report.topics} topics  "
                f"{report.messages} messages  {amounts.in_bytes(report.rate)}/s  {amounts.in_bytes(report.bytes)}  "
                f"lost {sum(report.lost.values())}  {amounts.in_bytes(report.free_bytes)} free"
            )
            if args.json and args.progress:
                output.say_if_possible(output.as_json({"progress": _progress(report)}))

        return await record(
            order,
            settings.mesh,
            on_waiting=told_while_waiting(settings.mesh),
            on_ready=lambda me: running.say_ready(f"recording as {me} to {path}"),
            on_progress=tell,
            on_file=lambda report: output.say_if_possible(_told(report, args.json)),
            on_asked=lambda told: output.say_if_possible(_asked(told, args.json)),
        )


def _progress(report: Report) -> dict[str, object]:
    return {
        "seconds": round(report.seconds, 1),
        "messages": report.messages,
        "bytes": report.bytes,
        "bytes_per_s": round(report.rate),
        "robots": report.robots,
        "topics": report.topics,
        "lost": dict(report.lost),
    }


def _asked(told: dict[str, str], as_json: bool) -> str:
    if as_json:
        return output.as_json({"ring": told})
    return plain(f"writing {told['file']}" if "file" in told else f"not written: {told['refused']}")


def _told(report: Report, as_json: bool) -> str:
    files = [str(file) for file in report.files]
    if as_json:
        return output.as_json(
            {
                "files": files,
                "messages": report.messages,
                "bytes": report.bytes,
                "seconds": round(report.seconds, 3),
                "lost": dict(report.lost),
                "reason": report.reason,
            }
        )
    lost = ", ".join(f"{name} {count}" for name, count in sorted(report.lost.items())) or "none"
    why = f" ({report.reason})" if report.reason else ""
    size_ = amounts.in_bytes(report.bytes)
    return plain(f"{' '.join(files)}: {report.messages} messages, {size_}, lost: {lost}{why}")
