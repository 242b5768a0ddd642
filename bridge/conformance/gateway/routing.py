"""Which agents get a message, how often, and in which bytes."""

from __future__ import annotations

import asyncio
import struct

from macs_zenoh.timeouts import within

from .. import vectors
from ..agents import Agent
from ..checks import Level, NotHeld
from .scene import Scene, Trials, expect, expect_copies

TRIALS = Trials()

_LARGE_BYTES = 1 << 20
_STALLED_MESSAGES = 15


def _case(name: str, vector: str, copies: int, level: Level = Level.COMPATIBLE) -> None:
    """One headset sends, another one in the group gets so many copies."""
    about = f"{vectors.named('headset_frames', vector).about} Copies: {copies}."

    @TRIALS.add(name, about, level)
    async def _arrives(scene: Scene) -> None:
        sender, receiver = await scene.headset(), await scene.headset(scene.group)
        expect_copies(await scene.sends(sender, receiver, vector), copies)


_case("routing.by_id", "unicast", 1)
_case("routing.by_id_in_last_slot", "unicast_last_slot", 1)
_case("routing.ten_ids", "unicast_ten", 1)
_case("routing.id_of_other_type", "unicast_robot_type", 0)
_case("routing.by_group", "group", 1)
_case("routing.group_in_last_slot", "group_last_slot", 1)
_case("routing.group_of_other_type", "group_robots", 0)
_case("routing.broadcast", "broadcast", 1)
_case("routing.broadcast_ignores_names", "broadcast_named", 1)
_case("routing.one_copy_of_two_ids", "unicast_twice", 1, Level.STRICT)
_case("routing.one_copy_of_id_and_group", "unicast_and_group", 1, Level.STRICT)


@TRIALS.add("routing.not_to_others", "A message by id comes to nobody else.")
async def _not_to_others(scene: Scene) -> None:
    sender, receiver, other = [await scene.headset() for _ in range(3)]
    word = scene.word()
    await sender.say("unicast", peer=receiver.id, text=word)
    expect_copies(await scene.fence(sender, receiver, word), 1)
    expect_copies(await scene.fence(sender, other, word), 0)


@TRIALS.add("routing.not_to_other_groups", "A message to a group comes to nobody outside it.")
async def _not_to_other_groups(scene: Scene) -> None:
    sender, receiver = await scene.headset(), await scene.headset(scene.group + 1)
    expect_copies(await scene.sends(sender, receiver, "group", group=scene.group), 0)


@TRIALS.add("routing.all_of_a_group", "A message to a group comes to all who are in it.")
async def _all_of_group(scene: Scene) -> None:
    sender = await scene.headset()
    word = scene.word()
    receivers = [await scene.headset(scene.group) for _ in range(4)]
    await sender.say("group", group=scene.group, text=word)
    for receiver in receivers:
        expect_copies(await scene.fence(sender, receiver, word), 1)


@TRIALS.add("routing.to_itself", "Who names its own id gets the message.")
async def _to_itself(scene: Scene) -> None:
    agent = await scene.headset()
    expect_copies(await scene.sends(agent, agent, "unicast_itself"), 1)


@TRIALS.add("routing.no_echo_of_broadcast", "A broadcast does not come back to who sent it.", Level.STRICT)
async def _no_echo(scene: Scene) -> None:
    agent = await scene.headset()
    expect_copies(await scene.sends(agent, agent, "broadcast"), 0)


@TRIALS.add("routing.no_echo_of_group", "Nor does a message to a group that its sender is in.", Level.STRICT)
async def _no_group_echo(scene: Scene) -> None:
    agent = await scene.headset(scene.group)
    expect_copies(await scene.sends(agent, agent, "group"), 0)


# -- bytes -----------------------------------------------------------------------------------------------------------


@TRIALS.add("frames.bytes_unchanged", "The message arrives byte by byte as it was sent, and without the header.")
async def _unchanged(scene: Scene) -> None:
    sender, receiver = await scene.headset(), await scene.headset()
    word = scene.word()
    frame = sender.frame("unicast_strange_order", peer=receiver.id, text=word)
    arrived = await scene.puts(sender, receiver, frame, word)
    expect_copies(arrived, 1)
    expect(arrived[0].raw == frame[39:], f"{frame[39:]!r} was sent, {arrived[0].raw!r} came")


async def _cut(scene: Scene, *places: int) -> None:
    """A message whose frame is cut at these places (negative from its end) arrives, and the next one as well."""
    sender, receiver = await scene.headset(), await scene.headset()
    word = scene.word()
    frame = sender.frame("unicast", peer=receiver.id, text=word)
    await sender.send(frame, [place % len(frame) for place in places])
    expect_copies(await scene.fence(sender, receiver, word), 1)


@TRIALS.add("frames.cut_in_header", "A frame may be cut within its header.")
async def _cut_header(scene: Scene) -> None:
    await _cut(scene, 1, 20, 36)


@TRIALS.add("frames.cut_behind_header", "Or behind it.")
async def _cut_behind(scene: Scene) -> None:
    await _cut(scene, 39)


