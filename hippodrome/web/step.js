// Step pages work without this script. With it they keep a draft of the answers, say what is happening when the
// connection is bad, and copy a completion code.
import { addSlider, isUnset, removeUnset, setSlider } from "./game/sliders.js";

(() => {
  "use strict";

  const MOST = 250_000; // bytes of the encoded form; the server refuses forms over 256 KiB
  const SLOW = 10_000; // ms until we say that sending takes long
  const GIVE_UP = 20_000; // ms until the button works again
  const MOST_MS = 2 ** 31 - 1; // setTimeout takes no more
  const SOON = 600; // seconds: if the page can be answered later than that, it says when
  const KEEP = 2 * 24 * 3600 * 1000; // ms that a draft outlives its page: participants may share a device
  const UNKEPT = new Set(["password", "hidden", "file", "submit", "image", "button", "reset"]);

  const page = document.body.dataset;
  const form = document.querySelector("form.page");
  const prefix = "hippodrome:";
  const key = prefix + [page.project, page.user, page.step].join(":");

  // The draft

  // Storage may be full or forbidden; then there is no draft.
  function withStorage(work) {
    try {
      return work(window.localStorage);
    } catch {
      return null;
    }
  }

  // A field named "elements" or "addEventListener" hides that property of its form, so none is read from the form itself.
  function inForm(selector) {
    return [...document.querySelectorAll("form.page " + selector)];
  }

  function listen(type, work, capture = false) {
    EventTarget.prototype.addEventListener.call(form, type, work, capture);
  }

  function fields() {
    return inForm(":is(input, select, textarea)").filter((field) => field.name && !UNKEPT.has(field.type));
  }

  function valueOf(field) {
    if (field.type === "checkbox" || field.type === "radio") return field.checked;
    if (field.type === "select-multiple") return [...field.options].map((option) => option.selected);
    return field.value;
  }

  function setValue(field, value) {
    if (field.type === "checkbox" || field.type === "radio") field.checked = value === true;
    else if (field.type === "select-multiple") [...field.options].forEach((o, i) => { o.selected = value[i] === true; });
    else field.value = value;
    if (field.type === "range") setSlider(field);
  }

  // A draft finds its fields by name and, for checkboxes and radio buttons, by value: if the page was changed meanwhile, only
  // the changed fields lose their answers.
  function nameOf(field) {
    const choice = field.type === "checkbox" || field.type === "radio";
    return choice ? `${field.name}=${field.value}` : field.name;
  }

  function keepDraft() {
    const draft = { at: Date.now(), values: fields().filter((field) => !isUnset(field)).map((field) => [nameOf(field), valueOf(field)]) };
    withStorage((storage) => storage.setItem(key, JSON.stringify(draft)));
  }

  function restoreDraft() {
    const draft = withStorage((storage) => JSON.parse(storage.getItem(key)));
    if (!draft || !Array.isArray(draft.values)) return;
    const values = new Map();
    for (const [name, value] of draft.values) values.set(name, [...(values.get(name) ?? []), value]);
    for (const field of fields()) {
      const kept = values.get(nameOf(field));
      if (kept?.length) setValue(field, kept.shift());
    }
  }

  // Removes the drafts of the participant's other pages, which have been sent, and old drafts of all participants.
  function clearDrafts() {
    withStorage((storage) => {
      const own = prefix + [page.project, page.user, ""].join(":");
      for (const name of Object.keys(storage).filter((each) => each.startsWith(prefix))) {
        const current = name === key && page.done === undefined;
        const old = Date.now() - (JSON.parse(storage.getItem(name))?.at ?? 0) > KEEP;
        if (old || (name.startsWith(own) && !current)) storage.removeItem(name);
      }
    });
  }

  // Sending

  const status = inForm(".status:last-of-type").at(0);
  let sending = false;
  let warnedOffline = false;
  const shownAt = Date.now(); // goes on while a laptop sleeps
  let timers = [];

  function say(text, warn = false) {
    status.textContent = text;
    status.classList.toggle("warn", warn);
  }

  function idle(text = "", warn = false) {
    sending = false;
    timers.forEach(clearTimeout);
    inForm("[aria-disabled]").forEach((button) => button.removeAttribute("aria-disabled"));
    say(text, warn);
  }

  // How many bytes the browser will send for these fields. Line ends count twice: it writes them as CR LF.
  function sizeOf(fields) {
    const text = new URLSearchParams(fields).toString();
    return text.length + 3 * (text.match(/%0A/g) ?? []).length;
  }

  // Says by how many characters the longest text is too long. People count characters: an emoji, for one, has twelve bytes.
  function tooLong(size) {
    const texts = fields().filter((field) => typeof field.value === "string");
    if (!texts.length) return TEXT.tooLong;
    const longest = texts.reduce((a, b) => (b.value.length > a.value.length ? b : a));
    const characters = [...longest.value].length;
    const less = Math.ceil((size - MOST) / (sizeOf([["", longest.value]]) / characters));
    const name = nameForPeople(longest);
    const much = less < characters ? roundUp(less).toLocaleString(TEXT.language) : "";
    if (!name) return much ? TEXT.shortenLongestBy(much) : TEXT.shortenLongest;
    return much ? TEXT.shortenBy(name, much) : TEXT.shorten(name);
  }

  function roundUp(number) {
    const unit = 10 ** Math.max(0, Math.floor(Math.log10(number)) - 1);
    return Math.ceil(number / unit) * unit;
  }

  // The server takes no answers before.
  function secondsLeft() {
    return Number(page.least ?? 0) - (Date.now() - shownAt) / 1000;
  }

  function sayWhen(warn) {
    const left = secondsLeft();
    const style = { weekday: "long", day: "numeric", month: "long", hour: "numeric", minute: "numeric" };
    const time = new Date(Date.now() + left * 1000).toLocaleString(TEXT.language, style);
    idle(left > SOON ? TEXT.opensAt(time) : TEXT.tooSoon(Math.ceil(left)), warn);
    timers = [setTimeout(say, Math.min(left * 1000, MOST_MS), "")];
  }

  function onSubmit(event) {
    if (sending) {
      event.preventDefault();
      return;
    }
    if (secondsLeft() > 0) {
      event.preventDefault();
      sayWhen(true);
      return;
    }
    const submitter = event.submitter?.name ? event.submitter : undefined;
    const size = sizeOf(new FormData(form, submitter));
    if (size > MOST) {
      event.preventDefault();
      idle(tooLong(size), true);
      return;
    }
    if (navigator.onLine === false && !warnedOffline) {
      event.preventDefault();
      warnedOffline = true;
      idle(TEXT.offline, true);
      return;
    }
    keepDraft();
    sending = true;
    say(TEXT.sending);
    event.submitter?.setAttribute("aria-disabled", "true");
    timers = [
      setTimeout(() => say(TEXT.stillSending, true), SLOW),
      setTimeout(() => idle(TEXT.noReply, true), GIVE_UP),
    ];
  }

  // Fields without an answer

  function nameForPeople(field) {
    const set = field.type === "radio" ? field.closest("fieldset")?.querySelector("legend") : null;
    const row = field.type === "radio" ? field.closest("tr")?.querySelector("th") : null;
    const source = row ?? set ?? field.labels?.[0];
    const words = [...(source?.childNodes ?? [])].filter((each) => each.className !== "note").map((each) => each.textContent).join("");
    const text = words.replace(/\s+/g, " ").replace(/[\s*]+$/, "").trim() || (field.getAttribute("aria-label") ?? "");
    return text.length > 90 ? `${text.slice(0, 88)}…` : text;
  }

  const notes = new Map(); // field -> the sentence below it; of radio buttons that are one question, the first has it
  let reported = false; // whether this press of the button has met a field without a valid answer

  // A browser's bubble would cover the next question and go after a moment: sentences of our own stay until the answer is there.
  function onInvalid(event) {
    event.preventDefault();
    const field = event.target;
    const known = [...notes.keys()].some((each) => each === field || (each.type === "radio" && each.name === field.name));
    if (!known) notes.set(field, noteAt(field));
    if (notes.has(field)) notes.get(field).textContent = isEmpty(field) ? TEXT.answerHere : field.validationMessage;
    sayMissing();
    if (reported) return;
    reported = true;
    field.focus();
    setTimeout(() => { reported = false; });
  }

  function isEmpty(field) {
    return field.validity.valueMissing || isUnset(field);
  }

  function noteAt(field) {
    const note = Object.assign(document.createElement("span"), { className: "note", id: `note-${notes.size}-${field.name}` });
    const question = field.type === "radio" ? field.closest("tr")?.querySelector("th") ?? field.closest("fieldset")?.querySelector("legend") : null;
    const next = field.nextElementSibling; // a label may follow its checkbox
    if (question) question.append(note);
    else (field.closest("label, .range") ?? (next?.htmlFor && next.htmlFor === field.id ? next : field)).after(note);
    field.setAttribute("aria-invalid", "true");
    field.setAttribute("aria-describedby", note.id);
    return note;
  }

  function sayMissing() {
    const lines = [...notes.keys()].map((field) => [isEmpty(field), nameForPeople(field)]).filter(([, name]) => name);
    say(lines.map(([empty, name]) => (empty ? TEXT.missing(name) : TEXT.lookAgain(name))).join("\n"), true);
  }

  function onInput() {
    keepDraft();
    let less = false;
    for (const [field, note] of [...notes]) {
      if (!field.validity.valid) continue;
      notes.delete(field);
      note.remove();
      field.removeAttribute("aria-invalid");
      field.removeAttribute("aria-describedby");
      less = true;
    }
    if (less) sayMissing();
  }

  // Completion codes

  function addCopy(code) {
    const select = () => getSelection().selectAllChildren(code);
    code.addEventListener("click", select); // one tap is enough
    if (!navigator.clipboard || code.closest("[disabled]")) return;
    const button = document.createElement("button");
    const say = (text) => { button.textContent = text; };
    Object.assign(button, { type: "button", className: "copy", ariaLive: "polite" });
    button.addEventListener("click", async () => {
      try {
        await navigator.clipboard.writeText(code.textContent.trim());
        say(TEXT.copied);
        setTimeout(say, 3_000, TEXT.copy);
      } catch {
        select(); // so that the participant can copy it
      }
    });
    say(TEXT.copy);
    code.after(button);
  }

  clearDrafts();
  document.querySelectorAll(".code").forEach(addCopy);
  if (!form) return;
  inForm("input[type=range]").forEach(addSlider);
  restoreDraft();
  listen("formdata", ({ formData }) => removeUnset(formData));
  listen("input", onInput);
  listen("change", onInput);
  listen("submit", onSubmit);
  listen("invalid", onInvalid, true);
  if (secondsLeft() > SOON) sayWhen(false);
  window.addEventListener("pageshow", (event) => { if (event.persisted) idle(); });
})();
