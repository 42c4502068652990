// The page: one link, one drive control, and the views.

import { barred, invited, permit, refusal, request } from "./access.js";
import { Camera } from "./camera.js";
import { Drive, SOURCE } from "./drive.js";
import { boarded, driving, still, turning } from "./commander.js";
import { Link } from "./link.js";
import { PathMap } from "./map.js";
import { Minute } from "./plots.js";
import * as settings from "./settings.js";
import * as views from "./views.js";
import { RELEASE, figure, person, spot, yaw } from "./words.js";

const { $ } = views;
const { stopping } = window; // of stop.js, which has run before
if (!stopping) {
  views.text("alarm", "STOP does not work here, because a part of this page did not run. Reload the page.");
  throw new Error("stop.js did not run, and a page without STOP does not drive");
}
const VIEWS = ["drive", "status", "events", "set"];
const READ = 8000; // time after which a message disappears, ms
const KINDS = { stopped: "stop", fault: "fault", inactive: "inactive" }; // of the causes, by the mode
const ON = { activate: "the robot is already on" };
const both = (why) => ({ activate: why, deactivate: why });
/** Maps a mode to the buttons that would change nothing in it, with the reason. */
const NEEDLESS = {
  waiting: ON, driving: ON, ready: ON, inactive: { deactivate: "the robot is already off" },
  stopped: both("press Release STOP first"), fault: both("press Release fault first"),
};
/** Time, ms, for which the release button must show the same text before a press of it counts. A double click may take
 *  900 ms, and a held Enter key may click again after 1000 ms. */
const SETTLED = 1000;
const HASTY = "This button has just appeared or changed, or was pressed twice: read it, wait a second, then press it once.";
const ABSENT = "Nothing is received from the robot, so nothing can be changed now.";
const SOON = 300; // ms within which a STOP is answered over the WebSocket, unless the connection is dead but still open

const complain = notice((words) => {
  views.text("complaint", ""); // a screen reader announces a repeated message only if the text changes
  views.text("complaint", words);
});
const hint = notice((words) => {
  note = words;
  readied();
});
const link = new Link(refused, {
  hello: greeted,
  state: stated,
  odom: ({ value: { pose } }) => map.pose(pose.pose.position.x, pose.pose.position.y, yaw(pose.pose.orientation)),
  "sim/pose": ({ value: { pose } }) => map.truth(pose.position.x, pose.position.y),
  cmd_vel_out: commanded,
  wheel_states: ({ value, age }) => plots.rolled(performance.now() - age, value.velocity),
  diagnostics: ({ value }) => views.parts($("parts"), value),
  events: ({ value }) => views.happened($("happened"), value),
  path: ({ path }) => map.trail(path),
  refused: ({ reason }) => hint(reason),
  gone: ({ gone }) => (silent = gone),
  up: connected,
  down: disconnected,
});
const map = new PathMap($("map"));
const drive = new Drive(link, $("stick"), $("knob"), hint);
const camera = new Camera($("camera"));
const plots = new Minute();
let view = "drive";
let state = null;
let stateTime = -Infinity; // time at which `state` was true, by performance.now()
let hello = null;
let wished = null;
let tried = false; // a connection was attempted
let seen = false; // a state was received at some time
let silent = ""; // why the robot is silent, as reported by the page's server
let uninvited = ""; // why the invitation was rejected
let degrees = false; // turn rates are shown in degrees per second
let note = ""; // the message at the stick
let absent = true; // nothing has been received from the robot for a while
let offer = ""; // the mode and the numbers of the causes that the release button ends, "" while it is hidden
let settling = 0; // time at which `offer` changed or the release button was last clicked, by performance.now()
let down = null; // time at which a finger came down on the release button

/** Return whether this page has the view Settings. A user with the role viewer may not change any. */
function settable() {
  return !hello || !barred(hello, "activate");
}

function open(name) {
  view = name;
  for (const tab of VIEWS) {
    $(tab).hidden = tab !== view;
    $(`tab-${tab}`).setAttribute("aria-selected", String(tab === view));
    $(`tab-${tab}`).tabIndex = tab === view ? 0 : -1;
  }
  drive.shown = view === "drive";
  if (!drive.shown) drive.release();
  if (view === "status") link.subscribe("diagnostics", 1);
  else link.unsubscribe("diagnostics");
  if (view === "events") listed();
  if (view === "set") {
    views.text("set-answer", ""); // the note of an earlier button is outdated
    configured();
  }
  map.redraw();
}

async function asked(verb, payload) {
  return answered(await link.call(verb, payload));
}

