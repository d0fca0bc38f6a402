// The project's labels of arrows: each stands below its arrow.
import { hooks } from "./hooks.js";
import { addStyle } from "./page.js";

addStyle(`
.pad .named { padding: 0; font-size: 1.1rem; line-height: 1.1; overflow: hidden; }
.pad .named::after { content: attr(aria-label); display: block; font-size: .65rem; overflow-wrap: anywhere; }`);

function caption({ labels }) {
  if (!labels) return;
  const texts = Object.values(labels);
  for (const button of document.querySelectorAll(".pad button")) {
    button.classList.toggle("named", texts.includes(button.getAttribute("aria-label")));
  }
}

hooks.message.push(caption);
