// The page: one link, one drive control, and the views.

import { barred, hint, invited, permit, refusal } from "./access.js";
import { Camera } from "./camera.js";
import { Drive, SOURCE } from "./drive.js";
import { boarded, driving, objection, still } from "./commander.js";
import { Link } from "./link.js";
import { PathMap } from "./map.js";
import { Minute } from "./plots.js";
import { Recordings } from "./recordings.js";
import { Settings } from "./settings.js";
import * as views from "./views.js";
import { RELEASE, figure, person, spot, yaw } from "./words.js";

const $ = (id) => document.getElementById(id);
const { stopping } = window; // of stop.js, which has run before
if (!stopping) {
  $("alarm").hidden = false;
  views.text("alarm", "STOP does not work here, because a part of this page did not run. Reload the page.");
  throw new Error("stop.js did not run, and a page without STOP does not drive");
}
const VIEWS = ["drive", "status", "events", "set"];
const READ = 8000; // time that a person needs to read a message, ms
const LATCHED = ["stopped", "fault"];
const KINDS = { stopped: "stop", fault: "fault", inactive: "inactive" }; // of the causes, by the mode
const ON = { activate: "the robot is already on" };
/** Maps a mode to the button that would change nothing in it, with the reason. */
const NEEDLESS = { waiting: ON, driving: ON, ready: ON, inactive: { deactivate: "the robot is already off" } };
/** Time, ms, for which the release button must show the same text before a press of it counts. A double click may take
 *  900 ms, and a held Enter key may click again after 1000 ms. */
const SETTLED = 1000;
const HASTY = "this button has just appeared or changed, or was pressed twice: read it, wait a second, then press it once";
const DATED = "nothing is received from the robot, so this press did nothing: press again when this button is not gray";
const UNSHOWN = "nothing is received from the robot, so this page does not know what it would release";
const SOON = 300; // ms within which a STOP is answered over the WebSocket, unless the connection is dead but still open

const link = new Link(refused);
const map = new PathMap($("map"));
const drive = new Drive(link, $("stick"), $("knob"), told);
const camera = new Camera($("camera"));
const settings = new Settings($("settings"), set);
const recordings = new Recordings($("recordings"), $("no-recordings"));
const plots = new Minute();
let view = "drive";
let state = null;
let heard = -Infinity; // time at which `state` was true, by performance.now()
let hello = null;
let wished = null;
let tried = false; // a connection was attempted
let seen = false; // a state was received at some time
let silent = ""; // why the robot is silent, as reported by the page's server
let uninvited = ""; // why the invitation was rejected
let degrees = false; // turn rates are shown in degrees per second
let note = { why: "", at: 0 }; // the message at the stick and its time, by performance.now()
let complaint = { why: "", at: 0 }; // the message about a button and its time, by performance.now()
let offer = ""; // the mode and the numbers of the causes that the release button ends, "" while it is hidden
let settling = 0; // time at which `offer` changed or the release button was last clicked, by performance.now()
let down = null; // time at which a finger came down on the release button

/** Return whether this page has the view Settings. A user with the role viewer may not change any. */
function settable() {
  return !hello || !barred(hello, "activate");
}

function open(name) {
  view = name;
  for (const one of VIEWS) {
    $(one).hidden = one !== view;
    $(`tab-${one}`).setAttribute("aria-selected", String(one === view));
    $(`tab-${one}`).tabIndex = one === view ? 0 : -1;
  }
  drive.shown = view === "drive";
  if (!drive.shown) drive.release();
  if (view === "status") link.subscribe("diagnostics", 1);
  else link.unsubscribe("diagnostics");
  if (view === "events") listed();
  if (view === "set") {
    said({ ok: true, text: "" }); // the note of an earlier button is outdated
    configured();
  }
  map.redraw();
}

async function asked(verb, payload) {
  return answered(await link.call(verb, payload));
}

/** Show the answer to a button, and return it. */
function answered(told) {
  complain(told.ok ? "" : told.text);
  said(told.ok ? told : { ok: true, text: "" });
  return told;
}

/** Show in every view why a button failed, until `why` is "". */
function complain(why) {
  complaint = { why, at: performance.now() };
  views.complain(why);
}

/** Return the numbers of the causes that hold the robot in `mode` and that this page shows. */
function shown(mode) {
  return state.causes.filter(({ kind }) => kind === KINDS[mode]).map(({ number }) => number);
}

/** Call the service `verb` to release what holds the robot in `mode`. Without a state, the page shows no cause, and the
 *  call could release one that nobody has seen. */
