// A browser and a robot for the stories in `page_stories.js`: the elements of index.html, events, a WebSocket, HTTP,
// and clocks that only a story moves. It draws nothing: what a person sees is tested in Chromium, in `system/`.

import { readFileSync } from "node:fs";
import { runInThisContext } from "node:vm";

let now = 1000;
let count = 0;
const timers = new Map();
const yielded = () => new Promise((done) => setImmediate(done)); // all promises that can go on have gone on
const timed = (does, ms, every) => (timers.set(++count, { due: now + Math.max(ms, 1), every, does }), count);

/** Let `ms` pass. */
export async function pass(ms) {
  const end = now + ms;
  for (await yielded(); ; await yielded()) {
    const [id, timer] = [...timers].reduce((a, b) => (b[1].due < a[1].due ? b : a), [0, { due: Infinity }]);
    if (timer.due > end) break;
    now = Math.max(now, timer.due);
    if (timer.every) timer.due = now + timer.every;
    else timers.delete(id);
    timer.does();
  }
  now = Math.max(now, end);
}

/** Let `ms` pass in which the page does not run. */
export function stall(ms) {
  now += ms;
}

class Target {
  heard = [];
  addEventListener(type, does, how = false) {
    this.heard.push([type, does, how === true || how.capture === true]);
  }
  removeEventListener() {}
}

const VOID = ["meta", "link", "input", "br", "wbr"];
const paper = new Proxy(() => {}, {
  get: (_, name) => (name === Symbol.toPrimitive ? () => 0 : paper), set: () => true, apply: () => paper,
});

class Element extends Target {
  dataset = {};
  style = { setProperty() {} };
  looks = new Set();
  parts = [];
  parent = null;
  title = "";
  clientWidth = 300;
  clientHeight = 300;

