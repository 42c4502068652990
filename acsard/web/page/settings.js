// The settings that can be changed while the robot runs: one row each, with its range.

import { made } from "./views.js";
import { number } from "./words.js";

export class Settings {
  #form;
  #call;

  /** `call(payload)` changes a setting and shows the outcome. */
  constructor(form, call) {
    this.#form = form;
    this.#call = call;
    form.addEventListener("submit", (event) => event.preventDefault());
  }

  /** Show rows of {key, value, what, when, low, high, choices}. */
  show(rows) {
    if (this.#form.contains(document.activeElement) && document.activeElement.tagName === "INPUT") return;
    this.#form.replaceChildren(...rows.map((row, n) => this.#row(row, `set-${n}`)));
  }

  #row(row, id) {
    const range = row.low === undefined ? "" : ` (${row.low} to ${row.high})`;
    // Allow a narrow screen to break a key at its dots and underscores.
    const name = row.key.split(/(?<=[._])/).flatMap((part) => [part, made("wbr")]);
    const label = made("label", "", ...name, made("small", "", `${row.what}${range}; ${row.when}`));
    label.htmlFor = id;
    const field = made(row.choices ? "select" : "input", "");
    for (const one of row.choices ?? []) field.append(new Option(one, one));
    field.id = id;
    if (!row.choices) field.inputMode = typeof row.value === "number" ? "decimal" : "text";
    field.value = row.value;
    const send = (more) => this.#call({ settings: { [row.key]: read(field.value, row.value) }, ...more });
    const buttons = [["Set", {}], ["Keep", { keep: true }]].map(([name, more]) => {
      const button = made("button", "", name);
      button.setAttribute("aria-label", `${name} ${row.key}`);
      button.addEventListener("click", () => send(more));
      return button;
    });
    field.addEventListener("keydown", (event) => event.key === "Enter" && send({}));
    return made("div", "", label, field, ...buttons);
  }
}

/** Convert the typed text to the type of the present value `before`. A text that does not fit is returned unchanged,
 *  and the daemon rejects it. */
export function read(typed, before) {
  if (typeof before !== "number") return typed;
  const value = number(typed);
  return Number.isNaN(value) ? typed : value;
}
