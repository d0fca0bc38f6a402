// Binary frames (docs/wire.md): the header, and the pixels or the picture that follow it.

const HEADER = 10; // bytes before the pixels
export const KEY = 0, DIFFERENCE = 1, JPEG = 2, ROWS = 3; // kinds of frames
const PART = 2 ** 14; // bytes that are unpacked at a time; they become at most 17 MB
const LARGEST = 2 ** 24; // pixels of a picture: 4096 x 4096; hippodrome/trial/pictures/frames.py sends no more

// What this browser decodes (docs/wire.md, "Opening"); scene.js adds objects.
export const decodes = canInflate() ? ["deflate", "jpeg"] : ["jpeg"];

function canInflate() {
  try {
    return Boolean(new DecompressionStream("deflate-raw"));
  } catch {
    return false; // Safari before 16.4, Firefox before 113, Chrome before 103
  }
}

// An object without fields, which `unpack` refuses, if the message is too short for a header.
export function readHeader(buffer) {
  if (buffer.byteLength < HEADER) return {};
  const view = new DataView(buffer);
  return {
    kind: view.getUint8(0),
    id: view.getUint32(1),
    width: view.getUint16(5),
    height: view.getUint16(7),
    channels: view.getUint8(9),
  };
}

// Resolves to `{ picture }` for a JPEG, `{ first, bytes }` for rows, `{ bytes }` otherwise. Rejects if it is no valid frame.
export async function unpack(header, buffer) {
  const { kind, width, height, channels } = header;
  const known = width * height > 0 && width * height <= LARGEST && (channels === 1 || channels === 3);
  if (!known || kind > ROWS || buffer.byteLength < HEADER + 2) throw new Error("no such frame");
  if (kind === JPEG) return decodeLossy(header, buffer);
  if (kind === ROWS) return inflateRows(header, buffer);
  return { bytes: await inflate(buffer.slice(HEADER), width * height * channels) };
}

async function inflateRows({ width, height, channels }, buffer) {
  const first = new DataView(buffer).getUint16(HEADER);
  const row = width * channels;
  const bytes = await inflate(buffer.slice(HEADER + 2), row, row * (height - first));
  if (bytes.length % row) throw new Error("no such frame");
  return { first, bytes };
}

// Unpacks little more than the header says: a small message must not become a huge picture. A DecompressionStream unpacks
// at once what it is given, so it gets each part when the previous part has been read. (The bytes of a Blob would come from
// another process, and each frame would wait for it.)
export async function inflate(packed, least, most = least) {
  let at = 0;
  const parts = new ReadableStream({
    pull: (to) => (at < packed.byteLength ? to.enqueue(packed.slice(at, (at += PART))) : to.close()),
  });
  const reader = parts.pipeThrough(new DecompressionStream("deflate-raw")).getReader();
  const pieces = [];
  let piece, length = 0;
  while (length <= most && !(piece = await reader.read()).done) {
    pieces.push(piece.value);
    length += piece.value.length;
  }
  if (length < least || length > most) throw new Error("no such frame");
  const bytes = new Uint8Array(length);
  for (const piece of pieces.reverse()) bytes.set(piece, (length -= piece.length));
  return bytes;
}

// For the same reason a JPEG's own size is read before it is decoded.
async function decodeLossy({ width, height }, buffer) {
  const size = jpegSize(new DataView(buffer, HEADER));
  if (size?.width !== width || size.height !== height) throw new Error("no such frame");
  const picture = await decodeImage(new Blob([buffer.slice(HEADER)], { type: "image/jpeg" }));
  if (picture.width !== width || picture.height !== height) throw new Error("no such frame");
  return { picture };
}

// The size in the frame header (SOF) of a JPEG; null if there is none. Segments begin with 0xff, a marker and their length.
export function jpegSize(view) {
  for (let at = 2; at + 9 <= view.byteLength; at += 2 + view.getUint16(at + 2)) {
    const marker = view.getUint16(at);
    if (marker < 0xffc0 || marker === 0xffda) return null;
    const isTable = marker === 0xffc4 || marker === 0xffc8 || marker === 0xffcc;
    if (marker <= 0xffcf && !isTable) return { width: view.getUint16(at + 7), height: view.getUint16(at + 5) };
  }
  return null;
}

// Resolves to a picture for `drawImage`. Safari before 15 has only the element for images.
export async function decodeImage(blob) {
  if (typeof createImageBitmap === "function") return createImageBitmap(blob);
  const picture = new Image();
  const reader = new FileReader();
  reader.readAsDataURL(blob);
  await new Promise((done) => (reader.onloadend = done));
  picture.src = reader.result;
  await picture.decode();
  return picture;
}
