"""A fuzz target: what others put on a robot's router is read or refused with a name, and nothing else.

It stops at the first input that breaks a rule and prints it::

    python -m tests.fuzz.rmw_zenoh --seconds 60 --seed 1

Inputs are recorded tokens (with their hashes and QoS), attachments and messages, changed. The rules are in `RULES`.
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections.abc import Callable
from typing import NamedTuple

from bridge.rmw_zenoh.goals import statuses
from bridge.rmw_zenoh.robots import Robots
from bridge.settings.rmw_zenoh import RmwZenohSettings
from macs_zenoh.protocol.rmw_zenoh.attachment import ATTACHMENT_BYTES, encode_attachment, parse_attachment
from macs_zenoh.protocol.rmw_zenoh.cdr import read_text, written_text
from macs_zenoh.protocol.rmw_zenoh.graph import Graph
from macs_zenoh.protocol.rmw_zenoh.keyexpr import (
    BadName,
    BadToken,
    Endpoint,
    Node,
    data_key,
    endpoint_token,
    node_token,
    parse_token,
)
from macs_zenoh.protocol.rmw_zenoh.qos import parse_qos, written_qos
from tests.support.rmw_vectors import all_rows, tokens

TOKENS = tokens()
PROFILES = sorted({token.split("/")[12] for token in TOKENS if len(token.split("/")) > 12})
HASHES = sorted({token.split("/")[11] for token in TOKENS if len(token.split("/")) > 12})
ATTACHMENTS = [bytes.fromhex(row["attachment_hex"]) for _, row in all_rows() if row.get("attachment_hex")]
MESSAGES = [bytes.fromhex(row["payload_hex"]) for _, row in all_rows() if row.get("payload_hex")]
STRANGE = "%:,*?#$\0ü_a1-/ 9\n\u202e"


class Found(NamedTuple):
    """An input that breaks a rule."""

    data: str | bytes
    problem: Exception


def mutated(chance: random.Random, text: str) -> str:
    """A text with a piece taken out, doubled, put in or elsewhere, several times."""
    for _ in range(chance.randrange(1, 4)):
        at, size = chance.randrange(len(text) + 1), chance.randrange(12)
        piece = "".join(chance.choice(STRANGE) for _ in range(size)) * chance.choice((1, 1, 1, 400))
        text = chance.choice(
            (
                text[:at] + text[at + size :],
                text[:at] + piece + text[at:],
                text[:at] + piece + text[at + size :],
                text + text[at : at + size] * 3,
                text[at:] + text[:at],
            )
        )
    return text


def changed(chance: random.Random, data: bytes) -> bytes:
    """The same for bytes."""
    return mutated(chance, data.decode("latin-1")).encode("latin-1", "replace")


def token(text: str) -> None:
    """It is read and written again as what it says, or is a BadToken that a graph counts."""
    graph = Graph()
    found = graph.put(text)
    try:
        parsed = parse_token(text)
    except BadToken:
        assert found is None
        assert graph.malformed == 1
        return
    assert found == parsed
    again = endpoint_token(parsed) if isinstance(parsed, Endpoint) else node_token(parsed)
    if isinstance(parsed, Endpoint) and not parsed.type:
        return  # what its type was is not kept
    assert parse_token(again) == parsed
    if isinstance(parsed, Node):
        assert len(Robots(RmwZenohSettings()).look([parsed])) <= 1
    assert graph.delete(text) == parsed
    assert len(graph) == 0


def profile(text: str) -> None:
    """It is none, or written and read again as the same."""
    found = parse_qos(text)
    assert found is None or parse_qos(written_qos(found)) == found


def type_hash(text: str) -> None:
    """It makes a key of as many chunks as a key has, or is refused."""
    try:
        key = data_key(0, "/a/b", "std_msgs/msg/String", text)
    except BadName:
        return
    assert key.count("/") == 4
    assert not set(key) & set("*?#$")


def attachment(data: bytes) -> None:
    """It is whole, and is written as it was, or it is none."""
    found = parse_attachment(data)
    assert found is None or (len(data) == ATTACHMENT_BYTES and encode_attachment(*found) == data)


def message(data: bytes) -> None:
    """A text, or a ValueError; goals' statuses, no more than it has bytes."""
    try:
        text = read_text(data)
    except ValueError:
        pass
    else:
        assert len(text) <= len(data)
        assert read_text(written_text(text)) == text
    assert len(list(statuses(data))) <= len(data)


RULES: dict[str, tuple[Callable[[random.Random], str | bytes], Callable[..., None]]] = {
    "token": (lambda chance: mutated(chance, chance.choice(TOKENS)), token),
    "profile": (lambda chance: mutated(chance, chance.choice(PROFILES)), profile),
    "hash": (lambda chance: mutated(chance, chance.choice(HASHES)), type_hash),
    "attachment": (lambda chance: changed(chance, chance.choice(ATTACHMENTS)), attachment),
    "message": (lambda chance: changed(chance, chance.choice(MESSAGES)), message),
}


def run(seed: int, *, rounds: int = 1 << 62, seconds: float = 1e9) -> int | Found:
    """How many inputs were tried, or the first that breaks a rule."""
    until = time.monotonic() + seconds
    for number in range(rounds):
        if time.monotonic() > until:
            return number
        chance = random.Random(f"{seed} {number}")
        make, rule = RULES[chance.choice(list(RULES))]
        data = make(chance)
        try:
            rule(data)
        except Exception as error:  # noqa: BLE001 - whatever it is, it should not have been
            return Found(data, error)
    return rounds


def main() -> int:
    parser = argparse.ArgumentParser(description="Fuzz what is read of a robot that runs rmw_zenoh.")
    parser.add_argument("--seconds", type=float, default=10.0, help="how long to try (default: 10)")
    parser.add_argument("--seed", type=int, default=0, help="where the inputs start (default: 0)")
    arguments = parser.parse_args()
    result = run(arguments.seed, seconds=arguments.seconds)
    if isinstance(result, int):
        print(f"{result} inputs, every rule holds")
        return 0
    print(f"{type(result.problem).__name__}: {result.problem}: {result.data!r}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
