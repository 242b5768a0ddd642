"""The verb ``trace`` of a robot: where the time of its messages goes, for whoever may see it.

Data is a `TraceRequest` as a ping has it, or nothing; the answer is one to a ping, with the time here alone. A ping
tells all that a program has noted, marks whatever is asked for, and says more besides, so that it is for operators
where there are access rules. Here a robot marks what it sends itself, and tells what it noted of what came to it.
"""

from __future__ import annotations

import time

from macs_zenoh.agent import Agent
from macs_zenoh.errors import Refused
from macs_zenoh.protocol import ping, trace
from macs_zenoh.serving import Call, CallHandler


def telling(agent: Agent) -> CallHandler:
    """Answers for this robot. Raises Refused where others' messages are to be marked; TooLong, BadJson, BadField."""

    async def answer(call: Call) -> bytes:
        said = ping.Pong(time_s=time.time())
        if not call.data:
            return ping.encode(said)
        request = trace.decode_request(call.data)
        if request.put and not request.put.startswith(trace.said_by(agent.id)):
            raise Refused("a robot marks only what it sends itself")
        told = agent.mesh.tracing.told(request, trace.told_to(agent.id))
        return ping.encode(said, trace.encode_answer(told))

    return answer
