// Sliders of the researcher's pages. Each shows its number. One without a starting value has no knob and no answer until it is
// moved or tapped: the middle, where it stands, would be an answer that nobody gave.

const outputs = new Map(); // slider -> the element that shows its number
const unset = new Map(); // slider -> its value, which nobody has chosen

function showNumber(slider) {
  if (outputs.has(slider)) outputs.get(slider).textContent = unset.has(slider) ? "–" : slider.value;
}

function addOutput(slider) {
  if (slider.closest(".range") || document.querySelector(`output[for="${CSS.escape(slider.id)}"]`)) return;
  const box = document.createElement("span");
  const output = document.createElement("output");
  box.className = "range";
  if (slider.id) output.htmlFor = slider.id;
  slider.replaceWith(box);
  box.append(slider, output);
  outputs.set(slider, output);
}

export function isUnset(field) {
  return unset.has(field);
}

export function setSlider(slider) {
  unset.delete(slider);
  slider.classList.remove("unset");
  slider.setCustomValidity("");
  showNumber(slider);
}

export function resetSlider(slider) {
  if (!slider.hasAttribute("value")) {
    unset.set(slider, slider.value);
    slider.classList.add("unset");
    if (slider.required) slider.setCustomValidity(TEXT.answerHere);
  }
  showNumber(slider);
}

export function addSlider(slider) {
  addOutput(slider);
  resetSlider(slider);
  slider.addEventListener("input", () => setSlider(slider));
  slider.addEventListener("click", () => { // a tap where it stands moves nothing
    if (unset.has(slider)) slider.dispatchEvent(new Event("input", { bubbles: true }));
  });
}

// A slider that a script of the page has moved is sent. Fields that share its name are, too.
export function removeUnset(formData) {
  for (const [slider, value] of unset) {
    if (slider.value !== value || slider.matches(":disabled")) continue;
    const values = formData.getAll(slider.name);
    const at = values.lastIndexOf(value);
    if (at >= 0) values.splice(at, 1);
    formData.delete(slider.name);
    for (const other of values) formData.append(slider.name, other);
  }
}
