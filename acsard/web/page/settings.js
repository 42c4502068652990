// What may be set while the robot runs: a row for each, its range beside it.

import { made } from "./views.js";
import { number } from "./words.js";

export class Settings {
  #form;
  #call;

  /** `call(payload)` sets, and says what became of it. */
  constructor(form, call) {
    this.#form = form;
    this.#call = call;
    form.addEventListener("submit", (event) => event.preventDefault());
  }

  /** Rows of {key, value, what, when, low, high, choices}. */
  show(rows) {
    if (this.#form.contains(document.activeElement) && document.activeElement.tagName === "INPUT") return;
    this.#form.replaceChildren(...rows.map((row, n) => this.#row(row, `set-${n}`)));
  }

  #row(row, id) {
    const range = row.low === undefined ? "" : ` (${row.low} to ${row.high})`;
    const list = Array.isArray(row.value) ? "; commas between them and no space, which is STOP" : "";
    // A narrow screen breaks a name where its words end.
    const name = row.key.split(/(?<=[._])/).flatMap((part) => [part, made("wbr")]);
    const label = made("label", "", ...name, made("small", "", `${row.what}${range}; ${row.when}${list}`));
    label.htmlFor = id;
    const field = made(row.choices ? "select" : "input", "");
    for (const one of row.choices ?? []) field.append(new Option(one, one));
    field.id = id;
    if (!row.choices) field.inputMode = typeof row.value === "number" ? "decimal" : "text";
    field.value = Array.isArray(row.value) ? row.value.join(",") : row.value;
    const set = made("button", "", "Set");
    set.setAttribute("aria-label", `Set ${row.key}`);
    const send = () => this.#call({ settings: { [row.key]: read(field.value, row.value) } });
    set.addEventListener("click", send);
    field.addEventListener("keydown", (event) => event.key === "Enter" && send());
    return made("div", "", label, field, set);
  }
}

/** What was typed, of the kind that stands there now; what it cannot be goes as it is, and is refused. */
export function read(typed, before) {
  if (Array.isArray(before)) return typed.split(",").map(one);
  return typeof before === "number" ? one(typed) : typed;
}

function one(typed) {
  const value = number(typed);
  return Number.isNaN(value) ? typed : value;
}
