"""The site made of docs/: each page is on one shelf, and what is generated is all that the code has."""

from __future__ import annotations

import argparse
import functools
import re
from pathlib import Path, PurePosixPath

import msgspec
import pytest
import reference_pages

import macs_zenoh
from bridge.cli import VERBS, build_parser

DOCS = Path(__file__).parents[2] / "docs"
COPIES = {f"generated/{name.removesuffix('.md')}" for name in reference_pages.GENERATED}
PAGES = {path.stem for path in DOCS.glob("*.md")} | COPIES

generated = functools.cache(reference_pages.pages)


def text_of(name: str) -> str:
    made = generated().get(f"{name.removeprefix('generated/')}.md")
    return made if made is not None else (DOCS / f"{name}.md").read_text(encoding="utf-8")


def test_every_page_is_on_one_shelf() -> None:
    """The four shelves of docs/index.md have each page once, and no page that does not exist."""
    shelves = re.findall(r"```\{toctree\}\n:hidden:\n:caption: (\w+)\n\n(.*?)\n```", text_of("index"), re.DOTALL)
    assert [caption for caption, _ in shelves] == ["Start", "Guides", "Reference", "Explanation"]
    pages = [page for _, names in shelves for page in names.split()]
    assert sorted(pages) == sorted(PAGES - {"index"})


@pytest.mark.parametrize("name", sorted(PAGES))
def test_links_within_the_site(name: str) -> None:
    """Where a page leads inside the site, there is a page or a picture."""
    links = re.findall(r"\]\(([^)\s#]+)[^)]*\)", reference_pages.links_of_site(text_of(name), name))
    assert [link for link in links if "://" not in link and not _on_site(name, link)] == []


def _on_site(name: str, link: str) -> bool:
    place = (DOCS / PurePosixPath(name).parent / link).resolve().relative_to(DOCS)
    return place.with_suffix("").as_posix() in PAGES or (DOCS / place).is_file()


def test_a_file_of_the_repository_is_linked_where_it_is_kept() -> None:
    """Pages lead to sources and settings in the repository, and to what is made from a source on the site."""
    text = (
        "[a](../config/macs.toml) [b](../bridge/settings/__init__.py) [c](robot.md#qos) [d](#here) [e](../config/wan)"
    )
    kept = f"{reference_pages.repository()}/"
    assert reference_pages.links_of_site(text, "deploy") == (
        f"[a]({kept}blob/main/config/macs.toml) [b](generated/settings.md) [c](robot.md#qos) [d](#here) "
        f"[e]({kept}tree/main/config/wan)"
    )


def test_the_settings_page_has_every_setting() -> None:
    """Each field of each section, with a sentence of what it means."""
    for struct in reference_pages.sections():
        part = generated()["settings.md"].partition(f"\n## `{'[' * (1 + ('rule' in struct.section))}")[2]
        assert part
        meanings = reference_pages.field_docstrings(struct)
        for field in msgspec.structs.fields(struct):
            assert f"\n`{field.name}`\n: *" in generated()["settings.md"], field.name
            assert len(meanings.get(field.name, "")) > 5, f"{struct.__name__}.{field.name} has no docstring"


def test_the_command_page_has_every_verb() -> None:
    """Each verb, and each verb of a verb, has its help."""
    headings = set(re.findall(r"^##+ (.+)$", generated()["cli.md"], re.MULTILINE))
    assert headings >= {f"macs {verb}" for verb in VERBS}
    (verbs,) = (each for each in build_parser()._actions if isinstance(each, argparse._SubParsersAction))
    for name, parser in verbs.choices.items():
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                assert headings >= {f"macs {name} {inner}" for inner in action.choices}


def test_the_library_page_has_every_public_name() -> None:
    """What ``macs_zenoh`` exports is there, and says what it is."""
    assert set(re.findall(r":: macs_zenoh\.(\w+)$", generated()["api.md"], re.MULTILINE)) == set(
        reference_pages.public_names()
    )
    assert [name for name in reference_pages.public_names() if not getattr(macs_zenoh, name).__doc__] == []


def test_the_index_of_counters_says_where() -> None:
    """Each counter is there with a module that counts it."""
    rows = re.findall(r"^\| `(\w+)` \| \[", generated()["counter_index.md"], re.MULTILINE)
    assert rows == sorted(reference_pages.where_counted(), key=str.lower)
    assert len(rows) > 40


def test_the_picture_names_modules_that_exist() -> None:
    """The stations of the way of a message are modules, under the names that they have now."""
    named = set(re.findall(r">(\w+/\w+)<", (DOCS / "pictures" / "data.svg").read_text(encoding="utf-8")))
    modules = {path.relative_to(DOCS.parent).with_suffix("").as_posix() for path in reference_pages.sources()}
    assert len(named) >= 6
    assert {name for name in named if not {f"bridge/{name}", f"macs_zenoh/{name}"} & modules} == set()
