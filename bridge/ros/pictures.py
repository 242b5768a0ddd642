"""Raw image topics as JPEG, made once on the robot for all who look (``[[robot.rules]] as_jpeg``).

For each such topic there is ``<name>/compressed`` on the ROS graph, as ROS's image_transport calls it, so everything
that holds for topics holds for these: registrations, QoS, rules, recordings. The raw topic is taken only while
somebody takes the other. One thread makes all pictures; of a topic for which it has no time the latest waits.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from bridge.ros import jpeg, qos
from bridge.ros.interface import Robot
from bridge.ros.raw_image import COMPRESSED, IMAGE, NotAnImage, read_image, write_compressed
from bridge.ros.side import Closable, Events, NamesAndTypes, Publisher
from bridge.ros.types import InterfaceName
from bridge.settings.robot import AsJpeg, RobotSettings
from macs_zenoh.errors import MacsError, MissingExtra, Refused
from macs_zenoh.protocol.rmw_zenoh.qos import Qos
from macs_zenoh.timeouts import within

log = logging.getLogger("macs.ros")

LOOK_S = 1.0
CLOSE_S = 2.0
MOST = 64
"""So many topics have pictures."""
BEHIND, FAILED = "jpeg_behind", "no_jpeg"

Tell = Callable[[str, str, str], None]
"""Tells who registered for a topic what is wrong, by a name and a reason; from any thread."""


def check_installed(settings: RobotSettings) -> None:
    """Raises MissingExtra when pictures are wanted and cannot be made."""
    if any(rule.as_jpeg is not None for rule in settings.rules) and not jpeg.is_installed():
        raise MissingExtra("robot.rules.as_jpeg", "simplejpeg", jpeg.EXTRA)


class Pictures:
    """All of one robot's."""

    def __init__(self, robot: Robot, tell: Tell) -> None:
        self._robot = robot
        self._side = robot.session
        self._tell = tell
        self._made: dict[str, _Picture] = {}
        """By the name of the raw topic. In the ROS thread."""
        self._encoder = _Encoder(self._encode)
        self._open = False

    def start(self) -> None:
        """Look for images from now on, where settings want pictures of any."""
        if any(rule.as_jpeg is not None for rule in self._robot.rules.settings.rules):
            self._open = True
            self._side.submit(self._look_again)

    async def close(self) -> None:
        """End all. Waits no longer than `CLOSE_S` for a ROS thread that does not get to it, and for a picture that is
        being made: that thread ends with the program."""
        if not self._open:
            return
        self._open = False
        with contextlib.suppress(MacsError, asyncio.TimeoutError):
            await within(asyncio.wrap_future(self._side.submit(self._close)), CLOSE_S)
        await asyncio.to_thread(self._encoder.close, CLOSE_S)

    # -- in the ROS thread ---------------------------------------------------------------------------------------

    def _close(self) -> None:
        for name in list(self._made):
            try:
                self._end(name)
            except Exception:  # the middleware's, whatever it is: the others end nevertheless
                log.exception("the pictures of %s did not end", name)

    def _look_again(self) -> None:
        if self._open:
            self._look(self._side.topics())
            self._side.later(LOOK_S, self._look_again)

    def _look(self, topics: NamesAndTypes) -> None:
        images = {name for name, types in topics if IMAGE in types}
        for name in [name for name in self._made if name not in images]:
            self._end(name)
        for name in sorted(images - self._made.keys()):
            rule = self._robot.rules.of(name).as_jpeg
            if rule is None or len(self._made) >= MOST or self._is_taken(f"{name}/compressed"):
                continue
            try:
                self._made[name] = picture = _Picture(name, rule)
                picture.publisher = self._side.advertise(
                    self._side.message(InterfaceName.parse(COMPRESSED, "msg")),
                    picture.topic,
                    Qos(depth=1),
                    partial(self._matched, picture),
                )
            except Refused as refusal:
                self._robot.drops.note(FAILED, name, refusal.reason)
            else:
                self._robot.made[picture.topic] = COMPRESSED
                log.info("%s has pictures: %s", name, picture.topic)

    def _is_taken(self, topic: str) -> bool:
        """Whether somebody else publishes it, as image_transport does."""
        return any(other.node != self._side.full_name for other in self._side.publishers(topic))

    def _end(self, name: str) -> None:
        picture = self._made.pop(name)
        self._robot.made.pop(picture.topic, None)
        self._encoder.forget(picture)
        for one in (picture.subscription, picture.publisher):
            if one is not None:
                one.close()
        picture.subscription = picture.publisher = None

    def _matched(self, picture: _Picture, count: int) -> None:
        """In some thread: so many take the pictures now."""
        picture.takers = count
        self._side.submit(lambda: self._subscribe(picture))

    def _subscribe(self, picture: _Picture, *, again: bool = False) -> None:
        if picture.subscription is not None and (again or not picture.takers):
            picture.subscription.close()
            picture.subscription = None
            self._encoder.forget(picture)
        if picture.takers and picture.subscription is None and picture.publisher is not None:
            offered = [other.qos for other in self._side.publishers(picture.name)]
            anew = Events(incompatible=lambda: self._anew(picture))
            try:
                picture.subscription = self._side.subscribe(
                    self._side.message(InterfaceName.parse(IMAGE, "msg")),
                    picture.name,
                    partial(self._take, picture),
                    qos.for_subscription(offered, 1) if offered else qos.best_effort(1),
                    anew,
                )
            except Refused as refusal:
                self._robot.drops.note(FAILED, picture.name, refusal.reason)

    def _anew(self, picture: _Picture) -> None:
        """A publisher has come that offers less than the others."""
        self._side.submit(lambda: self._subscribe(picture, again=True))

    # -- in other threads ----------------------------------------------------------------------------------------

    def _take(self, picture: _Picture, cdr: bytes, _info: Mapping[str, Any]) -> None:
        if self._encoder.offer(picture, cdr):
            self._robot.drops.note(BEHIND, picture.name, "images come faster than pictures can be made")

    def _encode(self, picture: _Picture, cdr: bytes) -> None:
        publisher = picture.publisher
        if publisher is None:
            return
        try:
            image = read_image(cdr)
            data = jpeg.encode(image, picture.rule.quality, picture.rule.max_width)
        except Exception as error:  # the library has limits of its own, and says them in many ways
            reason = str(error) or type(error).__name__
            if not isinstance(error, NotAnImage):
                log.debug("%s: no picture", picture.name, exc_info=True)
            self._robot.drops.note(FAILED, picture.name, reason)
            self._tell(picture.topic, FAILED, f"no picture can be made of {picture.name}: {reason}")
            return
        with contextlib.suppress(Exception):  # it was closed meanwhile
            publisher.publish(write_compressed(image, f"{image.encoding}; jpeg compressed bgr8", data))


