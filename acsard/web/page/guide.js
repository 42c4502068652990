// A board check or a calibration: shows the command's output and questions, and sends the operator's answers.
// The command runs on the robot's computer and ends when this page's connection ends.

import { awake } from "./awake.js";
import { made, text } from "./views.js";
import { number } from "./words.js";

const $ = (id) => document.getElementById(id);
const LABELS = {
  fr: "front right", fl: "front left", rl: "rear left", rr: "rear right", none: "none", again: "show it again",
  start: "Start", write: "Write the values", leave: "Do not change the file", lifted: "The wheels are lifted: none touches anything",
};
const NAMES = { check: "Check of the board", calibrate: "Calibration" };
const LOOKS = { PASS: "", WARN: "warning", FAIL: "error", SKIPPED: "skipped" };
const LIFE = 100; // ms between two signs of life for the running command; after 900 ms without one, it stops the wheels
const MODIFIERS = ["Shift", "Control", "Alt", "AltGraph", "Meta", "Tab"];

export class Guide {
  #link;
  #running = false; // this page started the running command
  #question = null;
  #rides = false; // the robot drives for a calibration, and a key press stops it
  #busy = ""; // that another page runs a check or calibration, in words, or ""

  constructor(link) {
    this.#link = link;
    link.addEventListener("guide", ({ detail }) => this.#take(detail.guide));
    link.addEventListener("down", () => this.#running && this.#over("the connection is lost, so the robot's computer has ended it"));
    $("check").addEventListener("click", () => this.#begin({ begin: "check", port: $("check-port").value }));
    $("calibrate").addEventListener("click", () => this.#begin({ begin: "calibrate", ...this.#method() }));
    $("method").addEventListener("change", () => this.#methods());
    // Act on pointerdown, like STOP, so a finger that stays down or slides off counts as a press too.
    for (const [name, act] of [["guide-halt", () => this.#key()], ["guide-leave", () => this.leave()]]) {
      $(name).addEventListener("pointerdown", act);
      $(name).addEventListener("click", (event) => event.detail === 0 && act()); // Enter or Space key
    }
    $("guide-close").addEventListener("click", () => this.#close());
    $("guide-question").addEventListener("submit", (event) => event.preventDefault());
    document.addEventListener("visibilitychange", () => document.hidden && !this.#question && this.leave());
    addEventListener("keydown", (event) => this.#pressed(event));
  }

  /** Whether a check or a calibration is running, from this page or another one. */
  get going() {
    return this.#running || Boolean(this.#busy);
  }

  /** End the running command, like Ctrl-C. */
  leave() {
    if (this.#running) this.#link.urge({ press: "leave" });
  }

  /** Show the options that `api/guide` returned, or the reason why there are none. */
  choices({ methods, method, advice, ports, note, error }) {
    text("guide-note", [error ?? note, this.#busy].filter(Boolean).join(" "));
    for (const id of ["check-card", "calibrate-card"]) $(id).hidden = Boolean(error);
    if (error) return;
    options($("check-port"), ports.map(({ port, what }) => [port, what ? `${port} (${what})` : port]));
    const first = !$("method").options.length;
    options($("method"), [["", "a gyro if the robot has one, else a tape"], ...Object.entries(methods).map(([name, needs]) => [name, `${name}: ${needs}`])]);
    if (first) $("method").value = method; // keep a choice that the operator has made
    text("advice", advice);
    this.#methods();
  }

  refused(why) {
    text("guide-note", why);
  }

  #methods() {
    $("positions-row").hidden = $("method").value !== "positions";
  }

  #method() {
    const method = $("method").value;
    return method === "positions" ? { method, positions: $("positions").value.trim() } : { method };
  }

  #begin(wish) {
    text("guide-note", "");
    if (!this.#link.send(wish)) text("guide-note", "no connection to the robot's computer");
  }

  #take(said) {
    if ("running" in said) return this.#runs(said);
    if ("subject" in said) this.#subject(said);
    if ("message" in said) this.#tell(made("li", "", worded(said.message)));
    if ("doing" in said) text("guide-doing", said.doing);
    if ("finding" in said) this.#found(said.finding);
    if ("progress" in said) this.#progress(said.progress);
    if ("result" in said) this.#result(said.result);
    if ("question" in said) this.#ask(said);
    if ("ended" in said) this.#over(`${said.meaning} (exit ${said.ended})`, said.text, said.ended === 0 ? "" : "error");
  }

  #runs({ running, by, yours }) {
    const busy = running && !yours ? `${NAMES[running]} is running (${by}). Only one can run at a time.` : "";
    for (const id of ["check", "calibrate"]) [$(id).disabled, $(id).title] = [Boolean(running), busy];
    if (busy !== this.#busy) text("guide-note", (this.#busy = busy));
    if (!running || !yours) return;
    this.#running = true;
    this.#link.beat(LIFE);
    awake("guide", true);
    $("errands").hidden = true;
    $("guide").hidden = false;
    $("guide-leave").hidden = false;
    $("guide-close").hidden = $("guide-result").hidden = $("guide-where").hidden = true;
    text("guide-name", NAMES[running]);
    text("guide-doing", "starting");
    $("guide-story").replaceChildren();
    this.#progress(0);
    focus("guide-name");
  }

  #subject({ subject, simulated }) {
    const badge = $("guide-where");
    badge.hidden = false;
    badge.textContent = simulated ? "SIMULATED" : "REAL ROBOT";
    this.#tell(made("li", "", subject));
  }

  #found({ name, verdict, figure, text: meaning, mend }) {
    const head = made("strong", "", `${verdict} ${name}`);
    const more = [meaning, mend ? `→ ${mend}` : ""].filter(Boolean).map((one) => made("div", "quiet", one));
    this.#tell(made("li", LOOKS[verdict] ?? "", head, ` ${figure ?? ""}`, ...more));
  }

  #tell(item) {
    $("guide-story").append(item);
    item.scrollIntoView({ block: "nearest" });
  }

  #progress(share) {
    $("guide-progress").value = share;
    if (share >= 1) this.#ride(false);
  }

  #ride(on, byKey = false) {
    this.#rides = on;
    $("guide-halt").hidden = !on;
    $("guide-halt").textContent = byKey ? "NOW" : "Stop it";
    if (on) focus("guide-halt");
  }

  #result(found) {
    $("guide-result").hidden = false;
    text("guide-result", found);
  }

  #ask(question) {
    this.#question = question;
    this.#ride(false);
    const again = question.wrong ? worded(question.wrong) : "";
    const form = $("guide-question");
    form.hidden = false;
    text("guide-words", worded(question.words));
    text("guide-wrong", again && `Not accepted: ${again}`);
    text("guide-doing", "");
    const number = !question.answers;
    $("guide-answers").replaceChildren(...(number ? this.#number(question) : this.#choice(question)));
    focus(number ? "guide-number" : "guide-words");
    form.scrollIntoView({ block: "nearest" });
  }

  #choice({ answers }) {
    const answer = (one, label = LABELS[one] ?? one) => {
      const button = made("button", one === "start" || answers.length === 1 ? "go" : "", label);
      button.type = "button";
      button.dataset.answer = one;
      button.addEventListener("click", () => this.#answer(one));
      return button;
    };
    if (answers.length > 1 || answers[0] === "start") return answers.map((one) => answer(one));
    // A safety confirmation needs a tick before the operator can go on.
    const tick = made("input");
    const go = answer(answers[0], "Continue");
    tick.type = "checkbox";
    tick.id = "guide-tick";
    go.disabled = true;
    tick.addEventListener("change", () => (go.disabled = !tick.checked));
    // Space is STOP, so Enter ticks the box for a person without a pointer.
    tick.addEventListener("keydown", (event) => event.key === "Enter" && !event.repeat && tick.click());
    const hint = made("small", "quiet", "(Enter ticks this: Space is STOP)");
    return [made("label", "tick", tick, ` ${LABELS[answers[0]] ?? answers[0]}`, hint), go];
  }

  #number({ unit, usual }) {
    const field = made("input");
    field.id = "guide-number";
    field.inputMode = "decimal";
    field.autocomplete = "off";
    field.setAttribute("aria-describedby", "guide-words guide-wrong");
    const label = made("label", "number", "measured: ", field, ` ${unit}`);
    const button = made("button", "go", "OK");
    button.addEventListener("click", () => this.#answer(typed(field.value, usual)));
    return [label, button];
  }

  #answer(value) {
    const question = this.#question;
    if (!question) return;
    if (!this.#link.send({ reply: question.question, value })) {
      text("guide-wrong", "not sent, because the connection is too slow: press again");
      return;
    }
    this.#question = null;
    $("guide-question").hidden = true;
    text("guide-doing", "running");
    if (question.leg) {
      this.#progress(0);
      this.#ride(true, question.by_key);
    } else focus("guide-name");
  }

  #key() {
    this.#link.urge({ press: "key" });
  }

  /** Keys work as at a terminal: Escape ends the command, and any other key ends the present drive. Space is STOP
   *  everywhere. */
  #pressed(event) {
    if (!this.#running || event.repeat || MODIFIERS.includes(event.key)) return;
    if (event.key === "Escape") this.leave();
    else if (this.#rides && event.code !== "Space") {
      event.preventDefault();
      this.#key();
    }
  }

  #over(why, words = "", look = "warning") {
    this.#running = false;
    this.#link.beat();
    awake("guide", false);
    this.#question = null;
    this.#ride(false);
    $("guide-question").hidden = $("guide-leave").hidden = true;
    $("guide-close").hidden = false;
    text("guide-doing", `ended: ${why}`);
    for (const line of words.split("\n").filter(Boolean)) this.#tell(made("li", look, worded(line)));
    focus("guide-name");
  }

  #close() {
    $("guide").hidden = true;
    $("errands").hidden = false;
    $("check").focus();
  }
}

/** Replace a terminal's key hints by the names of the page's buttons. */
export function worded(words) {
  return words
    .replace('then type "lifted".', "then tick this.")
    .replace(" q or Ctrl-C quits at any time:", " Stop and quit ends the check at any time:")
    .replace("Press SPACE", "Press NOW")
    .replace("press only Enter", "leave this empty")
    .replace("any key stops the robot", "any key or the button stops the robot");
}

/** Return the typed number, or null for an empty answer to a question with the default `usual`. A text that is not a
 *  number is returned unchanged, and the command rejects it. */
export function typed(words, usual) {
  if (words.trim() === "") return usual === undefined ? "" : null;
  const value = number(words);
  return Number.isNaN(value) ? words.slice(0, 80) : value;
}

function options(select, rows) {
  const before = select.value;
  select.replaceChildren(...rows.map(([value, label]) => new Option(label, value)));
  if (rows.some(([value]) => value === before)) select.value = before;
}

/** Move the keyboard focus, which a screen reader follows, to an element if this view is visible. */
function focus(id) {
  if (!$("set").hidden) $(id).focus({ preventScroll: false });
}
