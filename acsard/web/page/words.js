// Formats numbers and times for people. This module is pure.

/** Maps a mode to the text of the button that ends it. */
export const RELEASE = { stopped: "Release STOP", fault: "Release fault", inactive: "Switch on" };

const NAMELESS = "a program without a name";
const UTC = /\b(\d{4}-\d\d-\d\d) (\d\d:\d\d:\d\d) UTC\b/g;

export function signed(value, decimals) {
  const text = value.toFixed(decimals);
  return Number(text) === 0 ? (0).toFixed(decimals) : text.replace("-", "−");
}

/** Format a measurement, or a dash if it is unknown. */
export function figure(value, decimals) {
  return value === null || value === undefined ? "–" : signed(value, decimals);
}

/** Parse a typed number, also in the form "−1,5"; NaN if it is not a number. */
export function number(typed) {
  const plain = typed.trim().replace("−", "-").replace(",", ".");
  return plain === "" ? NaN : Number(plain);
}

/** Format a stamp {sec, nanosec} as local time, with the date unless it is today. */
export function clock(stamp, now) {
  const at = new Date(milliseconds(stamp));
  return at.toDateString() === now.toDateString() ? at.toLocaleTimeString() : at.toLocaleString();
}

function milliseconds(stamp) {
  return stamp.sec * 1000 + stamp.nanosec / 1e6;
}

export function ago(seconds) {
  if (seconds === null || seconds === undefined) return "never";
  if (seconds < 1) return "now";
  if (seconds < 120) return `${Math.round(seconds)} s ago`;
  return seconds < 7200 ? `${Math.round(seconds / 60)} min ago` : `${Math.round(seconds / 3600)} h ago`;
}

/** Format seconds since 1970 as local date and time. */
export function began(seconds) {
  return typeof seconds === "number" ? new Date(seconds * 1000).toLocaleString() : "";
}

export function lasted(seconds) {
  if (typeof seconds !== "number") return "";
  return seconds < 120 ? `${Math.round(seconds)} s` : `${Math.round(seconds / 60)} min`;
}

export function age(ms) {
  return ms < 1000 ? `${Math.round(ms)} ms` : `${(ms / 1000).toFixed(1)} s`;
}

/** Format a pose in the odom frame. `x` and `y` are in m, `yaw` is in rad and shown in degrees. */
export function spot(x, y, yaw) {
  return `x ${signed(x, 2)} m · y ${signed(y, 2)} m · ${signed((yaw * 180) / Math.PI, 0)}°`;
}

/** Return the heading of a quaternion about z, rad. */
export function yaw(q) {
  return 2 * Math.atan2(q.z, q.w);
}

/** Return a short name for people for a sender's public name, "NAME/DIGITS [CERTIFICATE]" or "session DIGITS
 *  [CERTIFICATE]". `own` is the public name of this page, "" if it is not known. */
export function person(sender, own = "") {
  const [, name, certificate] = sender.match(/^(?:(.*)\/|session )?[0-9a-f]{16}(?: \[(.*)\])?$/) ?? [null, sender];
  if (own && sender === own) return "you";
  if (name === "unnamed") return NAMELESS;
  if (name === "here") return "another page on the robot itself";
  if (name && own && name === own.replace(/\/[^/]*$/, "")) return `another page of ${name}`;
  return name || certificate || NAMELESS;
}

/** Return the reason of the mode without the name of the mode, which the banner shows above the reason. */
export function reason(state) {
  if (state.mode === "ready" && state.reason.startsWith("waiting for a command")) return "Nobody drives.";
  const before = `${state.mode}: `;
  const words = said(named(state.reason.startsWith(before) ? state.reason.slice(before.length) : state.reason));
  return words.replace("press Release", `press ${RELEASE[state.mode] ?? "Release"}`);
}

/** Return a sentence in which the technical names of senders are replaced by names for people. */
export function named(text) {
  return text
    .replace(/\/[0-9a-f]{16}\b/g, "")
    .replace(/\b(?:session )?[0-9a-f]{16}\b(?: \[(.*?)\])?/g, (_, certificate) => certificate || NAMELESS)
    .replaceAll(" (native)", "")
    .replace(/\bby unnamed\b/g, `by ${NAMELESS}`)
    .replaceAll("here@page", "a page on the robot itself");
}

/** Return a sentence of the log with each sender id cut to four digits, which distinguish senders of the same name. */
export function logged(text) {
  return text.replace(/\b([0-9a-f]{4})[0-9a-f]{12}\b/g, "$1");
}

const BUTTONS = {
  "call srv/clear": "press Release",
  "srv/clear": "Release",
  "then call srv/activate": "then press Switch on",
  "call srv/activate": "press Switch on",
};

/** Replace the names of services by those of this page's buttons, and times in UTC by local times. */
export function said(text, now = new Date()) {
  const local = text.replace(UTC, (_, day, time) => clock({ sec: Date.parse(`${day}T${time}Z`) / 1000, nanosec: 0 }, now));
  return Object.entries(BUTTONS).reduce((words, [call, button]) => words.replace(call, button), local);
}
