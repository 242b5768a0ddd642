"""Pages that are made from the code: command line, settings, programming interface, counters.

`conf.py` writes them into docs/generated/ when the site is built; they are not kept in the repository, so they cannot
be out of date.
"""

from __future__ import annotations

import argparse
import ast
import functools
import inspect
import os
import re
import sys
import textwrap
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any, get_args

import msgspec

import macs_zenoh
from bridge import cli
from bridge.settings import Settings
from macs_zenoh import errors
from macs_zenoh.errors import WireError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
COPIED = {
    "keyexpr_map.md": "keyexpr_map.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "reporting.md",
    "CODE_OF_CONDUCT.md": "conduct.md",
}
"""Pages that live beside docs/, and what they are called in docs/generated/."""
MADE_FROM = {
    "bridge/cli/__init__.py": "cli.md",
    "bridge/settings/__init__.py": "settings.md",
    "macs_zenoh/__init__.py": "api.md",
}
"""Sources that pages link to for what is made from them here: such links also work where the repository is read."""


GENERATED = ("cli.md", "settings.md", "api.md", "counter_index.md", *COPIED.values())


def pages() -> dict[str, str]:
    """Every generated page, by its file name."""
    copies = {name: (ROOT / path).read_text(encoding="utf-8") for path, name in COPIED.items()}
    made = (command_line(), settings(), api(), counter_index(), *copies.values())
    return dict(zip(GENERATED, made, strict=True))


def repository() -> str:
    """Where the repository is kept, as pyproject.toml says."""
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["urls"]
    return str(urls["Repository"])


# Links


def links_of_site(text: str, name: str) -> str:
    """A page of the site with its relative links right; ``name`` as Sphinx has it, without ``.md``."""
    written_at = {f"generated/{copy.removesuffix('.md')}": path for path, copy in COPIED.items()}
    source = PurePosixPath(written_at.get(name, f"docs/{name}.md"))

    def lead(link: re.Match[str]) -> str:
        target, hash_sign, anchor = link[2].partition("#")
        if not target or "://" in target or target.startswith("mailto:"):
            return link[0]
        path = os.path.normpath(source.parent / target)
        return f"{link[1]}{_on_site(path, name)}{hash_sign}{anchor})"

    return re.sub(r"(\]\()([^)\s]+)\)", lead, text)


def _on_site(path: str, name: str) -> str:
    """Where a file of the repository is, seen from a page of the site."""
    if path == "README.md":
        path = "docs/index.md"
    if path in COPIED or path in MADE_FROM:
        page = {**COPIED, **MADE_FROM}[path]
        return os.path.relpath(f"generated/{page}", PurePosixPath(name).parent)
    if path.startswith("docs/") and (ROOT / path).suffix in (".md", ".svg"):
        return os.path.relpath(path.removeprefix("docs/"), PurePosixPath(name).parent)
    return f"{repository()}/{'tree' if (ROOT / path).is_dir() else 'blob'}/main/{path}"


# The command line


def command_line() -> str:
    """Each verb with its help, as it prints it."""
    os.environ.update(COLUMNS="100", NO_COLOR="1")
    parser = cli.build_parser()
    return "\n".join(
        [
            "# The command line",
            "",
            "What each verb of `macs` says with `--help`. Data goes to stdout, logs to stderr.",
            "",
            *_verbs(parser, 1),
        ]
    )


def _verbs(parser: argparse.ArgumentParser, level: int) -> Iterator[str]:
    if level > 1:
        yield f"{'#' * level} {parser.prog}\n"
    yield f"```text\n{parser.format_help().rstrip()}\n```\n"
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for verb in dict.fromkeys(action.choices.values()):
                verb.prog = re.sub(r"(?<= )(HOST\[:PORT\]|\[?-\S+).* (?=\w+$)", "", verb.prog)
                yield from _verbs(verb, level + 1)


# Settings


SETTINGS = """\
# Settings

What a settings file may say. It is TOML with the sections below and is given to a program with `--settings FILE`; of
several files, a later one wins, setting by setting. An option on the command line wins over all files. A misspelled
name and a value out of range are refused when the program starts.
[config/macs.toml](../../config/macs.toml) is such a file with every setting and its default, to copy and change.
`macs init` writes shorter ones for one robot, gateway or router.
"""