function released(verb, mode) {
  if (state) return asked(verb, { numbers: shown(mode) });
  return answered({ ok: false, text: UNSHOWN });
}

async function set(payload) {
  said(await link.call("set", payload));
  configured();
}

/** Show the message `why` at the stick. A reason that the banner shows already is not repeated. */
function told(why) {
  note = { why, at: performance.now(), objects: Boolean(why) && why === objection(state, SOURCE, hello?.sender) };
  views.text("told", why && why === state?.reason ? "not driving: the reason is shown above" : why);
}

function said(told) {
  $("set-told").classList.toggle("error", !told.ok);
  views.text("set-told", told.text);
}

async function got(path) {
  try {
    const answer = await fetch(path, { signal: expiring(5000) });
    const told = await answer.json();
    return answer.ok ? told : { error: told.error ?? `${answer.status}` };
  } catch {
    return { error: "no answer from the robot" };
  }
}

async function listed() {
  const files = await got("api/recordings");
  recordings.show(files.error ? [] : files, barred(hello, "recordings"), files.error);
}

async function configured() {
  const why = barred(hello, "set");
  if (why) return views.text("set-told", `settings are ${why}`);
  const rows = await got("api/settings");
  if (rows.error) return views.text("set-told", rows.error);
  settings.show(rows);
}

function limited() {
  drive.limit = Number($("limit").value);
  $("most").textContent = `${drive.limit.toFixed(2)} m/s`;
}

/** Return for how long a state counts as fresh, ms. This time grows with the interval between two states. */
function lasts() {
  return Math.max(500, 2500 / (hello?.state_rate || 10));
}

/** Return whether the state that this page shows is not fresh any more. */
function dated() {
  return Boolean(state) && performance.now() - heard > lasts();
}

function looked() {
  const old = link.open ? Math.max(performance.now() - heard, link.lag) : Infinity;
  const none = link.open ? "waiting" : tried ? "no connection" : "connecting";
  views.freshness(old, lasts(), link.way, none, seen, Boolean(state) && !boarded(state));
  if (dated()) views.unheard(silent);
  releasable();
  readied();
  camera.look(performance.now());
  if (old > 2 * lasts()) drive.release("released: nothing is received from the robot");
  if (view !== "status" || document.hidden) return;
  plots.draw(performance.now());
  views.text("unknown", plots.lacks(performance.now()));
}

/** Remove the messages about a button or the stick that belong to the previous mode. */
function outdated() {
  complain("");
  if (note.why && (note.why === state.reason || LATCHED.includes(state.mode))) told("");
}

/** Remove the message about a button after the time `READ`. If it says that nothing is received, remove it as soon as
 *  the state is fresh. */
function expired() {
  if (!complaint.why) return;
  const untrue = [DATED, UNSHOWN].includes(complaint.why) && !dated();
  if (untrue || performance.now() - complaint.at > READ) complain("");
}

/** Remove the message at the stick after the time `READ`. If it says why the robot does not follow this page, remove it
 *  when this reason is gone instead. */
function forgotten() {
  if (!note.why || drive.held || drive.strange) return;
  const why = objection(state, SOURCE, hello?.sender);
  if (note.objects ? why !== note.why : performance.now() - note.at > READ) told("");
}

/** Disable the stick while a push would not move the robot, and show the reason beside it. */
function readied() {
  const fresh = link.beat && performance.now() - heard <= 2 * lasts(); // without a beat to echo, no command counts
  drive.barred = link.open ? still(fresh ? state : null, SOURCE, hello?.sender) : "No connection.";
  const off = !drive.allowed || Boolean(drive.barred);
  $("stick").setAttribute("aria-disabled", String(off));
  const driver = driving(state, SOURCE, hello?.sender);
  const over = driver && `${driver} drives. Hold and push to take over. It drives on when you release: STOP ends that.`;
  views.text("hint", ((drive.allowed || !link.open) && (drive.barred || over)) || hint(hello));
}

/** Show the button that ends the mode. While no new state confirms the mode, the button stays in place and does
 *  nothing. If the button disappeared, STOP would grow into its place under a finger. */
function releasable() {
  const offers = state && state.mode in RELEASE;
  $("clear").hidden = !offers;
  const before = offer;
  offer = offers ? `${state.mode} ${shown(state.mode)}` : "";
  if (offer !== before) settling = performance.now();
  $("clear").setAttribute("aria-disabled", String(dated()));
}

/** Release the mode that the button named when the person's finger touched the button. The text of the button changes
 *  with the mode, and the button appears where STOP was. Without the wait of `SETTLED`, the second click of a double
 *  click would release a mode whose reason nobody has read. */
