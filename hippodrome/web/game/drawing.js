// Draws the frames of one connection in order. They are unpacked in parallel, but drawn one after the other, since each may
// be a difference to the previous one. A lossy picture is left out if a later whole picture is ready to be drawn; the
// server learns that by the acknowledgement of the later one.
import { drawPicture, drawPixels, forgetPicture } from "./canvas.js";
import { JPEG, KEY } from "./frames.js";

// Returns a function that takes a frame's header and the promise that `unpack` returned. `isOpen` says whether the
// connection is still in use. `drawn` gets the id of each frame that was drawn; `failed` is called if one cannot be drawn.
export function startDrawing(isOpen, drawn, failed) {
  let frames = 0;
  let newestWhole = 0; // number of the newest frame that is a whole picture and is unpacked
  let last = Promise.resolve();
  forgetPicture();

  return (header, unpacking) => {
    const number = (frames += 1);
    const whole = header.kind === KEY || header.kind === JPEG;
    unpacking.then(() => whole && (newestWhole = Math.max(newestWhole, number)), () => {}); // failures are seen below
    last = last.then(async () => {
      const unpacked = await unpacking;
      if (!isOpen()) return unpacked.picture?.close?.();
      const late = header.kind === JPEG && newestWhole > number;
      if (unpacked.draw) unpacked.draw();
      else if (!unpacked.picture) drawPixels(header, unpacked);
      else drawPicture(header, late ? null : unpacked.picture);
      unpacked.picture?.close?.();
      if (!late) drawn(header.id);
    }).catch(failed);
  };
}
