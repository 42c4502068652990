// STOP: repeated until the robot confirms it, because a dead link is not noticed at once. It is not repeated
// for long: later another person may have cleared the stop and be driving.

const URGENT = 30000; // ms after the press, by the clock that gets there first: one may be set, the other may sleep
const PAUSE = 300; // ms between two attempts
const UNSURE = "STOP was not confirmed: look at the robot, and press STOP again";

export class Stopping {
  #send;
  #tell;
  #press = 0;
  #waits = false; // waiting for the robot's confirmation
  #since = Infinity; // time of the press, by performance.now()
  #arrived = false;

  /** `send()` sends one request and resolves to {ok, text, lost}; `lost` means that there was no answer.
   *  `tell(words)` shows a message to the operator. */
  constructor(send, tell) {
    this.#send = send;
    this.#tell = tell;
  }

  async press() {
    const press = ++this.#press;
    const last = Date.now() + URGENT;
    this.#since = performance.now();
    this.#waits = true;
    this.#arrived = false;
    for (;;) {
      const told = await this.#send();
      if (press !== this.#press) return; // a newer press took over
      if (this.#ends(told)) return;
      this.#tell(`STOP: ${told.text}; this page sends it again`);
      await new Promise((done) => setTimeout(done, PAUSE));
      if (press !== this.#press || this.#ends(told)) return;
      if (Date.now() > last || performance.now() > this.#since + URGENT) return this.over();
    }
  }

  /** Note that the robot reported itself as stopped at the time `at`. This counts as the answer if the answer
   *  was lost. */
  heard(at) {
    if (at > this.#since) this.#arrived = true;
  }

  /** Give up the pending STOP, because the operator clears it or leaves the page. */
  over() {
    ++this.#press;
    if (this.#waits) this.#tell(UNSURE);
    this.#waits = false;
  }

  #ends(told) {
    if (!told.ok && !(told.lost && this.#arrived)) return false;
    this.#waits = false;
    this.#tell("");
    return true;
  }
}
