// The overlay that covers the picture, or at the end the controls, while the game does not run, and short messages of the server.
import { hooks } from "./hooks.js";
import { find, points, setText } from "./page.js";
import { game } from "./state.js";

export const overlays = {
  loading: { title: TEXT.loading, note: TEXT.loadingNote },
  ready: { title: TEXT.ready, button: TEXT.start, hint: TEXT.orArrow },
  paused: { title: TEXT.paused, button: TEXT.goOn, hint: TEXT.orArrow },
  break: { button: TEXT.goOnNow, aside: true }, // breaks.js has its words
  lost: { title: TEXT.lost, note: TEXT.lostNote },
  elsewhere: { title: TEXT.elsewhere, button: TEXT.playHere, note: TEXT.elsewhereNote },
  ended: { title: TEXT.saving, aside: true },
  over: { title: TEXT.over, button: TEXT.continue, aside: true },
};

// Shows the overlay with that name; no overlay for names without one, such as "playing".
export function showOverlay(name) {
  const overlay = overlays[name] ?? false;
  find("overlay").hidden = !overlay;
  if (overlay.aside) find("controls").after(find("overlay")); // in their place: the last picture stays visible
  else find("trouble").before(find("overlay"));
  find("controls").inert = !["ready", "playing", "paused"].includes(name);
  find("play").dataset.state = name; // for the style
  const score = name === "break" ? `. ${TEXT.yourScore(points(game.episodeScore))}.` : "";
  setText(find("announce"), `${overlay.title ?? TEXT.playing}${score}`);
  setText(find("overlay-score"), "");
  setText(find("overlay-title"), overlay.title ?? "");
  const hint = game.directions && matchMedia("(hover: hover) and (pointer: fine)").matches && overlay.hint;
  setText(find("overlay-hint"), overlay.note || hint || "");
  find("overlay-button").textContent = overlay.button;
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
