"""Which web pages may open a WebSocket here, by what a browser says of them. Pure.

A browser lets any page connect to any address, also to this machine's own, and says only where the page is from. So a
page must be this gateway's own, or be listed. And a name that somebody points at this machine's address makes his page
look like our own: the host that a browser believes to talk to must be an address, this machine, or listed.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Collection
from urllib.parse import urlsplit

LOCAL = ("localhost",)


def host_problem(host: str, hosts: Collection[str]) -> str | None:
    """What is wrong with the ``Host`` that a request names; ``hosts`` are the names that are known as ours."""
    name = _name(f"//{host}")
    if name is None:
        return "it names no host"
    if name in LOCAL or name in hosts or _is_address(name):
        return None
    return "it takes this gateway for another host"


def origin_problem(origin: str | None, host: str, origins: Collection[str]) -> str | None:
    """What is wrong with the ``Origin`` of a request for ``host``. None is said by programs that are no browsers."""
    if origin is None or origin in origins:
        return None
    scheme, _, netloc = origin.partition("://")
    if scheme in ("http", "https") and netloc.lower() == host.lower():
        return None
    return "it is from another page"


def _name(url: str) -> str | None:
    try:
        return urlsplit(url).hostname
    except ValueError:
        return None


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name.partition("%")[0])
    except ValueError:
        return False
    return True
