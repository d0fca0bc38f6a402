// The panel in which the participant talks to others, to the agent, or to a model (docs/talk.md): beside the game, or the
// whole page if the game is `talk`. All that others have written is shown as text, never as HTML.
import { releaseAll, start } from "./actions.js";
import { send } from "./connection.js";
import { nice } from "./controls.js";
import { hooks } from "./hooks.js";
import { data, find, make, setText } from "./page.js";
import { game } from "./state.js";
import { recall, remember } from "./storage.js";

const KEPT = 500; // lines that the page shows
const WAITING_LINES = 20; // lines that may wait to be sent
const BURST = 5; // lines that the server takes
const BURST_TIME = 5_500; // in so many ms, with some to spare
const STILL = 4_000; // ms without a key; then the participant types no longer
const FEW_LEFT = 50; // characters
const STORING = 10_000; // ms after its echo; then the line is stored, also if the page notices late that the server is lost

const isTalk = Boolean(data.talk); // there is no game beside the panel
const memory = `said-${data.project}-${document.body.dataset.user}-${data.step}`;
const hasMouse = matchMedia("(hover: hover) and (pointer: fine)");

const stack = make("div", { id: "chat-lines" });
const log = named(make("div", { id: "chat-log", tabIndex: 0 }, stack), TEXT.messages, "log");
const toNewest = make("button", { type: "button", id: "chat-newest", textContent: TEXT.newMessages, hidden: true });
const doing = make("p", { id: "chat-doing" }); // who types, or whose turn it is
const note = named(make("p", { id: "chat-note" }), "", "status");
const phraseButtons = make("div", { id: "chat-phrases" });
const field = named(make("textarea", { id: "chat-field", rows: 2, dir: "auto", placeholder: TEXT.writeMessage, enterKeyHint: "send" }), TEXT.writeMessage);
const room = make("span", { id: "chat-room" }); // how many characters may follow
const form = make("form", { id: "chat-form" }, field, make("button", { type: "submit", textContent: TEXT.sendMessage }), room);
const panel = named(make("section", { id: "chat" }, log, toNewest, doing, note, phraseButtons, form), TEXT.messages);

const stored = recall(memory) ?? {};
let chat = {}; // what the server says of this study's talk
let writer; // who may write now, if one after the other writes
let open = false; // whether the server has sent the lines so far over this connection
let closed = false; // whether the game is over
let unsent = []; // the participant's lines that have not come back from the server, each `{ id, text, typed, bubble }`
let echoed = []; // the participant's lines that came back a moment ago, as in `unsent`, with the time `at`
let newestId = 0;
let sendings = []; // when the last lines were sent
let typers = {}; // by name: whether they type
let toldTyping = false;
let typingSince = 0; // when the first character of this line was typed
let stillTimer;
let burstTimer;
const bubbles = new Map(); // the lines that are shown, by their numbers
let atEnd = true; // whether the end of the lines can be seen

// Gives an element a name, and a role, for screen readers.
function named(element, label, role) {
  if (label) element.setAttribute("aria-label", label);
  if (role) element.setAttribute("role", role);
  return element;
}

const nameOf = (by) => chat.names?.[by] ?? data.names?.[by] ?? (by === "ai" ? TEXT.ai : isNaN(by) ? nice(by) : TEXT.player(by));
const lengthOf = (text) => [...text].length; // as Python counts

// Lines

function bubbleOf(by, text) {
  const mine = by === chat.me;
  const bubble = make("div", { className: mine ? "line mine" : "line" });
  bubble.by = by;
  bubble.append(make("b", { dir: "auto", className: mine ? "quiet" : "", textContent: mine ? TEXT.yourMessage : nameOf(by) }), make("p", { dir: "auto", textContent: text }));
  return bubble;
}

