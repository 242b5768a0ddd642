"""Every recorded byte of the existing programs is understood, however it arrives."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from macs_zenoh.errors import BadField, BadJson, BadSizes, UnknownManager, WireError
from macs_zenoh.protocol import messages
from macs_zenoh.protocol.decoders import FrameDecoder, MessageDecoder
from macs_zenoh.protocol.messages import Management, Metadata, decode_data, decode_management, encode_management
from macs_zenoh.protocol.wire import MACS, encode_frame, encode_message, parse_frame, split_message
from tests.support.recordings import BY_NAME, RECORDINGS, Recording, cut_around, one_by_one, reading

KINDS: dict[str, type[Management]] = {
    "AgentConfigurer": messages.Welcome,
    "AgentclientConfigurer": messages.Configuration,
    "HeartbeatHandler": messages.Heartbeat,
    "OnlineAgentsGetter": messages.OnlineRequest,
    "RosAgentNodeRegistrationForwarder": messages.Registration,
    "InterfaceNodeAdder": messages.AddNode,
    "InterfaceNodeRemover": messages.RemoveNode,
    "RosAgentSubscriberDataForwarder": messages.StreamData,
    "UnityAgentclientRemover": messages.GoOffline,
    "PrunedUnityAgentsInterfaceNodesCleaner": messages.AgentsGone,
    "FunctionalityGetter": messages.FunctionalityRequest,
}
"""The managers of the protocol page, section 4."""

IN_THE_DATA = {
    "AgentConfigurer",
    "InterfaceNodeAdder",
    "InterfaceNodeRemover",
    "PrunedUnityAgentsInterfaceNodesCleaner",
}
"""Those whose JSON is the data of a message that names them in its metadata."""

UNUSABLE: dict[str, type[WireError]] = {
    "router/fault_mgmt_bad_json": BadJson,
    "router/fault_mgmt_without_messageManager": BadField,
    "router/fault_unknown_message_manager": UnknownManager,
    "router/fault_inner_size_lie": BadSizes,
    "router/fault_zero_size_message": BadSizes,
}
"""What is wrong with one frame in these recordings; every other frame is good."""


def recorded(*, having: Callable[[Recording], object]) -> pytest.MarkDecorator:
    """A test for each recording that has something to test."""
    found = [recording for recording in RECORDINGS if having(recording)]
    return pytest.mark.parametrize("recording", found, ids=lambda recording: recording.name)


def management_of(recording: Recording) -> list[bytes]:
    """All management data in a recording, where it is good."""
    if recording.name in UNUSABLE:
        return []
    return [frame.management for frame in map(parse_frame, recording.frames) if frame.has_management]


def data_of(recording: Recording) -> list[tuple[str, bytes]]:
    """The JSON in the data parts of a recording, each with the manager that its metadata names."""
    parts = [(parse_frame(data).metadata, parse_frame(data).body) for data in good_frames(recording)]
    parts += [split_message(data) for data in recording.messages]
    named = [(reading(metadata)["message_manager"], bytes(body)) for metadata, body in parts if metadata]
    return [(manager, body) for manager, body in named if manager in IN_THE_DATA]


def good_frames(recording: Recording) -> list[bytes]:
    """The frames whose sizes add up, taken apart with nothing but struct."""
    found = []
    for data in recording.frames:
        management, message = struct.unpack_from("<II", data, 31)
        inner = data[39 + management :]
        if len(inner) == message >= 8 and len(inner) == 8 + sum(inner_sizes(inner)):
            found.append(data)
    return found


def inner_sizes(message: bytes) -> tuple[int, int]:
    """Sizes of metadata and data as the message declares them."""
    (metadata,) = struct.unpack_from("<I", message)
    (data,) = struct.unpack_from("<I", message, 4 + metadata)
    return metadata, data


def assert_says(value: msgspec.Struct, said: dict[str, Any]) -> None:
    """Each field is what the JSON says, or its default where the JSON is silent."""
    for field in msgspec.structs.fields(value):
        found = getattr(value, field.name)
        if isinstance(found, msgspec.Struct):
            assert_says(found, said[field.name])
            continue
        if found is msgspec.UNSET:
            assert field.name not in said
            continue
        found = msgspec.to_builtins(found)
        if field.name in said:
            assert found == said[field.name], field.name
        else:
            default = field.default_factory() if field.default is msgspec.NODEFAULT else field.default
            assert found == msgspec.to_builtins(default), field.name


def decode_frames(pieces: list[bytes]) -> list[bytes | None]:
    """The frames in a stream that comes in these pieces; None in the place of one whose sizes do not add up."""
    decoder = FrameDecoder()
    found = [one for piece in pieces for one in decoder.feed(piece)]
    assert decoder.error is None
    return [None if isinstance(one, BadSizes) else bytes(one.data) for one in found]


def decoded(recording: Recording) -> list[bytes | None]:
    """What comes of its frames."""
    good = good_frames(recording)
    return [data if data in good else None for data in recording.frames]


def decode_messages(pieces: list[bytes]) -> list[bytes]:
    """The messages in a stream that comes in these pieces."""
    decoder = MessageDecoder()
    return [message for piece in pieces for message in decoder.feed(piece)]


def test_every_kind_of_recording_is_there() -> None:
    """The router's, the headset's and the faulty recordings are all found, and hold frames and messages."""
    faults = [recording for recording in RECORDINGS if recording.is_fault]
    assert len(faults) >= 19
    assert set(UNUSABLE) <= {recording.name for recording in faults}
    assert sum(recording.name.startswith("headset/") for recording in RECORDINGS) >= 24
    assert sum(recording.name.startswith("router/") for recording in RECORDINGS) >= 59
    assert sum(len(recording.frames) for recording in RECORDINGS) >= 500
    assert sum(len(recording.messages) for recording in RECORDINGS) >= 230


def test_the_recordings_use_every_manager_that_agents_send() -> None:
    """No kind of management data that existing agents send goes without a recording."""
    used = {
        reading(parse_frame(data).management)["message_manager"]
        for recording in RECORDINGS
        if not recording.is_fault
        for data in recording.frames
        if parse_frame(data).has_management
    }
    assert used == {
        "AgentclientConfigurer",
        "HeartbeatHandler",
        "OnlineAgentsGetter",
        "RosAgentNodeRegistrationForwarder",
        "RosAgentSubscriberDataForwarder",
        "UnityAgentclientRemover",
    }


# -- frames ----------------------------------------------------------------------------------------------------------


@recorded(having=lambda recording: recording.frames)
def test_frames_come_whole_in_any_pieces(recording: Recording) -> None:
    """A recorded stream gives the recorded frames at once and byte by byte."""
    stream = b"".join(recording.frames)
    assert decode_frames([stream]) == decoded(recording)
    assert decode_frames(one_by_one(stream)) == decoded(recording)


@recorded(having=lambda recording: recording.frames)
def test_frames_may_be_cut_around_every_boundary(recording: Recording) -> None:
    """A frame cut at or beside the end of any of its parts is the same frame."""
    for data, frame in zip(recording.frames, decoded(recording), strict=True):
        management, message = struct.unpack_from("<II", data, 31)
        at = 39 + management
        boundaries = [1, 21, 31, 35, 39, at, at + 4]
        if message >= 8:
            metadata = struct.unpack_from("<I", data, at)[0]
            boundaries += [at + 4 + metadata, at + 8 + metadata]
        for pieces in cut_around(data, boundaries):
            assert decode_frames(pieces) == [frame], len(pieces[0])


@recorded(having=lambda recording: recording.frames)
def test_frames_end_where_they_end(recording: Recording) -> None:
    """Bytes behind a frame are the beginning of the next one and no part of this one."""
    for data, frame in zip(recording.frames, decoded(recording), strict=True):
        for trailing in (b"\0", bytes(38), data[:38], data[:-1]):
            assert decode_frames([data + trailing]) == [frame]
        with pytest.raises(BadSizes):
            parse_frame(data + b"\0")
        with pytest.raises(BadSizes):
            parse_frame(data[:-1])


@recorded(having=lambda recording: recording.frames)
def test_frames_are_taken_apart_at_their_offsets(recording: Recording) -> None:
    """Header, management data, metadata and body of a frame are the bytes at the offsets of the protocol."""
    for data in good_frames(recording):
        fields = struct.unpack_from("<B10H10BII", data)
        frame = parse_frame(data)
        at = 39 + fields[-2]
        metadata, body = inner_sizes(data[at:])
        assert frame.header.agent_type == fields[0]
        assert frame.header.ids == tuple(filter(None, fields[1:11]))
        assert frame.header.groups == tuple(filter(None, fields[11:21]))
        assert (frame.header.management_bytes, frame.header.message_bytes) == fields[-2:]
        assert frame.destination == data[:31]
        assert frame.management == data[39:at]
        assert bytes(frame.message) == data[at:]
        assert frame.metadata == data[at + 4 : at + 4 + metadata]
        assert bytes(frame.body) == data[len(data) - body :]


@recorded(having=lambda recording: recording.frames)
def test_frames_are_written_again_byte_for_byte(recording: Recording) -> None:
    """A frame built from what was read is the recorded one, but that empty slots move to the end."""
    for data in good_frames(recording):
        frame = parse_frame(data)
        header = frame.header
        message = encode_message(frame.metadata, frame.body)
        again = encode_frame(
            header.agent_type, header.ids, header.groups, management=frame.management, message=message
        )
        assert message == bytes(frame.message)
        assert MACS.unpack(again) == header
        if recording.name == "router/fault_zero_ids_between":
            assert again[31:] == data[31:]
        else:
            assert again == data


@recorded(having=lambda recording: recording.frames)
def test_bad_frames_are_refused_one_by_one(recording: Recording) -> None:
    """One frame in some of the faulty recordings cannot be used and says why; every other frame can."""
    problems = []
    for data in recording.frames:
        try:
            frame = parse_frame(data)
            if frame.has_management:
                decode_management(frame.management)
            if frame.metadata:
                Metadata.decode(frame.metadata)
        except WireError as error:
            problems.append(type(error))
    assert problems == ([UNUSABLE[recording.name]] if recording.name in UNUSABLE else [])


# -- messages --------------------------------------------------------------------------------------------------------


@recorded(having=lambda recording: recording.messages)
def test_messages_come_whole_in_any_pieces(recording: Recording) -> None:
    """A recorded stream to an agent gives the recorded messages at once, byte by byte and cut at every boundary."""
    stream = b"".join(recording.messages)
    assert decode_messages([stream]) == recording.messages
    assert decode_messages(one_by_one(stream)) == recording.messages
    for data in recording.messages:
        metadata, _ = inner_sizes(data)
        for pieces in cut_around(data, [4, 4 + metadata, 8 + metadata]):
            assert decode_messages(pieces) == [data]
        for trailing in (b"\0", bytes(7), data[:-1]):
            assert decode_messages([data + trailing]) == [data]


@recorded(having=lambda recording: recording.messages)
def test_messages_are_taken_apart_and_written_again(recording: Recording) -> None:
    """Metadata and data of a message are where its sizes say, and make the same message again."""
    for data in recording.messages:
        metadata_bytes, data_bytes = inner_sizes(data)
        metadata, body = split_message(data)
        assert metadata == data[4 : 4 + metadata_bytes]
        assert bytes(body) == data[len(data) - data_bytes :]
        assert encode_message(metadata, body) == data
        for wrong in (data + b"\0", data[:-1], data[:7], b""):
            with pytest.raises(BadSizes):
                split_message(wrong)


# -- JSON ------------------------------------------------------------------------------------------------------------


@recorded(having=lambda recording: recording.frames)
def test_metadata_says_what_its_json_says(recording: Recording) -> None:
    """Every recorded metadata decodes to the values that another JSON parser reads in it."""
    sent = [parse_frame(data).metadata for data in good_frames(recording)]
    received = [split_message(data)[0] for data in recording.messages]
    for raw in filter(None, sent + received):
        assert_says(Metadata.decode(raw), reading(raw))


@recorded(having=management_of)
def test_management_data_says_what_its_json_says(recording: Recording) -> None:
    """Every recorded management data decodes to the kind it names, with the values another parser reads in it."""
    for raw in management_of(recording):
        value = decode_management(raw)
        said = reading(raw)
        assert type(value) is KINDS[said["message_manager"]]
        assert_says(value, said)


@recorded(having=management_of)
def test_management_data_is_written_as_it_was_said(recording: Recording) -> None:
    """What we write for recorded management data is compact and says the same."""
    for raw in management_of(recording):
        value = decode_management(raw)
        again = encode_management(value)
        assert b'": ' not in again
        assert set(reading(raw)) <= set(reading(again))
        assert type(value) is KINDS[reading(again)["message_manager"]]
        assert_says(value, reading(again))


@recorded(having=data_of)
def test_json_in_the_data_says_what_it_says(recording: Recording) -> None:
    """The data of a message that names a manager decodes to that kind, with the values another parser reads."""
    for manager, body in data_of(recording):
        assert_says(decode_data(KINDS[manager], body), reading(body))


def test_the_answer_to_who_is_online_is_read() -> None:
    """The recorded answers to a headset's question decode to the ids in them."""
    for name in ("headset/online_agents", "headset/noros2_online_agents", "router/online_agents"):
        answers = [split_message(data) for data in BY_NAME[name].messages]
        bodies = [bytes(body) for metadata, body in answers if reading(metadata)["message_manager"] == ""]
        assert bodies
        for body in bodies:
            assert_says(decode_data(messages.OnlineReply, body), reading(body))
