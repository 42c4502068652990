// STOP: sent until the robot has it, since a link may be dead and not know it yet. Never much later
// than it was pressed: by then somebody may have cleared it and be driving.

const URGENT = 30000; // ms after the press, by whichever clock comes first: one is set, one may sleep
const PAUSE = 300; // between two
const UNSURE = "STOP was not confirmed: look at the robot, and press it again";

export class Stopping {
  #send;
  #tell;
  #press = 0;
  #waits = false; // for the robot to have it
  #since = Infinity; // when it was pressed, by performance.now()
  #arrived = false;

  /** `send()` asks once and gives {ok, text, lost}, `lost` where nobody answered; `tell(words)` is
   *  what a person sees. */
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
      if (press !== this.#press) return; // a newer one tells
      if (this.#ends(told)) return;
      this.#tell(`STOP: ${told.text}; it is sent again`);
      await new Promise((done) => setTimeout(done, PAUSE));
      if (press !== this.#press || this.#ends(told)) return;
      if (Date.now() > last || performance.now() > this.#since + URGENT) return this.over();
    }
  }

  /** The robot said at that time that it is stopped: as good as an answer, where there was none. */
  heard(at) {
    if (at > this.#since) this.#arrived = true;
  }

  /** Nothing is sent any more of what was pressed: somebody clears it, or the page goes. */
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
