// Shows the game's scores, number and state, as the server's message says.
import { showBreak } from "./breaks.js";
import { showOverlay } from "./overlay.js";
import { find, points, setText } from "./page.js";
import { game } from "./state.js";

export function showStatus(message) {
  const before = game.state;
  Object.assign(game, message);
  const several = game.maxEpisodes > 1;
  setText(find("score"), points(game.episodeScore ?? game.score));
  setText(find("total"), TEXT.total(points(game.score)));
  find("total").hidden = !several || game.episodeScore === undefined || game.episode < 2; // in the first game both scores are equal
  setText(find("episode"), several ? TEXT.gameOf(game.episode, game.maxEpisodes) : "");
  if (game.state === "break") showBreak(message, before !== "break");
  else if (before !== game.state) showOverlay(game.state);
}
