// The game page: it waits for the participant's server, then plays. docs/wire.md describes the messages of the WebSocket,
// docs/pages.md the answers to polls. The page carries these modules as one script (hippodrome/control/participants/scripts.py):
// no top-level name may occur in two of them.
import { releaseAll, start } from "./actions.js";
import { countDown } from "./breaks.js";
import { ask, play, watch } from "./connection.js";
import { buildControls } from "./controls.js";
import { hooks } from "./hooks.js";
import { onKeyDown, onKeyUp } from "./keyboard.js";
import { leave } from "./leave.js";
import { hideMessage, showMessage, showOverlay } from "./overlay.js";
import { data, find, setText, showSection } from "./page.js";
import { loadPage, pause, pollUntilAnswered, secondsBehind } from "./requests.js";
import { game } from "./state.js";
import { showStatus } from "./status.js";
import { clearDrafts } from "./storage.js";
import { beat, isOver, noteRestart, pollDelay, restartedFor, showWaiting } from "./waiting.js";

const HANGS = TEXT.hangs;
const SILENT = 2_200; // ms without a message, although the server was asked
const LONG = 20_000; // ms without a message while the game is loaded
const LATE = 90; // seconds by which a clock is behind, so that it is said why the page cannot connect
const EARLY = 5 * 86_400; // seconds by which it is ahead: certificates of addresses are valid for 160 hours
const RELOAD_AFTER = 240_000; // ms of waiting: the request for a server may be lost, and a reload repeats it

const title = document.title;

async function main() {
  let state = data.state;
  let losses = 0;
  let hint = TEXT.noConnection; // why the game is not there yet, if the connection fails; "" once a server has let the page in
  let waitsSince = performance.now();
  for (let polls = 0; ; polls += 1) {
    if (state.state === "ready" && state.url) {
      if ("server" in data && !state.url.startsWith(data.server || "none")) await loadPage();
      const { why, welcome, result } = await playOn(state);
      losses = welcome ? 0 : losses + 1;
      if (welcome) hint = "";
      else if (why === "failed") hint = TEXT.takesLonger;
      if (why === "lost") hint ? setText(find("overlay-hint"), clockHint() || hint) : showOverlay("lost");
      if (why === "done") return leave(result);
      if (why === "moved") await loadPage();
      if (why === "elsewhere") await playHere();
      else await pause(Math.min(5_000, 500 * 2 ** losses));
      polls = 0;
      waitsSince = performance.now();
    } else {
      document.title = data.title ?? title;
      await showServer(state);
      if (performance.now() - waitsSince > RELOAD_AFTER && !isOver(state)) await loadPage();
      await pause(pollDelay(state, polls));
    }
    state = await pollUntilAnswered();
  }
}

// Shows the state of a server that is not ready. If it has ended, loads the page again, which then says why.
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
  checkForHang();
  releaseAll(false);
  game.state = end.why;
  return end;
}

function hear(message) {
  if (message.error) showMessage(String(message.error));
  if (Array.isArray(message.UI)) buildControls(message);
  if (message.state) showStatus(message);
  if (message.state === "playing") document.title = title;
  for (const hook of hooks.message) hook(message);
}

// Another page has the game. The participant decides: two pages could take it from each other without end.
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

// By a clock that is late, a certificate that is some seconds old is not valid yet; by one that is a week early, no more.
// Names have an old certificate, which is valid for months.
function clockHint() {
  const seconds = secondsBehind();
  if (!("server" in data) || (seconds < LATE && seconds > -EARLY)) return "";
  const time = new Date(Date.now() + seconds * 1_000);
  return TEXT.clockWrong(time.toLocaleString(TEXT.language, { dateStyle: "long", timeStyle: "short" }));
}

function checkForHang() {
  const silent = watch();
  if (silent > SILENT && game.state !== "loading") setText(find("trouble"), HANGS);
  else if (find("trouble").textContent === HANGS) hideMessage();
  if (game.state === "loading" && silent > LONG) setText(find("overlay-hint"), TEXT.takesLonger);
}

clearDrafts();
setInterval(() => find("wait").hidden || beat(), 1_000);
setInterval(checkForHang, 500);
setInterval(countDown, 200);
find("again").addEventListener("submit", (event) => event.submitter?.value === "restart" && noteRestart());
find("overlay-button").addEventListener("click", () => {
  if (["ready", "paused", "break"].includes(game.state)) start();
  find("screen").focus({ preventScroll: true });
});
// A click on a button must not take the focus from the game: the next Space is meant for the game.
find("play").addEventListener("mousedown", (event) => event.target.closest("button") && event.preventDefault());
find("play").addEventListener("contextmenu", (event) => event.preventDefault()); // the menu of a long press
window.addEventListener("keydown", onKeyDown);
window.addEventListener("keyup", onKeyUp);
window.addEventListener("blur", () => releaseAll());
window.addEventListener("online", ask);
document.addEventListener("visibilitychange", () => (document.hidden ? releaseAll() : ask()));
main();