class _Picture:
    """One topic's."""

    def __init__(self, name: str, rule: AsJpeg) -> None:
        self.name, self.rule = name, rule
        self.topic = f"{name}/compressed"
        self.publisher: Publisher | None = None
        self.subscription: Closable | None = None
        self.takers = 0
        self.due = 0.0
        """When the next one may be made."""


class _Encoder:
    """The thread that makes them. What waits is one message per topic."""

    def __init__(self, encode: Callable[[_Picture, bytes], None]) -> None:
        self._encode = encode
        self._waiting: OrderedDict[_Picture, bytes] = OrderedDict()
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._open = True

    def offer(self, picture: _Picture, cdr: bytes) -> bool:
        """Whether one that waited has to go although it was its turn."""
        with self._changed:
            late = picture in self._waiting and picture.due <= time.monotonic()
            self._waiting[picture] = cdr
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="macs-jpeg", daemon=True)
                self._thread.start()
            self._changed.notify()
        return late

    def forget(self, picture: _Picture) -> None:
        """Nobody takes it any more."""
        with self._changed:
            self._waiting.pop(picture, None)

    def close(self, timeout_s: float) -> None:
        """Waits so long at most for the one that is being made."""
        with self._changed:
            self._open = False
            self._changed.notify()
            thread = self._thread
        if thread is not None:
            thread.join(timeout_s)

    def _run(self) -> None:
        while (work := self._next()) is not None:
            try:
                self._encode(*work)
            except Exception:
                log.exception("a picture of %s failed", work[0].name)

    def _next(self) -> tuple[_Picture, bytes] | None:
        with self._changed:
            while self._open:
                now = time.monotonic()
                for picture in self._waiting:
                    if picture.due <= now:
                        period_s = 1 / picture.rule.max_hz
                        picture.due = max(picture.due + period_s, now)  # what comes a little late costs no later one
                        return picture, self._waiting.pop(picture)
                dues = [picture.due - now for picture in self._waiting]
                self._changed.wait(min(dues) if dues else None)
        return None
