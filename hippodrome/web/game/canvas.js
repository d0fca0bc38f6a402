// Draws unpacked frames on the canvas.
import { KEY, ROWS } from "./frames.js";
import { data, find } from "./page.js";

const canvas = find("screen");
const context = canvas.getContext("2d", { alpha: false });

let size = ""; // width, height and channels of the picture that is shown
let pixels = null; // the last lossless picture: one or three bytes for each pixel
let rows = 0; // how many rows have come of a lossless picture that comes in parts
let imageData = null;

// Forgets the picture: the next frame cannot be a difference to it.
export function forgetPicture() {
  size = "";
}

// Throws if the frame is a difference to a picture that is not there.
export function drawPixels(header, { first, bytes }) {
  if (header.kind === ROWS) return drawRows(header, first, bytes);
  beginPicture(header);
  if (header.kind === KEY) pixels = bytes;
  else if (!pixels) throw new Error("no such frame");
  else for (let i = 0; i < bytes.length; i += 1) pixels[i] ^= bytes[i];
  putRows(0, header.height, header);
}

// Draws a lossy picture; null: only takes over its size. The pixels of the last lossless picture stay: the next frame may
// be a difference to them.
export function drawPicture(header, picture) {
  beginPicture(header);
  if (picture) context.drawImage(picture, 0, 0);
}

// Puts rows in the place of those that are shown. After the last rows of a picture, differences to it can follow.
function drawRows(header, first, bytes) {
  const { width, height, channels } = header;
  if (size !== `${width} ${height} ${channels}` || (first !== 0 && first !== rows)) throw new Error("no such frame");
  const count = bytes.length / (width * channels);
  pixels ??= new Uint8Array(width * height * channels);
  pixels.set(bytes, first * width * channels);
  putRows(first, count, header);
  rows = first + count;
}

// Drops the pixels if not all rows of their picture have come, or if it has another size.
function beginPicture({ width, height, channels }) {
  if (rows > 0 && rows < height) pixels = null;
  rows = 0;
  const now = `${width} ${height} ${channels}`;
  if (now === size) return;
  size = now;
  pixels = imageData = null;
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  shapePicture(width / height);
}

// Fits the layout to the picture. `ratio` is its width divided by its height.
export function shapePicture(ratio) {
  leaveRoom(ratio);
  document.body.classList.add("shown");
}

function leaveRoom(ratio) {
  document.body.style.setProperty("--ratio", ratio);
  document.body.classList.toggle("wide", ratio > 1);
}

if (data.ratio) leaveRoom(data.ratio);

function putRows(first, count, { width, height, channels }) {
  if (!imageData) {
    imageData = new ImageData(width, height);
    imageData.data.fill(255);
  }
  const to = imageData.data;
  const green = channels === 3 ? 1 : 0;
  const end = 4 * width * (first + count);
  for (let from = channels * width * first, at = 4 * width * first; at < end; from += channels, at += 4) {
    to[at] = pixels[from];
    to[at + 1] = pixels[from + green];
    to[at + 2] = pixels[from + 2 * green];
  }
  context.putImageData(imageData, 0, 0, 0, first, width, count);
}
