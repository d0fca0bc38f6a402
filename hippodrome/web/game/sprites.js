// The images of a game that is drawn by objects: the page asks for them before the game, and a bar shows the progress.
import { send } from "./connection.js";
import { decodeImage, jpegSize } from "./frames.js";
import { hooks } from "./hooks.js";
import { showOverlay } from "./overlay.js";
import { find, make, setText } from "./page.js";
import { game } from "./state.js";

const PART_HEADER = 7; // bytes: kind, number, offset
const MAX_ASSET = 8 * 2 ** 20; // bytes; hippodrome/trial/pictures/assets.py sends none so large
const SPRITE_SIDE = 4096; // pixels
const AT_ONCE = 16; // images that are asked for; a server refuses more than 200 messages a second

const loaded = new Map(); // hash -> `{ bitmap, frames, animations }`, kept while the page is open; null if it is broken
let table = []; // the server's list of images
let arrived = new Map(); // number -> the bytes so far
let asked = 0; // images with smaller numbers were asked for on this connection, or had come before
let underWay = 0; // how many images were asked for and have not come
let pixelsLeft = 64 * 2 ** 20; // pixels of all images, of which a browser needs four bytes each
const bar = make("progress", { max: 1, value: 0, hidden: true });
bar.setAttribute("aria-label", TEXT.pictures);
find("overlay-hint").after(bar);

export const spriteOf = (name) => loaded.get(table.find((each) => each.name === name)?.hash);

const loading = () => table.some((each) => !loaded.has(each.hash));

export function askForSprites(assets) {
  table = assets;
  for (const { bytes, hash } of assets) if (!(bytes <= MAX_ASSET)) loaded.set(hash, null);
  askForMore();
  showProgress();
}

function askForMore() {
  for (; asked < table.length && underWay < AT_ONCE; asked += 1) {
    const { name, hash } = table[asked];
    if (loaded.has(hash) || table.findIndex((each) => each.hash === hash) < asked) continue;
    underWay += 1;
    send({ asset: name });
  }
}

export async function takeSpritePart(buffer, ready) {
  const view = new DataView(buffer);
  const number = view.getUint16(1);
  const image = table[number];
  if (!image || loaded.has(image.hash)) return;
  const part = new Uint8Array(buffer, PART_HEADER);
  const all = arrived.get(number) ?? { bytes: new Uint8Array(image.bytes), length: 0 };
  arrived.set(number, all);
  if (view.getUint32(3) !== all.length || all.length + part.length > image.bytes) return;
  all.bytes.set(part, all.length);
  all.length += part.length;
  if (all.length === image.bytes) {
    underWay -= 1;
    const sprite = await opened(all.bytes).catch(() => null);
    loaded.set(image.hash, sprite);
    askForMore();
    if (!loading()) ready();
  }
  showProgress();
}

async function opened(bytes) {
  const end = 4 + new DataView(bytes.buffer).getUint32(0);
  const { type, frames = {}, animations = {} } = JSON.parse(new TextDecoder().decode(bytes.subarray(4, end)));
  const image = new DataView(bytes.buffer, end);
  const { width, height } = sizeOf(image);
  if (!(width <= SPRITE_SIDE && height <= SPRITE_SIDE && pixelsLeft >= width * height)) throw new Error("no such image");
  pixelsLeft -= width * height;
  const bitmap = await decodeImage(new Blob([bytes.subarray(end)], { type }));
  return { bitmap, frames: new Map(Object.entries(frames)), animations: new Map(Object.entries(animations)) };
}

// The size in the header of an image file, which is read before the image is decoded.
function sizeOf(view) {
  if (view.getUint32(0) === 0x89504e47) return { width: view.getUint32(16), height: view.getUint32(20) }; // PNG
  if (view.getUint32(0) !== 0x52494646) return jpegSize(view) ?? {};
  const three = (at) => view.getUint16(at, true) + (view.getUint8(at + 2) << 16); // WebP: of one of three kinds
  if (view.getUint8(15) === 0x58) return { width: 1 + three(24), height: 1 + three(27) };
  if (view.getUint8(15) === 0x20) return { width: view.getUint16(26, true) & 0x3fff, height: view.getUint16(28, true) & 0x3fff };
  const bits = view.getUint32(21, true);
  return { width: 1 + (bits & 0x3fff), height: 1 + ((bits >> 14) & 0x3fff) };
}

let progressShown = false; // whether the overlay shows the progress

// Shows the progress; when all images have come, shows the overlay of the state again.
function showProgress() {
  if (loading() && ["ready", "paused"].includes(game.state)) {
    const whole = table.reduce((sum, each) => sum + each.bytes, 0);
    const there = table.reduce((sum, each, number) => sum + (loaded.has(each.hash) ? each.bytes : arrived.get(number)?.length ?? 0), 0);
    bar.value = there / whole;
    setText(find("overlay-title"), TEXT.loadingPictures);
    setText(find("overlay-hint"), "");
    find("overlay-button").hidden = true;
    bar.hidden = false;
    progressShown = true;
  } else if (progressShown) {
    bar.hidden = true;
    progressShown = false;
    showOverlay(game.state);
  }
}

const othersWait = hooks.waits;
hooks.waits = () => loading() || othersWait();
hooks.overlay.push((name) => {
  bar.hidden = true;
  progressShown = false;
  if (["lost", "elsewhere"].includes(name)) {
    arrived = new Map(); // the next connection sends them anew
    asked = underWay = 0;
  } else if (loading()) showProgress();
});