def settings() -> str:
    """Each section of a settings file with its fields: kind, range, default, meaning."""
    lines = [SETTINGS]
    for struct in sections():
        lines += [f"## {_title(struct)}", "", _prose(inspect.cleandoc(struct.__doc__ or "")), ""]
        meanings = field_docstrings(struct)
        for field in msgspec.structs.fields(struct):
            facts = f"*{_kind(field.type)}; {_default(field)}.*"
            lines += [f"`{field.name}`", f": {facts} {meanings.get(field.name, '')}", ""]
    return "\n".join(lines)


def sections() -> list[type[msgspec.Struct]]:
    """The structs of a settings file, in its order; those of lists after the section that has them."""
    found: list[type[msgspec.Struct]] = []
    for field in msgspec.structs.fields(Settings):
        for struct in _structs(field.type):
            found.append(struct)
            found += [inner for of in msgspec.structs.fields(struct) for inner in _structs(of.type)]
    return found


def _structs(kind: Any) -> list[type[msgspec.Struct]]:
    kinds = [kind, *get_args(kind)]
    return [each for each in kinds if isinstance(each, type) and issubclass(each, msgspec.Struct)]


def _title(struct: Any) -> str:
    in_list = struct.section in ("traffic", "robot.rules")
    return f"`[[{struct.section}]]`" if in_list else f"`[{struct.section}]`"


def field_docstrings(struct: type) -> dict[str, str]:
    """The texts below the fields of a class, each on one line."""
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(struct))).body
    assert isinstance(body, ast.ClassDef)
    found = {}
    for field, text in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
            assert isinstance(field.target, ast.Name)
            found[field.target.id] = _prose(" ".join(str(text.value.value).split()))
    return found


def _prose(text: str) -> str:
    """A docstring as Markdown: outside code its stars are wildcards, not emphasis; pages that it names are links."""
    parts = re.split(r"(``.+?``|`[^`]+`)", text)
    text = "".join(part if part.startswith("`") else part.replace("*", r"\*") for part in parts)
    return re.sub(r"docs/(\w+)\.md", r"[\1.md](../\1.md)", text)


def _kind(kind: Any) -> str:
    return _in_words(msgspec.inspect.type_info(kind))


def _in_words(kind: Any) -> str:
    match kind:
        case msgspec.inspect.BoolType():
            return "true or false"
        case msgspec.inspect.IntType() | msgspec.inspect.FloatType():
            word = "whole number" if isinstance(kind, msgspec.inspect.IntType) else "number"
            low = (
                f" from {kind.ge:,}" if kind.ge is not None else f" above {kind.gt:,}," if kind.gt is not None else ""
            )
            high = f" to {kind.le:,}" if kind.le is not None else ""
            return re.sub(r"(?<=\d),(?=\d)", " ", f"{word}{low}{high}").removesuffix(",")
        case msgspec.inspect.Metadata():
            return _in_words(kind.type)
        case msgspec.inspect.StrType():
            return "text"
        case msgspec.inspect.LiteralType():
            return "one of " + ", ".join(f"`{value}`" for value in kind.values)
        case msgspec.inspect.ListType():
            return f"list of {_in_words(kind.item_type)}"
        case msgspec.inspect.DictType():
            return f"table of {_in_words(kind.value_type)}"
        case msgspec.inspect.UnionType():
            of = [each for each in kind.types if not isinstance(each, msgspec.inspect.NoneType)]
            return " or ".join(map(_in_words, of))
        case msgspec.inspect.StructType():
            return f"tables, see `{kind.cls.section}`"
        case _:
            return "any value"


def _default(field: Any) -> str:
    if field.required:
        return "must be given"
    value = field.default if field.default is not msgspec.NODEFAULT else field.default_factory()
    if value in (None, "", [], {}):
        return "default: none"
    shown = str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)
    return f"default: `{shown}`" if not isinstance(value, list) else "default: " + ", ".join(f"`{v}`" for v in value)


# The programming interface


