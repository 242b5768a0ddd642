"""The scene for headsets by itself, at a gateway without robots: eyes, hands, panels, the table, who may."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy")  # the kit has a camera, which is a ROS node

from bridge.page.routes import POLICY
from tests.page.conftest import Gate
from tests.page.headsets import UNDRAWN, headset_at, needs_headset
from tests.page.polls import until
from tests.support.browser import AXE, needs_browser

pytestmark = [needs_browser, needs_headset]

FILL = """async ([topic, width, height, colours]) => {
  macsXr.telling.tell = macsXr.telling.tick = () => {};
  macsXr.room.setPanels([topic]);
  const canvas = new OffscreenCanvas(width, height);
  const context = canvas.getContext('2d');
  colours.forEach((colour, at) => {
    context.fillStyle = colour;
    context.fillRect((at * width) / colours.length, 0, width / colours.length, height);
  });
  const screen = macsXr.room.screens.get(topic);
  screen.show(await createImageBitmap(canvas));
  screen.say({ figures: '', tone: 'good', veil: '' });
}"""
READ = """async (kind) => {
  const { Pictures } = await import('/xr/pictures.js');
  const [width, height] = [640, 480];
  const context = new OffscreenCanvas(width, height).getContext('2d');
  for (const [colour, y] of [['#c03030', 0], ['#3030c0', height / 2]]) {
    context.fillStyle = colour;
    context.fillRect(0, y, width, height / 2);
  }
  let message;
  if (kind === 'rgb8') {
    const { data: all } = context.getImageData(0, 0, width, height);
    const data = all.filter((_, at) => at % 4 < 3);
    message = { width, height, step: 3 * width, encoding: kind, data, is_bigendian: 0 };
  } else {
    const file = await context.canvas.convertToBlob({ type: kind });
    message = { data: new Uint8Array(await file.arrayBuffer()) };
  }
  const given = await new Pictures().read(message, kind !== 'rgb8');
  macsXr.telling.tell = macsXr.telling.tick = () => {};
  macsXr.room.setPanels(['/one']);
  const screen = macsXr.room.screens.get('/one');
  screen.show(given.bitmap ?? { ...given, close() {} });
  screen.say({ figures: '', tone: 'good', veil: '' });
  return given.bitmap ? 'bitmap' : 'bytes';
}"""
STEREO = "device.stereoEnabled = true"
AIM = """([hand, [x, y, z], [tx, ty, tz]]) => {
  const one = device.controllers[hand];
  one.position.set(x, y, z);
  const [dx, dy, dz] = [tx - x, ty - y, tz - z];
  const yaw = Math.atan2(-dx, -dz);
  const pitch = Math.atan2(dy, Math.hypot(dx, dz));
  const [sy, cy, sp, cp] = [Math.sin(yaw / 2), Math.cos(yaw / 2), Math.sin(pitch / 2), Math.cos(pitch / 2)];
  one.quaternion.set(cy * sp, sy * cp, -sy * sp, cy * cp);
}"""
WORLD = {
    "scan": "{ points: new Float32Array(Array.from({length: 2000}, (_, i) => [0.05 * (i % 40) - 1, 0.1, 0.05 * "
    "Math.floor(i / 40) - 1]).flat()), place: null }",
    "map": "{ pixels: new Uint8Array(4 * 64).fill(220), width: 8, height: 8, size: [8, 8], origin: { position: "
    "{ x: -4, y: -4, z: 0 }, orientation: { x: 0, y: 0, z: 0, w: 1 } } }",
}


def like(pixels: list[int], colour: tuple[int, int, int], by: int = 24) -> bool:
    """Whether most of these pixels are of a colour."""
    hits = [all(abs(pixels[at + part] - colour[part]) <= by for part in range(3)) for at in range(0, len(pixels), 4)]
    return sum(hits) > len(hits) / 2


async def test_each_eye_has_its_half_of_a_wide_picture(gate: Gate) -> None:
    """Side by side: the left half is what the left eye sees, and a screen; the right half is the right eye's."""
    headset = await headset_at(gate)
    await until(lambda: headset.value("Boolean(window.macsXr)"))
    await headset.value(FILL, ["/stereo", 1280, 480, ["#c03030", "#3030c0"]])
    red, blue = (0xC0, 0x30, 0x30), (0x30, 0x30, 0xC0)
    assert like(await headset.pixels(0.5, 0.36), red)
    await headset.value(STEREO)
    await headset.enter()
    await headset.frame(3)
    assert like(await headset.pixels(0.25, 0.45), red)
    assert like(await headset.pixels(0.75, 0.45), blue)
    await headset.shot("stereo")


async def test_pictures_are_upright_and_have_their_colours(gate: Gate) -> None:
    """A JPEG file and a raw picture as bytes, a PNG file as a bitmap: the upper half is above, in its colour."""
    headset = await headset_at(gate)
    await until(lambda: headset.value("Boolean(window.macsXr)"))
    for kind, way in (("image/jpeg", "bytes"), ("image/png", "bitmap"), ("rgb8", "bytes")):
        assert await headset.value(READ, kind) == way, kind
        assert like(await headset.pixels(0.5, 0.27, 16), (0xC0, 0x30, 0x30)), kind
        assert like(await headset.pixels(0.5, 0.45, 16), (0x30, 0x30, 0xC0)), kind


