// Connects stick, keys and gamepad to one commander. The robot stops when the operator's finger or view leaves the
// control.

import { Commander, twist, ZERO } from "./commander.js";

export const SOURCE = "teleop"; // the command source for persons; programs use "app", which has a lower priority
const LOOK = 10;
const TWICE = 50; // ms between the first and the second zero command
const KEYS = {
  ArrowUp: [0, 1], KeyW: [0, 1], ArrowDown: [0, -1], KeyS: [0, -1],
  ArrowLeft: [-1, 0], KeyA: [-1, 0], ArrowRight: [1, 0], KeyD: [1, 0],
};
const SHOULDERS = [4, 5, 6, 7];
const STRANGE =
  "This gamepad does not drive, because the browser does not know its axes. Try the gamepad's mode switch (X, XInput) or another browser.";

export class Drive {
  #commander = new Commander();
  #link;
  #hint;
  #timer = null;
  #again = null;
  #by = null; // the input that drives: "stick", "keys" or "pad"; only this input can release
  #push = [0, 0];
  #pressed = new Set();
  #pointer = null;
  #padFree = null; // index of the gamepad whose shoulder buttons were up at the last look, or null
  #padDrives = null; // index of the gamepad that drives
  #padStrange = false; // the hint about an unknown gamepad was shown
  #awake = null; // the lock that keeps the screen on, as a promise; a locked screen hides the page, which releases
  state = null;
  stateTime = -Infinity; // time at which `state` was true, by performance.now()
  sender = "";
  limits = { linear: 0, angular: 0 };
  limit = 0.2;
  allowed = false;
  barred = "no connection yet"; // why a push would not move the robot, in words
  shown = true; // the view with the stick is visible

  constructor(link, stick, knob, hint) {
    this.#link = link;
    this.#hint = hint;
    this.stick = stick;
    this.knob = knob;
    this.#listen();
  }

  get held() {
    return this.#commander.held;
  }

  /** Release the active input and send a zero command; `why` is shown to the operator. */
  release(why = "") {
    const zero = this.#commander.release();
    if (zero) this.#send(zero);
    this.#rest();
    if (zero) this.#end(why);
  }

