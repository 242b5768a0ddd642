/** Raw pictures (sensor_msgs/Image) to pixels that a browser draws: {data, width, height, step, encoding, bigEndian}. Pure. */

const CHANNELS = {
  rgb8: [0, 1, 2, -1, 3],
  bgr8: [2, 1, 0, -1, 3],
  rgba8: [0, 1, 2, 3, 4],
  bgra8: [2, 1, 0, 3, 4],
  "8UC3": [2, 1, 0, -1, 3],
  "8UC4": [2, 1, 0, 3, 4],
  mono8: [0, 0, 0, -1, 1],
  "8UC1": [0, 0, 0, -1, 1],
};
const DEEP = { mono16: Uint16Array, "16UC1": Uint16Array, "32FC1": Float32Array };

/** Red, green, blue and opacity of each pixel, in the bytes that `room(count)` gives. Throws Error for what is no picture. */
export function decoded(picture, room = (bytes) => new Uint8Array(bytes)) {
  const { width, height, step, data, encoding } = picture;
  const most = 64e6;
  if (!(width * height > 0) || width * height * 4 > most * 4) throw new Error(`${width} × ${height} is no picture`);
  if (data.length < step * height) throw new Error("the picture is shorter than it says");
  if (CHANNELS[encoding]) return eightBit(picture, CHANNELS[encoding], room);
  if (DEEP[encoding]) return deep(picture, DEEP[encoding], room);
  throw new Error(`pictures in ${encoding} are not shown`);
}

function eightBit({ width, height, step, data }, [red, green, blue, alpha, size], room) {
  if (step < width * size) throw new Error("the picture's rows are shorter than it says");
  const pixels = room(width * height * 4);
  const words = new Uint32Array(pixels.buffer); // four bytes at once take half as long; browsers are little-endian
  const opaque = alpha < 0 ? 0xff000000 : 0;
  const last = alpha < 0 ? 0 : alpha;
  let to = 0;
  for (let row = 0; row < height; row++) {
    let from = row * step;
    for (let column = 0; column < width; column++, from += size) {
      const rest = opaque || data[from + last] << 24;
      words[to++] = data[from + red] | (data[from + green] << 8) | (data[from + blue] << 16) | rest;
    }
  }
  return pixels;
}

/** Depth and the like: the least is white, the greatest nearly black, by their logarithm; 0 and no number are black. */
function deep({ width, height, step, data, bigEndian }, Values, room) {
  const size = Values.BYTES_PER_ELEMENT;
  if (step < width * size) throw new Error("the picture's rows are shorter than it says");
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  const values = new Float32Array(width * height);
  let least = Infinity;
  let most = -Infinity;
  for (let row = 0, at = 0; row < height; row++) {
    for (let column = 0; column < width; column++, at++) {
      const place = row * step + column * size;
      const read = size === 2 ? view.getUint16(place, !bigEndian) : view.getFloat32(place, !bigEndian);
      const value = read > 0 && Number.isFinite(read) ? Math.log(read) : NaN;
      values[at] = value;
      if (value < least) least = value;
      if (value > most) most = value;
    }
  }
  const scale = most > least ? 225 / (most - least) : 0;
  const pixels = room(width * height * 4);
  for (let at = 0; at < values.length; at++) {
    const shade = Number.isNaN(values[at]) ? 0 : 255 - (values[at] - least) * scale;
    pixels[4 * at] = pixels[4 * at + 1] = pixels[4 * at + 2] = Math.round(shade);
    pixels[4 * at + 3] = 255;
  }
  return pixels;
}
