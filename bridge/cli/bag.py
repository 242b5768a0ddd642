"""Look into recordings and make new ones from them: any MCAP file, whoever recorded it.

`info` reads the index alone, however large the file is; everything else keeps a few chunks in memory. A recording
whose program was killed has no index: `repair` writes one that has, with all that was on the disk. Nothing is written
over.

Exit code 0: done; 1: a file cannot be read, or `check` found something wrong; 2: wrong usage; 130: stopped before
the end.

examples:
  macs bag info monday.mcap
  macs bag events monday.mcap                             who stopped, what was refused and lost, and when
  macs bag check monday.mcap
  macs bag repair monday.mcap                             writes monday.repaired.mcap
  macs bag merge site.mcap robot.mcap -o both.mcap
  macs bag cut monday.mcap -o stop.mcap --start 10m --end 12m --topics '/7/**'
  macs bag to-rosbag2 monday.mcap -o monday_ros

what it prints:
  monday.mcap: 1.2 GB, profile ros2, by macs-zenoh
  0:10:00.2 from 2026-11-29 08:00:00.123
  98231 messages on 12 channels, lost: none
    18000  /7/camera  sensor_msgs/msg/Image"""

from __future__ import annotations

import argparse
import datetime
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bridge.cli import amounts, output, terminal
from macs_zenoh.errors import UsageError
from macs_zenoh.plain import plain

if TYPE_CHECKING:
    from bridge.recording.bag import Bag

SUMMARY = "what is in recordings; repair, merge, cut, convert them"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    verbs = parser.add_subparsers(dest="bag_verb", metavar="VERB", required=True, title="verbs")
    info = _verb(verbs, "info", "what is in a file: channels, types, time, losses", many=True)
    info.add_argument("--json", action="store_true", help="for programs: one object per file and line")
    events = _verb(verbs, "events", "what happened: stops, dead-men, refusals, losses, control")
    events.add_argument("--json", action="store_true", help="for programs: one object per line")
    check = _verb(verbs, "check", "read all of a file and say what is wrong with it", many=True)
    check.add_argument("--json", action="store_true", help="for programs: one object per file and line")
    repair = _verb(verbs, "repair", "write a whole file of one that has no end or is damaged")
    repair.add_argument("-o", "--output", type=Path, metavar="FILE", help="default: NAME.repaired.mcap beside it")
    merge = _verb(verbs, "merge", "write several files as one, by time", many=True)
    cut = _verb(verbs, "cut", "write a part of a file, with what its latched topics said before")
    cut.add_argument(
        "--start", type=amounts.seconds, default=0.0, metavar="T", help="from so long after the beginning"
    )
    cut.add_argument("--end", type=amounts.seconds, metavar="T", help="to so long after the beginning")
    cut.add_argument(
        "--topics",
        type=amounts.pattern,
        action="append",
        default=[],
        metavar="PATTERN",
        help="channels, as '/7/**'; repeat",
    )
    rosbag2 = _verb(verbs, "to-rosbag2", "write a folder that `ros2 bag` reads")
    rosbag2.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap", help="(default: mcap)")
    for verb, kind in ((merge, "FILE"), (cut, "FILE"), (rosbag2, "FOLDER")):
        verb.add_argument("-o", "--output", type=Path, required=True, metavar=kind, help="where to write")
    for verb in (merge, cut):
        _add_compression(verb)


def _verb(verbs: Any, name: str, about: str, *, many: bool = False) -> argparse.ArgumentParser:
    verb: argparse.ArgumentParser = verbs.add_parser(name, help=about, description=about)
    if many:
        verb.add_argument("files", nargs="+", type=Path, metavar="FILE", help="MCAP files")
    else:
        verb.add_argument("file", type=Path, metavar="FILE", help="an MCAP file")
    return verb