// Puts a line behind those with smaller numbers. Lines that wait to be sent have no number and stay last.
function put(bubble, number) {
  bubble.n = number;
  let next = null;
  for (let each = stack.lastElementChild; each && (each === bubble || !(each.n < number)); each = each.previousElementSibling) {
    if (each !== bubble) next = each;
  }
  if (!bubble.isConnected || bubble.nextElementSibling !== next) stack.insertBefore(bubble, next);
  bubble.classList.toggle("same", bubble.previousElementSibling?.by === bubble.by);
}

function showLine({ n, by, text, id, more }) {
  let bubble = bubbles.get(n);
  const isNew = !bubble;
  const sent = unsent.find((each) => by === chat.me && each.id === id);
  if (sent) {
    unsent.splice(unsent.indexOf(sent), 1);
    echoed.push({ ...sent, at: performance.now() });
    bubble = sent.bubble;
    bubble.classList.remove("waiting");
  } else if (isNew || (!more && bubble.matches("[aria-hidden]"))) {
    // A line that grows is read out once it is complete: then it is a new element.
    bubble?.remove();
    bubble = bubbleOf(by, text);
  }
  if (more) bubble.setAttribute("aria-hidden", "true");
  else delete typers[by];
  setText(bubble.querySelector("p"), text);
  bubble.lineId = id;
  bubbles.set(n, bubble);
  put(bubble, n);
  if (by === chat.me && id > newestId) newestId = id;
  if (isNew && !atEnd && by !== chat.me) toNewest.hidden = false;
}

// Removes lines that the server before has lost, which gives their numbers to others: `lines` are all that there are, or
// the last KEPT. The participant's own lost lines wait to be sent again.
function forgetLost(lines) {
  const oldest = lines.length < KEPT ? 0 : lines[0].n;
  const known = new Map(lines.map((line) => [line.n, line]));
  for (const [n, bubble] of bubbles) {
    const line = known.get(n);
    if (n < oldest || (line?.by === bubble.by && line.id === bubble.lineId)) continue;
    bubbles.delete(n);
    bubble.remove();
  }
  const lost = echoed.filter(({ id }) => !lines.some((line) => line.by === chat.me && line.id === id));
  echoed = echoed.filter((each) => !lost.includes(each));
  for (const { bubble } of lost) {
    delete bubble.n;
    bubble.classList.add("waiting");
    stack.insertBefore(bubble, unsent[0]?.bubble ?? null);
  }
  unsent.unshift(...lost);
}

function hearLines(message) {
  const isHistory = !open;
  if (isHistory && message.lines.length > 1 && !bubbles.size) {
    log.setAttribute("aria-live", "off"); // after a reload, nobody wants to hear all of it again
    setTimeout(() => log.setAttribute("aria-live", "polite"), 1_000);
  }
  if (isHistory) forgetLost(message.lines);
  for (const line of message.lines) showLine(line);
  while (stack.childElementCount > KEPT) {
    bubbles.delete(stack.firstElementChild.n);
    stack.firstElementChild.remove();
  }
  if ("turn" in message) writer = message.turn;
  if (isHistory) {
    open = true;
    for (const each of unsent) each.sent = false; // those that are not among these lines are sent again, with their ids
    setText(note, "");
  }
  keep();
  follow();
  sendWaiting();
  showWhoWrites();
}

function follow() {
  if (atEnd) log.scrollTop = log.scrollHeight;
}

// What the participant writes

const nextId = () => (newestId = Math.max(newestId + 1, Date.now()));

function keep() {
  if (open) echoed = echoed.filter(({ at }) => performance.now() - at < STORING);
  remember(memory, { lines: [...echoed, ...unsent].map(({ id, text, typed }) => ({ id, text, typed })), draft: field.value });
}

function addWaiting(line) {
  const bubble = bubbleOf(chat.me, line.text);
  bubble.classList.add("waiting");
  bubble.append(make("small", { textContent: TEXT.sending }));
  stack.append(bubble);
  unsent.push({ ...line, bubble });
}

