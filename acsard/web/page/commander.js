// Decides which commands a held stick sends, and when. This module is pure: times in ms come in, commands go
// out.
//
// A hold begins with zeros until the robot follows this sender, because the daemon must receive a zero from a
// new sender before it lets the sender drive. Then the wished velocity is sent at 20 Hz. A release sends one
// zero (`drive.js` repeats it once), then nothing. A hold that ended by itself needs a new press, so a finger
// that was left on the stick never drives again by accident.

import { BATTERY, ESTOP, FINDINGS } from "./findings.js";
import { person } from "./words.js";

const PERIOD = 50;
const OPENING = 20;
const PATIENCE = 2000; // longest wait until the robot follows after a press
const GRACE = 500; // longest time for which the robot may cease to follow during a hold
const HICCUP = 250; // after a longer gap between two calls of `look` the robot has braked, so zeros come first
export const FROZEN = 1000; // after a longer gap between two calls of `look` the finger may be gone, so the hold ends

export const ZERO = { linear_x: 0, angular_z: 0 };

/** Modes that only a person or a restart ends. */
const NEVER = ["inactive", "stopped", "fault", "shutdown"];

/** Maps a mode to the reason why the robot does not drive in it, with the remedy. */
const BARS = {
  waiting: "Not ready: the reason is shown above.",
  inactive: "Switched off. Press Switch on first.",
  stopped: "Stopped. Press Release STOP first.",
  fault: "Fault. Press Release fault first.",
  shutdown: "The robot's daemon is ending.",
};

/** Return what must end at the robot before a stop can be released, in the words of its code, or undefined. */
function held(state) {
  const caused = (code) => state.causes.some((cause) => cause.code === code);
  const code =
    ESTOP[state.emergency_stop] ??
    ((caused("bumper") && state.bumpers?.some(Boolean) && "bumper") ||
      (caused("battery_empty") && BATTERY[state.battery?.level] === "battery_empty" && "battery_empty"));
  if (!code) return undefined;
  const [brief, advice] = FINDINGS[code];
  return `${brief[0].toUpperCase()}${brief.slice(1)}: ${advice || FINDINGS.battery_low[1]} first.`;
}

/** Return whether the link to the board is up. While it is down, nobody can stop the motors from here. */
export function boarded(state) {
  return state.link === "up";
}

/** Return why a push of the stick by `sender` would not move the robot, in words, or "". A push takes over from a
 *  source with a lower priority than `source`, but not from another sender with the same source. */
export function still(state, source, sender) {
  if (!state) return "Nothing is received from the robot.";
  if (!boarded(state) && !NEVER.includes(state.mode)) return "No board: nothing can drive.";
  const bar = (state.mode === "stopped" && held(state)) || BARS[state.mode];
  if (bar) return boarded(state) ? bar : `${bar} The board is missing, too.`;
  const ours = ranked(state, source);
  if (!ours) return `This robot takes no commands from a page: ${source} is not one of its sources.`;
  const driver = driving(state, source, sender);
  if (!driver) return "";
  if (state.source === source) return `${driver} drives: you can drive when they stop.`;
  const above = ranked(state, state.source)?.priority >= ours.priority;
  return above ? `${driver} drives and has priority: you can drive when it stops.` : "";
}

/** Return who drives the robot, in words, or "" if nobody or `sender` drives. */
export function driving(state, source, sender) {
  if (state?.mode !== "driving") return "";
  if (state.source === source) return state.sender && state.sender !== sender ? person(state.sender, sender) : "";
  return state.sender ? `${person(state.sender, sender)} (${state.source})` : state.source;
}

/** Return why the robot does not follow the pushed stick of `sender`, in words, or "" if it does. */
function objection(state, source, sender) {
  const bar = still(state, source, sender);
  if (bar || (state.mode === "driving" && state.source === source)) return bar;
  const { wait, waits_for } = ranked(state, source);
  return wait === "command" ? "The robot has not received a command yet." : waits_for || state.reason;
}

function ranked(state, source) {
  return state.sources.find(({ name }) => name === source);
}

export class Commander {
  phase = "idle"; // "idle", "opening" or "driving"
  #wish = ZERO;
  #begun = 0;
  #looked = 0;
  #fine = 0;
  #sent = -Infinity;

  get held() {
    return this.phase !== "idle";
  }

  press(now) {
    if (this.held) return;
    this.#open(now);
    this.#looked = now;
    this.#wish = ZERO;
  }

  wish(linear, angular) {
    this.#wish = { linear_x: linear, angular_z: angular };
  }

  /** Release the stick; return the zero command to send, or null if it was not held. */
  release() {
    if (!this.held) return null;
    this.phase = "idle";
    return ZERO;
  }

  #open(now) {
    this.phase = "opening";
    this.#begun = this.#fine = now;
    this.#sent = -Infinity;
  }

  /** Return {send, ended}: the command to send now and, if the hold has ended, the reason. Both may be missing.
   *  `stateTime` is the time at which `state` was true. */
  look(now, state, stateTime, source, sender) {
    if (!this.held) return {};
    if (now - this.#looked > FROZEN) return { send: this.release(), ended: "This page was suspended: press again." };
    if (now - this.#looked > HICCUP) this.#open(now);
    this.#looked = now;
    const why = objection(state, source, sender);
    if (state && NEVER.includes(state.mode)) return { send: this.release(), ended: why };
    // A state from before the hold began cannot show that the robot follows it.
    if (!why && stateTime > this.#begun) {
      this.#fine = now;
      this.phase = "driving";
    }
    const opening = this.phase === "opening";
    const [since, patience] = opening ? [this.#begun, PATIENCE] : [this.#fine, GRACE];
    if (now - since > patience) return { send: this.release(), ended: why };
    if (now - this.#sent < (opening ? OPENING : PERIOD)) return {};
    this.#sent = now;
    return { send: opening ? ZERO : this.#wish };
  }
}

/** Convert a push of the stick (x right and y up, within 1) to m/s and rad/s. */
export function twist(x, y, limit, limits) {
  const far = Math.hypot(x, y);
  if (far < 0.08) return [0, 0];
  const scale = far > 1 ? 1 / far : 1;
  return [y * scale * limit, -x * scale * turning(limit, limits)];
}

/** Return the highest turn rate of the stick at a highest speed, rad/s. */
export function turning(limit, limits) {
  // A robot that can only turn has a linear limit of 0.
  const share = limits.linear > 0 ? limit / limits.linear : 0;
  return Math.min(limits.angular, Math.max(0.4, limits.angular * share));
}
