// A game of several participants: who is there, the countdown, and what the page says when a participant is missing.
import { releaseAll } from "./actions.js";
import { ask, send } from "./connection.js";
import { nice } from "./controls.js";
import { hooks } from "./hooks.js";
import { overlays, showMessage, showOverlay } from "./overlay.js";
import { data, duration, find, make, setText } from "./page.js";
import { game } from "./state.js";

const GLANCE = 3_000; // ms for which a participant may look at another page in the game
const MAX_NAMES = 4; // if there are more players, the page shows their number
const STATES = { here: "", reads: TEXT.reads, awaited: TEXT.awaited, away: TEXT.away, policy: TEXT.computer };
const COVERS = ["gathering", "held", "begins"];

const pair = data.players === 2;
const waitsForAll = pair ? TEXT.waitingForOther : TEXT.waitingForOthers;
const presence = { people: {}, you: "", beginsAt: null, heldUntil: null, shown: "", reason: "" };
const peopleLine = make("span", { id: "people" });
const toGoOn = make("p", { id: "reading-wait", role: "status" });

document.querySelector(".hud").append(peopleLine);
find("reading-button")?.after(toGoOn);

overlays.gathering = { title: waitsForAll };
Object.assign(overlays, { held: {}, begins: {} });
overlays.lost.note = pair ? TEXT.otherSees : TEXT.othersSee;
// By outcome: the reason of an early end, if the server has sent none.
const ENDINGS = {
  left: TEXT.youLeft,
  partnerLeft: pair ? TEXT.otherLeft : TEXT.someLeft,
  ping: TEXT.tooSlow,
};

hooks.overlay.push((name) => {
  presence.shown = name;
  offerNoStart();
  // Other modules show these overlays too, such as sprites.js when all images have come; then this covers them again.
  if (["ready", "paused"].includes(name)) queueMicrotask(coverPicture);
});
const waitsToo = hooks.waits;
hooks.waits = () => COVERS.includes(presence.shown) || waitsToo();

hooks.message.push((message) => {
  if (message.done) return noteEnd(message);
  if (message.state !== "ended") presence.reason = message.error ?? ""; // the reason comes before the state "ended"
  if (message.UI) offerNoStart();
  if (message.people instanceof Object) showPeople(message);
  if (!message.state) return;
  presence.beginsAt = inSeconds(message.beginsIn);
  presence.heldUntil = inSeconds(message.heldFor);
  tellHasRead();
  coverPicture();
  queueMicrotask(() => sayWhoseTurn(message)); // later than turns.js, which says whose turn it is without names
});

const inSeconds = (seconds) => (typeof seconds === "number" ? performance.now() + 1000 * seconds : null);
const secondsUntil = (time) => Math.max(1, Math.ceil((time - performance.now()) / 1000));
const missing = () => Object.keys(presence.people).filter((name) => name !== presence.you && ["reads", "awaited", "away"].includes(presence.people[name]));

// Who is there

const playerName = (name) => data.names?.[name] ?? (isNaN(name) ? nice(name) : TEXT.player(name));

function showPeople({ people, you }) {
  const stop = document.querySelector("[data-command=stop]");
  if (stop) stop.textContent = TEXT.endForAll;
  const before = presence.people;
  Object.assign(presence, { people, you: you ?? presence.you });
  const names = Object.keys(people).slice(0, 64);
  const there = names.filter((name) => people[name] === "here").length;
  const shown = names.length > MAX_NAMES ? names.filter((name) => name === presence.you) : names;
  const parts = shown.map((name) => {
    const text = playerName(name), more = STATES[people[name]];
    const textContent = name === presence.you ? TEXT.you(text) : more ? `${text} (${more})` : text;
    return make("b", { className: people[name], textContent });
  });
  if (shown.length < names.length) parts.push(make("b", { className: "here", textContent: TEXT.areHere(there, names.length) }));
  peopleLine.replaceChildren(...parts);
  for (const name of names) if (name !== presence.you && before[name]) tellOf(name, before[name], people[name]);
}

function tellOf(name, before, now) {
  const who = playerName(name);
  if (now === "policy" && before !== "policy") showMessage(pair ? TEXT.otherReplaced : TEXT.replaced(who));
  if (now === "here" && ["away", "policy"].includes(before)) showMessage(pair ? TEXT.otherBack : TEXT.back(who));
}

