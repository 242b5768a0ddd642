"""Key expressions that people write, in settings and at the command line: what is wrong with one, which keys are among
its own. As Zenoh understands them, and without Zenoh; property tests hold the two together. Pure."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import lru_cache


def expression_problem(text: str) -> str | None:
    """Why Zenoh would not take this for a key expression in canonical form; None when it would."""
    if not text.strip("/"):
        return "it is empty"
    chunks = text.split("/")
    if "" in chunks:
        return "a / begins it, ends it or follows another"
    for chunk, following in zip(chunks, [*chunks[1:], ""], strict=True):
        if chunk == "**" and following in ("*", "**"):
            return f"instead of **/{following} write {'*/**' if following == '*' else '**'}"
        if chunk not in ("*", "**") and (problem := _chunk_problem(chunk)) is not None:
            return problem
    return None


def _chunk_problem(chunk: str) -> str | None:
    if forbidden := set(chunk) & set("?#"):
        return f"{min(forbidden)} is not allowed"
    if chunk == "$*":
        return "instead of $* alone write *"
    if "$*$" in chunk:
        return "nothing that begins with $ may follow $*"
    rest = chunk.replace("$*", "")
    if "*" in rest:
        return f"instead of {chunk} write {re.sub('[$*]*[*]', '$*', chunk)}: * within a chunk is $*"
    return "$ is only allowed in $*" if "$" in rest else None


@lru_cache(maxsize=1024)
def _chunks(expression: str) -> tuple[re.Pattern[str] | None, ...]:
    """The chunks of an expression as patterns; None for ``**``. ``@`` makes a chunk verbatim: no wildcard fits it,
    and one in it has no meaning."""
    return tuple(
        None
        if chunk == "**"
        else re.compile(re.escape(chunk))
        if chunk.startswith("@")
        else re.compile("(?!@)" + re.escape(chunk).replace(r"\$\*", ".*").replace(r"\*", ".*"), re.DOTALL)
        for chunk in expression.split("/")
    )


def fits(expression: str, key: str) -> bool:
    """Whether a key, one without wildcards, is among those of an expression, as Zenoh understands it."""
    reached = {0}  # how many of the expression's chunks may stand for the chunks of the key so far
    chunks = _chunks(expression)
    for chunk in key.split("/"):
        reached = _past_any(chunks, reached)
        reached = {
            at if chunks[at] is None else at + 1
            for at in reached
            if at < len(chunks) and _stands_for(chunks[at], chunk)
        }
    return len(chunks) in _past_any(chunks, reached)


def _past_any(chunks: tuple[re.Pattern[str] | None, ...], reached: set[int]) -> set[int]:
    """The same and what follows each ``**``, which may stand for nothing."""
    return reached | {at + 1 for at in reached if at < len(chunks) and chunks[at] is None}


def _stands_for(pattern: re.Pattern[str] | None, chunk: str) -> bool:
    return not chunk.startswith("@") if pattern is None else pattern.fullmatch(chunk) is not None


def begins(expression: str) -> str | None:
    """The first two chunks of an expression, as ``macs/from``; None where there are not two without wildcards."""
    chunks = expression.split("/")[:2]
    return "/".join(chunks) if len(chunks) == 2 and "*" not in "".join(chunks) else None


def distinct(keys: Iterable[str]) -> tuple[str, ...]:
    """The expressions, each once, without those that another one covers."""
    once = dict.fromkeys(keys)
    trees = {key.removesuffix("**") for key in once if key.endswith("/**")}
    covered = {key for key in once for tree in trees if key.startswith(tree) and key != f"{tree}**" and "@" not in key}
    return tuple(key for key in once if key not in covered)
