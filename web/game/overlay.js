// What covers the picture while the game does not run, and short messages of the server's.
import { hooks } from "./hooks.js";
import { find, points, setText } from "./page.js";
import { game } from "./state.js";

export const overlays = {
  loading: { title: "Loading the game…" },
  ready: { title: "Ready?", button: "Start", hint: "or press an arrow key" },
  paused: { title: "Paused", button: "Go on", hint: "or press an arrow key" },
  break: { title: "This game is over", button: "Go on now", band: true, note: "The next one begins in a moment." },
  lost: { title: "Connection lost – trying again…", note: "Your game is kept. Please stay on this page." },
  unreachable: {
    title: "Your game cannot be reached – trying again…",
    note: "Your game is kept. If this lasts for minutes, try another network, or tell whoever invited you to this study.",
  },
  elsewhere: {
    title: "The game was opened in another tab or on another device",
    button: "Play here instead",
    note: "If you have closed it there, go on here.",
  },
  ended: { title: "Saving your game…", band: true },
  over: { title: "The game is over", button: "Go on", band: true, shown: 4_000 }, // ms, unless the participant goes on
};

// Shows the overlay of that name; none for other names, such as "playing".
export function showOverlay(name) {
  const overlay = Object.hasOwn(overlays, name) && overlays[name];
  find("overlay").hidden = !overlay;
  find("overlay").classList.toggle("band", Boolean(overlay.band)); // the last picture stays to be seen
  find("controls").inert = !["ready", "playing", "paused"].includes(name);
  find("mode").dataset.state = name;
  setText(find("mode"), { playing: "Playing", paused: "Paused" }[name] ?? "");
  for (const button of document.querySelectorAll("[data-command=toggle]")) {
    button.textContent = { playing: "Pause", paused: "Go on" }[name] ?? "Start";
    button.style.visibility = game.offered?.has(name === "playing" ? "pause" : "start") ? "" : "hidden";
  }
  const score = name === "break" ? `. Your score: ${points(game.episodeScore)}.` : "";
  setText(find("announce"), `${overlay.title ?? "Playing"}${score}`);
  setText(find("overlay-score"), "");
  setText(find("overlay-title"), overlay.title ?? "");
  const hint = matchMedia("(hover: hover) and (pointer: fine)").matches && game.directions ? overlay.hint : "";
  setText(find("overlay-hint"), overlay.note ?? hint ?? "");
  find("overlay-button").textContent = overlay.button ?? "";
  find("overlay-button").hidden = !overlay.button;
  for (const hook of hooks.overlay) hook(name);
}

let messageTimer;

export function showMessage(text) {
  clearTimeout(messageTimer);
  setText(find("trouble"), text.charAt(0).toUpperCase() + text.slice(1));
  messageTimer = setTimeout(hideMessage, 8_000);
}

export function hideMessage() {
  setText(find("trouble"), "");
}
