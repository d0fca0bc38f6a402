// Where modules join in that only some projects' pages carry (hippodrome/participants/game_modules.py chooses them).

export const hooks = {
  said: [], // functions that get each message of the server's once the page has shown it
  overlay: [], // functions that get the name of each overlay that is shown, or of the state without one
  means: (name) => ({ action: name }), // what a key or a button of this name tells the server
  key: () => undefined, // what a keyboard event does, as `{ action }`, if the project says so itself
  controls: () => undefined, // groups of buttons and lines of the legend that stand for those of the actions' names
  rates: () => null, // buttons for the frame rate
  kinds: {}, // by kind of a binary message: a function that gets it, and one that takes a picture's header and what it became
  starts: () => false, // whether a press that starts the game does nothing else
  waits: () => false, // whether something is to be seen before the game begins or goes on, and is shown now
};
