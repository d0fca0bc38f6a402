// The page's elements, and the data that stand in the page (`_data` in hippodrome/control/participants/pages.py).

export const data = JSON.parse(document.getElementById("data").textContent);

export const find = (id) => document.getElementById(id);

const sections = ["wait", "over", "play", "leave", "reading"].map(find).filter(Boolean);

export function showSection(id) {
  for (const section of sections) section.hidden = section.id !== id;
  document.body.classList.toggle("playing", id === "play");
}

// A text is only written if it changes: otherwise a screen reader would say it again.
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function make(tag, properties, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

// Adds rules that only some games' pages need.
export function addStyle(rules) {
  document.head.append(make("style", { textContent: rules }));
}

// How numbers are shown

export function duration(seconds) {
  if (seconds < 90) return seconds === 1 ? TEXT.second : TEXT.seconds(seconds);
  return TEXT.minutes(Math.floor(seconds / 60), seconds % 60);
}

// Below 1,000 with two decimals, from there on without: the line above the picture has little room on a phone.
export function points(score) {
  return Number(score ?? 0).toLocaleString(TEXT.language, { maximumFractionDigits: Math.abs(score) < 1000 ? 2 : 0 });
}
