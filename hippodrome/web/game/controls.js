// The buttons and the slider, according to the server's message with `UI` and `actionSpace`.
import { command } from "./actions.js";
import { hooks } from "./hooks.js";
import { assignKeys, DIRECTIONS, showLegend } from "./keyboard.js";
import { find, make } from "./page.js";
import { game } from "./state.js";
import { actionButton, followFingers } from "./touch.js";

const COMPOUND = /^(up|down|left|right|fire){2,}$/; // two keys at once, such as "upright"

let built = ""; // what the controls were built from

export function buildControls(message) {
  const wanted = JSON.stringify([message.UI, message.actionSpace, message.allowFrameRateChange]);
  if (wanted === built) return;
  built = wanted;
  const shown = new Set(list(message.UI));
  const own = hooks.controls(message);
  const actions = own ? [] : singleActions(message.actionSpace);
  const space = own?.space ?? actions.includes("fire");
  const directions = Object.keys(DIRECTIONS).filter((name) => shown.has(name) && actions.includes(name));
  const buttonOf = (name) => actionButton(name, labelOf(name, message.labels), DIRECTIONS[name]?.sign);
  const others = actions.filter((name) => !(name in DIRECTIONS));
  game.directions = own?.arrows ?? directions.length > 0;
  game.offered = shown;
  assignKeys(directions, others, shown, space);
  find("controls").replaceChildren(
    ...[
      ...(own?.groups ?? [
        groupOf("pad", directions.map(buttonOf)),
        groupOf("others", others.map(buttonOf)),
      ]),
      commandsOf(shown, message),
      hooks.rates(shown, message),
    ].filter(Boolean),
  );
  showLegend(directions, others, shown, space, own?.lines);
}

const list = (value) => (Array.isArray(value) ? value : []);

// The actions that get keys or buttons: not "noop", and instead of a compound such as "upright" its parts.
function singleActions(actionSpace) {
  const single = list(actionSpace).map(String).flatMap((name) => (COMPOUND.test(name) ? name.match(/up|down|left|right|fire/g) : [name]));
  return [...new Set(single)].filter((name) => name !== "noop").slice(0, 64);
}

export function groupOf(className, buttons) {
  const letters = buttons.map((each) => each.textContent.length);
  return buttons.length ? followFingers(make("div", { className, style: `--letters:${Math.max(...letters)}` }, ...buttons)) : null;
}

export const labelOf = (action, labels = {}) => labels[action] ?? DIRECTIONS[action]?.label ?? nice(action);

// "trainOnline" as "Train online"
export function nice(name) {
  const words = name.replace(/[_-]|\B(?=[A-Z])/g, " ");
  return words.charAt(0).toUpperCase() + words.slice(1).toLowerCase();
}

function commandsOf(shown, { words }) {
  return commandButtons(shown, [
    ["toggle", TEXT.start, shown.has("start") ? "start" : "pause"],
    ["reset", TEXT.reset],
    ...Object.entries({ good: TEXT.good, bad: TEXT.bad, trainOnline: TEXT.trainOnline, trainOffline: TEXT.trainOffline }),
    ...list(words).map(String).map((word) => [word, nice(word)]),
    ["stop", TEXT.end],
  ]);
}

// Makes the buttons that the project offers, out of `all`: each is a command, its label, and its key in `ui` if that differs.
export function commandButtons(shown, all) {
  const buttons = all.filter(([name, , key = name]) => shown.has(key)).map(([name, label]) => {
    const button = make("button", { type: "button", textContent: label });
    button.dataset.command = name;
    button.addEventListener("click", () => command(name));
    return button;
  });
  return buttons.length ? make("div", { className: "commands" }, ...buttons) : null;
}
