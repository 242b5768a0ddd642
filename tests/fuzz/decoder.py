"""A fuzz target: whatever bytes an agent sends, there are frames and events, or a WireError, and nothing else.

Run it for as long as you like; it stops at the first input that breaks a rule and prints it::

    python -m tests.fuzz.decoder --seconds 60 --seed 1
    python -m tests.fuzz.decoder --replay 00ff...

Inputs are recorded frames, changed: bytes, sizes, JSON values and keys. The rules are in `check`.
"""

from __future__ import annotations

import argparse
import json
import random
import struct
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from macs_zenoh.errors import BadSizes, FrameTooLarge, TooLong, WireError
from macs_zenoh.protocol.decoders import FrameDecoder, MessageDecoder
from macs_zenoh.protocol.messages import Metadata, decode_management
from macs_zenoh.protocol.tcp_agent import Event, Left, Limits, Rejected, Sent, State, Streamed, TcpAgent
from macs_zenoh.protocol.wire import Frame, encode_frame, encode_message, parse_frame, split_message

VECTORS = Path(__file__).parents[1] / "vectors"
LIMIT = 1 << 20
AGENT_ID = 7


class Broken(Exception):
    """A rule does not hold."""


class Found(NamedTuple):
    """An input that breaks a rule."""

    data: bytes
    problem: Exception


# -- rules -----------------------------------------------------------------------------------------------------------


def check(data: bytes, pieces: list[bytes]) -> None:
    """Every rule, for a stream that comes whole and in pieces. Raises Broken, or whatever should not have been."""
    whole, cut = _frames([data]), _frames(pieces)
    _must(whole == cut, "the same frames in any pieces")
    at = 0
    for raw in whole:  # between them are those that were too long
        found = data.find(raw, at)
        _must(found >= 0, "frames are the stream")
        at = found + len(raw)
    for raw in whole:
        _check_frame(raw)
    _check_messages(data, pieces)
    for agent_type in (0, 1, 2):
        events, again = _events(agent_type, [data]), _events(agent_type, pieces)
        _must(_told(events) == _told(again), "the same events in any pieces")


def _frames(pieces: list[bytes]) -> list[bytes]:
    decoder = FrameDecoder(LIMIT)
    found = [bytes(one.data) for piece in pieces for one in decoder.feed(piece) if isinstance(one, Frame)]
    _must(all(len(raw) <= LIMIT for raw in found), "no frame above the limit")
    return found


def _check_frame(raw: bytes) -> None:
    with suppress(BadSizes, TooLong):
        frame = parse_frame(raw)
        _must(encode_message(frame.metadata, frame.body) == bytes(frame.message), "a message is its parts")
        for decode, part in ((decode_management, frame.management), (Metadata.decode, frame.metadata)):
            with suppress(WireError):
                decode(part)


def _check_messages(data: bytes, pieces: list[bytes]) -> None:
    results = []
    for stream in ([data], pieces):
        decoder = MessageDecoder(LIMIT)
        found: list[bytes] = []
        with suppress(FrameTooLarge):
            for piece in stream:
                found += decoder.feed(piece)
            results.append(found)
        for message in found:
            split_message(message)
    _must(len(results) != 2 or results[0] == results[1], "the same messages in any pieces")


def _events(agent_type: int, pieces: list[bytes]) -> list[Event]:
    peer = TcpAgent(AGENT_ID, 1, 0.0, limits=Limits(max_frame_bytes=LIMIT))
    if agent_type:
        raw = b'{"agentType":%d,"agentId":7,"messageManager":"AgentclientConfigurer"}' % agent_type
        peer.receive(encode_frame(management=raw), 0.0)
    events = [event for piece in pieces for event in peer.receive(piece, 1.0)]
    for event in events:
        if isinstance(event, Sent | Streamed):
            metadata = json.loads(event.frame.metadata.decode("utf-8"))
            sender = (metadata["senderAgentType"], metadata["senderAgentId"])
            _must(sender == (peer.agent_type, AGENT_ID), "what is forwarded has its true sender")
    _must(not any(isinstance(event, Left) for event in events[:-1]), "nothing comes after leaving")
    _must((peer.state is State.GONE) == (bool(events) and isinstance(events[-1], Left)), "who is gone has left")
    return events