async function pressed(event) {
  // A click by a key has no pointerdown. If a finger slides off the button, its pointerdown stays in `down`.
  const since = ((event.detail && down) || event.timeStamp) - settling;
  down = null;
  if (dated()) return answered({ ok: false, text: DATED });
  settling = performance.now();
  if (since < SETTLED) return answered({ ok: false, text: HASTY });
  const ended = state?.mode;
  const press = stopping.over();
  const told = await released(ended === "inactive" ? "activate" : "clear", ended);
  if (ended === "stopped" && told.ok) stopping.released(press);
}

function stated({ detail }) {
  // A state from long before this page opened says nothing about the present.
  if (!state && detail.age > 2 * lasts()) return;
  const other = state?.mode !== detail.value.mode;
  if (state && other) outdated();
  seen = true;
  state = drive.state = detail.value;
  if (other) permitted();
  heard = drive.heard = performance.now() - detail.age;
  silent = "";
  views.banner(state, Boolean(hello?.barred.clear), hello?.sender);
  releasable();
  readied();
  map.lose(!boarded(state));
  const who = state.sender ? person(state.sender, hello?.sender) : state.source;
  views.text("who", !state.source || state.mode !== "driving" ? "nobody" : state.source === SOURCE ? who : `${who} (${state.source})`);
  views.text("where", spot(state.x, state.y, state.yaw));
  const { linear, angular } = state; // null without feedback from the board
  dialled();
  expired();
  forgotten();
  const late = state.latencies.period_lateness?.last_minute;
  plots.late.add(heard, late ? late.p99 / 1000 : null, late ? late.max / 1000 : null);
  plots.volts.add(heard, state.battery?.volts);
  plots.speed.add(heard, linear, null);
  plots.turn.add(heard, angular, null);
  if (view !== "status") return;
  views.sources($("sources"), state, hello?.sender);
  views.counters($("counters"), state);
}

/** Show the measured speeds, and the commanded speeds, which are known even without feedback from the board. */
function dialled() {
  const [unit, times, decimals] = degrees ? ["°/s", 180 / Math.PI, 0] : ["rad/s", 1, 2];
  const shown = (value, by = 1) => (value === null || value === undefined ? null : value * by);
  views.text("speed", `${figure(state.linear, 2)} m/s`);
  views.text("speed-command", `command ${figure(wished?.linear, 2)}`);
  views.text("turn", `${figure(shown(state.angular, times), decimals)} ${unit}`);
  views.text("turn-command", `command ${figure(shown(wished?.angular, times), decimals)}`);
}

/** Show turn rates in the other unit. */
function converted() {
  degrees = !degrees;
  $("unit").title = `Show the turn in ${degrees ? "radians" : "degrees"} per second`;
  if (state) dialled();
}

function greeted({ detail }) {
  hello = detail.hello;
  $("robot").textContent = hello.robot;
  // A viewer may do nothing in the settings.
  $("tab-set").hidden = !settable();
  if (view === "set" && !settable()) open("drive");
  $("simulated").hidden = !hello.simulated;
  $("role").textContent = hello.role + (hello.unused && ` · version ${hello.unused} is installed, not in use`);
  drive.sender = hello.sender;
  camera.show(hello.camera);
  drive.limits = hello.limits;
  drive.allowed = !barred(hello, "drive");
  if (drive.allowed) link.subscribe("beat", 20);
  permitted();
  $("limit").max = String(hello.limits.linear);
  limited();
  readied();
  if (uninvited) views.text("told", uninvited); // an earlier token still gave access
  uninvited = "";
  if (hello.simulated) link.subscribe("sim/pose", 5);
}

/** Disable the controls that the robot would refuse to this client or that would change nothing. */
function permitted() {
  permit(hello, NEEDLESS[state?.mode]);
}

/** Show why the robot rejects the connection. Returns true if another attempt is pointless. */
async function refused() {
  const { why, shut, barred: uninvites } = await refusal();
  if (link.open) return false;
  if (uninvites) stopping.uninvited();
  if (why) views.lost(shut && uninvited ? uninvited : why);
  $("again").hidden = !shut;
  return shut;
}

/** Resolve to the answer to a STOP. `called` is its call over the WebSocket. If this call is not answered within
 *  `SOON`, the STOP is also sent by `post`. */
async function hedged(called, post) {
  const told = await Promise.race([called, new Promise((done) => setTimeout(done, SOON))]);
  if (told && !told.lost) return told;
  const answered = (one) => one.then((told) => (told.lost ? Promise.reject() : told));
  const posted = post();
  return Promise.any([answered(called), answered(posted)]).catch(() => posted);
}

