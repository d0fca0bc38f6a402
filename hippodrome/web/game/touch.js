// Buttons that act while they are held. A finger may slide from one to the next.
import { press, release, tap } from "./actions.js";
import { make } from "./page.js";

export function actionButton(action, label, sign) {
  const button = make("button", { type: "button", textContent: sign ? `${sign}\ufe0e` : label, className: `hold ${action}` });
  button.setAttribute("aria-label", label);
  button.dataset.action = action;
  button.addEventListener("click", (event) => event.detail === 0 && tap(action)); // a click by the keyboard
  return button;
}

// Follows the fingers (and the mouse) on the action buttons of an element, which is returned.
export function followFingers(group) {
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
