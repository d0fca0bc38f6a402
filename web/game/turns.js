// Games that are played turn by turn: shows whose turn it is, and how much time is left.
import { hooks } from "./hooks.js";
import { find, make, setText } from "./page.js";
import { game } from "./state.js";

const MINE = TEXT.yourTurn;
const turn = make("span", { id: "turn" });
let turnEndsAt = null;
let wasMine = false;

document.querySelector(".hud").append(turn);
const turnSheet = new CSSStyleSheet(); // only these games' pages need it
turnSheet.replaceSync(`.hud { flex-wrap: wrap; }
.hud #turn { flex: 1 0 100%; min-height: 1.6em; text-align: center; white-space: normal; }
#turn.mine { color: var(--ink); font-weight: 600; }
@media (min-aspect-ratio: 5/4) { .hud #turn { flex: none; text-align: inherit; } }`);
document.adoptedStyleSheets = [...document.adoptedStyleSheets, turnSheet];
// A press that starts or resumes the game is no action.
hooks.starts = () => true;

hooks.message.push((message) => {
  if (!message.state) return;
  turnEndsAt = typeof message.turnEndsIn === "number" ? performance.now() + 1000 * message.turnEndsIn : null;
  showTurn();
  const mine = isMine();
  const announced = find("announce").textContent === MINE;
  if (mine ? !wasMine : announced) setText(find("announce"), mine ? MINE : "");
  wasMine = mine;
});

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
