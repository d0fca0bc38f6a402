// The study's own words for what servers say, which they say in English (`SAID` in hippodrome/model/texts.py).
import { hooks } from "./hooks.js";
import { showMessage } from "./overlay.js";
import { data } from "./page.js";

function sayOwnWords(said) {
  if (!Object.hasOwn(data.said, said.error ?? "")) return;
  said.error = data.said[said.error]; // for what comes after this
  showMessage(said.error);
}

hooks.said.unshift(sayOwnWords);