@TRIALS.add("frames.cut_in_sizes", "Or within the size of its metadata.")
async def _cut_sizes(scene: Scene) -> None:
    await _cut(scene, 41, 43)


@TRIALS.add("frames.cut_in_data", "Or within its data.")
async def _cut_data(scene: Scene) -> None:
    await _cut(scene, -5, -1)


@TRIALS.add("frames.bytewise", "It may come byte by byte.")
async def _bytewise(scene: Scene) -> None:
    sender, receiver = await scene.headset(), await scene.headset()
    word = scene.word()
    frame = sender.frame("unicast", peer=receiver.id, text=word)
    await sender.send(frame, range(1, len(frame)))
    expect_copies(await scene.fence(sender, receiver, word), 1)


@TRIALS.add("frames.many_at_once", "Many frames may come at once, and arrive in their order.")
async def _many(scene: Scene) -> None:
    sender, receiver = await scene.headset(), await scene.headset()
    words = [scene.word() for _ in range(50)]
    await sender.send(b"".join(sender.frame("unicast", peer=receiver.id, text=word) for word in words))
    arrived = await scene.fence(sender, receiver)
    expect([message.json().get("text") for message in arrived] == words, f"{len(arrived)} came, or in another order")


@TRIALS.add("frames.order", "Messages of one agent to another arrive in order.")
async def _order(scene: Scene) -> None:
    sender, receiver = await scene.headset(), await scene.headset()
    words = [scene.word() for _ in range(20)]
    for word in words:
        await sender.say("unicast", peer=receiver.id, text=word)
        await asyncio.sleep(0)
    arrived = await scene.fence(sender, receiver)
    expect([message.json().get("text") for message in arrived] == words, f"{len(arrived)} came, or in another order")


@TRIALS.add("frames.no_data", "A message may be without data.")
async def _no_data(scene: Scene) -> None:
    sender, receiver = await scene.headset(), await scene.headset()
    arrived = await scene.puts(sender, receiver, sender.frame("unicast_no_data", peer=receiver.id))
    expect_copies([message for message in arrived if message.fields.get("senderAgentId") == sender.id], 1)


def with_data(frame: bytes, data: bytes) -> bytes:
    """A frame without management data, with other data in its message."""
    metadata_bytes = struct.unpack_from("<I", frame, 39)[0]
    message = frame[39 : 43 + metadata_bytes] + struct.pack("<I", len(data)) + data
    return frame[:35] + struct.pack("<I", len(message)) + message


@TRIALS.add("frames.large", "A message of 1 MiB arrives whole.")
async def _large(scene: Scene) -> None:
    sender, receiver = await scene.headset(), await scene.headset()
    word = scene.word()
    data = word.encode() + bytes(_LARGE_BYTES)
    await sender.send(with_data(sender.frame("unicast", peer=receiver.id), data))
    arrived = await scene.fence(sender, receiver, word)
    expect_copies(arrived, 1)
    expect(arrived[0].data == data, f"{len(arrived[0].data)} bytes came, and they are others")


async def _senders(scene: Scene, vector: str) -> None:
    sender, receiver = await scene.headset(), await scene.headset()
    arrived = await scene.sends(sender, receiver, vector)
    expect_copies(arrived, 1)
    named = (arrived[0].fields.get("senderAgentType"), arrived[0].fields.get("senderAgentId"))
    expect(named == (2, sender.id), f"it says {named}, true is (2, {sender.id})")


@TRIALS.add("sender.true", "Who sent a message is said in it.")
async def _true(scene: Scene) -> None:
    await _senders(scene, "unicast")


@TRIALS.add("sender.false_is_mended", "Who names another as the sender does not speak for it.", Level.STRICT)
async def _false(scene: Scene) -> None:
    await _senders(scene, "unicast_false_sender")


@TRIALS.add("sender.early_is_mended", "The id 0 of nodes made before the handshake is put right.", Level.STRICT)
async def _early(scene: Scene) -> None:
    await _senders(scene, "unicast_early_sender")


# -- whoever does not read -------------------------------------------------------------------------------------------


async def _send_large(scene: Scene, sender: Agent, receiver: Agent) -> None:
    frame = with_data(sender.frame("unicast", peer=receiver.id), bytes(_LARGE_BYTES))
    for _ in range(_STALLED_MESSAGES):
        await sender.send(frame)


@TRIALS.add("stalled.sender_goes_on", "15 MiB to a headset that reads nothing do not stop their sender.")
async def _sender_goes_on(scene: Scene) -> None:
    sender, stalled = await scene.headset(), await scene.headset()
    stalled.pause()
    try:
        await within(_send_large(scene, sender, stalled), 4 * scene.patience_s)
    except asyncio.TimeoutError:
        raise NotHeld("its router did not read any more: existing headsets freeze then") from None
    await scene.online(sender)


@TRIALS.add("stalled.others_go_on", "Nor do they hold up what goes to others.")
async def _others_go_on(scene: Scene) -> None:
    sender, stalled, other, third = [await scene.headset() for _ in range(4)]
    stalled.pause()
    await _send_large(scene, sender, stalled)
    expect_copies(await scene.sends(other, third, "unicast"), 1)
