// The game page: it waits for the participant's server, then plays. docs/wire.md says what travels over the WebSocket,
// docs/pages.md what the poll address answers. The page carries these modules as one script
// (hippodrome/participants/scripts.py): no top-level name may occur in two of them.
import { isRunning, releaseAll, start } from "./actions.js";
import { countDown } from "./breaks.js";
import { ask, play, watch } from "./connection.js";
import { buildControls } from "./controls.js";
import { hooks } from "./hooks.js";
import { onKeyDown, onKeyUp } from "./keyboard.js";
import { leave } from "./leave.js";
import { hideMessage, showMessage, showOverlay } from "./overlay.js";
import { data, find, setText, showSection } from "./page.js";
import { loadPage, pause, pollUntilAnswered } from "./requests.js";
import { game } from "./state.js";
import { showStatus } from "./status.js";
import { clearDrafts } from "./storage.js";
import { isOver, noteRestart, pollDelay, restartedFor, showClock, showWaiting } from "./waiting.js";

const HANGS = TEXT.hangs;
const SILENT = 4_500; // ms without a message in a game; the server was asked meanwhile
const LONG = 20_000; // ms of trouble until more is said
const RELOAD_AFTER = 240_000; // ms of waiting: the request for a server may have been lost, and a reload repeats it

const title = document.title;

async function main() {
  let state = data.state;
  let losses = 0;
  let lostSince = null;
  let waitsSince = performance.now();
  for (let polls = 0; ; polls += 1) {
    if (state.state === "ready" && state.url) {
      const { why, welcome, result } = await playOn(state);
      losses = welcome ? 0 : losses + 1;
      lostSince = welcome ? performance.now() : lostSince ?? performance.now();
      if (why === "lost") showOverlay(performance.now() - lostSince < LONG ? "lost" : "unreachable");
      if (why === "done") return leave(result);
      if (why === "moved") await loadPage();
      if (why === "elsewhere") await playHere();
      else await pause(Math.min(5_000, 500 * 2 ** losses));
      polls = 0;
      waitsSince = performance.now();
    } else {
      document.title = data.title ?? title;
      lostSince = null;
      await showServer(state);
      if (performance.now() - waitsSince > RELOAD_AFTER && !isOver(state)) await loadPage();
      await pause(pollDelay(state, polls));
    }
    state = await pollUntilAnswered();
  }
}

// A server that is not ready, or gone. Loads the page again if the page does not know yet that it is gone, and why.
async function showServer(state) {
  const restarted = restartedFor(state);
  if (!isOver(state)) showWaiting(state);
  else if (restarted !== null) showWaiting({ ...state, state: "queued", seconds: restarted });
  else if (state.state !== data.state.state || state.attempt !== data.state.attempt) await loadPage();
  else showSection("over");
}

async function playOn(server) {
  if (find("play").hidden) {
    showSection("play");
    showOverlay("loading");
    document.title = TEXT.readyTitle(title);
    find("screen").focus({ preventScroll: true });
  }
  game.state = "loading";
  const end = await play(server, hear);
  lookWhetherItHangs();
  releaseAll(false);
  game.state = end.why;
  return end;
}

function hear(said) {
  if (said.error) showMessage(String(said.error));
  if (Array.isArray(said.UI)) buildControls(said);
  if (said.state) showStatus(said);
  if (said.state === "playing") document.title = title;
  for (const hook of hooks.said) hook(said);
}

// Two pages that took the game from each other by themselves would do so for ever.
function playHere() {
  showOverlay("elsewhere");
  hideMessage();
  return new Promise((resolve) => {
    find("overlay-button").addEventListener("click", () => {
      showOverlay("loading");
      resolve();
    }, { once: true });
  });
}

function lookWhetherItHangs() {
  const silent = watch(isRunning());
  if (silent > SILENT && isRunning()) setText(find("trouble"), HANGS);
  else if (find("trouble").textContent === HANGS) hideMessage();
  if (game.state === "loading" && silent > LONG) setText(find("overlay-hint"), TEXT.takesLonger);
}

clearDrafts();
setInterval(() => find("wait").hidden || showClock(), 1_000);
setInterval(lookWhetherItHangs, 1_000);
setInterval(countDown, 200);
find("again").addEventListener("submit", noteRestart);
find("overlay-button").addEventListener("click", () => {
  if (["ready", "paused", "break"].includes(game.state)) start();
  find("screen").focus({ preventScroll: true });
});
// A click must not take the keyboard away from the game: the next Space is meant for it.
find("play").addEventListener("mousedown", (event) => event.target.closest("button") && event.preventDefault());
find("play").addEventListener("contextmenu", (event) => event.preventDefault()); // what a long press brings up
window.addEventListener("keydown", onKeyDown);
window.addEventListener("keyup", onKeyUp);
window.addEventListener("blur", () => releaseAll());
window.addEventListener("online", ask);
document.addEventListener("visibilitychange", () => (document.hidden ? releaseAll() : ask()));
main();
