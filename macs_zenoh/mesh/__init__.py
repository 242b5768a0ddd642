"""The Zenoh session: the only package that imports zenoh.

Zenoh has no asyncio API. Here its threads put samples into a queue and wake the event loop once per batch; everything
a caller passes in (callbacks, handlers) runs on the loop that opened the mesh, except what is said to be *at once*.

Zenoh calls back in its own threads, instead of through a queue and a thread of each subscription's own: one thread
switch less is what a single message feels, and one queue of ours keeps the order between subscriptions.

`session` is the mesh, `opening` how its session of Zenoh is opened; `outgoing` what is put, `sender` what of it is
left to a thread, `streams` topic data of others; `arrivals` what comes, `copies` what is large of it; `calls` what is
asked and served, `reliable` what is asked for again; `tracing` what is noted of messages on their way, `link_log` what
the log says of links; `declared` the words that all of them use, `gathered` tokens that are declared together,
`zenoh_config` Zenoh's configuration, `threads` how Zenoh and Python share a processor. `ros_network` is a session on
which our programs are ROS nodes.
"""

from .answers import FAILED, said, understood
from .arrivals import now_s
from .declared import Aged, AtOnce, Handler, OnBatch, OnMiss, Payload, Sample, Subscription, Token, Traffic
from .gathered import GatheredTokens
from .session import Mesh
from .tracing import Tracing
from .zenoh_config import configuration

__all__ = [
    "FAILED",
    "Aged",
    "AtOnce",
    "GatheredTokens",
    "Handler",
    "Mesh",
    "OnBatch",
    "OnMiss",
    "Payload",
    "Sample",
    "Subscription",
    "Token",
    "Tracing",
    "Traffic",
    "configuration",
    "now_s",
    "said",
    "understood",
]