const isMyTurn = () => chat.turns !== "alternate" || (writer === chat.me && !unsent.length);

// Returns whether the line is sent now or later.
function say(text, typed) {
  if (closed || !text || !isMyTurn()) return false;
  const excess = unsent.length >= WAITING_LINES ? TEXT.tooManyMessages : lengthOf(text) > chat.maxLength ? TEXT.messageTooLong(chat.maxLength) : "";
  setText(note, excess || (open ? "" : TEXT.messageKept));
  if (excess) return false;
  if (isTalk && ["ready", "paused"].includes(game.state)) start();
  addWaiting({ id: nextId(), text, typed });
  atEnd = true;
  follow();
  sendWaiting();
  keep();
  showWhoWrites();
  return true;
}

function sendWaiting() {
  clearTimeout(burstTimer);
  for (const each of unsent) {
    if (!open || each.sent) continue;
    const now = performance.now();
    sendings = sendings.filter((time) => now - time < BURST_TIME);
    if (sendings.length >= BURST) {
      burstTimer = setTimeout(sendWaiting, BURST_TIME - now + sendings[0]);
      return;
    }
    const { id, text, typed } = each;
    each.sent = send({ say: { id, text, typed } });
    sendings.push(now);
  }
}

function hearRefusal({ id, why }) {
  const refused = unsent.find((each) => each.id === id);
  if (!refused) return;
  unsent.splice(unsent.indexOf(refused), 1);
  refused.bubble.remove();
  const words = { tooFast: TEXT.tooManyMessages, tooLong: TEXT.messageTooLong(chat.maxLength), held: TEXT.messageHeld };
  setText(note, words[why] ?? TEXT.messageRefused);
  if (why !== "held" && chat.typing) field.value = [refused.text, field.value].filter(Boolean).join("\n");
  showRoom();
  keep();
  showWhoWrites();
}

function tellTyping(types) {
  clearTimeout(stillTimer);
  if (types) stillTimer = setTimeout(() => tellTyping(false), STILL);
  if (types !== toldTyping && open && send({ typing: types })) toldTyping = types;
}

function showRoom() {
  const left = chat.maxLength - lengthOf(field.value.trim());
  setText(room, left >= FEW_LEFT ? "" : left < 0 ? TEXT.charactersOver(-left) : TEXT.charactersLeft(left));
}

// What the panel says

function showWhoWrites() {
  const names = Object.keys(typers).filter((name) => typers[name]).map(nameOf);
  const writes = names.length > 1 ? TEXT.areTyping(names.join(", ")) : names.length ? TEXT.isTyping(names[0]) : "";
  const whose = chat.turns !== "alternate" || unsent.length || closed ? "" : writer === chat.me ? TEXT.yourTurn : writer ? TEXT.writesNext(nameOf(writer)) : "";
  setText(doing, writes || whose);
  for (const button of panel.querySelectorAll("form button, #chat-phrases button")) button.disabled = closed || !isMyTurn();
  field.disabled = closed;
}

function setUp(said) {
  panel.hidden = !said;
  if (!said) return; // the server still runs a registration without talk
  const isFirst = !chat.me;
  chat = { maxLength: 500, typing: true, ...said };
  form.hidden = !chat.typing;
  phraseButtons.hidden = !chat.phrases?.length;
  panel.classList.toggle("phrases", !phraseButtons.hidden);
  if (isFirst) {
    phraseButtons.append(...(chat.phrases ?? []).map(phraseButton));
    field.value ||= stored.draft ?? "";
    for (const line of stored.lines ?? []) addWaiting(line);
    showRoom();
  }
  showWhoWrites();
}

function phraseButton(text) {
  const button = make("button", { type: "button", dir: "auto", textContent: text });
  button.addEventListener("click", () => say(text));
  return button;
}

