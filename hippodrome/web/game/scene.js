// Games that are drawn by objects (docs/wire.md, "A scene"): puts the server's changes together, and shows the scene.
import { decodes, DIFFERENCE, inflate, JPEG, KEY, readHeader, ROWS, unpack } from "./frames.js";
import { hooks } from "./hooks.js";
import { askForSprites, takeSpritePart } from "./sprites.js";
import { addStyle, find, make, setText } from "./page.js";
import { paint, place, prepare, putAway } from "./painter.js";

const SCENE_HEADER = 5; // bytes: kind, id
const MAX_SCENE = 16 * 2 ** 20; // bytes, unpacked; hippodrome/trial/pictures/scene.py makes none so large
const TWEENED = ["x", "y", "angle", "width", "height", "radius", "alpha"];
const DEFAULTS = { angle: 0, alpha: 1 }; // the values of fields that the server leaves out

const utf8 = new TextDecoder();
const things = new Map(); // id -> the object: its `fields`, and while it moves `from`, `began`, `ms`
let layers = null; // the objects in the order in which they are drawn; null if they must be sorted again
let waitsForPaint = false;

const hud = make("span", { id: "scene-hud", hidden: true });
find("score").closest("p").append(hud);
addStyle(`.hud { flex-wrap: wrap; }
.hud #scene-hud { flex: 1 0 100%; white-space: pre-line; overflow-wrap: anywhere; text-align: center; }
@media (min-aspect-ratio: 5/4) {
  .hud { flex-wrap: nowrap; }
  .hud #scene-hud { flex: none; text-align: inherit; }
}`);

async function unpackScene(kind, buffer) {
  const body = buffer.slice(SCENE_HEADER);
  const bytes = kind === 5 ? await inflate(body, 2, MAX_SCENE) : body;
  const scene = JSON.parse(utf8.decode(bytes));
  return { draw: () => change(scene) };
}

// Applies the changes of a scene, and draws it at once, if objects have changed: the screen shows it at its next refresh.
function change(scene) {
  const now = performance.now();
  if (scene.new) things.clear();
  for (const id of scene.gone ?? []) things.delete(id);
  for (const [id, fields] of Object.entries(scene.set ?? {})) {
    const thing = things.get(id);
    if (!thing) things.set(id, { fields, since: now });
    else Object.assign(thing, fields.type ? { fields, since: now, from: null } : moved(thing, fields, now));
    if (!thing || fields.type || "depth" in fields) layers = null;
  }
  for (const id of scene.order ?? []) {
    const thing = things.get(id);
    things.delete(id);
    if (thing) things.set(id, thing);
  }
  if (scene.new || scene.gone || scene.order) layers = null;
  if (scene.hud !== undefined) {
    setText(hud, scene.hud);
    hud.hidden = !scene.hud;
  }
  const changed = scene.new || scene.set || scene.gone || scene.order;
  if (place() || changed) show(now);
}

// The changed object. With a tween it moves to its new values from those that are shown now.
function moved(thing, fields, now) {
  const next = { ...thing.fields };
  for (const [key, value] of Object.entries(fields)) {
    if (value === null) delete next[key];
    else next[key] = value;
  }
  const since = "animation" in fields ? now : thing.since;
  const steps = next.tween ? TWEENED.filter((key) => key in fields) : [];
  if (!steps.length) return { fields: next, since, ...(thing.from && !next.tween ? { from: null } : {}) };
  const here = shownNow(thing, now);
  const from = Object.fromEntries(steps.map((key) => [key, here[key] ?? DEFAULTS[key]]));
  for (const key in thing.from ?? {}) from[key] ??= here[key];
  return { fields: next, since, from, began: now, ms: next.tween };
}

// The object's fields at this time, in the middle of a tween too.
function shownNow(thing, now) {
  if (!thing.from) return thing.fields;
  const share = (now - thing.began) / thing.ms;
  if (share >= 1) {
    thing.from = null;
    return thing.fields;
  }
  const shown = { ...thing.fields };
  for (const [key, start] of Object.entries(thing.from)) {
    let way = (shown[key] ?? DEFAULTS[key]) - start;
    if (key === "angle") way = ((((way + 180) % 360) + 360) % 360) - 180; // the shorter way round
    if (Number.isFinite(way)) shown[key] = start + share * way;
  }
  return shown;
}

// Draws the scene, and again at each refresh of the screen while something moves by itself.
function show(now) {
  layers ??= [...things.values()].sort((one, other) => (one.fields.depth ?? 0) - (other.fields.depth ?? 0));
  const plays = paint(layers.map((thing) => [shownNow(thing, now), now - thing.since]));
  if ((plays || layers.some((thing) => thing.from)) && !waitsForPaint) {
    waitsForPaint = true;
    requestAnimationFrame(() => {
      waitsForPaint = false;
      if (things.size) show(performance.now());
    });
  }
}

decodes.push("objects");
for (const kind of [4, 5]) {
  hooks.kinds[kind] = (buffer, take) => take({ kind, id: new DataView(buffer).getUint32(1) }, unpackScene(kind, buffer));
}
for (const kind of [KEY, DIFFERENCE, JPEG, ROWS]) {
  hooks.kinds[kind] = (buffer, take) => {
    const header = readHeader(buffer);
    take(header, unpack(header, buffer).finally(putAway));
  };
}
hooks.kinds[6] = (buffer) => takeSpritePart(buffer, () => things.size && show(performance.now()));
hooks.message.push((message) => {
  if (!message.scene) return;
  prepare(message.scene, () => things.size && show(performance.now()));
  askForSprites(message.assets ?? []);
});