  #rest() {
    this.#by = this.#pointer = null;
    this.#pressed.clear();
    this.#show(0, 0);
  }

  #press(by) {
    if (!this.allowed || this.barred || !this.shown || this.#commander.held) return;
    clearTimeout(this.#again);
    this.#by = by;
    this.#hint("");
    this.#commander.press(performance.now());
    this.stick.classList.add("held");
    // Without HTTPS or with a low battery the browser refuses, and the screen locks as usual.
    this.#awake = navigator.wakeLock?.request("screen").catch(() => null);
    this.#timer = setInterval(() => this.#look(), LOOK);
    this.#look();
  }

  /** Send the command that is due, and show whether the robot follows this page. While another sender drives, the ring
   *  of the stick is not blue. */
  #look() {
    this.stick.classList.toggle("follows", this.#commander.phase === "driving");
    this.#commander.wish(...twist(...this.#push, this.limit, this.limits));
    const { send, ended } = this.#commander.look(performance.now(), this.state, this.stateTime, SOURCE, this.sender);
    if (send) this.#send(send);
    if (ended === undefined) return;
    this.#rest();
    this.#end(ended);
  }

  #end(why) {
    clearInterval(this.#timer);
    // A daemon that reads late drops a command that closely follows another one, so the zero is sent twice.
    // Then this page is silent, because a sender that repeats zeros keeps other senders from driving. A
    // hidden or stalled page runs its timers late. By then another person may drive, so the second zero is
    // left out.
    clearTimeout(this.#again);
    const last = performance.now() + 3 * TWICE;
    this.#again = setTimeout(() => !document.hidden && performance.now() < last && this.#send(ZERO), TWICE);
    this.stick.classList.remove("held", "follows");
    this.#awake?.then((lock) => lock?.release());
    this.#hint(why);
  }

  /** Send a command. A release is sent even over a congested connection. */
  #send(cmd) {
    const message = { cmd, source: SOURCE, echo: this.#link.beat };
    if (this.held) this.#link.send(message);
    else this.#link.urge(message);
  }

  #show(x, y) {
    this.#push = [x, y];
    const far = Math.max(1, Math.hypot(x, y));
    this.knob.style.transform = `translate(${(x / far) * 97}%, ${(-y / far) * 97}%)`;
  }

  #listen() {
    const stick = this.stick;
    stick.addEventListener("pointerdown", (event) => this.#down(event));
    stick.addEventListener("pointermove", (event) => event.pointerId === this.#pointer && this.#moved(event));
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"])
      stick.addEventListener(name, (event) => event.pointerId === this.#pointer && this.release());
    stick.addEventListener("contextmenu", (event) => event.preventDefault());
    addEventListener("pointerdown", (event) => this.#second(event), true);
    addEventListener("keydown", (event) => this.#key(event, true));
    addEventListener("keyup", (event) => this.#key(event, false));
    addEventListener("focusin", (event) => this.#by === "keys" && busy(event) && this.release());
    addEventListener("blur", () => this.release("Released: the window lost the focus"));
    // The browser waits for this handler before it navigates. The next event, pagehide, may come late on a
    // busy machine.
    addEventListener("beforeunload", () => this.release("Released: you left the page"));
    addEventListener("pagehide", () => this.release());
    document.addEventListener("freeze", () => this.release());
    document.addEventListener("visibilitychange", () => document.hidden && this.release("Released: the page was hidden"));
    addEventListener("contextmenu", () => this.#by === "keys" && this.release("Released: a menu is open"), true);
    // While something is dragged, no browser reports the release of a key.
    addEventListener("dragstart", () => this.#by === "keys" && this.release("Released: something is dragged"), true);
    addEventListener("gamepaddisconnected", () => {
      this.#padFree = null; // the gamepad may come back before the next look, with a button held
      if (this.#by === "pad") this.release("Released: the gamepad is disconnected");
    });
    setInterval(() => this.#pad(), 50);
  }

  /** A second finger on anything but STOP releases the stick. */
  #second(event) {
    if (this.#pointer !== null && !event.target.closest?.("#stick, #stop")) this.release("Released: use one finger to drive");
  }

  #down(event) {
    if (event.button !== 0) return;
    event.preventDefault();
    if (this.#pointer !== null) return this.release("Released: use one finger to drive");
    if (this.#by) return;
    this.#pointer = event.pointerId;
    this.stick.setPointerCapture(event.pointerId);
    this.#move(event);
    this.#press("stick");
    if (!this.#commander.held) this.release();
  }

  /** A mouse reports a change of a second button by a move event, so check the buttons on each move. */
  #moved(event) {
    if (event.buttons === 1) this.#move(event);
    else this.release("Released: another button is down");
  }

  #move(event) {
    const box = this.stick.getBoundingClientRect();
    const half = (box.width / 2) * 0.66;
    this.#show((event.clientX - box.left - box.width / 2) / half, -(event.clientY - box.top - box.height / 2) / half);
  }

  #key(event, down) {
    // With a modifier key down, some systems do not report the release of another key.
    if (down && this.#by === "keys" && (event.metaKey || event.ctrlKey || event.altKey))
      return this.release("Released: another key is down");
    if (!(event.code in KEYS)) return;
    // Handle a key release no matter where the focus is and which other keys are down.
    if (!down && !this.#pressed.delete(event.code)) return;
    if (down && (!this.shown || busy(event))) return;
    event.preventDefault();
    if (event.repeat || (this.#by && this.#by !== "keys")) return;
    if (down) this.#pressed.add(event.code);
    const sum = [...this.#pressed].reduce(([x, y], code) => [x + KEYS[code][0], y + KEYS[code][1]], [0, 0]);
    if (!this.#pressed.size) return this.release();
    this.#show(...sum.map(Math.sign));
    if (down) this.#press("keys");
    // A key that does not drive is forgotten: its release may never be reported, and it would drive with the next key.
    if (!this.#commander.held) this.release();
  }

  #pad() {
    // Only the standard mapping is used. On other gamepads the axes are unknown, and a trigger at rest may
    // read as full lock.
    const pads = [...(navigator.getGamepads?.() ?? [])].filter((pad) => pad?.connected);
    const pad = pads.find(({ mapping }) => mapping === "standard");
    const strange = !pad && pads.length > 0;
    if (strange && !this.#padStrange && this.allowed) this.#hint(STRANGE);
    this.#padStrange = strange && this.allowed;
    const held = pad ? SHOULDERS.some((n) => pad.buttons[n]?.pressed) : false;
    if (this.#by === "pad") {
      if (held && pad.index === this.#padDrives) this.#show(farther(pad.axes[0], pad.axes[2]), -farther(pad.axes[1], 0));
      else this.release();
    } else if (held && pad.index === this.#padFree && !this.#by && document.hasFocus()) {
      this.#padDrives = pad.index;
      this.#show(0, 0);
      this.#press("pad");
    }
    // Only a press that begins while the gamepad is connected drives. A gamepad that comes back with its button held
    // has not been pressed again.
    this.#padFree = pad && !held ? pad.index : null;
  }
}

/** Return whether a key belongs to the focused control or to a shortcut. A slider uses the arrow keys only. */
function busy(event) {
  if (event.ctrlKey || event.altKey || event.metaKey) return true;
  const slider = event.target.matches?.("input[type=range]") && event.code?.startsWith("Key");
  return !slider && event.target.matches?.("input, select, textarea");
}

/** Return the value of the axis that is pushed farther, or 0 if it is within the slack of the spring. */
function farther(one = 0, other = 0) {
  const most = Math.abs(one) > Math.abs(other) ? one : other;
  return Math.abs(most) < 0.12 ? 0 : most;
}
