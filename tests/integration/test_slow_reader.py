"""Who stands still while others send him more than may wait: what he has not, his gateway counted, on each port."""

from __future__ import annotations

import pytest

from bridge.headset import frames
from bridge.headset.stream import open_stream
from macs_zenoh.protocol.decoders import MessageDecoder
from macs_zenoh.protocol.messages import UNITY
from macs_zenoh.protocol.wire import split_message
from tests.integration.test_door import PORTS, StartDoor, start_door, tokens
from tests.support.waiting import PATIENCE_S, until

__all__ = ["start_door", "tokens"]
SIZE, MESSAGES = 64 << 10, 600
"""Four times as much as may wait for an agent, and as much again as sockets hold."""


@pytest.mark.parametrize("port", PORTS)
async def test_what_he_loses_is_counted(start_door: StartDoor, port: str) -> None:
    """Of messages of 64 KiB, sent as fast as they are taken, those that do not arrive are as many as are counted, by
    name, at his connection; those that do are in order, and nothing else is dropped."""
    door = await start_door(web_without_token="everybody")
    gateway = door.other if port == "web_tls" else door.gateway
    stream = await open_stream("127.0.0.1", *door.way(port))
    decoder = MessageDecoder()
    while not decoder.feed(await stream.read()):  # its welcome
        pass
    stream.write(frames.configuration(0, 0, 0, 1, None))
    (reader,) = await until(lambda: list(gateway.agents.online()))
    async with await door.come("plain") as sender:
        await until(lambda: door.know((UNITY, reader.agent_id), (UNITY, sender.id)))
        for number in range(MESSAGES):
            await sender.send(number.to_bytes(4, "big").ljust(SIZE, b"x"), to=UNITY, ids=[reader.agent_id])
        await sender.online(PATIENCE_S)  # all of it has been read
        came: list[int] = []
        lasts: list[int] = []
        asked = 0
        while not lasts:
            await sender.send(asked.to_bytes(4, "big"), to=UNITY, ids=[reader.agent_id])
            asked += 1
            for message in decoder.feed(await stream.read()):
                data = bytes(split_message(message)[1])
                if len(data) in (4, SIZE):
                    (lasts if len(data) == 4 else came).append(int.from_bytes(data[:4], "big"))
    assert came == sorted(set(came))
    counted = reader.all_drops()
    assert counted == {"outbox_full": MESSAGES - len(came) + lasts[0]}
    assert counted["outbox_full"] > 0
    stream.abort()
