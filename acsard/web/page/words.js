// Formats numbers and times for people. This module is pure.

/** Maps a mode to the text of the button that ends it. */
export const RELEASE = { stopped: "Release STOP", fault: "Release fault", inactive: "Switch on" };

const NAMELESS = "a program without a name";

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
 *  [CERTIFICATE]". A certificate is always shown: the sender chose its name itself. `own` is the public name of this
 *  page, "" if it is not known. */
export function person(sender, own = "") {
  if (own && sender === own) return "you";
  const [, bare, certificate] = sender.match(/^(.*) \[(.*)\]$/) ?? [null, sender];
  if (!certificate) return claimed(bare, own);
  return bare.startsWith("session ") ? certificate : `${claimed(bare, own)} [${certificate}]`;
}

function claimed(sender, own) {
  const [, name] = sender.match(/^(?:(.*)\/|session )?[0-9a-f]{16}$/) ?? [null, sender];
  if (name === "unnamed") return NAMELESS;
  if (name === "here") return "another page on the robot itself";
  const ours = own.replace(/\/[^/]*$/, "");
  if (name && name === ours) return `another page of ${name}`;
  if (name?.endsWith("@page")) return name === `${ours}@page` ? "your page" : `the page of ${name.slice(0, -5)}`;
  return name || NAMELESS;
}

/** Return why the robot moves or does not move, in the words of this page. `own` is the public name of this page. */
export function reason(state, own) {
  if (state.mode === "driving" && state.sender) return `Driven by ${person(state.sender, own)}.`;
  if (state.code === "no_command") return "Nobody drives.";
  if (!RELEASE[state.mode]) return state.reason;
  const causes = state.causes.filter(({ kind }) => (kind === "inactive") === (state.mode === "inactive"));
  const words = ({ text, by }) => (by ? text.replace(by, () => person(by.replace(/ \(native\)$/, ""), own)) : text);
  return causes.map((cause) => `${words(cause)} · ${clock(cause.stamp, new Date())}`).join("; also ") || state.reason;
}