hooks.message.push((message) => {
  if (message.UI) setUp(message.chat);
  if (Array.isArray(message.lines)) hearLines(message);
  if (message.typing instanceof Object) {
    Object.assign(typers, message.typing);
    showWhoWrites();
  }
  if (message.refused) hearRefusal(message.refused);
  if (message.done || message.state === "ended") {
    closed = true;
    showWhoWrites();
  }
});

hooks.overlay.push((name) => {
  if (["loading", "lost", "elsewhere"].includes(name)) {
    if (open) keep();
    open = toldTyping = false;
    typers = {};
    showWhoWrites();
  }
  if (isTalk && name === "break") setText(find("announce"), find("overlay-title").textContent); // there is no score
  if (isTalk && name === "playing" && hasMouse.matches) field.focus({ preventScroll: true });
});

// Keys: those that are pressed in the panel are not the game's, and the game's are let go when the panel gets the focus.
// Escape, or a click on the game, gives them back.

const hasFocus = () => panel.contains(document.activeElement);
const backToGame = () => hasFocus() && find("screen").focus({ preventScroll: true });

for (const type of ["keydown", "keyup"]) (isTalk ? document.body : panel).addEventListener(type, (event) => event.stopPropagation());
panel.addEventListener("focusin", () => releaseAll());
panel.addEventListener("keydown", (event) => event.key === "Escape" && backToGame());
// A click on a phrase leaves the focus where it is: in the game, or in the field.
panel.addEventListener("mousedown", (event) => event.target.closest("button") && event.preventDefault());
panel.addEventListener("contextmenu", (event) => event.stopPropagation()); // there, text is copied and pasted
find("play").addEventListener("pointerdown", (event) => panel.contains(event.target) || backToGame());

field.addEventListener("keydown", (event) => {
  if (event.key !== "Enter" || event.shiftKey || event.isComposing || event.keyCode === 229) return; // 229: Safari, at the end of a composition
  event.preventDefault();
  sayField();
});
field.addEventListener("input", () => {
  const types = Boolean(field.value.trim());
  typingSince = types ? typingSince || performance.now() : 0;
  tellTyping(types);
  setText(note, "");
  showRoom();
  keep();
});
form.addEventListener("submit", (event) => {
  event.preventDefault();
  sayField();
});

function sayField() {
  if (!say(field.value.trim(), Math.round(performance.now() - typingSince))) return;
  field.value = "";
  typingSince = 0;
  tellTyping(false);
  showRoom();
  keep();
}

// Scrolling: new lines move nothing for those who read earlier ones.

log.addEventListener("scroll", () => {
  atEnd = log.scrollHeight - log.scrollTop - log.clientHeight < 40;
  if (atEnd) toNewest.hidden = true;
});
toNewest.addEventListener("click", () => { log.scrollTop = log.scrollHeight; });
const resized = new ResizeObserver(follow);
for (const each of [log, stack]) resized.observe(each);

// The keyboard of a phone covers the page: then the panel moves above it.
const seen = window.visualViewport;

function fitAboveKeyboard() {
  const covers = hasFocus() && window.innerHeight - seen.height > 120;
  document.body.style.setProperty("--seen", `${seen.height}px`);
  document.body.classList.toggle("types", covers);
  if (covers) window.scrollTo(0, 0);
}

seen?.addEventListener("resize", fitAboveKeyboard);
panel.addEventListener("focusout", () => setTimeout(fitAboveKeyboard, 100));

document.body.classList.add(isTalk ? "talks" : "chats");

// The panel is beside the game, or beside the page that is read instead of it.
const readingPage = find("reading");
const board = document.querySelector(".board");

function settle() {
  const reads = Boolean(readingPage) && !readingPage.hidden;
  const parent = reads ? readingPage.parentElement : board;
  if (panel.parentElement === parent) return;
  document.body.classList.toggle("reads", reads);
  parent.append(panel);
  follow();
}

if (readingPage) new MutationObserver(settle).observe(readingPage, { attributes: true });
settle();
