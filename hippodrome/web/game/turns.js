// Games that are played turn by turn: shows whose turn it is, how much time is left, what the participant has chosen, and
// what was chosen for them because the time was up.
import { labelOf } from "./controls.js";
import { hooks } from "./hooks.js";
import { addStyle, find, make, setText } from "./page.js";
import { game } from "./state.js";

const MINE = TEXT.yourTurn;
const turn = make("span", { id: "turn" });
const choice = make("span", { id: "choice" });
let labels = {};
let turnEndsAt = null;
let wasMine = false;

document.querySelector(".hud").append(turn, choice);
addStyle(`.hud { flex-wrap: wrap; }
.hud :is(#turn, #choice) { flex: 1 0 100%; min-height: 1.6em; text-align: center; white-space: normal; }
#turn { font-size: 1rem; }
.hud #choice { font-size: .875rem; line-height: 1.2; color: var(--ink); }
#choice:empty { display: none; }
#turn.mine { color: var(--ink); font-weight: 600; }
.others:first-child { min-width: 100%; }
.hold[aria-pressed=true] { color: #fff; background: var(--accent); }
@media (min-aspect-ratio: 5/4) { .hud :is(#turn, #choice) { flex: none; text-align: inherit; } }`);
// A press that starts or resumes the game is no action.
hooks.starts = () => true;

hooks.message.push((message) => {
  if (message.UI) labels = message.labels ?? {};
  if (!message.state) return;
  turnEndsAt = typeof message.turnEndsIn === "number" ? performance.now() + 1000 * message.turnEndsIn : null;
  showTurn();
  showChoice(message);
  const mine = isMine();
  const announced = find("announce").textContent.endsWith(MINE);
  if (mine ? !wasMine : announced) setText(find("announce"), mine ? `${message.timeUp === undefined ? "" : choice.textContent} ${MINE}`.trim() : "");
  wasMine = mine;
});

function showChoice({ chosen, timeUp }) {
  const name = chosen && labelOf(chosen, labels);
  let shown = false; // whether a button shows it
  for (const button of document.querySelectorAll(".hold")) {
    const is = name === button.getAttribute("aria-label");
    shown ||= is;
    if (is) button.setAttribute("aria-pressed", "true");
    else button.removeAttribute("aria-pressed");
  }
  if (timeUp === "noop" && !labels.noop) setText(choice, TEXT.timeUpIdle);
  else if (timeUp) setText(choice, TEXT.timeUp(labelOf(timeUp, labels)));
  else if (timeUp === "") setText(choice, TEXT.timeUpEnds);
  else setText(choice, chosen && !shown ? TEXT.youChose(name) : "");
}

const isMine = () => game.state === "playing" && Boolean(game.toAct);

function showTurn() {
  const others = game.players?.length > 2 ? TEXT.othersTurn : TEXT.otherTurn;
  const left = Math.max(0, Math.ceil((turnEndsAt - performance.now()) / 1000));
  turn.classList.toggle("mine", isMine());
  // A server that was started before turns were registered plays in real time.
  if (game.state !== "playing" || game.pace !== "turns") setText(turn, "");
  else if (isMine()) setText(turn, turnEndsAt === null ? MINE : TEXT.yourTurnLeft(left));
  else setText(turn, game.players ? others : "");
}

setInterval(() => turnEndsAt !== null && isMine() && showTurn(), 200);
