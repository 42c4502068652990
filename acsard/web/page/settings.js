// The settings that can be changed while the robot runs: one row each, with its unit and its range.

import { made } from "./views.js";
import { number } from "./words.js";

/** Show `rows` of {key, value, what, when, unit, low, high, choices} in `place`. `call(payload)` changes a setting
 *  and shows the outcome. */
export function show(place, rows, call) {
  if (place.contains(document.activeElement) && document.activeElement.tagName === "INPUT") return;
  place.replaceChildren(...rows.map((row, n) => shown(row, `set-${n}`, call)));
}

function shown({ key, value, what, when, unit = "", low, high, choices }, id, call) {
  unit = unit.replace("2", "²").replace("3", "³");
  const range = low === undefined ? "" : `; ${low} to ${high} ${unit}`;
  // Allow a narrow screen to break a key at its dots and underscores.
  const name = key.split(/(?<=[._])/).flatMap((part) => [part, made("wbr")]);
  const label = made("label", "", ...name, made("small", "", `${what}${range}; ${when}`));
  label.htmlFor = id;
  const field = made(choices ? "select" : "input", "", ...(choices ?? []).map((choice) => new Option(choice, choice)));
  field.id = id;
  if (!choices) field.inputMode = typeof value === "number" ? "decimal" : "text";
  field.value = value;
  const send = () => call({ settings: { [key]: read(field.value, value) } });
  field.addEventListener("keydown", (event) => event.key === "Enter" && send());
  const button = made("button", "", "Set");
  button.setAttribute("aria-label", `Set ${key}`);
  button.addEventListener("click", send);
  return made("div", "", label, field, made("span", "quiet", unit.split(" ")[0]), button);
}

/** Convert the typed text to the type of the present value `before`. A text that does not fit is returned unchanged,
 *  and the daemon rejects it. */
export function read(typed, before) {
  if (typeof before !== "number") return typed;
  const value = number(typed);
  return Number.isNaN(value) ? typed : value;
}
