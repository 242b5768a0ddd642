"""Which web pages may connect."""

from __future__ import annotations

from macs_zenoh.protocol.origins import host_problem, origin_problem


def test_only_known_pages_may_connect() -> None:
    """Our own page and those listed; not another one, nor one whose name was pointed at this machine."""
    ours = {"hall.example.org"}
    for host, origin, allowed in [
        ("127.0.0.1:7080", None, True),
        ("127.0.0.1:7080", "http://127.0.0.1:7080", True),
        ("localhost:7080", "http://localhost:7080", True),
        ("[::1]:7080", "http://[::1]:7080", True),
        ("hall.example.org", "https://hall.example.org", True),
        ("127.0.0.1:7080", "https://listed.example.org", True),
        ("127.0.0.1:7080", "http://127.0.0.1:8000", False),
        ("127.0.0.1:7080", "http://evil.example", False),
        ("127.0.0.1:7080", "null", False),
        ("127.0.0.1:7080", "", False),
        ("evil.example:7080", "http://evil.example:7080", False),
        ("evil.example:7080", None, False),
        ("127.0.0.1.evil.example", "http://127.0.0.1.evil.example", False),
        ("", None, False),
        ("[", "http://[", False),
    ]:
        problem = host_problem(host, ours) or origin_problem(origin, host, ["https://listed.example.org"])
        assert (problem is None) is allowed, (host, origin)
