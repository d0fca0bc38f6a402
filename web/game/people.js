// A game that several participants play together: who is there, the countdown, and what is said when a participant is missing.
import { releaseAll } from "./actions.js";
import { ask, send } from "./connection.js";
import { nice } from "./controls.js";
import { hooks } from "./hooks.js";
import { overlays, showMessage, showOverlay } from "./overlay.js";
import { data, duration, find, make, setText } from "./page.js";
import { game } from "./state.js";

const GLANCE = 3_000; // ms for which a participant may look at another page in the game
const MOST_NAMES = 4; // of more players the page shows how many are there
const READ = 600_000; // ms for which the reason of an early end is shown, unless the participant goes on
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
overlays.unreachable.note = TEXT.unreachableTogether;
// By outcome, what is said of an early end if the server has not said it.
const ENDINGS = {
  left: TEXT.youLeft,
  partnerLeft: pair ? TEXT.otherLeft : TEXT.someLeft,
  ping: TEXT.tooSlow,
};

hooks.overlay.push((name) => {
  presence.shown = name;
  offerNoStart();
  find("overlay").dataset.name = name;
  // Others show where the game stands, such as the images when all are there; then it is said anew what it waits for.
  if (["ready", "paused"].includes(name)) queueMicrotask(coverPicture);
});
const waitsToo = hooks.waits;
hooks.waits = () => COVERS.includes(presence.shown) || waitsToo();

hooks.said.push((said) => {
  if (said.done) return noteEnd(said);
  if (said.state !== "ended") presence.reason = said.error ?? ""; // what ends the game is said before that it has ended
  if (said.UI) offerNoStart();
  if (said.people instanceof Object) showPeople(said);
  if (!said.state) return;
  presence.beginsAt = inSeconds(said.beginsIn);
  presence.heldUntil = inSeconds(said.heldFor);
  tellThatRead();
  coverPicture();
  queueMicrotask(() => sayWhoseTurn(said)); // after turns.js, which knows no names
});

const inSeconds = (seconds) => (typeof seconds === "number" ? performance.now() + 1000 * seconds : null);
const secondsUntil = (time) => Math.max(1, Math.ceil((time - performance.now()) / 1000));
const missing = () => Object.keys(presence.people).filter((name) => name !== presence.you && ["reads", "awaited", "away"].includes(presence.people[name]));

// Where the game says who is there

const playerName = (name) => data.names?.[name] ?? (isNaN(name) ? nice(name) : TEXT.player(name));

function showPeople({ people, you }) {
  const stop = document.querySelector("[data-command=stop]");
  if (stop) stop.textContent = TEXT.endForAll;
  const before = presence.people;
  Object.assign(presence, { people, you: you ?? presence.you });
  const names = Object.keys(people).slice(0, 64);
  const there = names.filter((name) => people[name] === "here").length;
  const shown = names.length > MOST_NAMES ? names.filter((name) => name === presence.you) : names;
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

// Turn by turn: whose turn it is, if it is another's
function sayWhoseTurn({ state, toAct, turnOf }) {
  const names = Array.isArray(turnOf) ? turnOf.slice(0, MOST_NAMES).map((name) => playerName(String(name))) : [];
  if (state === "playing" && !toAct && names.length) setText(find("turn"), TEXT.theirTurn(names.join(", ")));
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
  if (presence.heldUntil !== null) return presence.people[presence.you] === "awaited" && !missing().length ? "gathering" : "held"; // awaited: still measured
  if (presence.beginsAt !== null) return "begins";
  return missing().length && ["ready", "paused"].includes(game.state) ? "gathering" : game.state;
}

// The seconds of the countdown, or until the one who is missing is waited for no longer.
function countSeconds() {
  if (find("play").hidden) return showWhoReads();
  if (presence.shown === "begins") showCountdown();
  if (presence.shown === "gathering" || (presence.shown === "held" && !missing().length)) return setText(find("overlay-hint"), game.state === "paused" ? TEXT.goesOnWithAll : TEXT.beginsWithAll);
  if (presence.shown !== "held") return;
  const left = duration(secondsUntil(presence.heldUntil));
  const read = missing().every((name) => presence.people[name] === "reads");
  setText(find("overlay-hint"), read ? TEXT.theyRead(left) : data.absentEnds ? TEXT.absentEnds(left) : TEXT.absentReplaced(left));
}

// Images that still come say so where the title is.
function showCountdown() {
  setText(find("overlay-title"), overlays.begins.title);
  setText(find("overlay-score"), String(secondsUntil(presence.beginsAt)));
}

// No participant has to press Start: its button and its key are there for the pause, if that is offered.
function offerNoStart() {
  const line = [...find("legend").children].find((each) => [` ${TEXT.keyStart}`, ` ${TEXT.keyToggle}`].includes(each.lastChild.textContent));
  if (line?.lastChild.textContent === ` ${TEXT.keyStart}`) line.remove();
  else if (line) line.lastChild.textContent = ` ${TEXT.keyPause}`;
  for (const button of document.querySelectorAll("[data-command=toggle]")) button.hidden = !["playing", "paused"].includes(presence.shown) || !game.offered.has("pause");
}

// Pages that are read beside the game: it goes on once all have read them

function tellThatRead() {
  if (presence.people[presence.you] === "reads" && game.state === "ready" && !find("play").hidden) send({ command: "start" });
}

function showWhoReads() {
  const left = duration(secondsUntil(presence.heldUntil));
  if (presence.people[presence.you] !== "reads") setText(toGoOn, missing().length ? `${waitsForAll}…` : "");
  else setText(toGoOn, presence.heldUntil === null ? "" : pair ? TEXT.otherWaits(left) : TEXT.othersWait(left));
}

// The end

function noteEnd(said) {
  if (!Object.hasOwn(ENDINGS, said.outcome)) return;
  if (!said.episodes) delete said.score; // nothing was played
  Object.assign(overlays.over, { title: TEXT.hasEnded, note: String(presence.reason || ENDINGS[said.outcome]), band: false, shown: READ });
  setText(find("leave-title"), TEXT.thanks);
  setTimeout(() => setText(find("announce"), overlays.over.note), 500); // after what the page says of every end
}

find("reading-button")?.addEventListener("click", () => {
  tellThatRead();
  coverPicture();
});
setInterval(countSeconds, 200);
new MutationObserver(() => presence.shown === "begins" && showCountdown()).observe(find("overlay-title"), { childList: true });
// A page that has slept says that it is there again: without new pictures it has nothing else to say.
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
hooks.said.push((said) => said.state && game.state !== "playing" && tellIfHidden());