link.addEventListener("hello", greeted);
link.addEventListener("key:state", stated);
link.addEventListener("key:odom", ({ detail: { value } }) => {
  const { position, orientation } = value.pose.pose;
  map.pose(position.x, position.y, yaw(orientation));
});
link.addEventListener("key:sim/pose", ({ detail: { value } }) => map.truth(value.pose.position.x, value.pose.position.y));
link.addEventListener("key:cmd_vel_out", ({ detail: { value, age } }) => {
  wished = { linear: value.twist.linear.x, angular: value.twist.angular.z };
  plots.speed.add(performance.now() - age, null, wished.linear);
  plots.turn.add(performance.now() - age, null, wished.angular);
});
link.addEventListener("key:wheel_states", ({ detail: { value, age } }) => plots.wheels.add(performance.now() - age, ...value.velocity));
link.addEventListener("key:diagnostics", ({ detail }) => views.parts($("parts"), detail.value));
link.addEventListener("key:events", ({ detail }) => views.happened($("happened"), detail.value));
link.addEventListener("path", ({ detail }) => map.trail(detail.path));
link.addEventListener("minute", ({ detail }) => plots.begin(performance.now(), detail.minute));
link.addEventListener("refused", ({ detail }) => {
  told((detail.refused === "cmd" && objection(state, SOURCE, hello?.sender)) || detail.reason);
});
link.addEventListener("gone", ({ detail }) => {
  silent = detail.gone;
  views.text("reason", silent);
});
link.addEventListener("up", () => {
  tried = camera.connected = true;
  complain("");
  views.waiting();
});
link.addEventListener("down", ({ detail }) => {
  drive.release(`released: ${detail.reason || "the connection is lost"}`);
  tried = true;
  camera.connected = false;
  heard = -Infinity;
  views.lost(detail.reason || (state ? "this page connects again" : "")); // the text shown before is outdated
  state = drive.state = wished = null;
  for (const name of ["speed-command", "turn-command"]) views.text(name, "command –");
  releasable();
  readied();
});

for (const name of VIEWS) $(`tab-${name}`).addEventListener("click", () => open(name));
document.querySelector("nav").addEventListener("keydown", (event) => {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (!step || view === "drive") return; // in this view the arrow keys drive
  const there = VIEWS.filter((name) => !$(`tab-${name}`).hidden);
  open(there[(there.indexOf(view) + step + there.length) % there.length]);
  $(`tab-${view}`).focus();
});
// The daemon refuses the release if a stop or a "deactivate" came after the state that this person sees.
$("clear").addEventListener("pointerdown", (event) => (down = event.timeStamp));
$("clear").addEventListener("click", pressed);
$("activate").addEventListener("click", () => released("activate", "inactive"));
$("deactivate").addEventListener("click", () => asked("deactivate"));
$("reset").addEventListener("click", () => asked("reset_odometry"));
$("nearer").addEventListener("click", () => map.zoom(1.4));
$("farther").addEventListener("click", () => map.zoom(1 / 1.4));
$("recentre").addEventListener("click", () => map.recentre());
$("turns").addEventListener("click", () => $("turns").setAttribute("aria-pressed", String(map.turn())));
$("erase").addEventListener("click", () => map.erase());
$("limit").addEventListener("input", limited);
$("unit").addEventListener("click", converted);
// After a mouse or a finger has set the slider, the arrow keys drive again. If the user reached the slider by Tab, the
// arrow keys keep moving the slider.
for (const name of ["pointerup", "click", "change"])
  $("limit").addEventListener(name, ({ target }) => target.matches(":focus-visible") || target.blur());
$("again").addEventListener("click", () => location.reload());

permit();
limited();
$("tab-set").hidden = !settable();
open("drive");
for (const [key, rate] of [["state", 10], ["odom", 20], ["cmd_vel_out", 10], ["wheel_states", 5], ["events", 5]])
  link.subscribe(key, rate);
setInterval(looked, 100);
// Refresh the list, because recordings grow and new ones begin while it is visible.
setInterval(() => view === "events" && !document.hidden && listed(), 5000);
const post = stopping.send;
stopping.send = () => (link.open ? hedged(link.call("stop"), post) : post());
stopping.after = (told) => {
  if (state?.mode === "fault") answered({ ok: false, text: "STOP is latched, too: when Release fault has ended the fault, the mode is STOPPED" });
};
stopping.before = () => {
  complain("");
  drive.release();
};
stopping.complete();
// Opening an invitation where this page is already open only changes the part behind the #, so reload.
addEventListener("hashchange", () => location.reload());
uninvited = await invited(views.lost);
link.start();
