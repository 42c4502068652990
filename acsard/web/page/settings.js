// The settings that can be changed while the robot runs: one row each, with its unit and its range.

import { made } from "./views.js";
import { number } from "./words.js";

/** Show `rows` of {key, value, what, when, unit, low, high, choices} in `place`. `call(payload)` changes a setting
 *  and shows the outcome. */
export function show(place, rows, call) {
  if (place.contains(document.activeElement) && document.activeElement.tagName === "INPUT") return;
  const buttons = () => [...place.querySelectorAll("button")];
  const focus = buttons().indexOf(document.activeElement);
  place.replaceChildren(...rows.map((row, n) => shown(row, `set-${n}`, call)));
  if (focus >= 0) buttons()[focus].focus();
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
  const keep = made("code", "", keeping(key, field.value));
  field.addEventListener("input", () => (keep.textContent = keeping(key, field.value)));
  const send = () => call({ settings: { [key]: read(field.value, value) } });
  field.addEventListener("keydown", (event) => event.key === "Enter" && send());
  const button = made("button", "", "Set");
  button.setAttribute("aria-label", `Set ${key}`);
  button.addEventListener("click", send);
  return made("div", "", label, field, made("span", "quiet", unit.split(" ")[0]), button, keep);
}

/** Return the command that keeps a value, for a terminal on the robot: the page may not write the file. */
export function keeping(key, value) {
  return `acsard set ${key} ${String(value).replace(",", ".")} --keep`;
}

/** Convert the typed text to the type of the present value `before`. A text that does not fit is returned unchanged,
 *  and the daemon rejects it. */
export function read(typed, before) {
  if (typeof before !== "number") return typed;
  const value = number(typed);
  return Number.isNaN(value) ? typed : value;
}
