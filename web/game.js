// The game page: it waits for the participant's server, then plays. docs/wire.md says what travels over the WebSocket,
// docs/pages.md what the poll address answers.
(() => {
  "use strict";

  const SUBPROTOCOLS = ["hippodrome.2", "hippodrome.1"]; // the first has lossy frames too
  const HEADER = 10; // bytes before the pixels of a binary frame
  const KEY = 0, DIFFERENCE = 1, JPEG = 2, ROWS = 3; // kinds of frames
  const LARGEST = 4096 * 4096; // pixels of a picture; trial/frames.py sends no more
  const MOST_ACTIONS = 64; // buttons for them; more would fill no page but memory
  const STAGES = ["queued", "starting", "naming", "ready"];
  const SILENCE = 5_000; // ms without a word until we ask whether the server is there, and again until we give it up
  const ACK_EVERY = 8; // ms; more would be too many messages at high frame rates
  const DIALLING = 10_000; // ms; some firewalls neither let through nor refuse
  const LONG = 20_000; // ms of trouble until more is said
  const FAREWELL = 2_000; // ms for which the end shows the score
  const RELOAD_EVERY = 5_000; // ms; whatever goes wrong, a page never reloads in a tight loop

  const data = JSON.parse(document.getElementById("data").textContent);
  const title = document.title;
  const find = (id) => document.getElementById(id);
  const sections = ["wait", "over", "play", "leave"].map(find);

  // Small helpers

  function showSection(id) {
    for (const section of sections) section.hidden = section.id !== id;
    document.body.classList.toggle("playing", id === "play");
  }

  // Writing the same text again would make a screen reader say it again.
  function setText(element, text) {
    if (element.textContent !== text) element.textContent = text;
  }

  // Waits, but no longer than until the connection comes back or the participant looks at the page again.
  function pause(ms) {
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

  // Session storage may be forbidden; then we remember nothing.
  function remember(key, value) {
    try {
      sessionStorage.setItem(`hippodrome-${key}`, JSON.stringify(value));
    } catch {
      // as if nothing had been said
    }
  }

  function recall(key) {
    try {
      return JSON.parse(sessionStorage.getItem(`hippodrome-${key}`));
    } catch {
      return null;
    }
  }

  // The drafts of the step pages before have been sent.
  function clearDrafts() {
    try {
      const own = `hippodrome:${data.project}:${document.body.dataset.user}:`;
      Object.keys(localStorage).filter((key) => key.startsWith(own)).forEach((key) => localStorage.removeItem(key));
    } catch {
      // no storage, no drafts
    }
  }

  async function loadPage() {
    await pause(Math.max(0, RELOAD_EVERY - Date.now() + (recall("reloaded") ?? 0)));
    remember("reloaded", Date.now());
    location.replace(data.page);
    await new Promise(() => {}); // nothing else happens here
  }

  // Asking how far the server is

  async function poll() {
    const answer = await fetch(data.poll, {
      headers: { Accept: "application/json" },
      cache: "no-store",
      signal: AbortSignal.timeout?.(10_000),
    });
    const state = answer.ok ? await answer.json() : null;
    if (typeof state?.state !== "string") throw new Error("no answer");
    return state;
  }

  async function pollUntilAnswered() {
    for (let tries = 0; ; tries += 1) {
      try {
        const state = await poll();
        setText(find("wait-status"), "");
        return state;
      } catch {
        setText(find("wait-status"), "No connection – trying again…");
        await pause(Math.min(4_000, 1_000 * 2 ** tries));
      }
    }
  }

  // Milliseconds between two questions: few at first and in the last state before `ready`, more otherwise.
  const POLLS = { first: 1_000, growth: 1.15, longest: 4_000, naming: 1_500 };
  const RELOAD_WAIT = 240_000; // the request for a server may have been lost, and a reload asks once more

  function pollDelay(state, polls) {
    if (isOver(state)) return POLLS.longest;
    if (state.state === "naming") return POLLS.naming;
    return Math.min(POLLS.longest, POLLS.first * POLLS.growth ** polls);
  }

  // Waiting

  const waiting = { since: 0, typical: null, stage: "" };

  function isOver(state) {
    return state.state === "ended" || state.state === "failed";
  }

  function secondsNow() {
    return Math.max(0, Math.round((performance.now() - waiting.since) / 1000));
  }

  function inWords(seconds) {
    if (seconds < 90) return seconds === 1 ? "1 second" : `${seconds} seconds`;
    return `${Math.floor(seconds / 60)} min ${seconds % 60} s`;
  }

  function showClock() {
    const seconds = secondsNow();
    find("elapsed").textContent = `Waiting for ${inWords(seconds)}.`;
    if (!waiting.typical) return;
    const long = seconds > 2 * waiting.typical + 10;
    find("typical").textContent = long
      ? "This takes longer than usual. Please stay on this page."
      : `Usually it takes about ${inWords(waiting.typical)}.`;
  }

  function showWaiting(state) {
    waiting.since = performance.now() - 1000 * (state.seconds ?? 0);
    waiting.typical = state.typical;
    const now = Math.max(0, STAGES.indexOf(state.state));
    STAGES.forEach((name, at) => {
      const item = find(`stage-${name}`);
      item.classList.toggle("past", at < now);
      item.toggleAttribute("aria-current", at === now);
      if (at === now) item.setAttribute("aria-current", "step");
    });
    find("wait-first").hidden = Boolean(state.replaces);
    find("wait-moved").hidden = !state.replaces;
    showClock();
    showSection("wait");
    if (waiting.stage !== state.state) setText(find("announce"), find(`stage-${STAGES[now]}`).textContent);
    waiting.stage = state.state;
  }

  // After "Try again" the server's record stays closed for a moment; that is not the news it looks like.
  function askedAgain(state) {
    const asked = recall("again");
    return asked?.attempt === state.attempt && Date.now() - asked.at < 30_000;
  }

  // The picture

  function makeScreen(canvas) {
    const context = canvas.getContext("2d", { alpha: false });
    let size = ""; // of the picture that is shown
    let pixels = null; // of the last lossless picture, as they came: one or three bytes each
    let rows = 0; // of a lossless picture that comes in parts, so far
    let image = null;

    function resize({ width, height, channels = 0 }) {
      const now = `${width} ${height} ${channels}`;
      if (now === size) return;
      size = now;
      pixels = image = null;
      rows = 0;
      if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
      document.body.style.setProperty("--ratio", width / height);
    }

    function show(first, count, { width, height, channels }) {
      if (!image) {
        image = new ImageData(width, height);
        image.data.fill(255);
      }
      const to = image.data;
      const green = channels === 3 ? 1 : 0;
      const end = 4 * width * (first + count);
      for (let from = channels * width * first, at = 4 * width * first; at < end; from += channels, at += 4) {
        to[at] = pixels[from];
        to[at + 1] = pixels[from + green];
        to[at + 2] = pixels[from + 2 * green];
      }
      context.putImageData(image, 0, 0, 0, first, width, count);
    }

    // Rows replace those of the picture that is shown. With the last of them, differences to it can follow.
    function drawRows(header, first, bytes) {
      const { width, height, channels } = header;
      if (size !== `${width} ${height} ${channels}` || (first !== 0 && first !== rows)) throw new Error("rows of nothing");
      const count = bytes.length / (width * channels);
      pixels ??= new Uint8Array(width * height * channels);
      pixels.set(bytes, first * width * channels);
      show(first, count, header);
      rows = first + count;
    }

    return {
      forget() {
        size = "";
      },
      draw(header, { first, bytes }) {
        if (header.kind === ROWS) return drawRows(header, first, bytes);
        resize(header);
        const partly = rows > 0 && rows < header.height;
        if (header.kind === KEY) pixels = bytes;
        else if (!pixels || partly) throw new Error("a difference to nothing");
        else for (let i = 0; i < bytes.length; i += 1) pixels[i] ^= bytes[i];
        rows = 0;
        show(0, header.height, header);
      },
      // The pixels of the last lossless picture stay: the next difference may be to them.
      drawPicture(header, picture) {
        resize(header);
        if (rows > 0 && rows < header.height) pixels = null;
        rows = 0;
        if (picture) context.drawImage(picture, 0, 0);
      },
    };
  }

  function readHeader(buffer) {
    const view = new DataView(buffer);
    return {
      kind: view.getUint8(0),
      id: view.getUint32(1),
      width: view.getUint16(5),
      height: view.getUint16(7),
      channels: view.getUint8(9),
    };
  }

  function unpack(header, buffer) {
    const { kind, width, height, channels } = header;
    const known = width * height > 0 && width * height <= LARGEST && (channels === 1 || channels === 3);
    if (!known || kind > ROWS || buffer.byteLength < HEADER + 2) return Promise.reject(new Error("no such picture"));
    if (kind === JPEG) return decodeLossy(header, buffer);
    if (kind === ROWS) return inflateRows(header, buffer);
    return inflate(buffer.slice(HEADER), width * height * channels, width * height * channels).then((bytes) => ({ bytes }));
  }

  async function inflateRows({ width, height, channels }, buffer) {
    const first = new DataView(buffer).getUint16(HEADER);
    const row = width * channels;
    const bytes = await inflate(buffer.slice(HEADER + 2), row, row * (height - first));
    if (bytes.length % row) throw new Error("rows of the wrong size");
    return { first, bytes };
  }

  // No more than the header says is unpacked: a small message must not become a huge picture.
  async function inflate(packed, least, most) {
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
    const reader = stream.getReader();
    const parts = [];
    let length = 0;
    for (let part = await reader.read(); !part.done; part = await reader.read()) {
      parts.push(part.value);
      length += part.value.length;
      if (length > most) break;
    }
    if (length < least || length > most) {
      reader.cancel().catch(() => {});
      throw new Error("a frame of the wrong size");
    }
    return new Uint8Array(await new Blob(parts).arrayBuffer());
  }

  // For the same reason a JPEG's own size is read before it is decoded.
  async function decodeLossy({ width, height }, buffer) {
    const size = jpegSize(new DataView(buffer, HEADER));
    if (size?.width !== width || size.height !== height) throw new Error("a JPEG of another size");
    const blob = new Blob([buffer.slice(HEADER)], { type: "image/jpeg" });
    const picture = await createImageBitmap(blob, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
    if (picture.width !== width || picture.height !== height) throw new Error("a JPEG of another size");
    return { picture };
  }

  // What the frame header (SOF) of a JPEG says. Segments begin with 0xff, a marker and their length.
  function jpegSize(view) {
    for (let at = 2; at + 9 <= view.byteLength; at += 2 + view.getUint16(at + 2)) {
      const marker = view.getUint16(at);
      if (marker < 0xffc0 || marker === 0xffda) return null;
      const isTable = marker === 0xffc4 || marker === 0xffc8 || marker === 0xffcc;
      if (marker <= 0xffcf && !isTable) return { width: view.getUint16(at + 7), height: view.getUint16(at + 5) };
    }
    return null;
  }

  async function decodeJpeg(base64) {
    const picture = new Image();
    picture.src = `data:image/jpeg;base64,${base64}`;
    await picture.decode();
    return { picture, width: picture.naturalWidth, height: picture.naturalHeight };
  }

  const screen = makeScreen(find("screen"));

  // The connection

  const canInflate = typeof DecompressionStream === "function";
  const canDecode = typeof createImageBitmap === "function";
  const spoken = canInflate ? SUBPROTOCOLS.slice(canDecode ? 0 : 1) : [];
  let link = null; // the present connection; what an earlier one still says does not count
  let game = { state: "loading" }; // what the server last said of itself

  // Plays until the connection is over. Resolves to what comes next: "done", "elsewhere", "moved" or "lost".
  function play(server) {
    return new Promise((resolve) => {
      const socket = new WebSocket(server.url, spoken);
      const own = { socket, drawn: Promise.resolve(), heard: performance.now(), asked: 0, acked: 0, welcome: false };
      Object.assign(own, { frames: 0, whole: 0 });
      own.over = (why) => {
        if (link !== own) return;
        link = null;
        releaseAll(false);
        socket.close();
        resolve({ why, welcome: own.welcome });
      };
      link = own;
      screen.forget();
      socket.binaryType = "arraybuffer";
      socket.onopen = () => send({ userId: server.userId, token: server.token, step: data.step });
      socket.onmessage = (event) => link === own && hear(own, event.data);
      socket.onclose = (event) => own.over(whatNext(event.code));
    });
  }

  function whatNext(code) {
    return { 1000: "done", 4409: "elsewhere", 4404: "moved" }[code] ?? "lost";
  }

  function send(message) {
    if (link?.socket.readyState === WebSocket.OPEN) link.socket.send(JSON.stringify(message));
  }

  function hear(own, message) {
    own.heard = performance.now();
    own.asked = 0;
    if (typeof message !== "string") {
      const header = message.byteLength >= HEADER ? readHeader(message) : {};
      return showFrame(own, header, unpack(header, message));
    }
    if (message === "done") return own.over("done");
    let said;
    try {
      said = JSON.parse(message) ?? {};
    } catch {
      return own.over("lost"); // no server of ours speaks like that
    }
    if (said.frame) showFrame(own, { id: said.frameId }, decodeJpeg(said.frame));
    if (said.done) {
      game.result = said;
      return own.over("done");
    }
    if (said.error) showTrouble(String(said.error));
    if (Array.isArray(said.UI)) {
      own.welcome = true;
      buildControls(said);
    }
    if (said.state) showGame(said);
  }

  // Frames are unpacked side by side, but drawn one after the other: each may be a difference to the one before. A lossy
  // picture is left out if a later whole picture is ready to be drawn; the server learns of it by that one.
  function showFrame(own, header, unpacking) {
    const number = (own.frames += 1);
    const whole = header.kind === KEY || header.kind === JPEG;
    unpacking.then(() => whole && (own.whole = Math.max(own.whole, number)), () => {}); // failures are looked at below
    own.drawn = own.drawn.then(async () => {
      const unpacked = await unpacking;
      if (link !== own) return unpacked.picture?.close?.();
      if (!unpacked.picture) screen.draw(header, unpacked);
      else {
        const late = header.kind === JPEG && own.whole > number;
        screen.drawPicture(header.kind === JPEG ? header : unpacked, late ? null : unpacked.picture);
        unpacked.picture.close?.();
        if (late) return;
      }
      acknowledge(own, header.id);
    }).catch(() => own.over("lost")); // a new connection begins with a whole picture
  }

  function acknowledge(own, id) {
    if (!SUBPROTOCOLS.includes(own.socket.protocol)) return;
    const tell = () => {
      own.timer = null;
      own.acked = performance.now();
      if (link === own) send({ ack: own.newest });
    };
    own.newest = id;
    const wait = own.acked + ACK_EVERY - performance.now();
    if (wait <= 0) tell();
    else own.timer ??= setTimeout(tell, wait);
  }

  // On bad Wi-Fi a connection can be dead for minutes before the browser notices.
  function ask() {
    if (!link?.welcome || link.asked) return;
    link.asked = performance.now();
    send({ command: "requestUI" });
  }

  function watch() {
    if (!link) return;
    const now = performance.now();
    if (link.asked && now - link.asked > SILENCE) link.over("lost");
    else if (link.socket.readyState === WebSocket.CONNECTING && now - link.heard > DIALLING) link.over("lost");
    else if (game.state === "loading" && now - link.heard > LONG) setText(find("veil-hint"), "This takes longer than usual. Please stay on this page.");
    else if (["playing", "break"].includes(game.state) && now - link.heard > SILENCE) ask();
  }

  // What is said of the game

  const veils = {
    loading: { title: "Loading the game…" },
    ready: { title: "Ready?", button: "Start", hint: "or press an arrow key" },
    paused: { title: "Paused", button: "Go on", hint: "or press an arrow key" },
    break: { title: "This game is over", button: "Go on now", note: "The next one begins in a moment." },
    lost: { title: "Connection lost – trying again…", note: "Your game is kept. Please stay on this page." },
    unreachable: {
      title: "Your game cannot be reached – trying again…",
      note: "Your game is kept. If this lasts for minutes, try another network, or tell whoever invited you to this study.",
    },
    elsewhere: { title: "The game is open in another tab or on another device", button: "Play here instead" },
    ended: { title: "Saving your game…" },
  };

  function showGame(said) {
    const before = game.state;
    game = { ...game, ...said };
    const several = game.maxEpisodes > 1;
    setText(find("score"), points(game.episodeScore ?? game.score));
    setText(find("total"), `Total ${points(game.score)}`);
    find("total").hidden = !several || game.episodeScore === undefined;
    setText(find("episode"), several ? `Game ${game.episode} of ${game.maxEpisodes}` : "");
    showRate();
    if (game.state === "break") showBreak(said, before !== "break");
    else if (before !== game.state) showVeil(game.state);
  }

  function points(score) {
    return Number(score ?? 0).toLocaleString();
  }

  // Between two games: the score of the one that is over, and how long it is until the next.
  function showBreak(said, begins) {
    if (begins) releaseAll(); // these keys were meant for the game that is over
    if (typeof said.nextIn === "number") game.nextAt = performance.now() + 1000 * said.nextIn;
    veils.break.title = `Game ${game.episode} of ${game.maxEpisodes} is over`;
    if (begins) showVeil("break");
    setText(find("veil-score"), `Your score: ${points(game.episodeScore)}`);
    countDown();
  }

  function countDown() {
    if (game.state !== "break" || !game.nextAt) return;
    const seconds = Math.max(1, Math.ceil((game.nextAt - performance.now()) / 1000));
    setText(find("veil-hint"), `The next game begins in ${inWords(seconds)}.`);
  }

  function showVeil(name) {
    const veil = Object.hasOwn(veils, name) ? veils[name] : null;
    find("veil").hidden = !veil;
    find("controls").inert = !["ready", "playing", "paused"].includes(name);
    find("mode").dataset.state = name;
    setText(find("mode"), { playing: "Playing", paused: "Paused" }[name] ?? "");
    for (const button of document.querySelectorAll("[data-command=toggle]")) {
      button.textContent = name === "playing" ? "Pause" : "Start";
      button.style.visibility = game.offered?.has(name === "playing" ? "pause" : "start") ? "" : "hidden";
    }
    const score = name === "break" ? ` Your score: ${points(game.episodeScore)}.` : "";
    setText(find("announce"), `${veil?.title ?? "Playing"}${score && `.${score}`}`);
    setText(find("veil-score"), "");
    if (!veil) return;
    setText(find("veil-title"), veil.title);
    const hint = matchMedia("(hover: hover) and (pointer: fine)").matches && game.directions ? veil.hint : "";
    setText(find("veil-hint"), veil.note ?? hint ?? "");
    find("veil-button").textContent = veil.button ?? "";
    find("veil-button").hidden = !veil.button;
  }

  function showTrouble(text) {
    clearTimeout(showTrouble.timer);
    setText(find("trouble"), text.charAt(0).toUpperCase() + text.slice(1));
    showTrouble.timer = setTimeout(() => setText(find("trouble"), ""), 8_000);
  }

  // Actions: what is held down, by which key or finger

  const held = new Map(); // action -> the set of its keys and fingers

  function press(action, source) {
    if (game.state === "elsewhere") return;
    if (game.state !== "playing" && game.state !== "break") start();
    const sources = held.get(action) ?? new Set();
    held.set(action, sources.add(source));
    if (sources.size === 1) send({ action, held: true });
  }

  function release(action, source) {
    const sources = held.get(action);
    if (!sources?.delete(source) || sources.size) return;
    held.delete(action);
    send({ action, held: false });
  }

  function releaseAll(tell = true) {
    if (tell) for (const action of held.keys()) send({ action, held: false });
    held.clear();
    document.querySelectorAll(".pressed").forEach((button) => button.classList.remove("pressed"));
  }

  function start() {
    if (link?.welcome && !link.asked) link.asked = performance.now(); // an answer must come
    send({ command: "start" });
  }

  function command(name) {
    if (name === "toggle" && game.state !== "playing") return start();
    if (name === "toggle") return game.offered?.has("pause") && send({ command: "pause" });
    if (name === "stop" && !window.confirm("End the game now? You cannot go on with it afterwards.")) return;
    if (name === "faster" || name === "slower") return send({ changeFrameRate: name });
    send({ command: name });
  }

  // Keys

  const DIRECTIONS = {
    up: { label: "Up", sign: "↑", codes: ["ArrowUp", "KeyW"] },
    left: { label: "Left", sign: "←", codes: ["ArrowLeft", "KeyA"] },
    right: { label: "Right", sign: "→", codes: ["ArrowRight", "KeyD"] },
    down: { label: "Down", sign: "↓", codes: ["ArrowDown", "KeyS"] },
  };
  const COMPOUND = /^(up|down|left|right|fire){2,}$/; // two keys at once, such as "upright"
  let keys = new Map(); // event.code -> what it does

  function onKeyDown(event) {
    const does = keys.get(event.code);
    if (!does || find("play").hidden || event.ctrlKey || event.metaKey || event.altKey) return;
    const on = event.target;
    if (on.matches("input, select, textarea") || (on.matches("button") && event.code === "Space")) return;
    event.preventDefault(); // the page must not scroll
    if (event.repeat) return;
    if (does.action) press(does.action, event.code);
    else command(does.command);
  }

  function onKeyUp(event) {
    const does = keys.get(event.code);
    if (does?.action) release(does.action, event.code);
  }

  // Controls on the page

  function parts(names) {
    const known = names.flatMap((name) => (COMPOUND.test(name) ? name.match(/up|down|left|right|fire/g) : [name]));
    return [...new Set(known)].filter((name) => name !== "noop");
  }

  function buildControls(said) {
    const wanted = JSON.stringify([said.UI, said.actionSpace, said.allowFrameRateChange]);
    if (wanted === buildControls.built) return;
    buildControls.built = wanted;
    const shown = new Set(said.UI);
    const actions = parts((Array.isArray(said.actionSpace) ? said.actionSpace : []).map(String)).slice(0, MOST_ACTIONS);
    const directions = Object.keys(DIRECTIONS).filter((name) => shown.has(name) && actions.includes(name));
    const others = actions.filter((name) => !(name in DIRECTIONS));
    game.directions = directions.length > 0;
    game.offered = shown;
    keys = assignKeys(directions, others, shown);
    find("controls").replaceChildren(
      ...[padOf(directions), othersOf(others), commandsOf(shown), ratesOf(shown, said)].filter((part) => part),
    );
    showLegend(directions, others, shown);
  }

  function assignKeys(directions, others, shown) {
    const map = new Map();
    for (const name of directions) for (const code of DIRECTIONS[name].codes) map.set(code, { action: name });
    others.forEach((name, at) => map.set(keyOf(name, others, at), { action: name }));
    if (!others.includes("fire")) map.set("Space", { command: "toggle" });
    if (!map.has("KeyP") && (shown.has("pause") || others.includes("fire"))) map.set("KeyP", { command: "toggle" });
    if (shown.has("reset")) map.set("KeyR", { command: "reset" });
    if (shown.has("good")) map.set("KeyG", { command: "good" });
    if (shown.has("bad")) map.set("KeyB", { command: "bad" });
    return map;
  }

  function keyOf(name, others) {
    if (name === "fire") return "Space";
    const number = others.filter((other) => other !== "fire").indexOf(name) + 1;
    return number <= 9 ? `Digit${number}` : `Unreachable${number}`;
  }

  function showLegend(directions, others, shown) {
    const lines = [];
    const arrows = ["left", "up", "right", "down"].filter((name) => directions.includes(name));
    if (arrows.length) lines.push([arrows.map((name) => DIRECTIONS[name].sign), "move"]);
    for (const name of others) {
      const code = keyOf(name, others);
      if (!code.startsWith("Unreachable")) lines.push([[code.replace("Digit", "")], name]);
    }
    lines.push([[others.includes("fire") ? "P" : "Space"], shown.has("pause") ? "start and pause" : "start"]);
    if (shown.has("reset")) lines.push([["R"], "begin again"]);
    if (shown.has("good")) lines.push([["G"], "good"]);
    if (shown.has("bad")) lines.push([["B"], "bad"]);
    find("legend").replaceChildren(...lines.map(([names, what]) => {
      const item = make("span", {});
      item.append(...names.map((name) => make("kbd", { textContent: name })), ` ${what}`);
      return item;
    }));
  }

  function make(tag, properties, ...children) {
    const element = Object.assign(document.createElement(tag), properties);
    element.append(...children);
    return element;
  }

  // A button that acts while it is held. A finger may slide from one to the next, as thumbs do.
  function actionButton(action, label, sign) {
    const button = make("button", { type: "button", textContent: sign ?? label, className: `hold ${action}` });
    button.setAttribute("aria-label", label);
    button.dataset.action = action;
    button.addEventListener("click", (event) => event.detail === 0 && tap(action)); // from the keyboard
    return button;
  }

  function tap(action) {
    if (game.state !== "playing" && game.state !== "break") start();
    send({ action });
  }

  function padOf(directions) {
    if (!directions.length) return null;
    const buttons = directions.map((name) => actionButton(name, DIRECTIONS[name].label, `${DIRECTIONS[name].sign}\ufe0e`));
    return fingers(make("div", { className: "pad" }, ...buttons));
  }

  function othersOf(others) {
    const nice = (name) => name.charAt(0).toUpperCase() + name.slice(1).replace(/[_-]/g, " ");
    return others.length
      ? fingers(make("div", { className: "others" }, ...others.map((name) => actionButton(name, nice(name)))))
      : null;
  }

  function fingers(group) {
    const touching = new Map(); // pointer -> the button below it

    function move(pointer, button) {
      const before = touching.get(pointer);
      if (before === button) return;
      if (before) {
        before.classList.remove("pressed");
        release(before.dataset.action, pointer);
      }
      if (button) {
        touching.set(pointer, button);
        button.classList.add("pressed");
        press(button.dataset.action, pointer);
      } else touching.delete(pointer);
    }

    function below(event) {
      const button = document.elementFromPoint(event.clientX, event.clientY)?.closest("button.hold");
      return button && group.contains(button) ? button : null;
    }

    group.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      event.preventDefault();
      group.setPointerCapture(event.pointerId);
      move(event.pointerId, below(event));
    });
    group.addEventListener("pointermove", (event) => {
      if (group.hasPointerCapture(event.pointerId)) move(event.pointerId, below(event));
    });
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
      group.addEventListener(end, (event) => move(event.pointerId, null));
    }
    return group;
  }

  function commandsOf(shown) {
    const all = [
      ["toggle", "Start", shown.has("start") || shown.has("pause")],
      ["reset", "Begin again", shown.has("reset")],
      ["good", "Good", shown.has("good")],
      ["bad", "Bad", shown.has("bad")],
      ["trainOnline", "Train online", shown.has("trainOnline")],
      ["trainOffline", "Train offline", shown.has("trainOffline")],
      ["stop", "End the game", shown.has("stop")],
    ];
    return commandButtons(all);
  }

  function commandButtons(all) {
    const buttons = all.filter(([, , wanted]) => wanted).map(([name, label]) => {
      const button = make("button", { type: "button", textContent: label });
      button.dataset.command = name;
      button.addEventListener("click", () => command(name));
      return button;
    });
    return buttons.length ? make("div", { className: "commands" }, ...buttons) : null;
  }

  function ratesOf(shown, said) {
    if (!said.allowFrameRateChange) return null;
    const buttons = commandButtons([
      ["slower", "Slower", shown.has("fpsDown")],
      ["faster", "Faster", shown.has("fpsUp")],
    ]);
    const box = make("div", { className: "rates" });
    if (shown.has("fpsSet")) {
      const slider = make("input", { type: "range", id: "rate", min: said.minFrameRate, max: said.maxFrameRate });
      slider.addEventListener("change", () => send({ changeFrameRate: Number(slider.value) }));
      box.append(make("label", { htmlFor: "rate", textContent: "Speed" }), slider, make("output", { htmlFor: "rate" }));
    }
    if (buttons) box.append(buttons);
    return box.childElementCount ? box : null;
  }

  function showRate() {
    const slider = find("rate");
    if (!slider) return;
    slider.value = game.frameRate;
    slider.nextElementSibling.value = `${game.frameRate} per second`;
  }

  // The whole story, one thing after the other

  async function main() {
    const first = data.state;
    let state = first;
    let losses = 0;
    let lostSince = null;
    let waitsSince = performance.now();
    for (let polls = 0; ; polls += 1) {
      if (state.state === "ready" && state.url) {
        const { why, welcome } = await playOn(state);
        losses = welcome ? 0 : losses + 1;
        lostSince = welcome ? performance.now() : lostSince ?? performance.now();
        if (why === "lost") showVeil(performance.now() - lostSince < LONG ? "lost" : "unreachable");
        if (why === "done") return leave();
        if (why === "moved") await loadPage();
        if (why === "elsewhere") await playHere();
        else await pause(Math.min(5_000, 500 * 2 ** losses));
        polls = 0;
        waitsSince = performance.now();
      } else {
        document.title = title;
        lostSince = null;
        if (!isOver(state)) showWaiting(state);
        else if (askedAgain(state)) showWaiting({ ...state, state: "queued", seconds: (Date.now() - recall("again").at) / 1000 });
        else if (state.state !== first.state || state.attempt !== first.attempt) await loadPage();
        else showSection("over");
        if (performance.now() - waitsSince > RELOAD_WAIT && !isOver(state)) await loadPage();
        await pause(pollDelay(state, polls));
      }
      state = await pollUntilAnswered();
    }
  }

  async function playOn(server) {
    if (find("play").hidden) {
      showSection("play");
      showVeil("loading");
      document.title = `Ready – ${title}`;
      find("screen").focus({ preventScroll: true });
    }
    game.state = "loading";
    const end = await play(server);
    game.state = end.why;
    return end;
  }

  // Two pages that took the game from each other by themselves would do so for ever.
  function playHere() {
    game.state = "elsewhere";
    showVeil("elsewhere");
    setText(find("trouble"), "");
    return new Promise((resolve) => {
      find("veil-button").addEventListener("click", () => {
        showVeil("loading");
        resolve();
      }, { once: true });
    });
  }

  async function leave() {
    const { score, episodes } = game.result ?? {};
    const scored = typeof score === "number";
    setText(find("leave-score"), scored ? `Your ${episodes > 1 ? `total score in ${episodes} games` : "score"}: ${points(score)}` : "");
    find("leave-score").hidden = !scored;
    showSection("leave");
    const seen = new Promise((resolve) => setTimeout(resolve, FAREWELL));
    for (;;) {
      try {
        const answer = await fetch(data.page, { method: "HEAD", cache: "no-store", signal: AbortSignal.timeout?.(10_000) });
        await seen;
        if (answer.status < 500) await loadPage();
      } catch {
        setText(find("leave-text"), "Your game is saved. There is no connection at the moment – trying again…");
      }
      await pause(2_000);
    }
  }

  clearDrafts();
  setInterval(() => find("wait").hidden || showClock(), 1_000);
  setInterval(watch, 1_000);
  setInterval(countDown, 200);
  find("again").addEventListener("submit", () => remember("again", { attempt: data.state.attempt, at: Date.now() }));
  find("veil-button").addEventListener("click", () => {
    if (["ready", "paused", "break"].includes(game.state)) start();
    find("screen").focus({ preventScroll: true });
  });
  // A click must not take the keyboard away from the game: the next Space is meant for it.
  find("play").addEventListener("mousedown", (event) => event.target.closest("button") && event.preventDefault());
  find("play").addEventListener("contextmenu", (event) => event.preventDefault()); // what a long press brings up
  window.addEventListener("keydown", onKeyDown);
  window.addEventListener("keyup", onKeyUp);
  window.addEventListener("blur", () => releaseAll());
  window.addEventListener("online", ask);
  document.addEventListener("visibilitychange", () => (document.hidden ? releaseAll() : ask()));
  main();
})();
