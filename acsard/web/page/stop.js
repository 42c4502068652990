// The STOP button. The page's server puts this classic script into index.html, so STOP works before the other scripts
// are loaded. The button is red while this script runs. The script posts the stop until the robot has answered. Later,
// `main.js` gives it the WebSocket, which is faster.
//
// A stop is repeated because a dead link is noticed late. It is repeated only for `URGENT`, because after that time
// another person may have released the stop and be driving.

"use strict";

// Longest time for which a stop is repeated, ms. The first of two clocks to reach it counts, because the wall clock may
// be set, and performance.now() may stand still while the device sleeps.
const URGENT = 30000;
const PAUSE = 300; // ms between two attempts
const SLOW = 10000; // ms after which a page whose modules do not run says so
const BARRED = [401, 403]; // HTTP statuses of a page without a valid invitation
const NOT_HERE = "STOP needs an invitation to this page: use the robot's own switch";
const UNSURE = "STOP was not confirmed: look at the robot, and press STOP again";
const RELOAD = "A part of this page did not load, so only STOP works here. Reload the page.";

class Stopping {
  #tell;
  #press = 0;
  #given = 0; // number of the last press that was given up
  #unconfirmed = false; // the robot has not answered the last STOP; stays true if that STOP is given up
  #whole = false; // the modules of the page run
  /** Called at each press before the stop is sent. */
  before = () => {};
  /** Called with the answer that confirms a stop. */
  after = () => {};

  /** `send()` sends one request and resolves to {ok}. Only its answer confirms a stop: a robot that reports that
   *  it is stopped may have been stopped by another person, who will release it. `tell(words)` shows a message to the
   *  operator. */
  constructor(send, tell) {
    this.send = send;
    this.#tell = tell;
  }

  async press() {
    const press = ++this.#press;
    const last = Date.now() + URGENT;
    const since = performance.now();
    this.#unconfirmed = true;
    try {
      this.before();
    } catch (error) {
      console.error(error); // the stop is sent whatever fails beside it
    }
    for (;;) {
      const answer = await this.send();
      if (press !== this.#press) return; // a newer press took over
      if (this.#ends(answer) || press === this.#given) return;
      this.#tell("STOP is not confirmed. This page sends it again; the robot's own switch stops it too.");
      await new Promise((done) => setTimeout(done, PAUSE));
      if (press !== this.#press || press === this.#given) return;
      if (Date.now() > last || performance.now() > since + URGENT) return this.over();
    }
  }

  /** Give up the pending STOP, because the operator releases it or leaves the page. The message stays until the robot
   *  answers a STOP (this one or a later one) or until `released` is called. Returns the number of the press, which is
   *  the argument of `released`. */
  over() {
    if (this.#unconfirmed) this.#tell(UNSURE);
    return (this.#given = this.#press);
  }

  /** Note that the robot has confirmed the release of the STOP for which `over` returned `press`. This STOP then needs
   *  no confirmation. If STOP was pressed again since, the call has no effect. */
  released(press) {
    if (press === this.#press) this.#settle("");
  }

  /** Note that the modules run and show the robot's state. */
  complete() {
    this.#whole = true;
    if (!this.#unconfirmed) this.#tell("");
  }

  /** Show that a part of the page is missing, unless the modules run. */
  lacks() {
    if (this.#whole) return;
    const mode = document.getElementById("mode");
    if (mode) mode.textContent = "NOT LOADED";
    if (!this.#unconfirmed) this.#tell(RELOAD);
  }

  /** Show STOP in gray, because the robot has refused this browser. A press is still sent. */
  uninvited() {
    document.documentElement.classList.remove("stops");
  }

  #ends(answer) {
    if (answer.barred) {
      this.#settle(NOT_HERE);
      this.uninvited();
      return true;
    }
    if (!answer.ok) return false;
    document.documentElement.classList.add("stops"); // this browser was invited again in another tab
    this.#settle(this.#whole ? "" : "STOP: the robot has confirmed it. This page is not complete: reload it.");
    this.after(answer);
    return true;
  }

  #settle(words) {
    this.#unconfirmed = false;
    this.#tell(words);
  }
}

/** Return a signal that aborts a request after `ms`. Browsers before 2022 have no AbortSignal.timeout. */
function expiring(ms) {
  const controller = new AbortController();
  setTimeout(() => controller.abort(), ms);
  return controller.signal;
}

/** Send STOP by HTTP, because the WebSocket may be refused or may not be open yet. The browser completes the
 *  request even if the person leaves the page. */
async function posted() {
  try {
    const answer = await fetch("api/srv/stop", { method: "POST", keepalive: true, signal: expiring(3000) });
    return { ok: answer.ok, barred: BARRED.includes(answer.status) };
  } catch {
    return { ok: false, lost: true };
  }
}

/** Show a message about STOP in every view until `words` is "". The messages of other buttons have another place
 *  (`main.js`), so that they do not hide this one. */
function alarm(words) {
  const place = document.getElementById("alarm");
  if (place) place.textContent = words;
}

window.stopping = new Stopping(posted, alarm);

// The listeners are on the window, because this script runs before the button exists.
const onStop = (event) => event.target.closest?.("#stop");
addEventListener("pointerdown", (event) => onStop(event) && window.stopping.press());
addEventListener("click", (event) => onStop(event) && event.detail === 0 && window.stopping.press()); // Enter or Space key
addEventListener("keydown", (event) => {
  if (event.code !== "Space") return;
  event.preventDefault();
  if (!event.repeat) window.stopping.press();
}, true);
addEventListener("keyup", (event) => event.code === "Space" && event.preventDefault(), true);
addEventListener("pagehide", () => window.stopping.over());
addEventListener("error", () => window.stopping.lacks(), true); // also if the browser could not load a file
setTimeout(() => window.stopping.lacks(), SLOW);
document.documentElement.classList.add("stops");