/** Show the answer to a button, and return it: a failure in every view. */
function answered(answer) {
  complain(answer.ok ? "" : answer.text);
  views.text("set-answer", answer.ok ? answer.text : "");
  return answer;
}

/** Return a function that shows a message by `show` until the person has had time to read it. */
function notice(show) {
  let timer;
  return (words) => {
    clearTimeout(timer);
    show(words);
    if (words) timer = setTimeout(show, READ, "");
  };
}

/** Return the numbers of the shown causes that hold the robot in `mode`. */
function shown(mode) {
  return state.causes.filter(({ kind }) => kind === KINDS[mode]).map(({ number }) => number);
}

function released(verb, mode) {
  return asked(verb, { numbers: shown(mode) });
}

async function set(payload) {
  await asked("set", payload);
  configured();
}

async function listed() {
  const { error, body } = await request("api/recordings");
  views.recordings($("recordings"), error ? [] : body, barred(hello, "recordings"), error);
}

async function configured() {
  if (barred(hello, "set")) return;
  const { error, body } = await request("api/settings");
  if (error) complain(error);
  else settings.show($("settings"), body, set);
}

function limited() {
  drive.limit = Number($("limit").value);
  $("most").textContent = `${drive.limit.toFixed(2)} m/s · ${turning(drive.limit, drive.limits).toFixed(1)} rad/s`;
}

/** Return for how long a state counts as fresh, ms. This time grows with the interval between two states. */
function lasts() {
  return Math.max(500, 2500 / (hello?.state_rate || 10));
}

/** Return whether the state that this page shows is not fresh any more. */
function dated() {
  return Boolean(state) && performance.now() - stateTime > lasts();
}

function looked() {
  const old = link.open ? Math.max(performance.now() - stateTime, link.lag) : Infinity;
  const none = link.open ? "waiting" : tried ? "no connection" : "connecting";
  views.freshness(old, lasts(), link.way, none, seen, Boolean(state) && !boarded(state));
  if (link.open && (dated() || (silent && !state))) views.unheard(silent);
  if (old > 2 * lasts()) drive.release("Released: nothing is received from the robot.");
  offered();
  camera.look(performance.now());
  if (view === "status" && !document.hidden) plots.draw(performance.now());
}

/** Offer what would have an effect now, and say why the rest is gray. */
function offered() {
  permitted();
  releasable();
  readied();
}

/** Disable the controls that the robot would refuse to this client or that would change nothing, and all of them while
 *  nothing is received from the robot. */
function permitted() {
  const before = absent;
  absent = !state || performance.now() - stateTime > 2 * lasts();
  permit(hello, absent ? ABSENT : "", NEEDLESS[state?.code === "port_released" ? "" : state?.mode]);
  if (before && !absent && view === "set") configured();
}

/** Disable the stick while a push would not move the robot, and show the reason beside it. */
function readied() {
  const sender = hello?.sender;
  const fresh = link.beat && !absent; // without a beat to echo, no command counts
  drive.barred = link.open ? still(fresh ? state : null, SOURCE, sender) : "No connection.";
  $("stick").setAttribute("aria-disabled", String(!drive.allowed || Boolean(drive.barred)));
  const driver = driving(state, SOURCE, sender);
  const over = driver && `${driver} drives. Hold and push to take over. It drives on when you release: STOP ends that.`;
  const why = drive.barred || over || "Hold and push to drive; release to stop.";
  views.text("hint", note || (link.open && hello && !drive.allowed ? "You may watch and stop, but not drive." : why));
}

/** Show the button that ends the mode. While no new state confirms the mode, the button stays in place, disabled. If
 *  it disappeared, STOP would grow into its place under a finger. */
function releasable() {
  const offers = state && state.mode in RELEASE;
  $("clear").hidden = !offers;
  const before = offer;
  offer = offers ? `${state.mode} ${shown(state.mode)}` : "";
  if (offer !== before) settling = performance.now();
  if (dated()) $("clear").disabled = true;
}

/** Release the mode that the button named when the person's finger touched the button. The text of the button changes
 *  with the mode, and the button appears where STOP was. Without the wait of `SETTLED`, the second click of a double
 *  click would release a mode whose reason nobody has read. */
async function pressed(event) {
  // A click by a key has no pointerdown. If a finger slides off the button, its pointerdown stays in `down`.
  const since = ((event.detail && down) || event.timeStamp) - settling;
  down = null;
  if (!state || dated()) return;
  settling = performance.now();
  if (since < SETTLED) return answered({ ok: false, text: HASTY });
  const ended = state.mode;
  const press = stopping.over();
  const answer = await released(ended === "inactive" ? "activate" : "clear", ended);
  if (ended === "stopped" && answer.ok) stopping.released(press);
}

