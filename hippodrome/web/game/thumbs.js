// Games with buttons for left, right and up only, on a phone: the left thumb moves, the right one jumps.
import { addStyle } from "./page.js";

const css = `
@media (pointer: coarse) {
  .pad { --thumb: calc(1.25 * var(--key)); grid: var(--thumb) / var(--thumb) var(--thumb) 1fr var(--thumb); width: 100%; max-width: 30rem; }
  .pad .left { grid-area: 1 / 1; }
  .pad .right { grid-area: 1 / 2; }
  .pad .up { grid-area: 1 / 4; }
}
@media (pointer: coarse) and (min-aspect-ratio: 5/4) { .pad { --thumb: calc(1.1 * var(--key)); } }
@media (pointer: coarse) and (min-aspect-ratio: 5/4) and (max-height: 34rem) {
  .wide .board { grid-template: "hud hud hud" "walk room jump" minmax(13rem, 1fr) / 7.2rem minmax(0, 1fr) 7.2rem; }
  .wide .controls { grid-area: 2 / 1 / 3 / 4; justify-content: end; justify-self: stretch; flex-flow: row wrap; width: auto; max-width: none; pointer-events: none; }
  .wide .controls .pad { max-width: none; grid-template-columns: var(--thumb) var(--thumb) 1fr 7.2rem; }
  .wide .controls button { pointer-events: auto; }
  .wide .hands > .overlay { grid-area: jump; zoom: .8; }
  .wide .overlay button { min-width: 0; }
  .wide .controls > :not(.pad) { align-self: end; width: 7.2rem; }
}`;
addStyle(css.replaceAll(".pad", ".pad:has(.left, .right):has(.up):not(:has(.down))"));
