// The buttons and the slider that the project offers: the server's message with `UI` and `actionSpace` says which.
import { command } from "./actions.js";
import { send } from "./connection.js";
import { assignKeys, DIRECTIONS, showLegend } from "./keyboard.js";
import { find, make } from "./page.js";
import { game } from "./state.js";
import { actionButton, followFingers } from "./touch.js";

const MOST_ACTIONS = 64; // buttons for them; more would fill no page but memory
const COMPOUND = /^(up|down|left|right|fire){2,}$/; // two keys at once, such as "upright"

let built = ""; // the message that the present controls were built from

export function buildControls(said) {
  const wanted = JSON.stringify([said.UI, said.actionSpace, said.allowFrameRateChange]);
  if (wanted === built) return;
  built = wanted;
  const shown = new Set(said.UI);
  const actions = singleActions(said.actionSpace);
  const directions = Object.keys(DIRECTIONS).filter((name) => shown.has(name) && actions.includes(name));
  const others = actions.filter((name) => !(name in DIRECTIONS));
  game.directions = directions.length > 0;
  game.offered = shown;
  assignKeys(directions, others, shown);
  find("controls").replaceChildren(
    ...[padOf(directions), othersOf(others), commandsOf(shown), ratesOf(shown, said)].filter((element) => element),
  );
  showLegend(directions, others, shown);
}

// The actions that have keys or buttons: without "noop", and of a compound such as "upright" its parts.
function singleActions(actionSpace) {
  const names = (Array.isArray(actionSpace) ? actionSpace : []).map(String);
  const single = names.flatMap((name) => (COMPOUND.test(name) ? name.match(/up|down|left|right|fire/g) : [name]));
  return [...new Set(single)].filter((name) => name !== "noop").slice(0, MOST_ACTIONS);
}

function padOf(directions) {
  if (!directions.length) return null;
  const buttons = directions.map((name) => actionButton(name, DIRECTIONS[name].label, `${DIRECTIONS[name].sign}\ufe0e`));
  return followFingers(make("div", { className: "pad" }, ...buttons));
}

function othersOf(others) {
  const nice = (name) => name.charAt(0).toUpperCase() + name.slice(1).replace(/[_-]/g, " ");
  return others.length
    ? followFingers(make("div", { className: "others" }, ...others.map((name) => actionButton(name, nice(name)))))
    : null;
}

function commandsOf(shown) {
  return commandButtons(shown, [
    ["toggle", "Start", shown.has("start") ? "start" : "pause"],
    ["reset", "Begin again"],
    ["good", "Good"],
    ["bad", "Bad"],
    ["trainOnline", "Train online"],
    ["trainOffline", "Train offline"],
    ["stop", "End the game"],
  ]);
}

// Of `all` (command, label, and the key of `ui` if it has another name) the buttons that the project offers.
function commandButtons(shown, all) {
  const buttons = all.filter(([name, , key = name]) => shown.has(key)).map(([name, label]) => {
    const button = make("button", { type: "button", textContent: label });
    button.dataset.command = name;
    button.addEventListener("click", () => command(name));
    return button;
  });
  return buttons.length ? make("div", { className: "commands" }, ...buttons) : null;
}

function ratesOf(shown, said) {
  if (!said.allowFrameRateChange) return null;
  const buttons = commandButtons(shown, [
    ["slower", "Slower", "fpsDown"],
    ["faster", "Faster", "fpsUp"],
  ]);
  const box = make("div", { className: "rates" });
  if (shown.has("fpsSet")) {
    const slider = make("input", { type: "range", id: "rate", min: said.minFrameRate, max: said.maxFrameRate });
    slider.addEventListener("change", () => send({ changeFrameRate: Number(slider.value) }));
    box.append(make("label", { htmlFor: "rate", textContent: "Speed" }), slider, make("output", { htmlFor: "rate" }));
  }
  if (buttons) box.append(buttons);
  return box.childElementCount ? box : null;
}

export function showRate() {
  const slider = find("rate");
  if (!slider) return;
  slider.value = game.frameRate;
  slider.nextElementSibling.value = `${game.frameRate} per second`;
}
