// The study's own words: for what servers say, which they say in English (`SAID` in hippodrome/model/texts.py), and on the
// button that starts and pauses, which keeps the width of the longest that it has had: what is beside it stays in its place.
import { hooks } from "./hooks.js";
import { showMessage } from "./overlay.js";
import { data } from "./page.js";

function sayOwnWords(said) {
  if (!Object.hasOwn(data.said, said.error ?? "")) return;
  said.error = data.said[said.error]; // for what comes after this
  showMessage(said.error);
}

hooks.said.unshift(sayOwnWords);
hooks.overlay.push(() => {
  for (const button of document.querySelectorAll("[data-command=toggle]")) {
    if (button.offsetWidth) button.style.minWidth = `${button.offsetWidth}px`;
  }
});
