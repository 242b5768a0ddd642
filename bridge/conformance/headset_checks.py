"""Everything that a headset under test is held to, in the order in which it is told. `headset` tries it. Pure."""

from __future__ import annotations

from . import client_frames, vectors
from .checks import Check, Level
from .vectors import Vector

STRICT = Level.STRICT

WELCOMES = {
    "request_zero": "welcome_request_zero",
    "compact": "welcome_compact",
    "other_order": "welcome_other_order",
    "unknown_keys": "welcome_unknown_keys",
    "few_keys": "welcome_few_keys",
}
IGNORED = ("online_answer", "agents_gone", "agents_gone_nobody", "node_refused", "data_refused", "refused_request")


def _deafening(vector: Vector) -> Check:
    deafens = bool(vector.marks["deafens_existing"])
    costs = "connects again" if vector.marks.get("costs") else "goes on"
    about = f"It {costs} after this: {vector.about[0].lower()}{vector.about[1:]}"
    return Check(f"bad.{vector.name}", about, STRICT if deafens else Level.COMPATIBLE, deafens)


CHECKS: tuple[Check, ...] = (
    Check("handshake.connects", "It connects."),
    Check("handshake.waits", "It sends no configuration before it was given an id."),
    Check("handshake.answers", "It answers the first message with its configuration within 5 s."),
    Check("handshake.agent_type", "agentType is 2."),
    Check("handshake.agent_id", "agentId is the id that it was given."),
    Check("handshake.group", "groupId is a number from 0 to 255, or missing."),
    Check("handshake.request_id", "requestId is that of the first message."),
    Check("handshake.message", "The configuration carries the message of eight zero bytes."),
    Check("handshake.once", "It answers once."),
    Check("handshake.bytewise", "The first message may come byte by byte.", STRICT),
    Check("renumber.answers", "It answers a later AgentConfigurer at any time."),
    Check("renumber.new_id", "It takes the id that this one gives."),
    Check("renumber.two_bytes", "Ids above 255 are ids."),
    Check("renumber.largest_id", "So is 65535."),
    Check("renumber.largest_number", "requestId may be 4294967295.", STRICT),
    *(
        Check(f"renumber.{name}", f"It understands this: {vectors.named('router_messages', vector).about}")
        for name, vector in WELCOMES.items()
    ),
    Check("fragments.bytewise", "A message may come byte by byte."),
    Check("fragments.in_size", "It may be cut within the size of its metadata."),
    Check("fragments.behind_size", "Or behind it."),
    Check("fragments.in_metadata", "Or within its metadata."),
    Check("fragments.in_data_size", "Or within the size of its data."),
    Check("fragments.in_data", "Or within its data."),
    Check("fragments.two_at_once", "Two messages may come at once, and are handled in order."),
    Check("fragments.large", "1 MiB for a node that it does not have is let go of, and what follows is handled."),
    *(
        Check(f"messages.{name}", f"It goes on after this: {vectors.named('router_messages', name).about}")
        for name in IGNORED
    ),
    Check("messages.topic", "It goes on after a topic's message for a node of its."),
    Check("messages.answer", "It goes on after an answer for a node of its."),
    *(_deafening(vector) for vector in vectors.read("bad_messages")),
    Check("pace.burst", "It handles what follows 500 messages that come at once."),
    Check("pace.stalled_router", "It goes on after its router did not read for 2 s."),
    Check("services.answers", "A headset that serves answers a request."),
    Check("services.number", "Its answer has the request's requestId, 0 as well."),
    Check("services.to_asker", "Its answer goes to the robot that asked."),
    Check("services.all", "Of 30 requests at once all are answered, each under its number.", STRICT),
    *client_frames.CHECKS,
    Check("heartbeat.comes", "Nothing else to say for 5 s, it sends a heartbeat."),
    Check("heartbeat.goes_on", "And another one after that, also while it receives."),
    Check("heartbeat.not_too_often", "Between two heartbeats there is a second at least."),
    Check("reconnect.after_end", "It connects again when its router closed the connection.", STRICT),
    Check("reconnect.after_reset", "And when the connection was reset.", STRICT),
    Check("reconnect.waits", "It waits for an id there as the first time.", STRICT),
    Check("reconnect.new_id", "It takes the id that it gets there.", STRICT),
    Check("reconnect.registers", "It registers again what it had registered.", STRICT),
    Check("reconnect.pauses", "It does not try more than 50 times a second while its router closes at once.", STRICT),
    Check("sessions.asks", "A headset that knows sessions asks for one by an empty text.", STRICT),
    Check("sessions.shows", "When its connection has ended it comes back with the secret that it was told.", STRICT),
    Check("sessions.received", "It says how many messages of the session it has.", STRICT),
    Check("sessions.waits", "It says nothing more until it is told what became of its session.", STRICT),
    Check("sessions.id", "It has the id that the session goes on with, and not that of the new greeting.", STRICT),
    Check("sessions.says_again", "It registers again what its router says has not come.", STRICT),
    Check("sessions.registers_nothing", "It registers nothing where all has come.", STRICT),
    Check("sessions.forgotten", "Where its router does not know it any more it registers everything.", STRICT),
    Check("offline.says", "A program that takes SIGTERM says that it leaves.", STRICT),
)
