"""Numbers on pages are those of the code: defaults of settings, and the table of how much may be said."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import pytest
import reference_pages

from bridge.gateway.routes import STRANGERS_PER_S
from macs_zenoh.protocol import limits
from macs_zenoh.protocol.directory import Directory
from macs_zenoh.protocol.named import Names
from macs_zenoh.protocol.robot_nodes import NODES

ROOT = Path(__file__).parents[2]
PAGES = [*(ROOT / "docs").glob("*.md"), ROOT / "README.md"]
UNITS = {"": 1.0, "s": 1.0, "ms": 1e-3, "minutes": 60.0, "KiB": 1024.0, "MiB": 1024.0**2}
CLAIM = re.compile(r"`(\w+)`(?: in `\[\w+\]`)?(?: \(|, |: )(\d[\d.]*)(?: (s|ms|minutes|KiB|MiB))?(?=[ ,;).|\n])")
"""``name`` (number unit), as in `lease_ms`, 2 s: what a page calls the default of a setting."""


def defaults() -> dict[str, set[float]]:
    """The numeric defaults of each setting, in seconds and bytes; a name can be in several sections."""
    found: dict[str, set[float]] = {}
    for struct in reference_pages.sections():
        for field in msgspec.structs.fields(struct):
            if isinstance(field.default, int | float) and not isinstance(field.default, bool):
                found.setdefault(field.name, set()).add(field.default / (1000 if field.name.endswith("_ms") else 1))
    return found


def test_defaults_on_pages_are_the_defaults() -> None:
    """A number behind the name of a setting is its default, on whatever page."""
    known, claims = defaults(), 0
    for page in PAGES:
        for name, number, unit in CLAIM.findall(page.read_text(encoding="utf-8")):
            if name in known:
                claims += 1
                assert float(number) * UNITS[unit] in known[name], f"{page.name}: {name} {number} {unit}"
    assert claims >= 10


LIMITS = {
    "management data": [limits.MANAGEMENT_BYTES, limits.NODE_AGENTS, limits.CONFIGURATION_BYTES, None],
    "metadata": [limits.METADATA_BYTES],
    "a name: node, topic, type, manager": [limits.NAME_BYTES],
    "JSON in the data of a registration, or of a request to a gateway, a manager or a robot": [limits.REQUEST_BYTES],
    "parts of such JSON above 4 KiB": [limits.JSON_PARTS, limits.JSON_PARTS, limits.JSON_FIELDS, limits.NESTING],
    "a frame that has begun": [limits.PARTIAL_BYTES_PER_S],
    "frames that have begun, of all agents of a gateway": [limits.UNFINISHED_IN_ALL_BYTES],
    "robots and groups that registrations name": [
        *(limits.NAMED_EACH, limits.NAMED_PER_ADDRESS, limits.NAMED_IN_ALL),
        limits.NODE_AGENTS,
    ],
    "what waits for one agent that reads slowly": [limits.WAITING_IN_ALL_BYTES],
    "interface nodes": [
        *(limits.NODES_EACH, limits.NODES_PER_ADDRESS, limits.NODES_IN_ALL),
        *(limits.NODES_EACH, NODES),
    ],
    "questions who is online, groups, registrations": [limits.REQUESTS_PER_S, limits.REGISTRATION_REQUESTS],
    "claims by token of who is online": [Directory.PER_SESSION, Directory.IN_ALL],
    "sessions that claim the same agent, block of ids, name, or type of a name": [Directory.PER_AGENT],
    "names, and message types that names take": [Names.NAMES, Names.TYPES, Names.NAMES_IN_ALL, Names.TYPES_IN_ALL],
    "destinations that nobody has": [STRANGERS_PER_S],
}


@pytest.mark.parametrize("row", LIMITS)
def test_the_table_of_limits_is_what_limits_are(row: str) -> None:
    """Each number of docs/protocol.md's table of what others may say is the constant that is enforced."""
    table = (ROOT / "docs" / "protocol.md").read_text(encoding="utf-8").partition("## How much may be said")[2]
    (cell,) = re.findall(rf"^\| {re.escape(row)} \| (.*) \|$", table, re.MULTILINE)
    numbers = [
        float(number.replace(" ", "")) * UNITS[unit]
        for number, unit in re.findall(r"(?<![\w.])(\d[\d ]*\d|\d)(?: (KiB|MiB))?(?![\w.])", cell)
    ]
    wanted = LIMITS[row]
    assert len(numbers) >= len(wanted)
    assert [have for have, want in zip(numbers, wanted, strict=False) if want not in (None, have)] == []
