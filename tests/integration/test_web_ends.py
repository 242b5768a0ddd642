"""A page whose tab is killed says no goodbye: what it had sent counts, as over plain TCP."""

from __future__ import annotations

import asyncio
import socket
import struct

from benchmarks import sequence
from benchmarks.headset import Headset
from macs_zenoh.protocol.decoders import MessageDecoder
from macs_zenoh.protocol.messages import UNITY
from macs_zenoh.protocol.wire import split_message
from tests.support.given import StartGateway
from tests.support.waiting import PATIENCE_S, until

MANY = 200


async def test_what_it_had_sent_counts_when_it_was_not_read_from(start_gateway: StartGateway) -> None:
    """Its socket ends while it waits for its turn to be read from: all that it had sent goes on, in order."""
    gateway = await start_gateway(web_port=0)
    page = await asyncio.to_thread(lambda: Headset.join(gateway.listeners.web_port, 0, way="websocket"))
    receiver, other = [await asyncio.to_thread(Headset.join, gateway.port, 0) for _ in range(2)]
    await until(lambda: len(list(gateway.agents.online())) == 3)
    await until(lambda: all((UNITY, each.id) in gateway.directory for each in (page, receiver, other)))
    connection = gateway.agents.find(UNITY, page.id)
    assert connection is not None
    connection.pause()
    way = {"ids": [receiver.id], "groups": []}
    for frame in sequence.messages(page.id, 32, MANY, [way]):
        page.socket.sendall(frame)
    page.socket.raw.shutdown(socket.SHUT_RDWR)
    await until(lambda: gateway.agents.find(UNITY, page.id) is None)
    *_, last = sequence.messages(other.id, 32, MANY + 1, [way])
    other.socket.sendall(last)
    receiver.socket.settimeout(PATIENCE_S)
    numbers: list[int] = []
    decoder = MessageDecoder()
    while not numbers or numbers[-1] != MANY:
        for message in decoder.feed(await asyncio.to_thread(receiver.socket.recv, 65536)):
            data = bytes(split_message(message)[1])
            if data.startswith(sequence.CDR):
                numbers += struct.unpack_from("<I", data, 4)
    assert numbers == list(range(MANY + 1))