def _told(events: list[Event]) -> list[object]:
    """What events say, however they were gathered: frames that begin alike and come at once are one event."""
    told: list[object] = []
    for event in events:
        if isinstance(event, Sent | Streamed):
            told += [(type(event), bytes(frame.data)) for frame in event.frame.each()]
        elif isinstance(event, Rejected):
            told.append(Rejected)  # of several things that are wrong with a frame, pieces may show another first
        else:
            told.append(repr(event))
    return told


def _must(holds: bool, rule: str) -> None:
    if not holds:
        raise Broken(rule)


# -- inputs ----------------------------------------------------------------------------------------------------------


def recorded() -> list[bytes]:
    """Every frame that an existing agent was recorded to send."""
    return [
        bytes.fromhex(row["hex"])
        for path in sorted(VECTORS.glob("*/*.json"))
        for row in json.loads(path.read_text(encoding="utf-8"))
        if row["dir"] == "agent->router" and row["hex"]
    ]


VALUES: list[Any] = [None, True, -1, 0, 1, 255, 256, 65536, 1 << 32, 1 << 64, 10**30, 0.5, 1e300, "", "x", "\0", "ä"]
VALUES += [[], [1], [-1], ["1"], {}, {"1": [1]}, {"": []}, {"2": [65536]}, {"1" * 5000: [1]}, "y" * 5000]
RAW = [b"[" * 3000 + b"]" * 3000, b'{"a":' * 3000 + b"1" + b"}" * 3000, b"1" * 5000, b'"\xff"', b'"\\ud800"', b"1e999"]
NUMBERS = [0, 1, 7, 8, 38, 39, 255, 256, 0x7FFFFFFF, 0x80000000, 0xFFFFFFF0, 0xFFFFFFFF]


