/**
 * Pictures as the graphics take them: bytes of red, green, blue and opacity, the upper row first. Of a bitmap the main thread
 * makes these anew for each upload.
 */

import { decoded } from "../page/pixels.js";
import { bounded, isJpeg } from "./sizes.js";

const RGBA = { format: "RGBA" };
/** Room that is not used now is kept for so many pictures, none of which is larger than that. */
const SPARE = 4;
const SPARE_BYTES = 9e6;

export class Pictures {
  #spare = [];
  /** Whether this browser may make bytes of a JPEG file: what it did not do once is not asked for again. */
  #decodes = typeof ImageDecoder === "function";

  /** {width, height, data}, or {width, height, bitmap} where the browser makes no bytes of it; `compressed`: it is a file. */
  async read(message, compressed) {
    if (!compressed) return this.#raw(message);
    bounded(message.data);
    if (this.#decodes && isJpeg(message.data)) {
      const found = await this.#file(message.data).catch(() => null); // the other way says what is wrong with it
      if (found) return found;
    }
    const options = { premultiplyAlpha: "none", colorSpaceConversion: "none" };
    const bitmap = await createImageBitmap(new Blob([message.data]), options);
    return { width: bitmap.width, height: bitmap.height, bitmap };
  }

  /** Room of pictures that are not shown any more, to be used again. */
  back(buffers) {
    this.#spare.push(...buffers.filter(({ byteLength }) => byteLength <= SPARE_BYTES));
    this.#spare.splice(0, this.#spare.length - SPARE);
  }

  #raw({ width, height, step, encoding, data, is_bigendian: bigEndian }) {
    const pixels = decoded({ data, width, height, step, encoding, bigEndian }, (bytes) => this.#room(bytes));
    return { width, height, data: new Uint8Array(pixels.buffer) };
  }

  /** null: not in this way. Throws Error for what is no picture. */
  async #file(bytes) {
    const decoder = new ImageDecoder({ data: bytes, type: "image/jpeg", colorSpaceConversion: "none" });
    try {
      const { image } = await decoder.decode();
      try {
        return await this.#bytesOf(image);
      } finally {
        image.close();
      }
    } finally {
      decoder.close();
    }
  }

  async #bytesOf(image) {
    const { displayWidth: width, displayHeight: height } = image;
    const size = 4 * width * height;
    // a browser that knows no formats gives its own one, whatever is asked for
    const own = ["RGBA", "RGBX"].includes(image.format);
    this.#decodes = own || (image.allocationSize(RGBA) === size && image.allocationSize() !== size);
    if (!this.#decodes || image.rotation || image.flip) return null;
    const data = this.#room(size);
    await image.copyTo(data, RGBA);
    return { width, height, data };
  }

  #room(bytes) {
    const at = this.#spare.findIndex(({ byteLength }) => byteLength === bytes);
    return new Uint8Array(at < 0 ? new ArrayBuffer(bytes) : this.#spare.splice(at, 1)[0]);
  }
}