def _add_compression(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--compress", choices=("zstd", "lz4", "none"), default="lz4", help="chunks (default: lz4)")


def run(args: argparse.Namespace) -> int:
    from bridge.recording import need_mcap

    need_mcap()
    return {
        "info": _info,
        "events": _events,
        "check": _check,
        "repair": _repair,
        "merge": _merge,
        "cut": _cut,
        "to-rosbag2": _to_rosbag2,
    }[args.bag_verb](args)


def _info(args: argparse.Namespace) -> int:
    from bridge.recording.bag import Bag

    for path in args.files:
        with Bag(path) as bag:
            told = _facts(bag)
        if args.json:
            output.say(output.as_json(told))
        else:
            _show(told)
    return 0


def _facts(bag: Bag) -> dict[str, Any]:
    metadata = bag.metadata()
    lost = {name: int(count) for kind, values in metadata if kind == "macs.lost" for name, count in _counts(values)}
    channels = []
    for channel in sorted(bag.channels.values(), key=lambda channel: channel.topic):
        schema = bag.schema_of(channel)
        channels.append(
            {
                "topic": channel.topic,
                "type": schema.name if schema is not None else channel.encoding,
                "encoding": channel.encoding,
                "schema_bytes": len(schema.data) if schema is not None else 0,
                "messages": bag.counts.get(channel.id, 0),
                "metadata": channel.metadata,
            }
        )
    return {
        "file": str(bag.path),
        "bytes": bag.size,
        "profile": bag.profile,
        "library": bag.library,
        "start_ns": bag.start_ns,
        "end_ns": bag.end_ns,
        "messages": bag.messages_in_all,
        "chunks": len(bag.chunks),
        "lost": lost,
        "channels": channels,
        "metadata": [{"name": name, "values": values} for name, values in metadata],
    }


def _counts(values: dict[str, str]) -> list[tuple[str, str]]:
    return [(name, count) for name, count in values.items() if count.isdigit() and len(count) < 20]


def _show(told: dict[str, Any]) -> None:
    lost = ", ".join(f"{name} {count}" for name, count in told["lost"].items()) or "none"
    begin = datetime.datetime.fromtimestamp(told["start_ns"] / 1e9).isoformat(" ", "milliseconds")
    by = f", by {told['library']}" if told["library"] else ""
    rows = [(str(each["messages"]), each["topic"], each["type"]) for each in told["channels"]]
    terminal.show(
        f"{told['file']}: {amounts.in_bytes(told['bytes'])}, profile {told['profile'] or 'none'}{by}",
        f"{amounts.in_time((told['end_ns'] - told['start_ns']) / 1e9)} from {begin}",
        f"{told['messages']} messages on {len(rows)} channels, lost: {lost}",
        *([terminal.Columns(rows, right=(0,), indent=2)] if rows else []),
    )


def _events(args: argparse.Namespace) -> int:
    from bridge.recording.bag import Bag
    from bridge.recording.happened import happened

    with Bag(args.file) as bag:
        for each in happened(bag):
            if args.json:
                output.say(output.as_json(each._asdict()))
            else:
                who = f"robot {each.robot}: " if each.robot else ""
                output.say(plain(f"{amounts.in_time(max(0.0, each.at_s)):>11}  {each.kind:8} {who}{each.text}"))
    return 0


def _check(args: argparse.Namespace) -> int:
    from bridge.recording.repair import problems

    wrong = False
    for path in args.files:
        with terminal.progress() as progress:
            found = problems(path, progress)
        wrong = wrong or bool(found)
        if args.json:
            output.say(json.dumps({"file": str(path), "wrong": bool(found), "problems": found}))
        else:
            output.say("\n".join(plain(f"{path}: {each}") for each in found or ["nothing is wrong"]))
    return int(wrong)


def _repair(args: argparse.Namespace) -> int:
    from bridge.recording.repair import repair

    path: Path = args.file
    out = args.output or path.with_name(f"{path.stem}.repaired{path.suffix or '.mcap'}")
    with terminal.progress() as progress:
        done = repair(path, out, progress)
    for problem in done.problems:
        output.note(plain(f"{path}: {problem}"))
    cut = f", {done.cut_bytes} bytes at the end are nothing" if done.cut_bytes else ""
    output.say(plain(f"{out}: {done.messages} messages of {done.chunks} whole chunks and {done.damaged} others{cut}"))
    return 0


def _merge(args: argparse.Namespace) -> int:
    from bridge.recording.copying import merge

    with terminal.progress() as progress:
        count = merge(args.files, args.output, args.compress, progress)
    output.say(plain(f"{args.output}: {count} messages of {len(args.files)} files"))
    return 0


def _cut(args: argparse.Namespace) -> int:
    from bridge.recording.bag import Bag, named
    from bridge.recording.copying import cut
    from macs_zenoh.protocol.name_patterns import matches

    if args.end is not None and args.end <= args.start:
        raise UsageError("--end is not after --start")
    with Bag(args.file) as bag:
        wanted = named(bag, args.topics, matches)
        start_ns = bag.start_ns + int(args.start * 1e9)
        end_ns = bag.start_ns + int(args.end * 1e9) if args.end is not None else 1 << 63
    with terminal.progress() as progress:
        count = cut(
            args.file,
            args.output,
            wanted,
            start_ns=start_ns,
            end_ns=end_ns,
            compression=args.compress,
            progress=progress,
        )
    output.say(plain(f"{args.output}: {count} messages"))
    return 0


def _to_rosbag2(args: argparse.Namespace) -> int:
    from bridge.recording.rosbag2 import to_rosbag2

    with terminal.progress() as progress:
        count = to_rosbag2(args.file, args.output, args.storage, progress)
    output.say(plain(f"{args.output}: {count} messages"))
    return 0