function stated({ value, age }) {
  // A state from long before this page opened says nothing about the present.
  if (!state && age > 2 * lasts()) return;
  if (state && state.mode !== value.mode) complain("");
  if (state?.mode !== value.mode && value.mode in RELEASE) hint("");
  seen = true;
  state = drive.state = value;
  stateTime = drive.stateTime = performance.now() - age;
  silent = "";
  views.banner(state, Boolean(hello?.barred.clear), hello?.sender);
  offered();
  map.lose(!boarded(state));
  const who = state.sender ? person(state.sender, hello?.sender) : state.source;
  views.text("who", state.mode !== "driving" || !state.source ? "nobody" : state.source === SOURCE ? who : `${who} (${state.source})`);
  views.text("where", spot(state.x, state.y, state.yaw));
  const { linear, angular } = state; // null without feedback from the board
  dialled();
  const late = state.latencies.period_lateness?.last_minute;
  plots.late.add(stateTime, late ? late.p99 / 1000 : null, late ? late.max / 1000 : null);
  plots.volts.add(stateTime, state.battery?.volts);
  plots.speed.add(stateTime, linear, null);
  plots.turn.add(stateTime, angular, null);
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

function greeted(message) {
  hello = message.hello;
  $("robot").textContent = hello.robot;
  // A viewer may do nothing in the settings.
  $("tab-set").hidden = !settable();
  if (view === "set" && !settable()) open("drive");
  $("simulated").hidden = !hello.simulated;
  $("role").textContent = hello.role;
  drive.sender = hello.sender;
  camera.show(hello.camera);
  drive.limits = hello.limits;
  drive.allowed = !barred(hello, "drive");
  if (drive.allowed) link.subscribe("beat", 20);
  $("limit").max = String(hello.limits.linear);
  limited();
  offered();
  if (uninvited) hint(uninvited); // an earlier token still gave access
  uninvited = "";
  if (hello.simulated) link.subscribe("sim/pose", 5);
}

/** Show why the robot rejects the connection. Returns true if another attempt is pointless. */
async function refused() {
  const { why, barred: uninvites } = await refusal();
  if (link.open) return false;
  if (uninvites) stopping.uninvited();
  if (why) views.lost(uninvites && uninvited ? uninvited : why);
  $("again").hidden = !uninvites;
  return uninvites;
}

/** Resolve to the answer to a STOP. `called` is its call over the WebSocket. If this call is not answered within
 *  `SOON`, the STOP is also sent by `post`. */
async function hedged(called, post) {
  const answer = await Promise.race([called, new Promise((done) => setTimeout(done, SOON))]);
  if (answer && !answer.lost) return answer;
  const answered = (call) => call.then((answer) => (answer.lost ? Promise.reject() : answer));
  const posted = post();
  return Promise.any([answered(called), answered(posted)]).catch(() => posted);
}

function commanded({ value: { twist }, age }) {
  wished = { linear: twist.linear.x, angular: twist.angular.z };
  plots.speed.add(performance.now() - age, null, wished.linear);
  plots.turn.add(performance.now() - age, null, wished.angular);
}

function connected() {
  tried = camera.connected = true;
  complain("");
  views.waiting();
}

function disconnected(reason) {
  drive.release(`Released: ${reason || "the connection is lost"}`);
  tried = true;
  camera.connected = false;
  stateTime = -Infinity;
  views.lost(reason || (state ? "This page connects again." : "")); // the text shown before is outdated
  state = drive.state = wished = null;
  for (const name of ["speed-command", "turn-command"]) views.text(name, "command –");
  offered();
}

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
const clicks = {
  clear: pressed,
  activate: () => released("activate", "inactive"),
  deactivate: () => asked("deactivate"),
  reset: () => asked("reset_odometry"),
  nearer: () => map.zoom(1.4),
  farther: () => map.zoom(1 / 1.4),
  recentre: () => map.recentre(),
  turns: () => $("turns").setAttribute("aria-pressed", String(map.turn())),
  erase: () => map.erase(),
  unit: converted,
  again: () => location.reload(),
};
for (const [id, does] of Object.entries(clicks)) $(id).addEventListener("click", does);
$("limit").addEventListener("input", limited);
// After a mouse or a finger has set the slider, the arrow keys drive again. If the user reached the slider by Tab, the
// arrow keys keep moving the slider.
for (const name of ["pointerup", "click", "change"])
  $("limit").addEventListener(name, ({ target }) => target.matches(":focus-visible") || target.blur());

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
stopping.after = () => {
  if (state?.mode === "fault") complain("STOP is latched, too: when Release fault has ended the fault, the mode is STOPPED.");
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
