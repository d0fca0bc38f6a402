// The WebSocket to the participant's server (docs/wire.md): handshake, acknowledgements, and how the page notices that it is dead.
import { startDrawing } from "./drawing.js";
import { decodes, readHeader, unpack } from "./frames.js";
import { hooks } from "./hooks.js";
import { data } from "./page.js";

const SUBPROTOCOL = "hippodrome";
const SILENCE = 1_500; // ms without a message; then the page asks whether the server is there
const PATIENCE = 5_000; // ms without an answer; then it gives up the connection
const CONNECTING = 10_000; // ms for a connection to open; some firewalls neither let it through nor refuse it
const ACK_EVERY = 8; // ms between acknowledgements; at high frame rates there would be too many
const ACK_WAIT = 50; // ms for which an acknowledgement waits for another picture, if they come that quickly
const ENDS = { 1000: "done", 4409: "elsewhere", 4404: "moved", 1011: "failed" }; // why the connection ended, by close code

let link = null; // the present connection; messages of earlier ones are ignored

// Plays until the connection ends; `hear` gets each message. Resolves to `{ why, welcome, result }`: `why` is "done",
// "elsewhere", "moved", "failed" (the game cannot begin on this server) or "lost", `welcome` whether the server let us in, `result` its last message after "done".
export function play(server, hear) {
  return new Promise((resolve) => {
    const socket = new WebSocket(server.url, SUBPROTOCOL);
    const own = { socket, heard: performance.now(), asked: 0, acked: 0, drawn: -Infinity, owed: 0, welcome: false };
    own.end = (why, result) => {
      if (link !== own) return;
      link = null;
      own.done = why === "done"; // the last picture may still be unpacked
      socket.close();
      resolve({ why, welcome: own.welcome, result });
    };
    link = own;
    const failed = () => own.end("lost"); // a new connection begins with a whole picture
    own.show = startDrawing(() => link === own || own.done, (id) => acknowledge(own, id), failed);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => send({ userId: server.userId, token: server.token, step: data.step, decodes });
    socket.onmessage = (event) => link === own && receive(own, event.data, hear);
    socket.onclose = (event) => own.end(own.welcome && event.code === 1011 ? "lost" : ENDS[event.code] ?? "lost");
  });
}

// Returns whether there is a connection that can take the message.
export function send(message) {
  const open = link?.socket.readyState === WebSocket.OPEN;
  if (open) link.socket.send(JSON.stringify(message));
  return open;
}

function receive(own, raw, hear) {
  own.heard = performance.now();
  own.asked = 0;
  if (typeof raw !== "string") {
    const special = hooks.kinds[new Uint8Array(raw)[0]];
    if (special) return special(raw, own.show);
    const header = readHeader(raw);
    return own.show(header, unpack(header, raw));
  }
  let message;
  try {
    message = JSON.parse(raw) ?? {};
  } catch {
    return own.end("lost"); // a trial server sends JSON
  }
  if (message.done) own.end("done", message);
  if (Array.isArray(message.UI)) own.welcome = true;
  hear(message);
}

// Acknowledges a picture at once if the last one came ACK_WAIT or more before it. If pictures come quicker, every second one
// is acknowledged, which stands for both.
function acknowledge(own, id) {
  const now = performance.now();
  const quick = now - own.drawn < ACK_WAIT;
  Object.assign(own, { newest: id, drawn: now, owed: own.owed + 1 });
  const wait = quick && own.owed < 2 ? ACK_WAIT : own.acked + ACK_EVERY - now;
  clearTimeout(own.timer);
  const tell = () => {
    Object.assign(own, { acked: performance.now(), owed: 0 });
    if (link === own) send({ ack: own.newest });
  };
  if (wait <= 0) tell();
  else own.timer = setTimeout(tell, wait);
}

// On bad Wi-Fi a connection can be dead for minutes before the browser notices.

// Notes that the server must answer the next message.
export function expectAnswer() {
  if (link?.welcome && !link.asked) link.asked = performance.now();
}

// Asks whether the server is there.
export function ask() {
  if (!link?.welcome || link.asked) return;
  expectAnswer();
  send({ command: "requestUI" });
}

// Asks after SILENCE, and gives up a connection that does not answer. Returns the milliseconds since its last message; 0
// without a connection.
export function watch() {
  if (!link) return 0;
  const now = performance.now();
  const silent = now - link.heard;
  const unreachable = link.socket.readyState === WebSocket.CONNECTING && silent > CONNECTING;
  if ((link.asked && now - link.asked > PATIENCE) || unreachable) link.end("lost");
  else if (silent > SILENCE) ask();
  return silent;
}