// Turn by turn: says whose turn it is, if it is not the participant's.
function sayWhoseTurn({ state, toAct, turnOf, chosen }) {
  const names = Array.isArray(turnOf) ? turnOf.slice(0, MAX_NAMES).map((name) => playerName(String(name))) : [];
  if (state !== "playing" || toAct || !names.length) return;
  const who = names.join(", ");
  setText(find("turn"), chosen ? TEXT.waitingForNames(who) : TEXT.theirTurn(who));
}

// What covers the picture

function coverPicture() {
  const name = coverName();
  if (game.state === "break" || (find("play").hidden && name !== "begins")) return showWhoReads();
  const title = !missing().length ? TEXT.youWereAway : pair ? waitsForAll : TEXT.waitingForNames(missing().map(playerName).join(", "));
  if (name === presence.shown && (name !== "held" || title === overlays.held.title)) return countSeconds();
  if (name === "held") releaseAll();
  overlays.begins.title = game.state === "paused" ? TEXT.goesOn : TEXT.begins;
  overlays.held.title = title;
  showOverlay(name);
  countSeconds();
}

function coverName() {
  if (game.state === "ended") return game.state;
  if (presence.heldUntil !== null) return presence.people[presence.you] === "awaited" && !missing().length ? "gathering" : "held"; // the participant is awaited while the connection is measured
  if (presence.beginsAt !== null) return "begins";
  return missing().length && ["ready", "paused"].includes(game.state) ? "gathering" : game.state;
}

// Shows the seconds of the countdown, or those for which the game still waits for a missing participant.
function countSeconds() {
  if (find("play").hidden) return showWhoReads();
  if (presence.shown === "begins") showCountdown();
  if (presence.shown === "gathering" || (presence.shown === "held" && !missing().length)) return setText(find("overlay-hint"), game.state === "paused" ? TEXT.goesOnWithAll : TEXT.beginsWithAll);
  if (presence.shown !== "held") return;
  const left = duration(secondsUntil(presence.heldUntil));
  const read = missing().every((name) => presence.people[name] === "reads");
  setText(find("overlay-hint"), read ? TEXT.theyRead(left) : data.absentEnds ? TEXT.absentEnds(left) : TEXT.absentReplaced(left));
}

// sprites.js may have put its own title in this place.
function showCountdown() {
  setText(find("overlay-title"), overlays.begins.title);
  setText(find("overlay-score"), String(secondsUntil(presence.beginsAt)));
}

// No participant has to press Start: its button and key are for the pause only, if that is offered.
function offerNoStart() {
  const line = [...find("legend").children].find((each) => [` ${TEXT.keyStart}`, ` ${TEXT.keyToggle}`].includes(each.lastChild.textContent));
  if (line?.lastChild.textContent === ` ${TEXT.keyStart}`) line.remove();
  else if (line) line.lastChild.textContent = ` ${TEXT.keyPause}`;
}

// Pages that are read beside the game: the game goes on once all participants have read them

function tellHasRead() {
  if (presence.people[presence.you] === "reads" && game.state === "ready" && !find("play").hidden) send({ command: "start" });
}

function showWhoReads() {
  const left = duration(secondsUntil(presence.heldUntil));
  if (presence.people[presence.you] !== "reads") setText(toGoOn, missing().length ? `${waitsForAll}…` : "");
  else setText(toGoOn, presence.heldUntil === null ? "" : pair ? TEXT.otherWaits(left) : TEXT.othersWait(left));
}

// The end

function noteEnd(message) {
  if (!Object.hasOwn(ENDINGS, message.outcome)) return;
  if (!message.episodes) delete message.score; // no game was played, so there is no score
  Object.assign(overlays.over, { title: TEXT.hasEnded, note: String(presence.reason || ENDINGS[message.outcome]), aside: false });
  setText(find("leave-title"), TEXT.thanks);
}

find("reading-button")?.addEventListener("click", () => {
  tellHasRead();
  coverPicture();
});
setInterval(countSeconds, 200);
new MutationObserver(() => presence.shown === "begins" && showCountdown()).observe(find("overlay-title"), { childList: true });
// A page that has slept asks the server, so that it counts as present again: without pictures it sends nothing else.
setInterval(() => presence.people[presence.you] === "away" && !document.hidden && ask(), 1_000);

// A participant who looks at another page is away: in the game after a moment, otherwise at once.

const tellIfHidden = () => document.hidden && send({ hidden: true });
let glance;

document.addEventListener("visibilitychange", () => {
  clearTimeout(glance);
  if (!document.hidden) send({ hidden: false });
  else if (game.state === "playing") glance = setTimeout(tellIfHidden, GLANCE);
  else tellIfHidden();
});
hooks.message.push((message) => message.state && game.state !== "playing" && tellIfHidden());
