// What the server says of the game: scores, the number of the game, its state.
import { showBreak } from "./breaks.js";
import { showOverlay } from "./overlay.js";
import { find, points, setText } from "./page.js";
import { game } from "./state.js";

export function showStatus(said) {
  const before = game.state;
  Object.assign(game, said);
  const several = game.maxEpisodes > 1;
  setText(find("score"), points(game.episodeScore ?? game.score));
  setText(find("total"), TEXT.total(points(game.score)));
  find("total").hidden = !several || game.episodeScore === undefined;
  setText(find("episode"), several ? TEXT.gameOf(game.episode, game.maxEpisodes) : "");
  if (game.state === "break") showBreak(said, before !== "break");
  else if (before !== game.state) showOverlay(game.state);
}
