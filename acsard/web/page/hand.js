// What a hand on the stick sends and when. Pure: times in ms come in, commands go out.
//
// A hold opens with zeros until the robot follows us, so that no press is the first thing that a
// robot hears of this browser; then what is wished goes at 20 Hz; letting go is one zero (which
// `drive.js` says a second time), then silence. A hold that ended by itself takes a new press: nobody's finger drives twice.

export const PERIOD = 50;
export const OPENING = 20;
export const PATIENCE = 2000; // for the robot to follow
export const GRACE = 500; // for it to follow again
export const HICCUP = 250; // between two looks: the robot has braked meanwhile, so it opens anew
export const FROZEN = 1000; // the page stood still, and the finger may be long gone

const NEVER = ["inactive", "stopped", "fault", "leaving"];
export const ZERO = { linear_x: 0, angular_z: 0 };

/** Why the robot does not follow `sender`, in words; "" when it does. */
export function objection(state, source, sender) {
  if (!state) return "nothing is heard of the robot";
  const ours = state.sources.find((one) => one.name === source);
  if (NEVER.includes(state.mode) || state.mode === "waiting") return state.reason;
  if (!ours) return `${source} is not one of the robot's sources`;
  if (state.source !== source) return ours.waits_for === "a command" ? "not heard yet" : ours.waits_for || state.reason || "not followed";
  if (state.mode !== "driving") return state.reason;
  if (state.sender && state.sender !== sender) return `somebody else drives as ${source}: ${state.sender}`;
  return "";
}

export class Hand {
  phase = "idle"; // opening, driving
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

  /** Let go; the zero to send, or null if nothing was held. */
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

  /** What to send now, and why the hold has ended if it has: {send, ended}. `heard` is when
   *  `state` was true. */
  look(now, state, heard, source, sender) {
    if (!this.held) return {};
    if (now - this.#looked > FROZEN) return { send: this.release(), ended: "the page stood still: press again" };
    if (now - this.#looked > HICCUP) this.#open(now);
    this.#looked = now;
    const why = objection(state, source, sender);
    if (state && NEVER.includes(state.mode)) return { send: this.release(), ended: why };
    // What was true before it opened says nothing of how this goes.
    if (!why && heard > this.#begun) {
      this.#fine = now;
      this.phase = "driving";
    }
    const patience = this.phase === "opening" ? PATIENCE : GRACE;
    const since = this.phase === "opening" ? this.#begun : this.#fine;
    if (now - since > patience) return { send: this.release(), ended: why };
    const opening = this.phase === "opening";
    if (now - this.#sent < (opening ? OPENING : PERIOD)) return {};
    this.#sent = now;
    return { send: opening ? ZERO : this.#wish };
  }
}

/** A push of the stick, x right and y up within 1 -> m/s and rad/s. */
export function twist(x, y, limit, limits) {
  const far = Math.hypot(x, y);
  if (far < 0.08) return [0, 0];
  const scale = far > 1 ? 1 / far : 1;
  // A robot that may only turn has no part of its speed to go by.
  const share = limits.linear > 0 ? limit / limits.linear : 0;
  const turn = Math.min(limits.angular, Math.max(0.4, limits.angular * share));
  return [y * scale * limit, -x * scale * turn];
}
