// The end of the game: the last picture with the score, then a section until the next page of the study can be loaded.
import { hideMessage, overlays, showOverlay } from "./overlay.js";
import { find, points, setText, showSection } from "./page.js";
import { loadPage, pageAnswers, pause } from "./requests.js";

// `result` is the server's last message; it lacks the score if the game was not played.
export async function leave({ score, episodes } = {}) {
  const scored = typeof score === "number";
  const text = !scored ? "" : episodes > 1 ? TEXT.totalScore(episodes, points(score)) : TEXT.yourScore(points(score));
  setText(find("leave-score"), text);
  find("leave-score").hidden = !scored;
  const seen = (scored || overlays.over.note ? lastPicture(text) : Promise.resolve()).then(() => showSection("leave"));
  for (;;) {
    try {
      const answers = await pageAnswers();
      await seen;
      if (answers) await loadPage();
    } catch {
      setText(find("leave-text"), TEXT.savedOffline);
    }
    await pause(2_000);
  }
}

// Shows the last picture. Resolves after some seconds, or when the participant goes on.
function lastPicture(text) {
  showOverlay("over");
  hideMessage();
  for (const id of ["overlay-score", "announce"]) setText(find(id), text);
  return new Promise((resolve) => {
    setTimeout(resolve, overlays.over.shown);
    find("overlay-button").addEventListener("click", resolve);
    find("overlay-button").focus({ preventScroll: true });
  });
}
