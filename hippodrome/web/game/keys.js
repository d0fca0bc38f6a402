// Keys and buttons of a project whose config.yml defines keys (`keys` in the server's message with `UI`).
import { groupOf, labelOf } from "./controls.js";
import { hooks } from "./hooks.js";
import { DIRECTIONS } from "./keyboard.js";
import { data } from "./page.js";
import { actionButton } from "./touch.js";

const ARROWS = { ArrowUp: "up", ArrowLeft: "left", ArrowRight: "right", ArrowDown: "down" };
const MAX_BUTTONS = 64;

let bound = new Map(); // the name of a key in this module -> its name in `keys`
const pressedKeys = new Map(); // event.code -> the name at the press: Shift may change `event.key` before the release

const nameOfKey = (key) => `key:${key}`;

// The single keys of a combination; the same as `parts` in hippodrome/protocol/keyboard.py.
const partsOf = (combined) => [...combined.matchAll(/(\+|[^+]+)(?:\+|$)/g)].map(([, key]) => key);

hooks.means = (name) => (bound.has(name) ? { key: bound.get(name) } : { action: name });

hooks.key = (event) => {
  if (event.type === "keyup") {
    const name = pressedKeys.get(event.code);
    pressedKeys.delete(event.code);
    return name && { action: name };
  }
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const onCode = /^(?:Key|Digit|Numpad)(.)$/.exec(event.code)?.[1].toLowerCase(); // another layout, or Shift with a digit
  const name = [nameOfKey(key), nameOfKey(onCode)].find((each) => bound.has(each));
  if (!name) return undefined;
  pressedKeys.set(event.code, name);
  return { action: name };
};

hooks.controls = ({ keys, labels = {}, actionSpace }) => {
  if (!keys) return undefined;
  const all = Object.entries(keys).map(([combined, action]) => ({ parts: partsOf(combined), action }));
  const single = new Map(all.filter(({ parts }) => parts.length === 1).map(({ parts, action }) => [parts[0], action]));
  bound = new Map(all.flatMap(({ parts }) => parts).map((key) => [nameOfKey(key), key]));
  const pad = Object.keys(ARROWS).filter((key) => bound.has(nameOfKey(key)));
  const label = (action) => labelOf(action, labels);
  const ofPad = ({ parts }) => parts.every((key) => pad.includes(key));
  const ofButtons = ({ parts }) => parts.every((key) => pad.includes(key) || single.has(key));

  // Whether the action gets a button outside of the pad. The action of two buttons together gets none.
  function standsAlone(action) {
    const own = all.filter((each) => each.action === action);
    if (own.some((each) => each.parts.length === 1 && ofPad(each))) return false;
    return Boolean(labels[action]) || own.some(({ parts }) => parts.length === 1) || !own.some(ofButtons);
  }

  const actions = actionSpace.filter((action) => labels[action] || all.some((each) => each.action === action));
  const keyOf = (action) => [...single.keys()].find((key) => single.get(key) === action);
  return {
    arrows: pad.length > 0,
    space: bound.has(nameOfKey(" ")),
    groups: [
      groupOf("pad", pad.map((key) => padButton(key, single.has(key) ? label(single.get(key)) : DIRECTIONS[ARROWS[key]].label))),
      groupOf("others", actions.filter((action) => action !== data.idle && standsAlone(action)).slice(0, MAX_BUTTONS).map((action) => {
        const key = keyOf(action);
        return actionButton(key === undefined ? action : nameOfKey(key), label(action));
      })),
    ],
    lines: actions.map((action) => [
      all.filter((each) => each.action === action && (each.parts.length === 1 || !ofPad(each))).map(signs),
      labels[action] ?? action,
    ]).filter(([shown]) => shown.length),
  };
};

function padButton(key, label) {
  const direction = ARROWS[key];
  const button = actionButton(nameOfKey(key), label, DIRECTIONS[direction].sign);
  button.className = `hold ${direction}`;
  return button;
}

function signs({ parts }) {
  return parts.map((key) => DIRECTIONS[ARROWS[key]]?.sign ?? { " ": TEXT.space }[key] ?? (key.length > 1 ? key : key.toUpperCase())).join(" + ");
}
