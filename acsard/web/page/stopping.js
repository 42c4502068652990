// STOP: sent until the robot has it, since a link may be dead and not know it yet. Never much later
// than it was pressed: by then somebody may have cleared it and be driving.

const URGENT = 30000; // ms after the press, by the wall clock: the other one may stand in a sleep
const PAUSE = 300; // between two

export class Stopping {
  #send;
  #tell;
  #press = 0;
  #since = Infinity; // when it was pressed, by performance.now()
  #arrived = false;

  /** `send()` asks once and gives {ok, text}; `tell(words)` is what a person sees. */
  constructor(send, tell) {
    this.#send = send;
    this.#tell = tell;
  }

  async press() {
    const press = ++this.#press;
    const last = Date.now() + URGENT;
    this.#since = performance.now();
    this.#arrived = false;
    for (;;) {
      const told = await this.#send();
      if (press !== this.#press) return; // a newer one tells
      const again = !told.ok && !this.#arrived;
      this.#tell(told.ok ? "" : `STOP: ${told.text}${again ? "; it is sent again" : ""}`);
      if (!again) return;
      await new Promise((done) => setTimeout(done, PAUSE));
      if (press !== this.#press) return;
      if (this.#arrived) return this.#tell("");
      if (Date.now() > last) return this.#tell("STOP was not confirmed: look at the robot, and press it again");
    }
  }

  /** The robot said at that time that it is stopped. */
  heard(at) {
    if (at > this.#since) this.#arrived = true;
  }

  /** What was pressed is over: somebody has cleared it, or the page goes. */
  over() {
    ++this.#press;
  }
}
