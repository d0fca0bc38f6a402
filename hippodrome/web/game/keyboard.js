// The keys of the game, and the legend that lists them.
import { command, press, release, releaseAll } from "./actions.js";
import { hooks } from "./hooks.js";
import { find, make } from "./page.js";

export const DIRECTIONS = {
  up: { sign: "↑", label: TEXT.up, codes: ["ArrowUp", "KeyW"] },
  left: { sign: "←", label: TEXT.left, codes: ["ArrowLeft", "KeyA"] },
  right: { sign: "→", label: TEXT.right, codes: ["ArrowRight", "KeyD"] },
  down: { sign: "↓", label: TEXT.down, codes: ["ArrowDown", "KeyS"] },
};

const COMMANDS = { reset: ["R", TEXT.keyReset], good: ["G", TEXT.keyGood], bad: ["B", TEXT.keyBad] }; // key, and text of the legend

let keys = new Map(); // event.code -> `{ action }` or `{ command }`
const actionsDown = new Map(); // event.code -> the action at the press: NumLock or Shift may change the key before the release

// `space`: whether the game uses the space key; then P starts and pauses the game.
export function assignKeys(directions, others, shown, space) {
  keys = new Map();
  for (const name of directions) for (const code of DIRECTIONS[name].codes) keys.set(code, { action: name });
  others.forEach((name) => keys.set(keyOf(name, others), { action: name }));
  if (!space) keys.set("Space", { command: "toggle" });
  if (!keys.has("KeyP") && (shown.has("pause") || space)) keys.set("KeyP", { command: "toggle" });
  for (const name in COMMANDS) if (shown.has(name)) keys.set(`Key${COMMANDS[name][0]}`, { command: name });
}

function keyOf(name, others) {
  if (name === "fire") return "Space";
  const number = others.filter((other) => other !== "fire").indexOf(name) + 1;
  return number <= 9 ? `Digit${number}` : `Unreachable${number}`;
}

export function showLegend(directions, others, shown, space, lines = []) {
  const arrows = ["left", "up", "right", "down"].filter((name) => directions.includes(name));
  if (arrows.length) lines.push([arrows.map((name) => DIRECTIONS[name].sign), TEXT.keyMove]);
  for (const name of others) {
    const code = keyOf(name, others);
    if (!code.startsWith("Unreachable")) lines.push([[code === "Space" ? TEXT.space : code.replace("Digit", "")], name]);
  }
  lines.push([[space ? "P" : TEXT.space], shown.has("pause") ? TEXT.keyToggle : TEXT.keyStart]);
  for (const name in COMMANDS) if (shown.has(name)) lines.push(COMMANDS[name]);
  find("legend").replaceChildren(...lines.map(([names, text]) => {
    const boxes = [...names].map((name) => make("kbd", { textContent: name }));
    return make("span", {}, ...boxes, ` ${text}`);
  }));
}

// The numeric keypad has the arrows without NumLock, and digits with it.
function codeOf({ code, key }) {
  if (!code.startsWith("Numpad")) return code;
  return /^[0-9]$/.test(key) ? `Digit${key}` : key;
}

// Keys play the game. A control that was reached with the Tab key keeps those that operate it; after a click or a touch,
// controls keep none.
const OPERATE = { BUTTON: /^(\s|Enter)$/, INPUT: /^(Arrow|Page|Home|End)/ }; // the only input is the slider for the speed
let tabbed = false;

function noteTab(is) {
  tabbed = is;
  find("play").classList.toggle("tabbed", is); // only then a ring shows the focus
}

window.addEventListener("pointerdown", () => noteTab(false), true);

export function onKeyDown(event) {
  if (event.key === "Meta") releaseAll(); // macOS sends no keyup of other keys while Cmd is held
  const does = hooks.key(event) ?? keys.get(codeOf(event));
  if (!does && event.key === "Tab") noteTab(true);
  if (!does || find("play").hidden || event.ctrlKey || event.metaKey || event.altKey) return;
  if (tabbed && OPERATE[event.target.tagName]?.test(event.key)) return;
  event.preventDefault(); // the page must not scroll
  if (event.repeat) return;
  if (!does.action) return command(does.command);
  actionsDown.set(event.code, does.action);
  press(does.action, event.code);
}

export function onKeyUp(event) {
  const action = hooks.key(event)?.action ?? actionsDown.get(event.code);
  actionsDown.delete(event.code);
  if (action) release(action, event.code);
}
