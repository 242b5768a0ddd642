/** Raw pictures to bitmaps, beside the page. */

import { decoded } from "./pixels.js";

self.onmessage = async ({ data: picture }) => {
  try {
    const pixels = decoded(picture, (bytes) => new Uint8ClampedArray(bytes));
    const bitmap = await createImageBitmap(new ImageData(pixels, picture.width, picture.height));
    self.postMessage({ bitmap }, [bitmap]);
  } catch (error) {
    self.postMessage({ problem: error.message });
  }
};
