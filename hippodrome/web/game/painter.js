// Draws the objects of a scene on a canvas of its own, which covers the canvas of the frames.
import { shapePicture } from "./canvas.js";
import { find, make } from "./page.js";
import { spriteOf } from "./sprites.js";

const MISSING = "#8080807f"; // the color in the place of an image that is missing
const LONGEST = 4096; // pixels of the canvas, on each side

const easel = make("canvas", { hidden: true });
Object.assign(easel.style, { position: "absolute", inset: 0, width: "100%", height: "100%" });
easel.setAttribute("aria-hidden", "true"); // the canvas below it has the label and the keyboard focus
find("screen").after(easel);
const brush = easel.getContext("2d", { alpha: false });

let picture = { width: 600, height: 400, background: "#ffffff", coordinates: "relative" };
let unitX = 600; // pixels of the picture for an x of 1
let unitY = 400;
let repaint = () => {};
let shaped = 0; // the ratio for which the layout has room; 0 if frames may have changed it

// Takes the picture's size and background from the scene's description. `changed` is called when the scene has to be drawn
// again.
export function prepare(scene, changed) {
  picture = scene;
  const relative = scene.coordinates === "relative";
  unitX = relative ? scene.width : 1;
  unitY = relative ? scene.height : 1;
  repaint = changed;
}

// Shows this canvas, in the shape of the scene. Returns whether it was hidden.
export function place() {
  const ratio = picture.width / picture.height;
  if (ratio !== shaped) shapePicture(ratio);
  shaped = ratio;
  if (!easel.hidden) return false;
  easel.hidden = false;
  fit();
  return true;
}

// Hides this canvas, so that the canvas of the frames shows.
export function putAway() {
  easel.hidden = true;
  shaped = 0;
}

// Gives the canvas as many pixels as it covers on the screen. Returns whether that changed.
function fit() {
  const scale = Math.min(devicePixelRatio * (easel.clientWidth || picture.width) / picture.width, LONGEST / Math.max(picture.width, picture.height));
  const width = Math.max(1, Math.round(picture.width * scale));
  const height = Math.max(1, Math.round(picture.height * scale));
  if (easel.width === width && easel.height === height) return false;
  Object.assign(easel, { width, height });
  return true;
}

// Draws each `[fields, ms]` over the earlier ones; `ms` is the age of the object. Returns whether an animation plays.
export function paint(layers) {
  brush.setTransform(1, 0, 0, 1, 0, 0);
  brush.globalAlpha = 1;
  brush.fillStyle = picture.background;
  brush.fillRect(0, 0, easel.width, easel.height);
  let plays = false;
  for (const [fields, ms] of layers) {
    brush.setTransform(easel.width / picture.width, 0, 0, easel.height / picture.height, 0, 0);
    brush.globalAlpha = fields.alpha ?? 1;
    brush.fillStyle = fields.color ?? "#000000";
    plays = draws[fields.type]?.(fields, ms) || plays;
  }
  return plays;
}

const draws = {
  circle(fields) {
    brush.beginPath();
    brush.arc(fields.x * unitX, fields.y * unitY, fields.radius, 0, 2 * Math.PI);
    fill(fields);
  },
  rectangle(fields) {
    const box = exact(...turned(fields, fields.width, fields.height), fields.width, fields.height);
    brush.beginPath();
    brush.rect(...box);
    fill(fields);
  },
  polygon(fields) {
    trace(fields.points);
    brush.closePath();
    fill(fields);
  },
  line(fields) {
    const { points, width = 1 } = fields;
    for (const edge of [fields.fill_above && 0, fields.fill_below && picture.height]) {
      if (typeof edge !== "number") continue;
      trace(points);
      brush.lineTo(points.at(-1)[0] * unitX, edge);
      brush.lineTo(points[0][0] * unitX, edge);
      brush.fill();
    }
    trace(points);
    Object.assign(brush, { strokeStyle: brush.fillStyle, lineWidth: width, lineJoin: "round" });
    if (width) brush.stroke();
  },
  text(fields) {
    const { text, size: pixelsHigh = 16, font = "Arial" } = fields;
    brush.font = `${pixelsHigh}px ${font}, sans-serif`;
    brush.textBaseline = "top";
    const lines = text.split("\n");
    const [, top] = turned(fields, 0, 1.2 * pixelsHigh * lines.length);
    brush.textAlign = "left";
    const share = fields.origin?.[0] ?? 0; // each line has its own width
    lines.forEach((each, number) => brush.fillText(each, -share * brush.measureText(each).width, top + 1.2 * pixelsHigh * number));
  },
  sprite(fields, ms) {
    const image = spriteOf(fields.image);
    const animation = image?.animations.get(fields.animation);
    const name = animation ? animation[0][Math.floor((ms / 1000) * animation[1]) % animation[0].length] : fields.frame;
    const box = name === undefined ? image && [0, 0, image.bitmap.width, image.bitmap.height] : image?.frames.get(name);
    const width = fields.width ?? (box ? (fields.height ? fields.height * box[2] / box[3] : box[2]) : 32);
    const height = fields.height ?? (box ? width * box[3] / box[2] : 32);
    const place = exact(...turned(fields, width, height), width, height);
    brush.imageSmoothingEnabled = !picture.pixelArt;
    if (box) brush.drawImage(image.bitmap, ...box, ...place);
    else {
      brush.fillStyle = MISSING;
      brush.fillRect(...place);
    }
    return Boolean(animation);
  },
};

// Moves the brush to the object's x and y, and turns it by the angle. Returns its left and top from there.
function turned({ x, y, angle = 0, origin = [0, 0] }, width, height) {
  brush.translate(x * unitX, y * unitY);
  brush.rotate(angle * Math.PI / 180);
  return [-origin[0] * width, -origin[1] * height];
}

// Moves the edges of a box that is not turned to whole pixels of the screen: between the tiles of a grid there is no gap.
function exact(left, top, width, height) {
  const { a, b, d, e, f } = brush.getTransform();
  if (b) return [left, top, width, height];
  const x = (each) => (Math.round(a * each + e) - e) / a;
  const y = (each) => (Math.round(d * each + f) - f) / d;
  return [x(left), y(top), x(left + width) - x(left), y(top + height) - y(top)];
}

function trace(points) {
  brush.beginPath();
  for (const [x, y] of points) brush.lineTo(x * unitX, y * unitY);
}

function fill({ outline, outline_width: lineWidth = 1 }) {
  brush.fill();
  if (outline) Object.assign(brush, { strokeStyle: outline, lineWidth }).stroke();
}

new ResizeObserver(() => !easel.hidden && fit() && repaint()).observe(easel);
