"""What a router must not pass on, and must outlive: one check for each vector of ``bad_frames``."""

from __future__ import annotations

from .. import vectors
from ..checks import Level, NotHeld
from ..vectors import Vector
from .routing import with_data
from .scene import Scene, Trials, expect, expect_copies

TRIALS = Trials()


async def costs_a_frame(scene: Scene, vector: Vector) -> None:
    """Nothing of it arrives, and both connections go on. Raises NotHeld."""
    sender, receiver = await scene.headset(), await scene.headset(scene.group)
    word = scene.word()
    values: dict[str, vectors.Value] = {"id": sender.id, "request": sender.request, "robot": sender.id, "group": 0}
    try:
        arrived = await scene.puts(sender, receiver, vector.fill({**values, "peer": receiver.id, "text": word}))
    except NotHeld as error:
        raise NotHeld(f"after it nothing goes through: {error}") from None
    expect_copies(arrived, 0)
    await scene.settled(sender)
    await scene.settled(receiver)


async def costs_a_connection(scene: Scene, vector: Vector) -> None:
    """The sender's connection ends, nobody else's. Raises NotHeld."""
    sender, receiver = await scene.headset(), await scene.headset()
    await sender.send(vector.fill({"id": sender.id, "peer": receiver.id}))
    await sender.until_ended()
    expect_copies(await scene.sends(await scene.headset(), receiver, "unicast"), 1)


def _trial(vector: Vector) -> None:
    @TRIALS.add(f"bad.{vector.name}", f"{vector.about} It costs that {vector.marks['costs']}.", Level.STRICT)
    async def _outlives(scene: Scene) -> None:
        if vector.marks["costs"] == "connection":
            await costs_a_connection(scene, vector)
        else:
            await costs_a_frame(scene, vector)


for _vector in vectors.read("bad_frames"):
    _trial(_vector)


@TRIALS.add("bad.nested_deeply", "Metadata with 20 000 lists in each other. It costs that frame.", Level.STRICT)
async def _nested(scene: Scene) -> None:
    sender, receiver = await scene.headset(), await scene.headset()
    metadata = b'{"senderAgentType":2,"x":' + b"[" * 20_000 + b"]" * 20_000 + b"}"
    frame = bytearray(with_data(sender.frame("unicast", peer=receiver.id), b""))
    message = len(metadata).to_bytes(4, "little") + metadata + bytes(4)
    frame[35:] = len(message).to_bytes(4, "little") + message
    expect_copies(await scene.puts(sender, receiver, bytes(frame)), 0)
    await scene.settled(sender)


@TRIALS.add("bad.many_after_another", "A hundred bad frames in a row cost those frames.", Level.STRICT)
async def _many(scene: Scene) -> None:
    sender, receiver = await scene.headset(), await scene.headset()
    bad = vectors.named("bad_frames", "metadata_no_json").fill({"peer": receiver.id})
    arrived = await scene.puts(sender, receiver, bad * 100)
    expect(not arrived, f"{len(arrived)} came")
    await scene.settled(sender)


@TRIALS.add("bad.strangers", "Ids that nobody has cost nothing: what follows goes through.", Level.STRICT)
async def _strangers(scene: Scene) -> None:
    sender, receiver = await scene.headset(), await scene.headset()
    strangers = b"".join(sender.frame("unicast", peer=60_000 + number) for number in range(200))
    expect_copies(await scene.puts(sender, receiver, strangers), 0)
