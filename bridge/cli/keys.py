"""Print the key map: who puts what where on the mesh. With KEY, explain one concrete key.

examples:
  macs keys
  macs keys macs/to/ros/0/7/unity/9
  macs keys --json | jq -r '.[].key'

what it prints:
  unicast     macs/to/{type}/{block}/{id}/{from_type}/{from_id}"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator

from bridge.cli import output, terminal
from bridge.cli.terminal import HEADING, Block, Columns
from macs_zenoh.protocol import keyexpr
from macs_zenoh.protocol.key_fields import Fields
from macs_zenoh.protocol.keyexpr import Key

SUMMARY = "the key map, or what one key means"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("key", metavar="KEY", nargs="?", help="a concrete key, without wildcards and namespace")
    parser.add_argument("--json", action="store_true", help="for programs")


def run(args: argparse.Namespace) -> int:
    if args.key is not None:
        return _explain(args.key, as_json=args.json)
    rows = [_row(name, space) for name, space in keyexpr.KEYS.items()]
    if args.json:
        output.say(json.dumps(rows, indent=2))
    else:
        terminal.show(*_table(rows))
    return 0


def _row(name: str, space: Key[Fields]) -> dict[str, str]:
    return {
        "space": name,
        "key": space.template,
        "publisher": space.publisher,
        "subscriber": space.subscriber,
        "payload": space.payload,
    }


def _table(rows: list[dict[str, str]]) -> Iterator[Block]:
    """Key space and key in columns, the sentences below each: they do not fit beside it on a terminal."""
    width = max(len(row["space"]) for row in rows)
    for row in rows:
        yield f"{row['space']:{width}}  {row['key']}", HEADING
        said = (("from", row["publisher"]), ("to", row["subscriber"]), ("payload", row["payload"]))
        yield Columns(said, indent=width + 4)


def _explain(key: str, *, as_json: bool) -> int:
    known = keyexpr.parse(key)
    if known is None:
        output.note(f"macs keys: {key!r} is no concrete key of this mesh (`macs keys` lists them)")
        return 1
    name, fields = known
    space = keyexpr.KEYS[name]
    if as_json:
        output.say(json.dumps({**_row(name, space), "fields": fields._asdict()}))
        return 0
    terminal.show(
        (f"{name}: {space.template}", HEADING),
        Columns([(field, _shown(field, value)) for field, value in fields._asdict().items()], indent=2, gap=1),
        f"from {space.publisher}",
        f"to {space.subscriber}",
        f"payload: {space.payload}",
    )
    return 0


def _shown(name: str, value: int | str) -> str:
    """A type by number as well, since that is what frames carry."""
    if name.endswith("type") and isinstance(value, int):
        return f"{keyexpr.type_name(value)} (type {value})"
    return str(value)
