// The end of the game: the last picture with the score, then a section until the next page of the study can be loaded.
import { hideMessage, overlays, showOverlay } from "./overlay.js";
import { find, points, setText, showSection } from "./page.js";
import { loadPage, pageAnswers, pause } from "./requests.js";

// Shows the last picture until the participant goes on, at most for some seconds; if there is a note to read, for minutes.
// The parts of the server's last message: it lacks the score if the game was not played; `error` says why it went wrong.
export async function leave({ score, episodes, error } = {}) {
  const text = score === undefined ? "" : episodes > 1 ? TEXT.totalScore(episodes, points(score)) : TEXT.yourScore(points(score));
  if (error) Object.assign(overlays.over, { note: error, aside: false });
  const { note } = overlays.over;
  showOverlay("over");
  hideMessage();
  for (const id of ["leave-score", "overlay-score"]) setText(find(id), text);
  setText(find("announce"), note ? `${text} ${note}` : text);
  const seen = new Promise((resolve) => {
    setTimeout(resolve, note ? 600_000 : 4_000);
    find("overlay-button").addEventListener("click", resolve);
    find("overlay-button").focus({ preventScroll: true });
  }).then(() => showSection("leave"));
  for (;;) {
    try {
      await seen; // asked only now: a network that was lost meanwhile would leave the participant on the browser's own page
      if (await pageAnswers()) await loadPage();
    } catch {
      setText(find("leave-text"), TEXT.savedOffline);
    }
    await pause(2_000);
  }
}