def api() -> str:
    """What ``macs_zenoh`` exports, by what kind it is."""
    kinds: dict[str, list[str]] = {"Functions": [], "Classes": [], "Errors": []}
    for name in public_names():
        value = getattr(macs_zenoh, name)
        is_class = isinstance(value, type)
        kind = "Errors" if is_class and issubclass(value, BaseException) else "Classes" if is_class else "Functions"
        kinds[kind].append(name)
    lines = ["# The Python library", "", inspect.cleandoc(macs_zenoh.__doc__ or ""), ""]
    lines += ["Nothing else is a public interface, and may change in any version.", ""]
    for kind, names in kinds.items():
        lines += [f"## {kind}", "", "```{eval-rst}"]
        for name in names:
            directive = "autofunction" if kind == "Functions" else "autoexception" if kind == "Errors" else "autoclass"
            lines += [f".. {directive}:: macs_zenoh.{name}"]
            lines += [*_members(getattr(macs_zenoh, name)), ""] if directive == "autoclass" else [""]
        lines += ["```", ""]
    return "\n".join(lines)


def public_names() -> list[str]:
    """What ``macs_zenoh`` exports, but for what needs a ROS that is not here."""
    return [name for name in macs_zenoh.__all__ if _is_here(name)]


def _is_here(name: str) -> bool:
    try:
        return bool(getattr(macs_zenoh, name))
    except ImportError:
        return False


def _members(value: Any) -> list[str]:
    """What is listed of a class: all, but of a struct its fields in one line, since types with ranges fill pages."""
    shown = ["   :members:", "   :undoc-members:"]
    if not (isinstance(value, type) and issubclass(value, msgspec.Struct)):
        return shown
    fields = [field.name for field in msgspec.structs.fields(value)]
    where = ". Each is explained under Settings" if hasattr(value, "section") else ""
    fields_line = f"   Fields: {', '.join(f'``{name}``' for name in fields)}{where}."
    hidden = ", ".join([*fields, "section", "zenoh"])
    return [*shown, f"   :exclude-members: {hidden}", "", fields_line]


# Counters

COUNTERS = {"drops", "_drops", "counters", "_counters"}
COUNTING = {"note", "once", "_no", "_lose", "_count", "drop"}
"""Functions whose first argument is the name of a counter, where it is a text."""


def _name_of(node: ast.AST) -> str:
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def counted(tree: ast.AST) -> Iterator[str]:
    """The names of counters that a module counts up."""
    for node in ast.walk(tree):
        found: ast.AST | None = None
        if isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Subscript):
            if _name_of(node.target.value) in COUNTERS:
                found = node.target.slice
        elif isinstance(node, ast.Call) and node.args and _name_of(node.func) in COUNTING:
            owner = node.func.value if isinstance(node.func, ast.Attribute) else None
            if owner is None or _name_of(owner) in COUNTERS | {"self"}:
                found = node.args[0]
        if isinstance(found, ast.Constant) and isinstance(found.value, str):
            yield found.value


def sources() -> list[Path]:
    """Every module of the product."""
    return sorted(path for folder in ("macs_zenoh", "bridge") for path in (ROOT / folder).rglob("*.py"))


@functools.cache
def where_counted() -> dict[str, list[str]]:
    """Each counter, and the modules that count it."""
    found: dict[str, list[str]] = {}
    for path in sources():
        for name in dict.fromkeys(counted(ast.parse(path.read_text(encoding="utf-8")))):
            found.setdefault(name, []).append(path.relative_to(ROOT).as_posix())
    refusals = (name for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, WireError))
    for name in refusals:
        found.setdefault(name, []).append("macs_zenoh/errors.py")
    return found


def counter_index() -> str:
    """Every counter in the order of the alphabet, with the module that counts it."""
    rows = (f"| `{name}` | {_linked(paths)} |" for name, paths in sorted(where_counted().items(), key=_by_name))
    return "\n".join(
        [
            "# Counters, from A to Z",
            "",
            "Where each counter is counted up. What they mean, and what to do: [Counters](../counters.md).",
            "Those that are written LikeThis are errors in what a peer sent, each counted under its own name.",
            "",
            "| counter | counted in |",
            "|---|---|",
            *rows,
            "",
        ]
    )


def _by_name(row: tuple[str, Any]) -> str:
    return row[0].lower()


def _linked(paths: Iterable[str]) -> str:
    return ", ".join(f"[{path}](../../{path})" for path in paths)
