"""The Zenoh session: the only package that imports zenoh.

Zenoh has no asyncio API. Here its threads put samples into queues and wake the event loop once per batch; everything
a caller passes in (callbacks, handlers) runs on the loop that opened the mesh.

Zenoh calls back in its own threads, one Python call for each sample, instead of through a thread of each
subscription's own: through one router that is 85 k samples/s instead of 320 k, but a sample here carries all that one
read of a socket brought, one thread switch less is what a single message feels, and one queue keeps the order between
subscriptions.

`session` is the mesh; `outgoing` what is put, `arrivals` what comes, `recovered` what is asked for again; `samples`
the words that all of them use, `opening` Zenoh's configuration.
"""

from .opening import configuration
from .samples import Handler, OnBatch, OnMiss, Payload, Sample, Subscription, Token, Traffic
from .session import Mesh

__all__ = [
    "Handler",
    "Mesh",
    "OnBatch",
    "OnMiss",
    "Payload",
    "Sample",
    "Subscription",
    "Token",
    "Traffic",
    "configuration",
]
