"""The vectors of the conformance kit: each is what it says, and ours and other readers agree on it."""

from __future__ import annotations

import json
import re
from importlib.resources import files

import pytest

from bridge.conformance import vectors
from bridge.conformance.vectors import FILES, Vector
from macs_zenoh.errors import WireError
from macs_zenoh.protocol.decoders import FrameDecoder
from macs_zenoh.protocol.messages import Metadata, decode_management
from macs_zenoh.protocol.tcp_agent import Rejected, TcpAgent
from macs_zenoh.protocol.wire import Frame, encode_frame, split_message
from tests.unit.test_docs import page

ALL = [vector for file in FILES for vector in vectors.read(file)]


def ids(vector: Vector) -> str:
    return f"{vector.file}.{vector.name}"


@pytest.mark.parametrize("file", FILES)
def test_hex_is_made_of_the_parts(file: str) -> None:
    """Each file is as `python -m bridge.conformance.vectors` writes it, and its names are there once."""
    text = files("bridge.conformance").joinpath(f"vectors/{file}.json").read_text(encoding="utf-8")
    assert text == vectors.written(file)
    names = [vector.name for vector in vectors.read(file)]
    assert len(names) == len(set(names)) > 5


@pytest.mark.parametrize("vector", [v for v in ALL if not v.file.startswith("bad")], ids=ids)
def test_good_vectors_are_read(vector: Vector) -> None:
    """Our readers take every vector that is meant to be taken, whole and byte by byte."""
    if vector.is_message:
        metadata, _ = split_message(vector.example)
        Metadata.decode(metadata)
        return
    for pieces in ([vector.example], [bytes([each]) for each in vector.example]):
        decoder = FrameDecoder()
        (frame,) = [frame for piece in pieces for frame in decoder.feed(piece)]
        assert isinstance(frame, Frame)
        if frame.has_management:
            decode_management(frame.management)
        else:
            Metadata.decode(frame.metadata)
            header = frame.header
            again = encode_frame(header.agent_type, header.ids, header.groups, message=bytes(frame.message))
            assert sorted(again) == sorted(vector.example)  # but for which slots are used


@pytest.mark.parametrize("vector", vectors.read("bad_frames"), ids=ids)
def test_bad_frames_are_refused(vector: Vector) -> None:
    """Our state machine refuses what it alone can refuse; what depends on others is for the gateway."""
    if vector.name in {"router_only_welcome", "router_only_gone"}:
        return
    agent = TcpAgent(7, 42, 0.0)
    agent.receive(vectors.fill("headset_frames", "configuration"), 0.0)
    events = agent.receive(vector.example, 1.0)
    assert any(isinstance(event, Rejected) for event in events), events
    assert (agent.state.value == "gone") is (vector.marks["costs"] == "connection")


@pytest.mark.parametrize("vector", vectors.read("bad_messages"), ids=ids)
def test_bad_messages_are_marked(vector: Vector) -> None:
    """Each says whether the existing headset goes deaf on it; what cannot be read at all does that to it."""
    assert isinstance(vector.marks["deafens_existing"], bool)
    try:
        Metadata.decode(split_message(vector.example)[0])
    except WireError:
        assert vector.marks["deafens_existing"]


def test_other_values_take_the_place_of_the_example_s() -> None:
    """A value that is given stands in the header and in the JSON, and sizes are its own."""
    (frame,) = FrameDecoder().feed(vectors.fill("headset_frames", "unicast", peer=300, id=65535, text="x" * 500))
    assert isinstance(frame, Frame)
    assert frame.header.ids == (300,)
    assert Metadata.decode(frame.metadata).sender_agent_id == 65535
    assert json.loads(bytes(frame.body)) == {"text": "x" * 500}


def test_the_page_has_every_file_and_member() -> None:
    """Each file, and each member that a vector can have, is in a table of docs/conformance.md."""
    text = page("docs/conformance.md")
    assert set(re.findall(r"^\| `(\w+)\.json` ", text, re.MULTILINE)) == set(FILES)
    members = {member for vector in ALL for member in (*vector.parts, *vector.marks)} | {"name", "about", "hex"}
    table = text.partition("| member | is |")[2].partition("\n\n")[0]
    rows = {
        name for row in re.findall(r"^\| (`[^|]+`) \|", table, re.MULTILINE) for name in re.findall(r"`(\w+)`", row)
    }
    assert rows >= members
