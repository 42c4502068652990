// Fills the views from the messages of the bus. Text is inserted as text, never as HTML.

import { boarded } from "./commander.js";
import { BATTERY, FINDINGS } from "./findings.js";
import { RELEASE, age, ago, began, clock, lasted, person, reason, signed } from "./words.js";

const DOUBTFUL = "STOP may not reach the robot from here: use its own switch.";
const LEVELS = ["", "warning", "error", "warning"];

export const $ = (id) => document.getElementById(id);

/** Return an element with its children; strings become text nodes. */
export function made(name, look, ...children) {
  const element = document.createElement(name);
  if (look) element.className = look;
  element.append(...children);
  return element;
}

export function sources(body, state, own) {
  body.replaceChildren(
    ...state.sources.map((source) => {
      const drives = source.name === state.source;
      const who = drives && state.sender ? `${source.name} (${person(state.sender, own)})` : source.name;
      const cells = [who, String(source.priority), source.age === null ? "–" : ago(source.age)];
      const waits = drives ? "drives" : source.waits_for;
      return made("tr", drives ? "drives" : "", ...[...cells, waits].map((text) => made("td", "", text)));
    }),
  );
}

export function parts(list, array) {
  list.replaceChildren(
    ...array.status.map((part) =>
      made("li", LEVELS[part.level] ?? "error", made("strong", "", part.name.replace(/^acsard: /, "")), ` ${part.message}`),
    ),
  );
}

export function counters(list, state) {
  const counted = Object.entries(state.counters).filter(([, count]) => count);
  list.replaceChildren(
    ...counted.map(([name, count]) =>
      made("div", "", made("dt", "", name.replaceAll("_", " ")), made("dd", "", count.toLocaleString())),
    ),
  );
}

/** Return the events, with each sequence of equal events merged into its first one. `equal` is their number. */
export function folded(events) {
  const rows = [];
  for (const event of events) {
    const last = rows.at(-1);
    if (last && ["name", "level", "text", "by"].every((key) => last[key] === event[key])) last.equal++;
    else rows.push({ ...event, equal: 1 });
  }
  return rows;
}

export function happened(list, { events }) {
  const rows = folded([...events].reverse()).map((event) => {
    const by = `${event.by ? ` — ${event.by}` : ""}${event.equal > 1 ? ` ×${event.equal}` : ""}`;
    const head = made("strong", "", event.name.replaceAll("_", " "));
    return made("li", event.level, made("span", "quiet", clock(event.stamp, new Date())), " ", head, ` ${event.text}${by}`);
  });
  list.replaceChildren(...rows);
}

/** Show the recordings, each with its download. `barred` says why this user may not download, or is ""; `trouble` says
 *  why the list is empty. */
export function recordings(list, files, barred, trouble) {
  const all = JSON.stringify([files, barred, trouble]);
  if (list.dataset.shown === all) return; // do not rebuild an unchanged list, so the focus stays
  list.dataset.shown = all;
  text("no-recordings", trouble || (files.length ? "" : "There are no recordings."));
  const rows = files.map((file) => {
    const parts = [began(file.begin), lasted(file.seconds), file.being_recorded && "being recorded", barred && `the download is ${barred}`];
    const link = made(barred ? "span" : "a", "", file.name);
    if (!barred) Object.assign(link, { href: `api/recordings/${encodeURIComponent(file.name)}`, download: file.name });
    return made("li", "", link, made("div", "quiet", parts.filter(Boolean).join(" · ")));
  });
  list.replaceChildren(...rows);
}

/** Show the mode, its reason and the warnings. `locked` is true for a client that may not release a stop. `own` is the
 *  public name of this page. */
