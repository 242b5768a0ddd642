"""What settings are made of: sections that hold their ranges, kinds of values, and one way to say what is wrong.

A misspelled name or a value out of range is a `ConfigError` whose path names file and field. The ranges hold however
a section is made, because the values end up in Zenoh, and Zenoh does not forgive (a transmit queue above 16 panics at
the first link). Pure, except `read_text`.
"""

from __future__ import annotations

import difflib
import functools
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar, get_args

import msgspec
from msgspec import Meta

from .errors import ConfigError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # type: ignore[import-not-found, unused-ignore]

AgentId = Annotated[int, Meta(ge=1, le=0xFFFF)]
GroupId = Annotated[int, Meta(ge=0, le=0xFF)]
"""0 means: in no group."""
AgentName = Annotated[str, Meta(min_length=1, max_length=200)]
"""Any text: it is escaped where Zenoh or ROS would not take it."""
Port = Annotated[int, Meta(ge=0, le=0xFFFF)]
"""0 means: any free one."""
Millis = Annotated[int, Meta(ge=0, le=3_600_000)]
Seconds = Annotated[float, Meta(gt=0, le=86_400)]
Bytes = Annotated[int, Meta(ge=39, le=0xFFFF_FFFF)]
"""At least one header, at most what the header's u32 can declare."""

_WORDS = "in words"


def in_words(text: str) -> dict[str, str]:
    """For a `Meta` with a pattern: what an error says in place of the regular expression."""
    return {_WORDS: text}


class Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A section of a settings file. Checks every range when it is made, from a file or in Python."""

    section: ClassVar[str] = ""

    def __post_init__(self) -> None:
        for field in _fields(type(self)):
            try:
                msgspec.convert(getattr(self, field.name), field.type)
            except msgspec.ValidationError as error:
                raise self._wrong(field.name, _told(str(error), field.type)[1]) from None
        self._check()

    def _check(self) -> None:
        """Rules that concern more than one field, or that a type cannot say."""

    def _wrong(self, field: str, problem: str) -> ConfigError:
        return ConfigError(f"{self.section}.{field}", problem)

    def _chosen(self, field: str) -> bool:
        """Whether the field differs from its default."""
        return bool(getattr(self, field) != getattr(_defaults(type(self)), field))


_S = TypeVar("_S", bound=msgspec.Struct)


def changed(settings: _S, **changes: Any) -> _S:
    """The same settings with some fields replaced; a change to None leaves the field (an option not given).

    Raises `ConfigError` naming section and field.
    """
    return msgspec.structs.replace(settings, **{name: value for name, value in changes.items() if value is not None})


# -- from files ------------------------------------------------------------------------------------------------------


def read_text(path: str | os.PathLike[str]) -> str:
    """The text of a file that somebody wrote for us. Raises `ConfigError`: it cannot be read, or is not UTF-8."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(str(path), error.strerror or str(error)) from error
    except UnicodeDecodeError as error:
        raise ConfigError(str(path), f"not UTF-8 at byte {error.start}") from error


def toml(text: str, source: str) -> dict[str, Any]:
    """What a TOML text says; ``source`` names it in errors. Raises `ConfigError`."""
    try:
        document: dict[str, Any] = tomllib.loads(text)
        return document
    except RecursionError as error:
        raise ConfigError(source, "not TOML that anybody wrote: it nests too deep") from error
    except ValueError as error:  # a TOMLDecodeError, or of a number or a date
        raise ConfigError(source, f"not TOML: {error}") from error


def read(document: dict[str, Any], kind: type[_S], source: str) -> _S:
    """What a file says, as a struct; ``source`` names it in errors. Raises `ConfigError` for an unknown name, or a
    value that may not be."""
    try:
        return msgspec.convert(document, kind)
    except msgspec.ValidationError as error:
        where, problem = _told(str(error), kind)
        raise ConfigError(f"{source}: {where}" if where else source, problem) from None
    except ConfigError as error:
        raise ConfigError(f"{source}: {error.path}", error.problem) from None


def _told(text: str, kind: Any) -> tuple[str, str]:
    """msgspec's ``Expected `int` <= 9 - at `$.mesh.port``` as a dotted path in such a value, and a sentence."""
    problem, _, where = text.partition(" - at `$")
    where = where.rstrip("`").lstrip(".")
    for name in re.findall(r"\w+", re.sub(r"\[.*?\]", "", where)):
        kind = next((field.type for struct in _structs(kind) for field in _fields(struct) if field.name == name), kind)
    problem = problem.replace("Object contains unknown field", "unknown name").replace("array", "list")
    for meta in _metas(kind):
        if meta.pattern is not None and meta.extra is not None:
            problem = problem.replace(f"`str` matching regex {meta.pattern!r}", meta.extra[_WORDS])
    return where, problem[:1].lower() + problem[1:] + _hint(problem, kind)


def _hint(problem: str, kind: Any) -> str:
    """``, did you mean `port`?`` after an unknown name that is nearly a known one."""
    unknown = re.fullmatch(r"unknown name `(.+)`", problem)
    if unknown is None:
        return ""
    known = [field.name for struct in _structs(kind) for field in _fields(struct)]
    near = difflib.get_close_matches(unknown[1], known, n=1)
    return f", did you mean `{near[0]}`?" if near else ""


def _parts(kind: Any) -> Iterator[Any]:
    """A type, and all that it is made of, as list and int of a list of int."""
    yield kind
    for part in get_args(kind):
        yield from _parts(part)


def _structs(kind: Any) -> Iterator[type[msgspec.Struct]]:
    return (part for part in _parts(kind) if isinstance(part, type) and issubclass(part, msgspec.Struct))


def _metas(kind: Any) -> Iterator[Meta]:
    return (part for part in _parts(kind) if isinstance(part, Meta))


@functools.cache
def _fields(struct: type[msgspec.Struct]) -> tuple[msgspec.structs.FieldInfo, ...]:
    """Its fields. msgspec evaluates every annotation for them, each time: most of what a session took to open."""
    return msgspec.structs.fields(struct)


@functools.cache
def _defaults(kind: type[_S]) -> _S:
    """A section in which nothing was chosen. Nobody else has it, so that nobody can change its lists."""
    return kind()
