// The WebSocket connection: reconnects by itself, measures the round trip, and knows how old the shown data
// may be.

const AGAIN = [300, 600, 1200, 2500, 5000];
const BEAT = 1000; // ms between two pings
const SILENT = 3000; // ms without any message after which the connection is cut, whatever the socket reports

export class Link {
  #socket = null;
  #tries = 0;
  #wanted = new Map();
  #answers = new Map();
  #number = 0;
  #received = 0;
  #asked = null; // send time of the ping that has no answer yet
  #refused;
  #takers;
  #shut = false; // closed for good
  open = false;
  way = null; // round trip, ms
  beat = null; // the newest beat of the daemon on this connection; each command echoes it

  /** `refused()` is called when the robot rejects a connection. It resolves to true if another attempt is pointless.
   *  `takers` maps a key, or another kind of message, to the function that takes it; `up()` and `down(reason)` report
   *  the connection. */
  constructor(refused, takers) {
    this.#refused = refused;
    this.#takers = takers;
  }

  start() {
    this.#connect();
    setInterval(() => this.#ping(), BEAT);
    this.#ping();
    document.addEventListener("visibilitychange", () => document.hidden || this.open || this.#connect());
    // A browser may freeze a page with its open connection when the user leaves it, and resume it later. The
    // robot would count the frozen page as a viewer.
    addEventListener("pagehide", () => this.#end("the page was left"));
    addEventListener("pageshow", (event) => event.persisted && this.#connect());
  }

  /** Possible age of the shown data in ms: the last round trip, or the time that a ping has waited. */
  get lag() {
    return Math.max(this.way ?? 0, this.#asked === null ? 0 : performance.now() - this.#asked);
  }

  /** Subscribe to a key with at most `rate` messages a second, again after each reconnection. */
  subscribe(key, rate) {
    const asked = { subscribe: key, rate };
    this.#wanted.set(key, asked);
    this.send(asked);
  }

  unsubscribe(key) {
    if (this.#wanted.delete(key)) this.send({ unsubscribe: key });
  }

  /** Send a message if the connection is open and not congested, and return whether it was sent. Nothing is
   *  queued. */
  send(message) {
    if (!this.open || this.#socket.bufferedAmount > 4096) return false;
    this.#socket.send(JSON.stringify(message));
    return true;
  }

  /** Send a message even over a congested connection; use it for messages that stop something. */
  urge(message) {
    if (this.open) this.#socket.send(JSON.stringify(message));
  }

  /** Call a service of the robot. Resolves to the answer; if there is none, to an answer with `lost` and the reason. */
  call(verb, payload) {
    const id = ++this.#number;
    return new Promise((done) => {
      const given = setTimeout(() => this.#unanswered(id, "no answer within 3 s"), 3000);
      this.#answers.set(id, (answer) => (clearTimeout(given), done(answer)));
      if (this.open) this.urge({ call: verb, payload, id });
      else this.#unanswered(id, "no connection to the robot");
    });
  }

  #connect() {
    if (this.#shut || (this.#socket && this.#socket.readyState <= 1)) return;
    const socket = new WebSocket(new URL("ws", location.href.replace(/^http/, "ws").replace(/#.*/, "")));
    this.#socket = socket;
    const given = setTimeout(() => socket.readyState === WebSocket.CONNECTING && socket.close(), SILENT);
    socket.onopen = () => {
      clearTimeout(given);
      this.open = true;
      this.beat = null;
      this.#tries = 0;
      this.#received = performance.now();
      this.#asked = null;
      for (const asked of this.#wanted.values()) this.send(asked);
      this.#takers.up();
      this.#ping();
    };
    socket.onmessage = (event) => this.#take(JSON.parse(event.data));
    socket.onclose = async (event) => {
      if (this.#socket !== socket) return;
      const was = this.open;
      this.#down(event.reason);
      if (!was) this.#shut = await this.#refused();
      if (document.hidden) return; // reconnect when the page is visible again
      setTimeout(() => this.#connect(), AGAIN[Math.min(this.#tries++, AGAIN.length - 1)]);
    };
  }

  #take(message) {
    this.#received = performance.now();
    if ("pong" in message) {
      // A ping that was repeated before its answer gets several answers; only the first counts.
      if (message.pong !== this.#asked) return;
      this.way = performance.now() - this.#asked;
      this.#asked = null;
    } else if ("answer" in message) this.#answer(message);
    else if (message.key === "beat") this.beat = message.value;
    else if ("key" in message) this.#takers[message.key]?.(message);
    else for (const kind of ["hello", "path", "refused", "gone"]) if (kind in message) this.#takers[kind](message);
  }

  #answer(message) {
    this.#answers.get(message.answer)?.(message);
    this.#answers.delete(message.answer);
  }

  #unanswered(id, text) {
    this.#answer({ answer: id, ok: false, lost: true, text });
  }

  #ping() {
    if (!this.open) return;
    if (performance.now() - this.#received > SILENT) {
      this.#end("the robot does not answer");
      this.#connect();
      return;
    }
    this.#asked ??= performance.now();
    this.send({ ping: this.#asked });
  }

  /** Drop the connection without waiting for the answer to a close, which a dead link or a frozen page never
   *  gives. */
  #end(reason) {
    const socket = this.#socket;
    if (!socket) return;
    this.#socket = socket.onclose = null;
    socket.close();
    this.#down(reason);
  }

  /** Mark the link as down and fail all calls that wait for an answer. */
  #down(reason) {
    this.open = false;
    this.way = null;
    for (const id of [...this.#answers.keys()]) this.#unanswered(id, "the connection was lost before an answer came");
    this.#takers.down(reason);
  }
}
