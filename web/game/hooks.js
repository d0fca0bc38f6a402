// Where modules join in that only some projects' pages carry (hippodrome/participants/game_modules.py chooses them).

export const hooks = {
  said: [], // functions that get each message of the server's once the page has shown it
  overlay: [], // functions that get the name of each overlay that is shown, or of the state without one
};
