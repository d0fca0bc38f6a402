// The first picture of a game, which stands still for a moment, and the time that is left in the game.
import { hooks } from "./hooks.js";
import { overlays, showOverlay } from "./overlay.js";
import { addStyle, duration, find, make, setText } from "./page.js";
import { game } from "./state.js";

const SOON = 10; // a screen reader says when so many seconds are left

const timeLeft = make("span", { id: "left", title: TEXT.timeLeft, hidden: true });
let startsAt = null; // when the first picture begins to move
let endsAt = null; // when the time is over, if the game is not held before
let saidSoon = false;

overlays.freeze = { title: TEXT.getReady };
// One line at the top, so that the picture below can be seen.
addStyle("[data-state=freeze] .overlay { place-self: start stretch; margin: 0; grid-auto-flow: column; align-items: baseline; justify-content: center; padding: .3rem; }");
find("score").parentNode.after(timeLeft);

hooks.message.push((message) => {
  if (!message.state) return;
  const now = performance.now();
  const freezes = message.state === "playing" && message.startsIn > 0;
  if (freezes && startsAt === null) {
    showOverlay("freeze");
    setText(find("announce"), TEXT.getReadyIn(duration(Math.ceil(message.startsIn))));
  } else if (!freezes && startsAt !== null && game.state === "playing") showOverlay("playing");
  startsAt = freezes ? now + 1000 * message.startsIn : null;
  const timed = typeof message.timeLeft === "number";
  endsAt = timed && game.state === "playing" && !freezes ? now + 1000 * message.timeLeft : null;
  timeLeft.hidden = !timed;
  if (freezes) countFreeze(now);
  if (timed) showLeft(message.timeLeft);
  if (timed && message.timeLeft > SOON) saidSoon = false;
});

function countFreeze(now) {
  setText(find("overlay-hint"), String(Math.max(1, Math.ceil((startsAt - now) / 1000))));
}

function showLeft(seconds) {
  const whole = Math.max(0, Math.ceil(seconds));
  setText(timeLeft, `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}`);
}

setInterval(() => {
  const now = performance.now();
  if (game.state !== "playing") return;
  if (startsAt !== null) countFreeze(now);
  if (endsAt === null) return;
  const seconds = (endsAt - now) / 1000;
  showLeft(seconds);
  if (seconds <= SOON && !saidSoon) {
    saidSoon = true;
    setText(find("announce"), TEXT.secondsLeft(SOON));
  }
}, 200);
