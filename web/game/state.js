// What the server last said of the game, and what this page adds: `state` "loading" before the first word, "elsewhere"
// when another page has the game; `offered`, the controls of the project's `ui`; `directions`, whether there are arrows;
// `nextAt`, when the break ends.

export const game = { state: "loading" };
