"""What the pages and the shipped settings say is what the code has."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from bridge.cli import VERBS
from bridge.settings import Settings, parse
from macs_zenoh.config import TrafficRule
from macs_zenoh.protocol.messages import MANAGERS, NodeType
from macs_zenoh.protocol.policing import REASONS

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])


def page(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_links_lead_somewhere(path: Path) -> None:
    """No page links to a file that does not exist."""
    links = re.findall(r"\]\(([^)]+)\)", path.read_text(encoding="utf-8"))
    targets = [link.partition("#")[0] for link in links if "://" not in link]
    assert [target for target in targets if target and not (path.parent / target).exists()] == []


def test_the_protocol_page_has_every_manager() -> None:
    """Each kind of management data is in the table, under its name on the wire and its name here."""
    rows = re.findall(r"^\| `(\w+)` \| `(\w+)` \|", page("docs/protocol.md"), re.MULTILINE)
    assert dict(rows) == {name: kind.__name__ for name, kind in MANAGERS.items()}


def test_the_protocol_page_has_every_node_type() -> None:
    """Each node type is in the table, the extension as well."""
    rows = re.findall(r"^\| (\d) \| ROS", page("docs/protocol.md"), re.MULTILINE)
    assert [int(number) for number in rows] == sorted(NodeType)


def test_the_design_page_names_modules_that_exist() -> None:
    """The table of modules is the list of modules: of the protocol, and of those beside it."""
    table = page("docs/design.md").partition("## Modules")[2].partition("\nImports go")[0]
    rows = [row.split("|")[1] for row in table.splitlines() if row.startswith("|")]
    named = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    core = (ROOT / "macs_zenoh").glob("*.py"), (ROOT / "macs_zenoh" / "protocol").glob("*.py")
    assert named == {path.stem for paths in core for path in paths if path.name != "__init__.py"}


def test_the_readme_has_every_verb() -> None:
    """Each verb of `macs` is in the table of commands."""
    assert set(re.findall(r"`macs ([\w-]+)", page("README.md").partition("## Commands")[2])) >= set(VERBS)


@pytest.mark.parametrize(
    "name", ["docs/traffic.md", "docs/robot.md", "docs/reliable.md", "docs/rmw-zenoh.md", "docs/robots-together.md"]
)
def test_settings_on_a_page_are_settings(name: str) -> None:
    """Every example of settings on a page is accepted as it stands there."""
    examples = re.findall(r"^```toml\n(.*?)^```", page(name), re.MULTILINE | re.DOTALL)
    assert examples
    for example in examples:
        parse(example)


def test_the_traffic_page_has_every_setting() -> None:
    """Each field of a traffic rule is in the table, and how its drops are counted."""
    rows = re.findall(r"^\| `(\w+)` \|.*?\| (?:`(\w+)` )?\|$", page("docs/traffic.md"), re.MULTILINE)
    assert [name for name, _ in rows] == list(TrafficRule.__struct_fields__)
    assert {name: reason for name, reason in rows if reason} == REASONS


def test_the_settings_file_explains_every_setting() -> None:
    """config/macs.toml has every field of every section, commented out, with its default if there is one."""
    text = page("config/macs.toml")
    shown = parse(re.sub(r"^#(?=\w+ = )", "", text, flags=re.MULTILINE))
    for section in ("mesh", "gateway", "robot", "rmw_zenoh", "awareness"):
        part = text.partition(f"\n[{section}]")[2].partition("\n[")[0]
        defaults = getattr(Settings(), section)
        assert set(re.findall(r"^#(\w+) = ", part, re.MULTILINE)) == set(defaults.__struct_fields__)
        for name in defaults.__struct_fields__:
            default = getattr(defaults, name)
            if default not in (None, []):  # without a default the file shows an example
                assert getattr(getattr(shown, section), name) == default, name
    example = text.partition("\n#traffic = ")[2].partition("\n")[0]
    assert set(re.findall(r"(\w+) = ", example)) == set(TrafficRule.__struct_fields__)
    assert len(shown.traffic) == example.count("match = ")
