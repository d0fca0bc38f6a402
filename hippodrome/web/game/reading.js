// The researcher's pages beside the game: instructions before the game and in a pause, and a page between two games.
import { start } from "./actions.js";
import { send } from "./connection.js";
import { hooks } from "./hooks.js";
import { overlays } from "./overlay.js";
import { data, find, make, points, setText, showSection } from "./page.js";
import { addSlider, removeUnset, resetSlider } from "./sliders.js";
import { game } from "./state.js";
import { recall, remember } from "./storage.js";

const LAST_PICTURE = 2_500; // ms for which the last picture and the score are shown before the page between two games

const texts = { instructions: find("text-instructions"), between: find("text-betweenEpisodes") };
const noted = `read-${data.step}`;
const trouble = make("p", { className: "problem", role: "status", hidden: true });
const sliders = [...find("reading").querySelectorAll("input[type=range]")];
const again = make("button", { type: "button", id: "instructions-button", textContent: TEXT.instructions, hidden: true });

let reading = ""; // the name of the text that is shown
let opening; // the timer of the page between two games

// `goOn` is the label of the button.
function openText(name, goOn, score = "") {
  clearTimeout(opening);
  reading = name;
  for (const each in texts) if (texts[each]) texts[each].hidden = each !== name;
  setText(find("reading-score"), score);
  find("reading-score").hidden = !score;
  find("reading-button").textContent = goOn;
  showSection("reading");
  window.scrollTo(0, 0);
  find("reading").focus({ preventScroll: true });
}

function closeText() {
  if (reading === "between") {
    texts.between.reset();
    sliders.filter((slider) => slider.form === texts.between).forEach(resetSlider);
  }
  reading = "";
  showSection("play");
  find("screen").focus({ preventScroll: true });
}

function openBetween() {
  openText("between", TEXT.nextGame, `${TEXT.gameOver(game.episode, game.maxEpisodes)}. ${TEXT.yourScore(points(game.episodeScore))}`);
}

// Sends what the participant has filled in; returns whether they may go on.
function sendFields(form, page) {
  if (!form.reportValidity()) return false;
  const fields = {};
  const formData = new FormData(form);
  removeUnset(formData);
  for (const [name, value] of formData) {
    if (typeof value !== "string") continue; // a file
    fields[name] = name in fields ? [fields[name], value].flat() : value;
  }
  return !Object.keys(fields).length || send({ form: { page, fields } });
}

const unread = () => Boolean(texts.instructions) && !recall(noted);

hooks.waits = () => {
  const between = game.state === "break" && texts.between && reading !== "between";
  if (between) openBetween();
  else if (game.state === "ready" && unread()) openText("instructions", TEXT.toGame);
  else return false;
  return true;
};

hooks.overlay.push((name) => {
  clearTimeout(opening);
  setText(trouble, name === "lost" ? `${TEXT.lost} ${overlays.lost.note}` : "");
  trouble.hidden = name !== "lost";
  again.hidden = !texts.instructions || !["ready", "paused"].includes(name);
  if (name === "ready" && unread()) openText("instructions", TEXT.toGame);
  else if (name === "break" && texts.between) opening = setTimeout(openBetween, LAST_PICTURE);
  else if (reading && name !== "lost") closeText();
});

sliders.forEach(addSlider);
if (texts.between) overlays.break.button = TEXT.continue;
find("overlay").append(again);
find("reading").append(trouble);
again.addEventListener("click", () => openText("instructions", TEXT.backToGame));

function goOn() {
  if (reading === "between" && game.state === "break") return sendFields(texts.between, "betweenEpisodes") && start();
  if (reading === "instructions" && unread() && !sendFields(texts.instructions, "instructions")) return;
  if (reading === "instructions") remember(noted, true);
  closeText();
}

find("reading-button").addEventListener("click", goOn);
for (const text of Object.values(texts)) {
  text?.addEventListener("submit", (event) => {
    event.preventDefault();
    goOn();
  });
}
