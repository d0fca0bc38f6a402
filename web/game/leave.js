// The last section: the score, until the next page of the study can be loaded.
import { find, points, setText, showSection } from "./page.js";
import { loadPage, pageAnswers, pause } from "./requests.js";

const SHOWN = 2_000; // ms for which the score is shown at least

// `result` is the server's last message; it lacks the score if the game was not played.
export async function leave({ score, episodes } = {}) {
  const scored = typeof score === "number";
  setText(find("leave-score"), scored ? `Your ${episodes > 1 ? `total score in ${episodes} games` : "score"}: ${points(score)}` : "");
  find("leave-score").hidden = !scored;
  showSection("leave");
  const seen = new Promise((resolve) => setTimeout(resolve, SHOWN));
  for (;;) {
    try {
      const answers = await pageAnswers();
      await seen;
      if (answers) await loadPage();
    } catch {
      setText(find("leave-text"), "Your game is saved. There is no connection at the moment – trying again…");
    }
    await pause(2_000);
  }
}
