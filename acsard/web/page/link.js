// The WebSocket: opens again by itself, measures the way there and back, and says how old is what
// is shown.

const AGAIN = [300, 600, 1200, 2500, 5000];
const BEAT = 1000; // between two pings
const STOOD = 150; // ms that the browser's clock may fall behind the wall clock between two pings
const SILENT = 3000; // without an answer for so long the way is cut, whatever the socket says

export class Link extends EventTarget {
  #socket = null;
  #tries = 0;
  #wanted = new Map();
  #answers = new Map();
  #number = 0;
  #heard = 0;
  #ahead = null; // of performance.now(), how far the wall clock was ahead at the last ping
  #asked = null; // a ping that has no answer yet, since when
  #timer = null;
  #refused;
  #shut = false; // for good
  open = false;
  way = null; // there and back, ms

  /** `refused()` is asked when the robot takes no connection: true ends the asking. */
  constructor(refused) {
    super();
    this.#refused = refused;
  }

  start() {
    this.#connect();
    this.beat();
    document.addEventListener("visibilitychange", () => document.hidden || this.open || this.#connect());
    // A browser may keep a page that was left, with its connection, and wake it when somebody goes
    // back to it: the robot would take it for one who looks.
    addEventListener("pagehide", () => this.#end("the page was left"));
    addEventListener("pageshow", (event) => event.persisted && this.#connect());
  }

  /** How far what is shown may lag behind, ms: the last way there and back, or what is waited for. */
  get lag() {
    return Math.max(this.way ?? 0, this.#asked === null ? 0 : performance.now() - this.#asked);
  }

  /** Ping so often, ms: pings are the signs that somebody is here. */
  beat(every = BEAT) {
    clearInterval(this.#timer);
    this.#timer = setInterval(() => this.#ping(), every);
    this.#ping();
  }

  /** Follow a key at most `rate` times a second, also after a new connection; of another `robot`
   *  than the page's own, if it is named. */
  subscribe(key, rate, robot) {
    const asked = { subscribe: key, rate, robot };
    this.#wanted.set(key, asked);
    this.send(asked);
  }

  unsubscribe(key) {
    const asked = this.#wanted.get(key);
    if (this.#wanted.delete(key)) this.send({ unsubscribe: key, robot: asked.robot });
  }

  /** True when it was handed on: nothing is kept for later, and nothing is added to a jam. */
  send(message) {
    if (!this.open || this.#socket.bufferedAmount > 4096) return false;
    this.#socket.send(JSON.stringify(message));
    return true;
  }

  /** The same whatever waits before it: what stops something. */
  urge(message) {
    if (this.open) this.#socket.send(JSON.stringify(message));
  }

  /** Ask for a service (of another `robot`, if it is named); the answer, or why there is none. */
  call(verb, payload, robot) {
    const id = ++this.#number;
    return new Promise((done) => {
      const given = setTimeout(() => this.#unanswered(id, "no answer within 3 s"), 3000);
      this.#answers.set(id, (told) => (clearTimeout(given), done(told)));
      if (this.open) this.urge({ call: verb, payload, id, robot });
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
      this.#tries = 0;
      this.#heard = performance.now();
      this.#asked = null;
      for (const asked of this.#wanted.values()) this.send(asked);
      this.#tell("up", {});
      this.#ping();
    };
    socket.onmessage = (event) => this.#take(JSON.parse(event.data));
    socket.onclose = async (event) => {
      if (this.#socket !== socket) return;
      const was = this.open;
      this.#down(event.reason);
      if (!was) this.#shut = await this.#refused();
      if (document.hidden) return; // again when somebody looks
      setTimeout(() => this.#connect(), AGAIN[Math.min(this.#tries++, AGAIN.length - 1)]);
    };
  }

  #take(message) {
    this.#heard = performance.now();
    if ("pong" in message) {
      // What is asked again before the answer has more than one.
      if (message.pong !== this.#asked) return;
      this.way = performance.now() - this.#asked;
      this.#asked = null;
    } else if ("answer" in message) this.#answer(message);
    else if ("key" in message) this.#tell(`key:${message.key}`, message);
    else for (const kind of ["hello", "path", "minute", "fleet", "refused", "gone", "guide"]) if (kind in message) this.#tell(kind, message);
  }

  #answer(message) {
    this.#answers.get(message.answer)?.(message);
    this.#answers.delete(message.answer);
  }

  #unanswered(id, text) {
    this.#answer({ answer: id, ok: false, lost: true, text });
  }

  #ping() {
    const before = this.#ahead;
    this.#ahead = Date.now() - performance.now();
    if (!this.open) return;
    // While a computer sleeps, performance.now() may stand. Commands stamped by it would look late
    // for ever, so they need a connection of their own, which gives them a new sender.
    const stood = before !== null && Math.abs(this.#ahead - before) > STOOD;
    if (stood || performance.now() - this.#heard > SILENT) {
      this.#end(stood ? "this device slept, or its clock was set" : "no answer");
      this.#connect();
      return;
    }
    this.#asked ??= performance.now();
    this.send({ ping: this.#asked });
  }

  /** At once: a close needs an answer too, which a cut way or a frozen page does not have. */
  #end(reason) {
    const socket = this.#socket;
    if (!socket) return;
    this.#socket = socket.onclose = null;
    socket.close();
    this.#down(reason);
  }

  /** What was asked by it has no answer any more. */
  #down(reason) {
    this.open = false;
    this.way = null;
    for (const id of [...this.#answers.keys()]) this.#unanswered(id, "the connection went before an answer came");
    this.#tell("down", { reason });
  }

  #tell(kind, detail) {
    this.dispatchEvent(new CustomEvent(kind, { detail }));
  }
}