def _change_bytes(data: bytes, chance: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(chance.choice((1, 1, 2, 5))):
        at = chance.randrange(len(changed) + 1)
        match chance.randrange(3):
            case 0:
                changed[at : at + 1] = chance.randbytes(1)
            case 1:
                del changed[at : at + chance.randint(1, 8)]
            case _:
                changed[at:at] = chance.randbytes(chance.randint(1, 8))
    return bytes(changed)


def _change_size(data: bytes, chance: random.Random) -> bytes:
    """Let one of the four sizes lie, by a little or by a lot."""
    at = chance.choice((31, 35, 39, max(39, len(data) - 4)))
    if len(data) < at + 4:
        return data
    (size,) = struct.unpack_from("<I", data, at)
    lie = chance.choice([*NUMBERS, size + 1, size - 1, size + chance.randrange(200)]) & 0xFFFFFFFF
    return data[:at] + struct.pack("<I", lie) + data[at + 4 :]


def _change_json(data: bytes, chance: random.Random) -> bytes:
    """Change a key or a value in the management data, the metadata or the data; sizes stay true."""
    try:
        frame = parse_frame(data)
    except (BadSizes, TooLong):
        return data
    parts = [frame.management, frame.metadata, bytes(frame.body)]
    which = chance.choice([n for n, part in enumerate(parts) if part.startswith(b"{")] or [0])
    parts[which] = _change_object(parts[which], chance)
    header = frame.header
    message = encode_message(parts[1], parts[2])
    return encode_frame(header.agent_type, header.ids, header.groups, management=parts[0], message=message)


def _change_object(raw: bytes, chance: random.Random) -> bytes:
    try:
        fields = json.loads(raw)
    except (ValueError, RecursionError):
        return raw
    if not isinstance(fields, dict) or not fields:
        return raw
    key = chance.choice(sorted(fields))
    match chance.randrange(5):
        case 0:
            del fields[key]
        case 1:
            fields[key] = chance.choice(VALUES)
        case 2:
            fields[key[:1].upper() + key[1:]] = chance.choice([fields.pop(key), chance.choice(VALUES)])
        case 3:
            fields[chance.choice(["new", "Sender_agent_id", "messagemanager"])] = chance.choice(VALUES)
        case _:
            fields[chance.choice([key, "new"])] = "@"
            return json.dumps(fields).encode().replace(b'"@"', chance.choice(RAW))
    return json.dumps(fields).encode()


CHANGES: list[Callable[[bytes, random.Random], bytes]] = [_change_bytes, _change_size, _change_json, _change_json]


def invent(seeds: list[bytes], chance: random.Random) -> tuple[bytes, list[bytes]]:
    """A stream of a few frames, most of them changed, and the same cut into pieces."""
    frames = []
    for _ in range(chance.randint(1, 4)):
        data = chance.choice(seeds)
        for _ in range(chance.choice((0, 1, 1, 2, 3))):
            data = chance.choice(CHANGES)(data, chance)
        frames.append(data)
    stream = b"".join(frames)
    at = sorted(chance.randrange(len(stream) + 1) for _ in range(chance.choice((0, 1, 3, 10))))
    return stream, [stream[start:end] for start, end in zip([0, *at], [*at, len(stream)], strict=True)]


def run(seed: int, *, rounds: int | None = None, seconds: float | None = None) -> Found | int:
    """Try inputs until a rule breaks or it is time to stop. Returns that input, or how many were tried."""
    seeds = [data for data in recorded() if len(data) < 2000]
    chance = random.Random(seed)
    end = None if seconds is None else time.monotonic() + seconds
    tried = 0
    while (rounds is None or tried < rounds) and (end is None or time.monotonic() < end):
        data, pieces = invent(seeds, chance)
        try:
            check(data, pieces)
        except Exception as problem:  # noqa: BLE001 - any exception at all is what is looked for
            return Found(data, problem)
        tried += 1
    return tried


def shrink(found: Found, *, seconds: float = 5.0) -> Found:
    """A smaller input with the same kind of problem, as far as leaving parts out and the time go."""
    end = time.monotonic() + seconds
    size = len(found.data) // 2
    while size and time.monotonic() < end:
        for at in range(0, len(found.data), size):
            data = found.data[:at] + found.data[at + size :]
            try:
                check(data, _one_by_one(data))
            except Exception as problem:  # noqa: BLE001 - likewise
                if type(problem) is type(found.problem):
                    found = Found(data, problem)
                    break
        else:
            size //= 2
    return found


def _one_by_one(data: bytes) -> list[bytes]:
    return [data[at : at + 1] for at in range(len(data))]


def main() -> int:
    """Fuzz for a time, or replay one input."""
    parser = argparse.ArgumentParser(description="Fuzz the decoders and the protocol of one TCP agent.")
    parser.add_argument("--seconds", type=float, default=10.0, help="how long to try (default: 10)")
    parser.add_argument("--seed", type=int, default=0, help="where the inputs start (default: 0)")
    parser.add_argument("--replay", metavar="HEX", help="check this one input, whole and byte by byte")
    arguments = parser.parse_args()
    if arguments.replay:
        data = bytes.fromhex(arguments.replay)
        check(data, _one_by_one(data))
        print("every rule holds")
        return 0
    result = run(arguments.seed, seconds=arguments.seconds)
    if isinstance(result, int):
        print(f"{result} inputs, every rule holds")
        return 0
    result = shrink(result)
    print(f"{type(result.problem).__name__}: {result.problem}", file=sys.stderr)
    print(f"python -m tests.fuzz.decoder --replay {result.data.hex()}")
    return 1


if __name__ == "__main__":
    sys.exit(main())
