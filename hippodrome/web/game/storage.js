// Values that the browser stores for this page. Storage may be full or forbidden; then nothing is stored.
import { data } from "./page.js";

export function remember(key, value) {
  try {
    sessionStorage.setItem(`hippodrome-${key}`, JSON.stringify(value));
  } catch {
    // nothing is stored
  }
}

export function recall(key) {
  try {
    return JSON.parse(sessionStorage.getItem(`hippodrome-${key}`));
  } catch {
    return null;
  }
}

// Deletes the drafts of earlier step pages (hippodrome/web/step.js): their answers have been sent.
export function clearDrafts() {
  try {
    const own = `hippodrome:${data.project}:${document.body.dataset.user}:`;
    Object.keys(localStorage).filter((key) => key.startsWith(own)).forEach((key) => localStorage.removeItem(key));
  } catch {
    // no storage, no drafts
  }
}
