"""Management messages for managers that somebody added (docs/managers.md)."""

from __future__ import annotations

import logging

from macs_zenoh.errors import Refused
from macs_zenoh.managers import Asker, Managers
from macs_zenoh.protocol.messages import Refusal, encode_data
from macs_zenoh.protocol.recipient import to_agent
from macs_zenoh.protocol.tcp_agent import Asked

from .connection import Connection

log = logging.getLogger("macs.gateway")


class Managing:
    """Those of one gateway."""

    def __init__(self, managers: Managers) -> None:
        self._managers = managers
        self.custom = {name: manager.Data for name, manager in managers.items()}
        """What their messages are, by their names."""

    def ask(self, connection: Connection, event: Asked) -> None:
        """An agent asks one of them."""
        asker = Asker(*connection.key, connection.peer.group)
        try:
            answer = self._managers[event.manager].manage(event.data, asker)
            data = encode_data(answer) if answer is not None else None
        except Refused as refusal:
            connection.complain("refused_by_manager", f"{event.manager}: {refusal.reason}")
            if connection.peer.extensions:  # an existing program expects its manager's own answer, or none
                connection.send_call(to_agent(Refusal(refusal.reason), request_id=event.request_id))
            return
        except Exception:
            log.exception("%s failed on a message of %s", event.manager, connection)
            connection.complain("manager_failed", f"{event.manager} failed, see above")
            return
        if data is not None:
            connection.send_call(to_agent(data, request_id=event.request_id))
