// The study's own texts instead of the servers' English sentences (`SAID` in hippodrome/control/model/texts.py).
import { hooks } from "./hooks.js";
import { showMessage } from "./overlay.js";
import { data } from "./page.js";

function sayOwnWords(message) {
  if (!Object.hasOwn(data.said, message.error ?? "")) return;
  message.error = data.said[message.error]; // changed in the message, so that later hooks get it too
  showMessage(message.error);
}

hooks.message.unshift(sayOwnWords);
