/** How large a compressed picture is, read from its first bytes: a browser makes room for it before it looks further. Pure. */

/** More pixels than that are no camera's; 256 MB once they are decoded. */
export const MOST_PIXELS = 64e6;
const MOST_SIDE = 16384;
const PNG = [0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a];

/** {width, height} of a JPEG or PNG file; null where it is another one, or its beginning does not say. */
export function sizeOf(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (bytes.length >= 24 && PNG.every((byte, at) => bytes[at] === byte)) {
    return { width: view.getUint32(16), height: view.getUint32(20) };
  }
  return isJpeg(bytes) ? jpeg(bytes, view) : null;
}

/** Whether it begins as a JPEG file. */
export function isJpeg(bytes) {
  return bytes.length >= 4 && bytes[0] === 0xff && bytes[1] === 0xd8;
}

/** Throws Error for a picture that is too large to be shown. */
export function bounded(bytes) {
  const size = sizeOf(bytes);
  if (size && (size.width > MOST_SIDE || size.height > MOST_SIDE || size.width * size.height > MOST_PIXELS)) {
    throw new Error(`the picture is too large: ${size.width} × ${size.height}`);
  }
}

/** Segments of a JPEG follow each other until the one that says how large it is. */
function jpeg(bytes, view) {
  let at = 2;
  while (at + 9 <= bytes.length && bytes[at] === 0xff) {
    const marker = bytes[at + 1];
    if (marker === 0xff) {
      at += 1; // filled up
    } else if (marker >= 0xc0 && marker <= 0xcf && ![0xc4, 0xc8, 0xcc].includes(marker)) {
      return { width: view.getUint16(at + 7), height: view.getUint16(at + 5) };
    } else if (marker === 0x01 || (marker >= 0xd0 && marker <= 0xd7)) {
      at += 2;
    } else {
      at += 2 + Math.max(2, view.getUint16(at + 2));
    }
  }
  return null;
}