export function banner(state, locked, own) {
  const alone = !boarded(state);
  const words = state.mode.toUpperCase();
  if (alone && state.mode === "waiting") mode("noboard", "NO BOARD");
  else mode(state.mode, alone ? `${words} · NO BOARD` : words);
  const others = state.mode === "inactive" ? "an operator switches it on" : "an operator releases it";
  text("reason", reason(state, own) + (locked && RELEASE[state.mode] ? `; ${others}` : ""));
  const warned = [
    alone ? "Nobody can stop the motors from here: use the robot's own switch" : "",
    brief(BATTERY[state.battery?.level]), pressed(state.bumpers), brief(state.pose_doubt),
    brief(state.wheel_fault && "wheel_fault", state.wheel_fault),
    brief(state.recording_error && "recording_fails", state.recording_error),
    brief(state.latch_file_error && "latch_file_fails", state.latch_file_error),
    ["valid", ""].includes(state.certificate) ? "" : `certificate ${state.certificate_expiry}`,
  ];
  text("doubt", warned.filter(Boolean).join("; "));
  powered(state.battery);
  $("estop").hidden = !["pressed", "silent"].includes(state.emergency_stop);
  document.body.classList.toggle("boardless", alone);
}

/** Return the short form of a code with its details, "" without a code, and a code of a later version as it is. */
function brief(code, details = "") {
  return code ? [FINDINGS[code]?.[0] ?? code, details].filter(Boolean).join(": ") : "";
}

/** Return which bumpers are pressed, in words, or "". */
function pressed(bumpers) {
  const numbers = (bumpers ?? []).flatMap((isPressed, n) => (isPressed ? [n + 1] : []));
  return numbers.length ? `bumper${numbers.length > 1 ? "s" : ""} ${numbers.join(" and ")} pressed` : "";
}

/** Show the state of charge or, if it is unknown, the voltage. The icon is filled by the state of charge. */
function powered(battery) {
  const shown = $("battery");
  shown.hidden = !battery;
  $("volts").hidden = typeof battery?.volts !== "number";
  if (!battery) return;
  const { percent, volts, level } = battery;
  shown.dataset.level = level;
  shown.style.setProperty("--charge", `${percent ?? (level === "ok" ? 100 : 0)}%`);
  text("battery", typeof percent === "number" ? `${Math.round(percent)} %` : typeof volts === "number" ? `${signed(volts, 1)} V` : "–");
}

/** Show a mode in the banner and in the title, which a background tab shows. Adapt STOP and the release button. */
function mode(name, words) {
  document.body.dataset.mode = name;
  text("mode", words);
  $("stop").setAttribute("aria-pressed", String(name === "stopped"));
  text("stop-words", name === "stopped" ? "STOPPED" : "STOP");
  if (RELEASE[name]) text("clear", RELEASE[name]);
  document.title = `${words} · ${$("robot").textContent}`;
}

/** Show that the robot's computer answers but has reported nothing about the robot yet. */
export function waiting() {
  mode("waiting", "WAITING");
  text("reason", "Nothing is received from the robot yet.");
  text("doubt", "");
}

/** Show that the data is old and that the robot may or may not be driving. */
export function unheard(why) {
  mode("lost", "NO DATA");
  text("reason", why || "Nothing is received from the robot.");
  text("doubt", DOUBTFUL);
}

/** Show that the connection is lost, and blank the values that are no longer known. */
export function lost(why) {
  mode("lost", "NO CONNECTION");
  if (why) text("reason", why);
  text("doubt", DOUBTFUL);
  for (const name of ["speed", "turn", "who"]) text(name, "–");
}

/** Show the age of the data (`old`, ms; stale above `fresh`) and the round trip (`way`, ms). `none` is the text while
 *  there is no data. `seen` means that older data is still on the page, and `alone` that the board is missing. */
export function freshness(old, fresh, way, none, seen, alone) {
  const stale = old > fresh;
  document.body.classList.toggle("stale", stale && seen);
  text("age", old === Infinity ? none : stale ? `STALE ${age(old)}` : alone ? "no board" : way === null ? "live" : `live · ${age(way)}`);
}

export function text(id, words) {
  const element = $(id);
  if (element.textContent !== words) element.textContent = words;
}
