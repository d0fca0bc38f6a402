// The section until the server is ready: its stages and clock, and how often the page polls.
import { data, duration, find, setText, showSection } from "./page.js";
import { recall, remember } from "./storage.js";

const STAGES = ["queued", "starting", "naming", "ready"];
const POLLS = { first: 1_000, growth: 1.15, longest: 4_000, naming: 1_500 }; // ms between polls; `growth` is a factor

const waiting = { since: 0, typical: null, stage: "" };

// Milliseconds until the next poll: few at first and in the state before `ready`, more otherwise.
export function pollDelay(state, polls) {
  if (isOver(state)) return POLLS.longest;
  if (state.state === "naming") return POLLS.naming;
  return Math.min(POLLS.longest, POLLS.first * POLLS.growth ** polls);
}

export function isOver(state) {
  return state.state === "ended" || state.state === "failed";
}

export function showWaiting(state) {
  waiting.since = performance.now() - 1000 * (state.seconds ?? 0);
  waiting.typical = state.typical;
  const now = Math.max(0, STAGES.indexOf(state.state));
  STAGES.forEach((name, at) => {
    const item = find(`stage-${name}`);
    item.classList.toggle("past", at < now);
    if (at === now) item.setAttribute("aria-current", "step");
    else item.removeAttribute("aria-current");
  });
  find("wait-first").hidden = Boolean(state.replaces);
  find("wait-moved").hidden = !state.replaces;
  showClock();
  showSection("wait");
  if (waiting.stage !== state.state) setText(find("announce"), find(`stage-${STAGES[now]}`).textContent);
  waiting.stage = state.state;
}

// Once a second.
export function beat() {
  find("wait").classList.toggle("beat");
  showClock();
}

function showClock() {
  const seconds = Math.max(0, Math.round((performance.now() - waiting.since) / 1000));
  find("elapsed").textContent = TEXT.waiting(duration(seconds));
  if (!waiting.typical) return;
  const long = seconds > 2 * waiting.typical + 10;
  find("typical").textContent = long
    ? TEXT.takesLonger
    : TEXT.usually(duration(waiting.typical));
}

// "Try again": for a moment after it, polls still answer that the server has ended.

export function noteRestart() {
  remember("again", { attempt: data.state.attempt, at: Date.now() });
}

// Seconds since the participant asked for another server, if the state does not show that yet; otherwise null.
export function restartedFor(state) {
  const asked = recall("again");
  const ago = Date.now() - asked?.at;
  return asked?.attempt === state.attempt && ago < 30_000 ? ago / 1000 : null;
}
