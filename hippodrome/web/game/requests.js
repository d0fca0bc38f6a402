// The page's HTTP requests: the state of the participant's server (docs/pages.md), and the page itself.
import { data, find, setText } from "./page.js";
import { recall, remember } from "./storage.js";

const RELOAD_EVERY = 5_000; // ms between reloads: a page must not reload without end, whatever goes wrong

// Waits so many ms, or until the connection comes back or the participant looks at the page again.
export function pause(ms) {
  return new Promise((resolve) => {
    const waking = new AbortController();
    const wake = () => {
      waking.abort();
      resolve();
    };
    setTimeout(wake, ms);
    window.addEventListener("online", wake, { signal: waking.signal });
    document.addEventListener("visibilitychange", () => document.hidden || wake(), { signal: waking.signal });
  });
}

export async function pollUntilAnswered() {
  for (let tries = 0; ; tries += 1) {
    try {
      const state = await poll();
      setText(find("wait-status"), "");
      return state;
    } catch {
      setText(find("wait-status"), TEXT.noConnection);
      await pause(Math.min(4_000, 1_000 * 2 ** tries));
    }
  }
}

let behind = 0; // seconds

// Seconds by which this device's clock was behind the site's when it answered last.
export function secondsBehind() {
  return behind;
}

async function poll() {
  const answer = await request(data.poll, { headers: { Accept: "application/json" } });
  behind = (Date.parse(answer.headers.get("date")) - Date.now()) / 1000 || 0;
  const state = answer.ok ? await answer.json() : null;
  if (typeof state?.state !== "string") throw new Error("no answer");
  return state;
}

function request(address, options) {
  return fetch(address, { ...options, cache: "no-store", signal: AbortSignal.timeout?.(10_000) });
}

// Whether the site answers for the page without an error of its own. Rejects if there is no connection.
export async function pageAnswers() {
  return (await request(data.page, { method: "HEAD" })).status < 500;
}

// Loads the page again. Never resolves.
export async function loadPage() {
  await pause(Math.max(0, RELOAD_EVERY - Date.now() + (recall("reloaded") ?? 0)));
  remember("reloaded", Date.now());
  location.replace(data.page);
  await new Promise(() => {});
}
