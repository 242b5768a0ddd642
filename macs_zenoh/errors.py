"""Every error of this project, in one tree whose branches say who is at fault.

::

    MacsError
    ├── WireError                 the peer: what it sent cannot be used
    │   ├── FrameTooLarge         (final for its connection: framing is lost)
    │   ├── BadSizes
    │   ├── TooLong
    │   ├── BadJson
    │   ├── BadField
    │   ├── UnknownManager
    │   ├── NotAllowed
    │   │   └── NotPermitted
    │   ├── NotAdmitted
    │   └── TooFast
    ├── UsageError                our caller
    │   ├── TooManyDestinations
    │   └── OutOfRange
    ├── ConfigError               the configuration
    ├── MissingExtra              this installation
    ├── Refused                   the other end answered, and said no
    │   └── HeldByAnother
    ├── Closed                    what was used has been closed here
    └── Unreachable               the world
        ├── NotServed
        └── CallTimeout           (also a TimeoutError)

Numbers are attributes; the text is made from them.
"""

from __future__ import annotations


class MacsError(Exception):
    """Base of all errors raised by this project."""


class WireError(MacsError):
    """The peer sent something that cannot be used. Costs that frame, at most that connection."""


class FrameTooLarge(WireError):
    """A header declares more bytes than allowed, so the next frame cannot be found: final for the connection."""

    def __init__(self, size: int, limit: int) -> None:
        super().__init__(f"a frame of {size} bytes was declared, the limit is {limit}")
        self.size = size
        self.limit = limit


class BadSizes(WireError):
    """The sizes inside a frame or message do not add up."""

    def __init__(self, what: str, declared: int, available: int) -> None:
        super().__init__(f"{what}: {declared} bytes declared, {available} there")
        self.what = what
        self.declared = declared
        self.available = available


class TooLong(WireError):
    """A part that is parsed, or a name, is longer than allowed (`limits`)."""

    def __init__(self, what: str, size: int, limit: int) -> None:
        super().__init__(f"{what} of {size} bytes, the limit is {limit}")
        self.what = what
        self.size = size
        self.limit = limit


class BadJson(WireError):
    """Bytes that should be a JSON object are not."""

    def __init__(self, what: str, problem: str) -> None:
        super().__init__(f"{what} is not valid JSON: {problem}")
        self.what = what
        self.problem = problem


class BadField(WireError):
    """A JSON field is missing or has the wrong type or range."""

    def __init__(self, what: str, problem: str) -> None:
        super().__init__(f"{what}: {problem}")
        self.what = what
        self.problem = problem


class UnknownManager(WireError):
    """Management data names a manager that nobody here has."""

    def __init__(self, name: str) -> None:
        super().__init__(f"unknown message manager {name[:64]!r}")
        self.name = name


class NotAllowed(WireError):
    """A peer asked for something that its place on the mesh does not permit."""


class NotPermitted(NotAllowed):
    """A token does not give the right to what its agent sent."""


class NotAdmitted(WireError):
    """A peer showed no token that holds where one is wanted. It says no more than that, whatever was wrong."""

    def __init__(self) -> None:
        super().__init__("no valid token")


class TooFast(WireError):
    """A peer sends more than its rate limit."""

    def __init__(self, frames_per_s: float) -> None:
        super().__init__(f"more than {frames_per_s:g} frames/s")
        self.frames_per_s = frames_per_s


class UsageError(MacsError):
    """Our caller passed something that cannot be done."""


class TooManyDestinations(UsageError):
    """More ids or groups than the header has slots."""

    def __init__(self, kind: str, count: int, limit: int) -> None:
        super().__init__(f"{count} destination {kind}, the header has {limit} slots")
        self.kind = kind
        self.count = count
        self.limit = limit


class OutOfRange(UsageError):
    """A number outside the range its field can carry."""

    def __init__(self, name: str, value: int, low: int, high: int) -> None:
        super().__init__(f"{name} is {value}, allowed is {low}..{high}")
        self.name = name
        self.value = value
        self.low = low
        self.high = high


class ConfigError(MacsError):
    """The configuration is wrong. ``path`` names the file and field."""

    def __init__(self, path: str, problem: str) -> None:
        super().__init__(f"{path}: {problem}")
        self.path = path
        self.problem = problem


class MissingExtra(MacsError):
    """An optional package is not installed here."""

    def __init__(self, what: str, package: str, extra: str) -> None:
        super().__init__(f"{what} needs {package}: pip install 'macs-zenoh[{extra}]'")
        self.package = package
        self.extra = extra


class Refused(MacsError):
    """A call was answered with a refusal. ``reason`` is for a person."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class HeldByAnother(Refused):
    """Somebody else has what only one can have. ``holder`` is (agent type, agent id)."""

    def __init__(self, reason: str, holder: tuple[int, int]) -> None:
        super().__init__(reason)
        self.holder = holder


class Closed(MacsError):
    """What was used has been closed on this side."""

    def __init__(self, what: str) -> None:
        super().__init__(f"{what} is closed")
        self.what = what


class Unreachable(MacsError):
    """A router or an agent cannot be reached."""

    def __init__(self, target: str, why: str) -> None:
        super().__init__(f"{target} cannot be reached: {why}")
        self.target = target
        self.why = why


class NotServed(Unreachable):
    """Nobody answers this call: no such agent is there, or it does not know the verb."""

    def __init__(self, target: str) -> None:
        super().__init__(target, "nobody there answers this call")


class CallTimeout(Unreachable, TimeoutError):
    """A call was not answered in time."""

    def __init__(self, target: str, timeout_s: float) -> None:
        super().__init__(target, f"no answer within {timeout_s:g} s")
        self.timeout_s = timeout_s
