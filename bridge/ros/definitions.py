"""The definitions of the types that a robot has, as its packages ship them: the verb ``definitions``.

Only files of installed interface packages are read, by names that the ament index has. Where a package ships no text
(one made of ``.idl`` alone), a message's is written from its class: the same fields, without constants and comments.
"""

from __future__ import annotations

import asyncio
import json
import re
import time
from collections import Counter
from collections.abc import Callable, Hashable, Iterable
from pathlib import Path
from typing import Any

from bridge.ros.types import InterfaceName, interface_file, resolve
from macs_zenoh.errors import Refused
from macs_zenoh.protocol.budget import may_have_one_more
from macs_zenoh.protocol.robot_state import Offered
from macs_zenoh.protocol.schemas import (
    TELL_BYTES,
    TEXT_BYTES,
    Definition,
    DefinitionsReply,
    full_type,
    needs,
)

ENTRY_BYTES = 256
"""What a type's name and hash take in an answer besides its text, at most."""

_IDL_TYPES = {"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64"}
_IDL_FIELD = re.compile(r"sequence<(?P<item>.+?)(?:, (?P<most>\d+))?>|(?P<array>.+)\[(?P<size>\d+)\]")


class Telling:
    """Tells of one robot's, beside the loop and to one who asks after the other, with pauses: reading files for many
    at once would take the time that a stop needs. Belongs to the loop."""

    EACH, TOTAL = 8, 64
    """So many questions of one sender, and of all, may wait."""
    PAUSE = 3.0
    """So many times as long as it took to tell, nothing is told."""

    def __init__(self, definitions: Definitions) -> None:
        self._definitions = definitions
        self._asking: Counter[Hashable] = Counter()
        self._turn = asyncio.Lock()
        self._next_at = 0.0

    async def tell(self, sender: Hashable, names: Iterable[str]) -> DefinitionsReply:
        """`Definitions.tell`. Raises Refused: too many ask."""
        mine = self._asking[sender]
        if not may_have_one_more(self._asking.total(), mine, each=self.EACH, total=self.TOTAL):
            raise Refused("so many ask for definitions that this one has no place; ask again")
        self._asking[sender] += 1
        try:
            async with self._turn:
                await asyncio.sleep(self._next_at - time.monotonic())
                began = time.monotonic()
                told = await asyncio.to_thread(self._definitions.tell, names)
                now = time.monotonic()
                self._next_at = now + self.PAUSE * (now - began)
            return told
        finally:
            self._asking[sender] -= 1
            if not self._asking[sender]:
                del self._asking[sender]


class Definitions:
    """Of one robot; each type is read once. Reads files: not for the loop's thread."""

    def __init__(self, of: Callable[[InterfaceName], Definition] | None = None) -> None:
        """``of``: where they are read, unless they are installed."""
        self._read = of or installed_definition
        self._known: dict[str, Definition] = {}
        """Only types that are installed get in here."""

    def tell(self, names: Iterable[str]) -> DefinitionsReply:
        """These types and all that they need, as much as fits into one answer."""
        found: dict[str, Definition] = {}
        missing: dict[str, str] = {}
        left: list[str] = []
        waiting = [full_type(name) for name in names]
        seen = set(waiting)
        room = TELL_BYTES
        while waiting:
            name = waiting.pop(0)
            try:
                definition = self._of(name)
            except Refused as refusal:
                missing[name] = refusal.reason
                room -= len(name) + len(refusal.reason) + ENTRY_BYTES
                continue
            size = 2 * len(definition.text.encode()) + ENTRY_BYTES
            if size > room and found:
                left.append(name)
                continue
            room -= size
            found[name] = definition
            for needed in needs(name, definition.text):
                if needed not in seen:
                    seen.add(needed)
                    waiting.append(needed)
        return DefinitionsReply(found, missing, left)

    def _of(self, name: str) -> Definition:
        """Raises Refused: no such type, or its files cannot be read."""
        known = self._known.get(name)
        if known is None:
            kind = name.split("/")[1]
            parsed = InterfaceName.parse(name, kind if kind in ("msg", "srv", "action") else "msg")
            known = self._known[name] = self._read(parsed)
        return known


def installed_definition(name: InterfaceName) -> Definition:
    """Of an interface that is installed here. Raises Refused."""
    return Definition(_text(name), _hash(name))


def offered_types(offered: Offered) -> list[str]:
    """The types of all that a robot offers, by full name."""
    topics = {*offered.publishers.values(), *offered.subscribers.values()}
    services = {full_type(name, "srv") for name in offered.services.values()}
    actions = {full_type(name, "action") for name in offered.actions.values()}
    hidden = {name for name in services if name.endswith(("_SendGoal", "_GetResult"))}  # parts of actions
    return sorted({full_type(name) for name in topics} | (services - hidden) | actions)


def _text(name: InterfaceName) -> str:
    path = interface_file(name, f"{name.name}.{name.kind}")
    if path is not None:
        return _read(path)
    if name.kind != "msg":
        raise Refused(f"type {name} is installed on this robot without the text of its definition")
    return _written(resolve(str(name)))


def _hash(name: InterfaceName) -> str:
    path = interface_file(name, f"{name.name}.json")
    if path is None:
        return ""
    try:
        hashes = json.loads(path.read_text(encoding="utf-8"))["type_hashes"]
        return next((str(each["hash_string"])[:100] for each in hashes if each["type_name"] == str(name)), "")
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return ""  # what is said without it is still true


def _read(path: Path) -> str:
    try:
        if (size := path.stat().st_size) > TEXT_BYTES:
            raise Refused(f"{path.name} has {size} bytes, at most {TEXT_BYTES} are told")
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise Refused(f"{path.name} cannot be read on this robot: {error.strerror}") from error


def _written(message: Any) -> str:
    """A message's text, from what rclpy knows of its fields."""
    return "".join(
        f"{_msg_type(of_type)} {field}\n" for field, of_type in message.get_fields_and_field_types().items()
    )


def _msg_type(of_type: str) -> str:
    """``sequence<double, 3>`` → ``float64[<=3]``, ``float[9]`` → ``float32[9]``, ``string<5>`` → ``string<=5``."""
    if (match := _IDL_FIELD.fullmatch(of_type)) is not None:
        if match["item"]:
            return f"{_msg_type(match['item'])}[{'<=' + match['most'] if match['most'] else ''}]"
        return f"{_msg_type(match['array'])}[{match['size']}]"
    return re.sub(r"(w?string)<(\d+)>", r"\1<=\2", _IDL_TYPES.get(of_type, of_type))
