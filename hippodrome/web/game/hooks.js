// Hooks for the modules that only some projects' pages carry (hippodrome/control/participants/game_modules.py chooses them).

export const hooks = {
  message: [], // functions that get each message of the server, after the page has shown it
  overlay: [], // functions that get the name of each overlay that is shown, or of the state that has none
  means: (name) => ({ action: name }), // the message for a key or a button of this name
  key: () => undefined, // what a keyboard event does, as `{ action }`, if the project defines keys
  controls: () => undefined, // the project's own groups of buttons and lines of the legend, instead of those of the actions' names
  rates: () => null, // buttons for the frame rate
  kinds: {}, // by kind of binary message: a function that gets the message, and the function that `startDrawing` returns
  starts: () => false, // whether a press that starts the game does nothing else
  waits: () => false, // whether the participant has to see something first, which is shown now
};
