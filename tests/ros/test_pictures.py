"""Raw image topics as JPEG: what a robot makes of them for whoever looks, with real images from rclpy."""

from __future__ import annotations

import array
import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import numpy
import pytest
import simplejpeg
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CompressedImage, Image

import macs_zenoh
from bridge.ros import jpeg
from bridge.ros.agent import RobotAgent
from bridge.ros.program import open_robot
from bridge.ros.raw_image import NotAnImage, read_image, write_compressed
from bridge.settings import RobotSettings, Settings, TopicRule
from bridge.settings.robot import AsJpeg
from macs_zenoh.errors import ConfigError, MissingExtra
from tests.support.local import patient
from tests.support.ros_peer import ROBOT, Peer
from tests.support.waiting import get, until

WIDTH, HEIGHT = 160, 120
RED, GREEN, BLUE = (220, 40, 30), (30, 200, 60), (20, 50, 210)


def picture(*colours: tuple[int, int, int], width: int = WIDTH, height: int = HEIGHT) -> Any:
    """Columns of these colours, as rgb."""
    columns = numpy.array(colours, numpy.uint8)[numpy.arange(width) * len(colours) // width]
    return numpy.broadcast_to(columns, (height, width, 3)).copy()


def image(pixels: Any, encoding: str, *, pad: int = 0, big_endian: bool = False, frame: str = "cam") -> Image:
    """A message of these bytes, rows by pixels by channels; ``pad`` more bytes are in each row."""
    message = Image(height=pixels.shape[0], width=pixels.shape[1], encoding=encoding, is_bigendian=big_endian)
    message.header.frame_id = frame
    message.header.stamp.sec, message.header.stamp.nanosec = 1_234_567, 890
    rows = pixels.reshape(pixels.shape[0], -1).view(numpy.uint8)
    rows = numpy.pad(rows, ((0, 0), (0, pad)))
    message.step = rows.shape[1]
    message.data = array.array("B", rows.tobytes())
    return message


def yuv(rgb: Any, luma_first: bool) -> Any:
    """Two pixels in four bytes, after ITU-R BT.601 as JPEG has it."""
    r, g, b = (rgb[..., each].astype(float) for each in range(3))
    y = 0.299 * r + 0.587 * g + 0.114 * b
    u, v = 128 + 0.564 * (b - y), 128 + 0.713 * (r - y)
    colour = numpy.where(numpy.arange(rgb.shape[1]) % 2 == 0, u, v)
    pair = (y, colour) if luma_first else (colour, y)
    return numpy.stack(pair, -1).round().clip(0, 255).astype(numpy.uint8)


def encoded(message: Image, quality: int = 90, max_width: int = 0) -> Any:
    """The pixels of what is made of it."""
    raw = read_image(bytes(serialize_message(message)))
    return simplejpeg.decode_jpeg(jpeg.encode(raw, quality, max_width), "RGB")


COLOURS = picture(RED, GREEN, BLUE)
ALPHA = numpy.full((HEIGHT, WIDTH, 1), 99, numpy.uint8)
GREY = COLOURS.mean(2).astype(numpy.uint8)[..., None]


@pytest.mark.parametrize("pad", [0, 24])
@pytest.mark.parametrize(
    ("pixels", "encoding"),
    [
        (COLOURS, "rgb8"),
        (COLOURS[..., ::-1].copy(), "bgr8"),
        (numpy.concatenate((COLOURS, ALPHA), 2), "rgba8"),
        (numpy.concatenate((COLOURS[..., ::-1], ALPHA), 2), "bgra8"),
        (yuv(COLOURS, luma_first=False), "yuv422"),
        (yuv(COLOURS, luma_first=True), "yuv422_yuy2"),
    ],
)
@pytest.mark.parametrize("max_width", [0, 60])
def test_each_encoding_has_its_colours(pixels: Any, encoding: str, pad: int, max_width: int) -> None:
    """In the middle of each column, with and without rows that are longer than their pixels, and made smaller."""
    shown = encoded(image(pixels, encoding, pad=pad), max_width=max_width)
    width = WIDTH if not max_width else WIDTH // 3 // 2 * 2
    assert abs(shown.shape[1] - width) <= 1
    for number, colour in enumerate((RED, GREEN, BLUE)):
        at = shown[shown.shape[0] // 2, int(shown.shape[1] * (number + 0.5) / 3)].astype(int)
        assert abs(at - colour).max() < 16, (encoding, number, at)


@pytest.mark.parametrize("big_endian", [False, True])
def test_grey_images(big_endian: bool) -> None:
    """8 bits, and the upper 8 of 16."""
    deep = (GREY.astype(numpy.uint16) << 8 | 7).astype(">u2" if big_endian else "<u2")
    for message in (image(GREY, "mono8"), image(deep, "mono16", big_endian=big_endian)):
        assert abs(encoded(message)[..., 0].astype(int) - GREY[..., 0]).mean() < 3


def test_what_is_no_image_is_told() -> None:
    """Depth and others are refused by name; cut-off and contradictory bytes cost nothing but themselves."""
    depth = read_image(bytes(serialize_message(image(GREY.astype(numpy.uint16), "16UC1"))))
    with pytest.raises(NotAnImage, match="'16UC1' is none of rgb8, bgr8"):
        jpeg.encode(depth, 80, 0)
    whole = bytes(serialize_message(image(COLOURS, "rgb8")))
    for end in range(400):
        with pytest.raises(NotAnImage):
            read_image(whole[:end])
    raw = read_image(whole)
    with pytest.raises(NotAnImage, match="too short"):
        jpeg.encode(raw._replace(step=WIDTH), 80, 0)
    for wrong in (Image(encoding="rgb8"), Image(height=1 << 31, width=1 << 31, step=1, encoding="rgb8")):
        with pytest.raises(NotAnImage):
            read_image(bytes(serialize_message(wrong)))


@pytest.mark.parametrize("frame", ["", "a", "abc", "camera", "camera_optical_frame"])
def test_stamp_and_frame_are_kept(frame: str) -> None:
    """As rclpy reads what was written, wherever the alignment falls."""
    message = image(COLOURS, "rgb8", frame=frame)
    made = deserialize_message(
        write_compressed(read_image(bytes(serialize_message(message))), "jpeg", b"123"), CompressedImage
    )
    assert (made.header, made.format, bytes(made.data)) == (message.header, "jpeg", b"123")


def rules(**as_jpeg: Any) -> list[TopicRule]:
    return [TopicRule(match="/camera/**", as_jpeg=AsJpeg(**as_jpeg))]


@asynccontextmanager
async def robot(router: str, domain: int, **as_jpeg: Any) -> AsyncIterator[RobotAgent]:
    settings = Settings(mesh=patient(router), robot=RobotSettings(id=ROBOT, rules=rules(**as_jpeg)))
    async with open_robot(settings, domain_id=domain) as opened:
        yield opened


@asynccontextmanager
async def published(
    peer: Peer, message: Image, hz: float = 30, qos: Any = qos_profile_sensor_data
) -> AsyncIterator[Any]:
    """A camera."""
    publisher = await peer.publisher(Image, "/camera/image", qos)

    async def publish() -> None:
        while True:
            publisher.publish(message)
            await asyncio.sleep(1 / hz)

    task = asyncio.create_task(publish())
    try:
        yield publisher
    finally:
        task.cancel()


async def offered(agent: RobotAgent) -> dict[str, str]:
    return (await agent.offers.now()).publishers


@pytest.mark.parametrize("reliable", [False, True])
async def test_a_headset_gets_pictures_of_a_raw_topic(reliable: bool, router: str, domain: int, peer: Peer) -> None:
    """Offered beside the raw one, made only while somebody takes it, once for two who do; with the camera's stamp."""
    qos = QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE) if reliable else qos_profile_sensor_data
    async with robot(router, domain) as agent, published(peer, image(COLOURS, "rgb8"), qos=qos) as camera:
        await until(lambda: "/camera/image/compressed" in agent.nodes.robot.made)
        await until(lambda: camera.get_subscription_count() == 0)

        async def is_offered() -> bool:
            return (await offered(agent)).get("/camera/image/compressed") == "sensor_msgs/msg/CompressedImage"

        await until(is_offered)
        async with (
            macs_zenoh.join("unity", settings=patient(router)) as one,
            macs_zenoh.join("unity", settings=patient(router)) as two,
        ):
            takers = []
            for each in (one, two):
                await until(lambda each=each: (1, ROBOT) in each.directory)
                takers.append(await each.subscribe("/camera/image/compressed", robot=ROBOT))
            for taker in takers:
                message = deserialize_message((await asyncio.wait_for(taker.receive(), 60)).data, CompressedImage)
                assert message.format == "rgb8; jpeg compressed bgr8"
                assert (message.header.stamp.sec, message.header.frame_id) == (1_234_567, "cam")
                shown = simplejpeg.decode_jpeg(bytes(message.data), "RGB")
                assert abs(shown[60, 26].astype(int) - RED).max() < 20
            assert camera.get_subscription_count() == 1
        await until(lambda: camera.get_subscription_count() == 0)


async def test_ros_nodes_may_take_them_too(router: str, domain: int, peer: Peer) -> None:
    """As from image_transport; and where that publishes them already, the agent does not."""
    async with robot(router, domain, max_width=80) as agent, published(peer, image(COLOURS, "bgr8")):
        received = await peer.subscription(CompressedImage, "/camera/image/compressed", qos_profile_sensor_data)
        message = await get(received)
        assert simplejpeg.decode_jpeg_header(bytes(message.data))[:2] == (HEIGHT // 2, WIDTH // 2)
        await peer.publisher(CompressedImage, "/camera/other/compressed")
        await peer.publisher(Image, "/camera/other")
        await until(lambda: agent.session.count_publishers("/camera/other") == 1)
        await peer.publisher(Image, "/camera/third")
        await until(lambda: "/camera/third/compressed" in agent.nodes.robot.made)
        assert "/camera/other/compressed" not in agent.nodes.robot.made


async def test_a_topic_that_ends_takes_its_pictures_along(router: str, domain: int, peer: Peer) -> None:
    """And they come back with it."""
    async with robot(router, domain) as agent:
        made = agent.nodes.robot.made
        camera = await peer.publisher(Image, "/camera/image")
        await until(lambda: "/camera/image/compressed" in made)
        await peer.session.run(lambda: peer.session.node.destroy_publisher(camera))
        await until(lambda: not made)
        await peer.publisher(Image, "/camera/image")
        await until(lambda: "/camera/image/compressed" in made)


@asynccontextmanager
async def refused(router: str, agent: RobotAgent) -> AsyncIterator[list[str]]:
    """Somebody would like the pictures and does not get them: what he is told."""
    await until(lambda: "/camera/image/compressed" in agent.nodes.robot.made)
    async with macs_zenoh.join("unity", settings=patient(router)) as headset:
        await until(lambda: (1, ROBOT) in headset.directory)
        taker = await headset.subscribe("/camera/image/compressed", robot=ROBOT)
        told: list[str] = []
        taker.on_refused(lambda _robot, reason: told.append(reason))
        await until(lambda: told)
        yield told


async def test_what_cannot_be_shown_is_counted_and_told(router: str, domain: int, peer: Peer) -> None:
    """A depth image: by name, with the encodings that can."""
    message = image(GREY.astype(numpy.uint16), "16UC1")
    async with robot(router, domain) as agent, published(peer, message), refused(router, agent) as told:
        assert "'16UC1' is none of rgb8, bgr8" in told[0]
        assert agent.nodes.drops["no_jpeg"]


async def test_what_the_library_refuses_is_counted_and_told(
    router: str, domain: int, peer: Peer, caplog: pytest.LogCaptureFixture
) -> None:
    """An image higher than a JPEG may be, as one whose encoding is not known: in one line, and not at each frame."""
    message = image(picture(RED, width=2, height=65_600), "rgb8")
    async with robot(router, domain) as agent, published(peer, message), refused(router, agent) as told:
        assert "no picture can be made of /camera/image: " in told[0]
        await until(lambda: agent.nodes.drops["no_jpeg"] > 2)
    said = [
        record for record in caplog.records if record.levelno > logging.DEBUG and "/camera/image" in record.message
    ]
    assert [record.exc_info for record in said if "no_jpeg" in record.message or record.exc_info] == [None]


async def test_there_are_no_more_than_are_wanted(router: str, domain: int, peer: Peer) -> None:
    """5 of 60 a second."""
    async with robot(router, domain, max_hz=5), published(peer, image(COLOURS, "rgb8"), hz=60):
        received = await peer.subscription(CompressedImage, "/camera/image/compressed", 100)
        await get(received)
        loop = asyncio.get_running_loop()
        began = loop.time()
        for _ in range(5):
            await get(received)
        assert loop.time() - began > 0.75


async def test_without_the_library_a_robot_that_needs_it_does_not_start(
    router: str, domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It says what to install."""
    monkeypatch.setattr(jpeg, "is_installed", lambda: False)
    with pytest.raises(MissingExtra, match=r"macs-zenoh\[jpeg\]"):
        async with robot(router, domain):
            pass


def test_settings_out_of_range_are_named() -> None:
    """Each by its field."""
    for field, value in (("quality", 0), ("quality", 101), ("max_width", -1), ("max_hz", 0)):
        with pytest.raises(ConfigError, match=field):
            AsJpeg(**{field: value})


async def test_what_it_saves(router: str, domain: int, peer: Peer) -> None:
    """640 x 480 pixels with as much noise as a camera has: a raw image has 921 600 bytes, a picture a twentieth."""
    chance = numpy.random.default_rng(1)
    pixels = picture(RED, GREEN, BLUE, (200, 190, 180), width=640, height=480) + chance.normal(0, 3, (480, 640, 3))
    message = image(pixels.clip(0, 255).astype(numpy.uint8), "rgb8")
    async with robot(router, domain, quality=75) as agent, published(peer, message):
        received = await peer.subscription(CompressedImage, "/camera/image/compressed", 100)
        size = len((await get(received)).data)
        print(f"640 x 480 at 30 Hz: {len(message.data) * 240 / 1e6:.0f} Mbit/s raw, {size * 240 / 1e6:.1f} as JPEG")
        assert size < len(message.data) / 20
        assert agent.session.count_publishers("/camera/image/compressed") == 1
