// The buttons and the slider, according to the server's message with `UI` and `actionSpace`.
import { command } from "./actions.js";
import { hooks } from "./hooks.js";
import { assignKeys, DIRECTIONS, showLegend } from "./keyboard.js";
import { data, find, make } from "./page.js";
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
      commandButtons(shown, [["good", TEXT.good], ["bad", TEXT.bad], ...list(message.words).map((word) => [String(word), nice(String(word))])], "commands words"),
      commandsOf(shown),
      hooks.rates(shown, message),
    ].filter(Boolean),
  );
  showLegend(directions, others, shown, space, own?.lines);
}

const list = (value) => (Array.isArray(value) ? value : []);

// The actions that get keys or buttons: not the one that is taken while no key is pressed, and instead of a compound such as "upright" its parts.
function singleActions(actionSpace) {
  const single = list(actionSpace).map(String).flatMap((name) => (COMPOUND.test(name) ? name.match(/up|down|left|right|fire/g) : [name]));
  return [...new Set(single)].filter((name) => name !== "noop" && name !== data.idle).slice(0, 64);
}

export function groupOf(className, buttons) {
  return buttons.length ? followFingers(equalButtons(className, buttons)) : null;
}

// All buttons of a group are as large as the one with the longest label needs.
function equalButtons(className, buttons) {
  const letters = buttons.map((each) => each.textContent.length);
  return make("div", { className, style: `--letters:${Math.max(...letters)}` }, ...buttons);
}

export const labelOf = (action, labels = {}) => labels[action] ?? DIRECTIONS[action]?.label ?? nice(action);

// "trainOnline" as "Train online"
export function nice(name) {
  const words = name.replace(/[_-]|\B(?=[A-Z])/g, " ");
  return words.charAt(0).toUpperCase() + words.slice(1).toLowerCase();
}

function commandsOf(shown) {
  return commandButtons(shown, [
    ["toggle", TEXT.pause, "pause"],
    ["reset", TEXT.reset],
    ["trainOnline", TEXT.trainOnline],
    ["trainOffline", TEXT.trainOffline],
    ["stop", TEXT.end],
  ]);
}

// Makes the buttons that the project offers, out of `all`: each is a command, its label, and its key in `ui` if that differs.
export function commandButtons(shown, all, className = "commands") {
  const buttons = all.filter(([name, , key = name]) => shown.has(key)).map(([name, label]) => {
    const button = make("button", { type: "button", textContent: label });
    button.dataset.command = name;
    button.addEventListener("click", () => command(name));
    return button;
  });
  return buttons.length ? equalButtons(className, buttons) : null;
}