async def test_its_screen_can_be_used_by_all(gate: Gate) -> None:
    """What axe finds nothing wrong with: the scene, and its settings."""
    headset = await headset_at(gate)
    await until(lambda: headset.value("Boolean(window.macsXr)"))
    await headset.value(AXE.read_text(encoding="utf-8") + ";0")
    wrong = "axe.run().then((found) => found.violations.map((each) => [each.id, each.nodes.map((node) => node.html)]))"
    assert await headset.value(wrong) == []
    await headset.page.click("#open-settings")
    assert await headset.value(wrong) == []
    await headset.page.fill("#setting-forward", "100")
    await headset.page.press("#setting-forward", "Tab")
    assert await headset.page.get_attribute("#setting-forward", "aria-invalid") == "true"
    assert await headset.value("macsXr.settings.get('forward')") == 0.5
    await headset.shot("settings")


async def test_hands_move_panels_and_press_buttons(gate: Gate) -> None:
    """A trigger on a panel takes it along and turns it to the head, the stick scales it; a button it presses once."""
    headset = await headset_at(gate)
    await until(lambda: headset.value("Boolean(window.macsXr)"))
    await headset.value(FILL, ["/one", 640, 480, ["#30c030"]])
    await headset.enter()
    where = "(({ x, y, z }) => [x, y, z])(macsXr.room.screens.get('/one').group.position)"
    before = await headset.value(where)
    await headset.value(AIM, ["right", [0.2, 1.4, 0], before])
    await headset.frame(3)
    await headset.trigger("right", held=True)
    await headset.frame(3)
    await headset.value(AIM, ["right", [0.2, 1.4, 0], [before[0] - 1.5, before[1], before[2]]])
    await headset.frame(3)
    after = await headset.value(where)
    assert after[0] < before[0] - 0.8
    assert await headset.value("macsXr.room.screens.get('/one').group.rotation.y") > 0.2, "it looks away"
    await headset.stick("right", 1, 0)
    await until(lambda: headset.value("macsXr.room.screens.get('/one').group.scale.x > 1.3"))
    await headset.stick("right", 0, 0)
    await headset.trigger("right", held=False)
    await headset.frame(3)
    await headset.value(AIM, ["right", [0.2, 1.4, 0], before])
    await headset.frame(3)
    assert await headset.value(where) == after, "it is not held any more"

    button = await headset.value(BUTTON, "flat")
    await headset.value(AIM, ["left", [0, 1.3, 0], button])
    await headset.frame(3)
    assert await headset.value("macsXr.settings.get('curve')") > 0
    await headset.trigger("left", held=True)
    await until(lambda: headset.value("macsXr.settings.get('curve') === 0"))
    await headset.frame(5)
    assert await headset.value("macsXr.settings.get('curve')") == 0, "pressed once"
    await headset.trigger("left", held=False)
    await headset.shot("moved")
    await headset.leave()
    assert await headset.value("macsXr.stage.room.visible")
    await headset.enter("immersive-ar")
    await until(lambda: headset.value("!macsXr.stage.room.visible"))  # the real one is to be seen


BUTTON = """(id) => {
  const { group } = macsXr.room.menu;
  const at = macsXr.room.menu.placeOf(id);
  group.updateMatrixWorld();
  const { elements: m } = group.matrixWorld;
  return [0, 1, 2].map((row) => m[row] * at.x + m[4 + row] * at.y + m[12 + row]);
}"""


async def test_the_world_is_drawn_on_the_table(gate: Gate) -> None:
    """A scan and a map change what is seen there, and nothing outside its edge; layers that are off are not drawn."""
    headset = await headset_at(gate)
    await until(lambda: headset.value("Boolean(window.macsXr)"))
    table, outside = (0.5, 0.82), (0.88, 0.95)
    empty, beside = await headset.pixels(*table), await headset.pixels(*outside)
    for layer, value in WORLD.items():
        await headset.value(f"macsXr.room.model.take('{layer}', {value})")
        assert await headset.pixels(*table) != empty, layer
        assert await headset.pixels(*outside) == beside, layer
    await headset.shot("table")
    await headset.value("macsXr.room.follow('layers', [])")
    assert await headset.pixels(*table) == empty


async def test_who_may_is_asked_and_nothing_is_from_elsewhere(gate: Gate) -> None:
    """Where a token is wanted the scene asks for it, and offers what it permits; its policy is the page's."""
    headset = await headset_at(gate, wanted=True, size=UNDRAWN)
    await headset.page.fill("#token", gate.secret)
    await headset.page.click("button[type=submit]")
    await headset.page.wait_for_selector("#scene")
    assert not await headset.page.is_visible("#stop"), "this token may not stop"
    response = await headset.page.goto(headset.page.url)
    assert response is not None
    assert response.headers["content-security-policy"] == POLICY
    worker = await headset.page.request.get(f"{headset.page.url.rpartition('/')[0]}/xr/command-worker.js")
    assert worker.headers["content-security-policy"] == POLICY
