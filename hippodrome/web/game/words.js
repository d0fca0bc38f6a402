// The study's own texts: instead of the servers' English sentences (`SAID` in hippodrome/control/model/texts.py), and on the button
// that starts and pauses. That button keeps the width of its longest text, so that what is beside it does not move.
import { hooks } from "./hooks.js";
import { showMessage } from "./overlay.js";
import { data } from "./page.js";

function sayOwnWords(message) {
  if (!Object.hasOwn(data.said, message.error ?? "")) return;
  message.error = data.said[message.error]; // changed in the message, so that later hooks get it too
  showMessage(message.error);
}

hooks.message.unshift(sayOwnWords);
hooks.overlay.push(() => {
  for (const button of document.querySelectorAll("[data-command=toggle]")) {
    if (button.offsetWidth) button.style.minWidth = `${button.offsetWidth}px`;
  }
});
