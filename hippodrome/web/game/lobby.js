// The lobby, in which a participant waits for others. The rest of the script runs once the participant is matched, so
// this module stands before it and imports nothing that runs the game. docs/pages.md describes the answers to polls.
import { data, duration, find, make, setText, showSection } from "./page.js";
import { loadPage, pageAnswers, pause, pollUntilAnswered } from "./requests.js";
import { isOver } from "./waiting.js";

// Milliseconds between polls. For the lobby, a participant who has not asked for ten seconds is gone; one who is matched
// confirms that by the next poll. The answer to a poll sets the timer of the next one, and no timer sets another timer:
// browsers let such chains run only once a minute on pages that are hidden for long
// (developer.chrome.com/blog/timer-throttling-in-chrome-88).
const ASK_EVERY = 2_000;
const CONFIRM_AFTER = 500;
const CLOCKS_DIFFER = 5; // seconds by which the clocks of the site's computers may differ
const NO_ANSWER = 10_000; // after so many ms of failed polls the page is fetched: it may say why they fail
const SOON_OVER = [60, 10]; // a screen reader says when so many seconds are left
const CALL = "● "; // stands before the title of a hidden page every other second

const studyTitle = document.title;
const lobby = { state: data.state, since: 0, trouble: null, waits: data.state.state === "lobby", text: "" };

async function waitForOthers() {
  while (lobby.waits) {
    showLobby();
    await pause(lobby.state.proposed ? CONFIRM_AFTER : ASK_EVERY);
    const asked = performance.now();
    const state = await pollUntilAnswered();
    const took = performance.now() - asked;
    // The study was registered anew, for another number of players than this page.
    if (state.players && state.players !== data.players) await reloadLobby();
    if (state.state === "lobby") {
      // The clock of a participant who was away begins anew.
      if (state.seconds < lobby.state.seconds - CLOCKS_DIFFER) {
        setText(find("lobby-note"), TEXT.lobbyAway);
        announce(find("lobby-note").textContent);
      }
      lobby.state = state;
      if (took > ASK_EVERY) await pause(took); // so a slow site is asked less often
    } else await proceed(state);
  }
}

// Loads the page again without leaving the lobby. Never resolves.
function reloadLobby() {
  lobby.waits = false;
  return loadPage();
}

// The participant is matched, or the study goes on without the game.
async function proceed(state) {
  lobby.waits = false;
  if (isOver(state) || state.state === "unmatched") return loadPage();
  data.state = state;
  find("lobby").hidden = true;
  showCompany();
  find("announce").textContent = TEXT.prepared;
}

// Shows who plays in the game that is being prepared, and sets the title.
function showCompany() {
  const others = (data.state.members ?? 1) - 1;
  const empty = data.players - others - 1;
  const people = others === 1 ? TEXT.oneOther : TEXT.someOthers(others);
  const computers = empty === 1 ? TEXT.oneComputer : TEXT.someComputers(empty);
  const known = data.state.members ? [others && people, empty && computers].filter(Boolean) : [];
  setText(find("company"), known[1] ? TEXT.playWithBoth(known[0], known[1]) : known.length ? TEXT.playWith(known[0]) : "");
  data.title = TEXT.preparedTitle(studyTitle);
  document.title = studyTitle;
}

function showLobby() {
  const { players, here, seconds, proposed, then } = lobby.state;
  const there = Math.min(players, here);
  lobby.since = performance.now() - 1000 * seconds;
  showSection("wait");
  find("lobby-places").replaceChildren(...Array.from({ length: players }, (_, at) => make("i", { className: at < there ? "taken" : "" })));
  const text = proposed ? textOfSession(players, there, then) : textOfFew(players, there);
  setText(find("lobby-here"), text);
  if (lobby.text && lobby.text !== text) announce(text);
  lobby.text = text;
  document.title = `${proposed && there === players ? TEXT.found : TEXT.countOf(there, players)} – ${studyTitle}`;
  showTime();
}

const textOfFew = (players, there) => there === 1 ? TEXT.firstOf(players) : TEXT.hereWithYou(there, players);

// The text on a session that is about to begin. With `policies` it may have empty places, even all but one.
function textOfSession(players, there, then) {
  if (there === players) return `${players === 2 ? TEXT.foundOther : TEXT.foundEnough} ${TEXT.moment}`;
  if (then !== "policies") return textOfFew(players, there);
  const one = players - there === 1;
  if (there === 1) return `${one ? TEXT.aloneWithOne : TEXT.aloneWithSome} ${TEXT.moment}`;
  return `${one ? TEXT.takesPlace(there, players) : TEXT.takePlaces(there, players)} ${TEXT.moment}`;
}

// Shows how long the participant has waited, and when the wait ends and what happens then.
function showTime() {
  const { players, patience, then, proposed } = lobby.state;
  const waited = Math.max(0, Math.round((performance.now() - lobby.since) / 1000));
  const left = Math.max(0, Math.ceil(patience - waited));
  const alone = players === 2;
  const next = {
    unmatched: TEXT.goWithout,
    policies: alone ? TEXT.playComputer : TEXT.beginWithFew,
  }[then];
  setText(find("lobby-clock"), TEXT.waited(duration(waited)));
  if (proposed) setText(find("lobby-then"), "");
  else if (left) setText(find("lobby-then"), alone ? TEXT.ifNobody(duration(left), next) : TEXT.ifFew(duration(left), next));
  else setText(find("lobby-then"), `${alone ? TEXT.nobodyCame(next) : TEXT.fewCame(next)} ${TEXT.moment}`);
  if (SOON_OVER.includes(left) && !proposed) announce(find("lobby-then").textContent);
}

const announce = (text) => setText(find("announce"), text);

function leaveLobby() {
  if (!lobby.waits) return;
  const form = new FormData(find("again"));
  form.set("hippodrome-action", "leave");
  navigator.sendBeacon(find("again").action, new URLSearchParams(form));
}

// Marks the page's title because its participant is matched, or removes the mark. On a hidden page it comes and goes.
function callBack(calls) {
  const plain = document.title.replace(CALL, "");
  if (!lobby.waits) document.title = calls ? CALL + plain : plain;
}

// If the site answers for the page but not to polls, the page says why: the study is closed, for instance.
async function lookAtPage() {
  lobby.trouble = find("wait-status").textContent ? lobby.trouble ?? performance.now() : null;
  if (lobby.trouble === null || performance.now() - lobby.trouble < NO_ANSWER) return;
  lobby.trouble = null;
  if (await pageAnswers().catch(() => false)) await loadPage();
}

setInterval(() => {
  if (lobby.waits) {
    showTime();
    lookAtPage();
  } else callBack(document.hidden && !document.title.startsWith(CALL));
}, 1_000);
document.addEventListener("visibilitychange", () => callBack(false));
window.addEventListener("pagehide", leaveLobby);

if (lobby.waits) await waitForOthers();
else if (data.state.session) showCompany();
