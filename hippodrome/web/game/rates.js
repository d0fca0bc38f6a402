// Buttons and a slider for the frame rate, where participants may change it.
import { commandButtons } from "./controls.js";
import { send } from "./connection.js";
import { hooks } from "./hooks.js";
import { addStyle, find, make } from "./page.js";
import { game } from "./state.js";

addStyle(`.rates { display: flex; flex-wrap: wrap; align-items: center; justify-content: center; gap: .5rem .8rem; }
.rates label { margin: 0; }
.rates input[type=range] { width: 8rem; }
.rates output { min-width: 8rem; font-variant-numeric: tabular-nums; }`);

hooks.rates = (shown, message) => {
  if (!message.allowFrameRateChange) return null;
  const buttons = commandButtons(shown, [
    ["slower", TEXT.slower, "fpsDown"],
    ["faster", TEXT.faster, "fpsUp"],
  ]);
  const box = make("div", { className: "rates" });
  if (shown.has("fpsSet")) {
    const slider = make("input", { type: "range", id: "rate", min: message.minFrameRate, max: message.maxFrameRate });
    slider.addEventListener("change", () => send({ changeFrameRate: Number(slider.value) }));
    box.append(make("label", { htmlFor: "rate", textContent: TEXT.speed }), slider, make("output", { htmlFor: "rate" }));
  }
  if (buttons) box.append(buttons);
  return box.childElementCount ? box : null;
};

hooks.message.push(showRate);

function showRate() {
  const slider = find("rate");
  if (!slider) return;
  slider.value = game.frameRate;
  slider.nextElementSibling.value = TEXT.perSecond(game.frameRate);
}
