// What the participant does: actions of the environment, held down by keys or fingers, and commands.
import { expectAnswer, send } from "./connection.js";
import { hooks } from "./hooks.js";
import { game } from "./state.js";

const held = new Map(); // action -> the set of keys and fingers that hold it down

const isRunning = () => game.state === "playing" || game.state === "break";

export function press(action, source) {
  if (game.state === "elsewhere") return;
  if (!isRunning()) {
    start();
    if (hooks.starts()) return;
  }
  const sources = held.get(action) ?? new Set();
  held.set(action, sources.add(source));
  if (sources.size === 1) send({ ...hooks.means(action), held: true });
}

export function release(action, source) {
  const sources = held.get(action);
  if (!sources?.delete(source) || sources.size) return;
  held.delete(action);
  send({ ...hooks.means(action), held: false });
}

// Lets go of all actions. `tell` is false when there is no server to tell.
export function releaseAll(tell = true) {
  if (tell) for (const action of held.keys()) send({ ...hooks.means(action), held: false });
  held.clear();
  document.querySelectorAll(".pressed").forEach((button) => button.classList.remove("pressed"));
}

// Sends an action once, without holding it down.
export function tap(action) {
  if (!isRunning()) {
    start();
    if (hooks.starts()) return;
  }
  send(hooks.means(action));
}

export function start() {
  if (hooks.waits()) return;
  expectAnswer();
  send({ command: "start" });
}

export function command(name) {
  if (name === "toggle" && game.state !== "playing") return start();
  if (name === "toggle") return game.offered?.has("pause") && send({ command: "pause" });
  if (name === "stop" && !window.confirm(TEXT.endConfirm)) return;
  if (name === "faster" || name === "slower") return send({ changeFrameRate: name });
  send({ command: name });
}
