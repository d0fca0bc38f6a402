// The break between two games: the score of the game that is over, and the time until the next game.
import { releaseAll } from "./actions.js";
import { overlays, showOverlay } from "./overlay.js";
import { duration, find, points, setText } from "./page.js";
import { game } from "./state.js";

export function showBreak(message, begins) {
  if (begins) releaseAll(); // these keys were meant for the game that is over
  if (typeof message.nextIn === "number") game.nextAt = performance.now() + 1000 * message.nextIn;
  overlays.break.title = TEXT.gameOver(game.episode, game.maxEpisodes);
  if (begins) showOverlay("break");
  setText(find("overlay-score"), TEXT.yourScore(points(game.episodeScore)));
  countDown();
}

export function countDown() {
  if (game.state !== "break" || !game.nextAt) return;
  const seconds = Math.max(1, Math.ceil((game.nextAt - performance.now()) / 1000));
  setText(find("overlay-hint"), TEXT.nextGameIn(duration(seconds)));
}