  constructor(tag, attributes = {}) {
    super();
    Object.assign(this, { tagName: tag.toUpperCase(), attributes, id: attributes.id, hidden: "hidden" in attributes });
    this.value = attributes.value ?? "";
    if (["button", "input", "select", "fieldset"].includes(tag)) this.disabled = false;
    for (const [name, value] of Object.entries(attributes)) if (name.startsWith("data-")) this.dataset[name.slice(5)] = value;
  }
  get classList() {
    const looks = this.looks;
    return {
      add: (name) => looks.add(name), contains: (name) => looks.has(name),
      remove: (...names) => names.forEach((name) => looks.delete(name)),
      toggle: (name, on) => (on ? looks.add(name) : looks.delete(name)),
    };
  }
  set className(names) {
    this.looks = new Set(names.split(" "));
  }
  get textContent() {
    return this.parts.map((part) => part.textContent ?? part).join("");
  }
  set textContent(words) {
    this.parts = [String(words)];
  }
  append(...parts) {
    for (const part of parts) if (part instanceof Element) part.parent = this;
    this.parts.push(...parts);
  }
  replaceChildren(...parts) {
    this.parts = [];
    this.append(...parts);
  }
  after(part) {
    part.parent = this.parent;
    this.parent.parts.splice(this.parent.parts.indexOf(this) + 1, 0, part);
  }
  *all() {
    yield this;
    for (const part of this.parts) if (part instanceof Element) yield* part.all();
  }
  matches(selector) {
    return selector.split(", ").some((one) => {
      const [, tag, id, name, value] = /^(\w*)(?:#([\w-]+))?(?:\[([\w-]+)(?:=(\w+))?\])?$/.exec(one) ?? [, "none"];
      return (!tag || tag.toUpperCase() === this.tagName) && (!id || id === this.id) &&
        (!name || (value === undefined ? name in this.attributes : this.attributes[name] === value));
    });
  }
  closest(selector) {
    return this.matches(selector) ? this : (this.parent?.closest(selector) ?? null);
  }
  querySelectorAll(selector) {
    return [...this.all()].filter((one) => one.matches(selector));
  }
  querySelector(selector) {
    return this.querySelectorAll(selector)[0] ?? null;
  }
  contains(other) {
    return [...this.all()].includes(other);
  }
  setAttribute(name, value) {
    this.attributes[name] = value;
  }
  focus() {
    document.activeElement = this;
    fire(this, "focusin");
  }
  blur() {}
  setPointerCapture() {}
  getContext() {
    return paper;
  }
  getBoundingClientRect() {
    return { left: 0, top: 0, width: 200, height: 200 };
  }
}

const root = new Element("html");
let top = root;
for (const [, end, tag, words, text] of readFileSync("index.html", "utf8").matchAll(/<(\/?)(\w+)([^>]*)>|([^<]+)/g)) {
  if (text) top.append(text);
  else if (end) top = top.parent ?? top;
  else if (tag !== "html") {
    const found = [...words.matchAll(/([\w-]+)(?:="([^"]*)")?/g)];
    const one = new Element(tag, Object.fromEntries(found.map(([, name, value]) => [name, value ?? ""])));
    top.append(one);
    if (!VOID.includes(tag)) top = one;
  }
}
const named = new Map([...root.all()].filter(({ id }) => id).map((one) => [one.id, one]));
const windows = new Target();
const document = Object.assign(new Target(), {
  documentElement: root, body: root.querySelector("body"), activeElement: null, hidden: false, title: "",
  hasFocus: () => true, createElement: (tag) => new Element(tag),
  getElementById: (id) => named.get(id) ?? null,
  querySelector: (selector) => root.querySelector(selector),
  querySelectorAll: (selector) => root.querySelectorAll(selector),
});

export const $ = (id) => document.getElementById(id);
export const text = (id) => ($(id).hidden ? "" : $(id).textContent);
export const grey = (id) => $(id).disabled || $(id).attributes["aria-disabled"] === "true";
export const held = () => $("stick").classList.contains("held");

/** Send an event to an element, `document` or `window`, and return whether the page has prevented its default. */
export function fire(target, type, more = {}) {
  const prevented = { preventDefault: () => (event.defaultPrevented = true) };
  const event = { type, target, timeStamp: now, defaultPrevented: false, ...prevented, ...more };
  const way = [[windows, true]];
  for (let one = target; one instanceof Element; one = one.parent) way.push([one, false]);
  if (target === document) way.push([document, false]);
  way.push([windows, false]);
  for (const [one, capture] of way)
    for (const [name, does, captures] of [...one.heard]) if (name === type && captures === capture) does(event);
  return event.defaultPrevented;
}

/** Press and release an element, as a finger does. A disabled or hidden button is not pressed. */
export function tap(id) {
  if ($(id).disabled || $(id).hidden) return;
  fire($(id), "pointerdown", { pointerId: 9, button: 0 });
  fire($(id), "click", { detail: 1 });
}

/** Move the finger `pointer` on the stick by this share of its way. */
export function push(x, y, type = "pointermove", more = {}) {
  const at = { clientX: 100 + x * 66, clientY: 100 - y * 66 };
  fire($("stick"), type, { pointerId: 1, button: 0, buttons: 1, ...at, ...more });
}

export const key = (type, code, target = document.body, more = {}) => fire(target, type, { code, key: code, ...more });

/** Replace the gamepads: [index, whether a shoulder button is down, its mapping] of each. The stick is forward. */
export function pads(...all) {
  const button = (held) => Array.from({ length: 16 }, (_, n) => ({ pressed: n === 5 && held }));
  navigator.getGamepads = () => all.map(([index, held, mapping = "standard"]) =>
    ({ index, connected: true, mapping, axes: [0, -1, 0, 0], buttons: button(held) }));
}

// The robot, as the page's server shows it.

export const robot = {
  reachable: true, // connections to it open
  passes: true, // an open connection passes messages on
  talks: true, // it sends its state
  beats: true, // it sends its beats
  ages: 0, // age of the states it sends, ms
  buffered: 0, // bytes that wait in the browser
  refusal: null, // the status and the reason with which it refuses this browser
  hello: {
    robot: "acsar", role: "maintainer", sender: "here/00112233445566aa", simulated: true, limits: { linear: 1, angular: 4 },
    barred: {}, camera: false, state_rate: 10,
  },
  state: {
    mode: "ready", code: "no_command", reason: "", link: "up", source: "", sender: "", causes: [], x: 0, y: 0, yaw: 0,
    linear: 0, angular: 0, latencies: {}, counters: {}, emergency_stop: "absent", wheel_fault: "", recording_error: "",
    latch_file_error: "", certificate: "", certificate_expiry: "",
    sources: [{ name: "teleop", priority: 50, wait: "neutral", waits_for: "a zero" }, { name: "app", priority: 10 }],
  },
  sent: [], // the commands: [time, m/s]
  asked: [], // the HTTP requests and the calls
  socket: null,
  last: -Infinity,
  cookie: "maintainer",

  /** Change the state, and send it. */
  now(changes) {
    Object.assign(this.state, changes);
    this.send({ key: "state", value: structuredClone(this.state), age: this.ages });
  },
  /** Latch a cause of this kind, as another client does. */
  latch(kind, mode = { stop: "stopped", fault: "fault", inactive: "inactive" }[kind]) {
    const causes = [...this.state.causes, { kind, number: ++count, text: `${kind} by bob`, stamp: { sec: 0, nanosec: 0 } }];
    this.now({ mode, causes });
  },
  release(numbers) {
    const causes = this.state.causes.filter(({ number }) => !numbers.includes(number));
    const kinds = { fault: "fault", stop: "stopped", inactive: "inactive" };
    const kind = Object.keys(kinds).find((name) => causes.some((cause) => cause.kind === name));
    this.now({ causes, mode: kinds[kind] ?? "ready" });
  },
  clear() {
    this.release(this.state.causes.map(({ number }) => number));
  },
  call(verb, payload) {
    this.asked.push(verb);
    if (verb === "stop") this.latch("stop", this.state.mode === "fault" ? "fault" : "stopped");
    if (verb === "deactivate") this.latch("inactive");
    if (verb === "clear" || verb === "activate") this.release(payload.numbers);
    return { ok: true, text: `${verb} is done` };
  },
  send(message) {
    if (!this.socket?.opened || !this.passes || (message.key === "state" && !this.talks)) return;
    this.socket.onmessage({ data: JSON.stringify(message) });
  },
  hear({ ping, call, id, payload, cmd }) {
    if (!this.passes) return;
    if (ping !== undefined) setTimeout(() => this.send({ pong: ping }), 5);
    if (call) setTimeout(() => this.send({ answer: id, ...this.call(call, payload) }), 5);
    if (cmd) this.drive(cmd.linear_x);
  },
  drive(speed) {
    this.sent.push([now, speed]);
    this.last = now;
    if (this.state.mode === "ready") this.now({ mode: "driving", source: "teleop", sender: this.hello.sender });
  },
  /** Answer an HTTP request: [status, body]. */
  http(path, how) {
    if (this.refusal && path !== "token") return [this.refusal[0], { error: this.refusal[1] }];
    if (path === "api/srv/stop") return this.call("stop") && [200, { success: true }];
    if (path === "api/recordings") return [200, [{ name: "1.rec.zst", begin: 1, seconds: 5 }]];
    if (path === "api/settings") return [200, [{ key: "limits.linear_speed", value: 1, what: "", when: "" }]];
    return [200, JSON.parse(how.body ?? "{}")];
  },
  /** End the connection with this reason. `back` says whether a next one opens. */
  lose(reason = "", back = false) {
    this.reachable = back;
    this.socket?.close(reason);
  },
};

const every = (ms, does) => timed(does, ms, ms);
every(100, () => robot.now({}));
every(50, () => {
  if (robot.beats) robot.send({ key: "beat", value: { run: 1, boot_us: Math.round(now) } });
  const { mode, sender } = robot.state;
  const silent = now - robot.last > 250;
  if (mode === "driving" && sender === robot.hello.sender && silent) robot.now({ mode: "ready", source: "", sender: "" });
});

class Socket {
  static CONNECTING = 0;
  readyState = 0;
  opened = false;
  constructor() {
    setTimeout(() => {
      if (this.readyState === 3 || !robot.passes) return;
      if (!robot.reachable || robot.refusal) return this.close();
      Object.assign(this, { readyState: 1, opened: true });
      robot.socket = this;
      this.onopen();
      robot.send({ hello: robot.hello });
      robot.now({});
    }, 20);
  }
  get bufferedAmount() {
    return robot.buffered;
  }
  send(data) {
    robot.hear(JSON.parse(data));
  }
  close(reason = "") {
    if (this.readyState === 3) return;
    Object.assign(this, { readyState: 3, opened: false });
    setTimeout(() => this.onclose?.({ reason }), 5);
  }
}

const fetched = (path, how = {}) => new Promise((done, fail) => {
  robot.asked.push(path);
  how.signal?.addEventListener("abort", () => fail(new Error("aborted")));
  setTimeout(() => {
    if (!robot.reachable) return fail(new Error("unreachable"));
    const [status, body] = robot.http(path, how);
    done({ ok: status < 400, status, type: status === 303 ? "opaqueredirect" : "basic", json: async () => body });
  }, 20);
});

const globals = {
  window: globalThis, document, WebSocket: Socket, fetch: fetched,
  performance: { now: () => now },
  setTimeout: (does, ms = 0, ...more) => timed(() => does(...more), ms),
  setInterval: (does, ms) => timed(does, ms, ms),
  clearTimeout: (id) => timers.delete(id), clearInterval: (id) => timers.delete(id),
  addEventListener: (...how) => windows.addEventListener(...how),
  navigator: { wakeLock: { request: async () => ({ released: false, release() { this.released = true; } }) } },
  location: { href: "http://robot/", pathname: "/", hash: "", reload: () => robot.asked.push("reload") },
  history: { replaceState: () => (location.hash = "") },
  confirm: () => false,
  requestAnimationFrame: () => 0,
  ResizeObserver: class { observe() {} },
  matchMedia: () => new Target(),
  getComputedStyle: () => ({ getPropertyValue: () => "" }),
  devicePixelRatio: 1,
  Option: class extends Element { constructor(words) { super("option"); this.append(words); } },
};
for (const [name, value] of Object.entries(globals))
  Object.defineProperty(globalThis, name, { value, writable: true, configurable: true });
const epoch = Date.now() - now;
Date.now = () => epoch + now;

/** Open the page, with an invitation or without one, and with or without the script of STOP. */
export async function open({ token = "", stops = true } = {}) {
  if (token) location.hash = `#token=${token}`;
  if (stops) runInThisContext(readFileSync("stop.js", "utf8"), { filename: "stop.js" });
  let whole = false;
  const ended = (error) => { whole = error ?? true; };
  import("./main.js").then(() => ended(), ended);
  // Files take real time. The page waits for the answer to an invitation.
  while (!whole && !robot.asked.includes("token")) await yielded();
  await pass(300);
  if (stops && whole instanceof Error) throw whole;
  return whole;
}
