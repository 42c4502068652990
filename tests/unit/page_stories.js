// What the page does and says, in a browser and with a robot that only pretend (`page_browser.js`).
// `node page_stories.js [WORDS]` plays the stories whose names contain these words, each in a browser of its own, and
// prints those that fail. It runs in a directory with the page's files.

import assert from "node:assert/strict";
import { isMainThread, Worker, workerData } from "node:worker_threads";
import { $, fire, grey, held, key, open, pads, pass, push, robot, stall, tap, text } from "./page_browser.js";

const stories = new Map();
const story = (name, play) => stories.set(name, play);
const says = (id, words) => assert.ok(text(id).includes(words), `${id} says ${JSON.stringify(text(id))}, not ${words}`);
const speeds = () => robot.sent.map(([, speed]) => speed);
const drives = () => robot.state.linear === 0 && robot.sent.at(-1)?.[1] > 0 && held();
const unanswered = () => new Promise(() => {});

/** Hold the stick forwards until the robot follows. */
async function hold() {
  push(0, 0, "pointerdown");
  push(0, 1);
  await pass(300);
  assert.ok(drives(), `${text("hint")} ${JSON.stringify(robot.sent)}`);
}

/** The stick is released, and the robot gets two zeros and then nothing. */
async function released(hint = "") {
  const before = robot.sent.length;
  await pass(500);
  assert.ok(!held());
  assert.equal(robot.sent.at(-1)[1], 0);
  assert.ok(speeds().slice(before).every((speed) => speed === 0));
  if (hint) says("hint", hint);
}

// The stick

const WAYS = {
  "a finger that is lifted": [() => push(0, 1, "pointerup"), ""],
  "a touch that the system takes": [() => push(0, 1, "pointercancel"), ""],
  "a second finger on the map": [() => fire($("map"), "pointerdown", { pointerId: 2 }), "use one finger"],
  "a second finger on the slider": [() => fire($("limit"), "pointerdown", { pointerId: 2 }), "use one finger"],
  "a second finger on the stick": [() => push(0, 1, "pointerdown", { pointerId: 2 }), "use one finger"],
  "a second mouse button": [() => push(0, 1, "pointermove", { buttons: 3 }), "another button is down"],
  "another view": [() => fire($("tab-status"), "click"), ""],
  "a window without the focus": [() => fire(window, "blur"), "lost the focus"],
  "a page that is left": [() => fire(window, "beforeunload"), "you left the page"],
  "a frozen page": [() => fire(document, "freeze"), ""],
  "a page that stood still": [() => stall(1200), "This page was suspended"],
  "STOP": [() => tap("stop"), "Press Release STOP first"],
  "a STOP without an answer": [() => ((stopping.send = unanswered), tap("stop")), ""],
  "a lost connection": [() => robot.lose("gone", true), "gone"],
  "a silent robot": [() => ((robot.talks = false), pass(1500)), "nothing is received"],
};
for (const [way, [act, hint]] of Object.entries(WAYS))
  story(`${way} releases the stick`, async () => {
    await open();
    await hold();
    await act();
    await pass(100);
    assert.ok(!held());
    if (hint) says("hint", hint);
    const before = robot.sent.length;
    push(0, 0.9); // the finger may still be down
    await pass(1000);
    assert.equal(robot.sent.length, before);
  });

story("the zero of a released stick is sent twice, also over a congested connection", async () => {
  await open();
  await hold();
  robot.buffered = 1e6;
  const before = robot.sent.length;
  push(0, 1, "pointerup");
  await pass(1000);
  const [[first, one], [second, two], ...more] = robot.sent.slice(before);
  assert.deepEqual([one, two, more], [0, 0, []]);
  assert.ok(second - first >= 50); // a daemon that reads late may drop a zero close behind a command
});

story("a hidden page sends its zero once, because its timers run late", async () => {
  await open();
  await hold();
  const before = robot.sent.length;
  document.hidden = true;
  fire(document, "visibilitychange");
  await pass(1000);
  assert.deepEqual(speeds().slice(before), [0]);
  says("hint", "the page was hidden");
});

story("a stick sends nothing while the robot is stopped or another page drives, and is grey", async () => {
  await open();
  robot.latch("stop");
  await pass(200);
  assert.ok(grey("stick"));
  push(0, 1, "pointerdown");
  assert.ok(!held());
  robot.clear();
  robot.now({ mode: "driving", source: "teleop", sender: "here/ffeeddccbbaa9988" });
  await pass(200);
  push(0, 1, "pointerdown");
  await pass(500);
  assert.ok(grey("stick") && !held());
  says("who", "another page on the robot itself");
  assert.deepEqual(robot.sent, []);
});

story("a finger that was held through a stop does not drive after its release", async () => {
  await open();
  await hold();
  robot.latch("stop");
  await pass(200);
  says("hint", "Stopped. Press Release STOP first.");
  robot.clear();
  const before = robot.sent.length;
  push(0, 0.8);
  await pass(500);
  assert.equal(robot.sent.length, before);
});

story("the screen stays on while the stick is held, and no longer", async () => {
  const locks = [], ask = navigator.wakeLock.request;
  navigator.wakeLock.request = async (kind) => (locks.push(await ask(kind)), locks.at(-1));
  await open();
  await hold();
  assert.deepEqual(locks.map(({ released }) => released), [false]);
  push(0, 1, "pointerup");
  await pass(10);
  assert.deepEqual(locks.map(({ released }) => released), [true]);
});

// Keys and gamepads

const LEFT = {
  "its release, at a field": () => ($("limit").focus(), key("keyup", "KeyW", $("limit"))),
  "its release, with a modifier": () => key("keyup", "KeyW", document.body, { ctrlKey: true }),
  "a modifier that may hide its release": () => key("keydown", "MetaLeft", document.body, { metaKey: true }),
  "a menu": () => fire(window, "contextmenu"),
  "something dragged": () => fire(document.body, "dragstart"),
};
for (const [way, act] of Object.entries(LEFT))
  story(`a key that drives is released by ${way}`, async () => {
    await open();
    key("keydown", "KeyW");
    await pass(300);
    assert.ok(drives());
    act();
    await released();
  });

story("a key that was pressed while the robot was stopped does not drive later", async () => {
  await open();
  robot.latch("stop");
  await pass(200);
  key("keydown", "KeyW"); // its release may never be reported
  robot.clear();
  key("keydown", "KeyA");
  await pass(500);
  assert.ok(held());
  assert.ok(speeds().every((speed) => Math.abs(speed) < 0.02));
  key("keyup", "KeyA");
  await released();
});

const PADS = {
  "lost and back": [[[[0, false]], [[0, true]], [], [[0, true]]], [false, true, false, false]],
  "connected while held": [[[[0, true]], [[0, false]], [[0, true]]], [false, false, true]],
  "another is lost": [[[[0, false], [1, true]], [[1, true]]], [false, false]],
  "another took its place": [
    [[[0, false], [1, false]], [[0, true], [1, true]], [[1, true]], [[1, false]], [[1, true]]],
    [false, true, false, false, true],
  ],
  "unknown to the browser": [[[[0, true, ""]]], [false]],
};
for (const [way, [all, holds]] of Object.entries(PADS))
  story(`a gamepad drives only after a press that begins while it is connected: ${way}`, async () => {
    await open();
    const seen = [];
    for (const connected of all) {
      pads(...connected);
      await pass(300);
      seen.push(held());
    }
    assert.deepEqual(seen, holds);
    if (all[0][0][2] === "") says("hint", "This gamepad does not drive");
  });

story("a gamepad that disconnects with its last values releases the stick", async () => {
  await open();
  pads([0, false]);
  await pass(100);
  pads([0, true]);
  await pass(300);
  assert.ok(drives());
  fire(window, "gamepaddisconnected");
  await released("the gamepad is disconnected");
  pads([0, false]);
  await pass(100);
  fire(window, "gamepaddisconnected");
  pads([0, true]); // it is back before the next look, with its button held
  await pass(300);
  assert.ok(!held());
});

// STOP and its release

story("a page releases only a stop that it shows now", async () => {
  await open();
  robot.latch("stop");
  await pass(200);
  assert.ok(!$("clear").hidden && !grey("clear"));
  robot.lose();
  await pass(500);
  says("mode", "NO CONNECTION");
  assert.ok($("clear").hidden && grey("activate"));
  assert.equal(text("speed"), "–");
  says("doubt", "STOP may not reach the robot from here");
  robot.latch("stop");
  robot.talks = false;
  robot.reachable = true;
  await pass(6000);
  robot.send({ gone: "nothing is received from the daemon" });
  await pass(500);
  says("mode", "NO DATA");
  fire($("clear"), "click", { detail: 0 });
  await pass(100);
  assert.ok($("clear").hidden && robot.state.mode === "stopped");
  robot.talks = true;
  await pass(1500);
  says("mode", "STOPPED");
  tap("clear");
  await pass(200);
  says("mode", "READY");
});

for (const first of ["the other stop", "this stop"])
  story(`a stop without an answer is sent again although another client has stopped the robot: ${first} first`, async () => {
    await open();
    let sent = 0;
    stopping.send = async () => (sent++, { ok: false, lost: true });
    if (first === "the other stop") robot.latch("stop");
    tap("stop");
    await pass(50);
    if (first === "this stop") robot.latch("stop");
    const before = sent;
    await pass(1000);
    assert.ok(sent > before + 2);
    says("alarm", "STOP is not confirmed");
    tap("clear");
    await pass(200);
    says("mode", "READY");
    assert.equal(text("alarm"), ""); // the operator has released the stop
  });

story("a stop is unconfirmed until the robot has answered one, whatever other buttons do", async () => {
  await open();
  const send = stopping.send;
  stopping.send = unanswered;
  tap("stop");
  stopping.over();
  says("alarm", "STOP was not confirmed");
  tap("reset");
  await pass(100);
  says("set-answer", "reset_odometry is done");
  robot.latch("stop");
  await pass(100);
  tap("clear");
  tap("clear");
  await pass(100);
  says("complaint", "pressed twice");
  robot.clear();
  await pass(100);
  says("mode", "READY");
  assert.equal(text("complaint"), "");
  robot.latch("inactive");
  await pass(1200);
  tap("clear");
  await pass(100);
  says("mode", "READY");
  says("alarm", "STOP was not confirmed");
  stopping.send = send;
  tap("stop");
  await pass(100);
  assert.equal(text("alarm"), "");
});

story("a connection that is open but dead delays a stop by 0.3 s, because it goes by HTTP too", async () => {
  await open();
  robot.passes = false;
  key("keydown", "Space", document.body);
  await pass(290);
  assert.equal(robot.state.mode, "ready");
  await pass(60);
  assert.equal(robot.state.mode, "stopped");
});

story("Space stops in each view and field, once", async () => {
  await open();
  for (const view of ["drive", "status", "events", "set"]) {
    tap(`tab-${view}`);
    assert.ok(key("keydown", "Space", $("limit")));
    key("keydown", "Space", $("limit"), { repeat: true });
    assert.ok(key("keyup", "Space", $("limit")));
    await pass(100);
    assert.equal(robot.state.mode, "stopped");
    assert.equal(robot.state.causes.length, 1);
    robot.clear();
    await pass(100);
  }
});

for (const pause of [0, 250, 900])
  story(`a double click with a pause of ${pause} ms releases only what the button said before`, async () => {
    await open();
    robot.latch("inactive");
    robot.latch("stop");
    await pass(1200);
    says("clear", "Release STOP");
    tap("clear");
    await pass(pause);
    tap("clear");
    await pass(500);
    says("clear", "Switch on");
    assert.equal(robot.state.mode, "inactive");
    await pass(1000);
    tap("clear");
    await pass(100);
    says("mode", "READY");
  });

story("a held Enter key releases only what the button said before", async () => {
  await open();
  robot.latch("inactive");
  robot.latch("stop");
  await pass(1200);
  for (let n = 0; n < 8; n++) {
    fire($("clear"), "click", { detail: 0 });
    await pass(200);
  }
  assert.equal(robot.state.mode, "inactive");
  await pass(1000);
  fire($("clear"), "click", { detail: 0 });
  await pass(100);
  says("mode", "READY");
});

story("a tap where STOP was does not release the stop that it made", async () => {
  await open();
  tap("stop");
  await pass(150);
  for (let n = 0; n < 4; n++) {
    tap("clear");
    await pass(400);
  }
  assert.equal(robot.state.mode, "stopped");
  says("complaint", "This button has just appeared or changed");
  await pass(9000);
  assert.equal(text("complaint"), "");
  tap("clear");
  await pass(100);
  says("mode", "READY");
});

story("a gap between two states greys the release, keeps it in place, and does not restart its second", async () => {
  await open();
  robot.latch("stop");
  await pass(1200);
  robot.talks = false;
  await pass(800);
  assert.ok(grey("clear") && !$("clear").hidden);
  says("clear", "Release STOP");
  tap("clear");
  robot.talks = true;
  await pass(200);
  tap("clear");
  await pass(100);
  says("mode", "READY");
  robot.latch("stop");
  await pass(1200);
  robot.talks = false;
  await pass(600);
  robot.latch("stop"); // another one, which nobody has read
  robot.talks = true;
  await pass(200);
  tap("clear");
  await pass(100);
  says("complaint", "has just appeared or changed");
  assert.equal(robot.state.mode, "stopped");
});

story("a stop during a fault stays latched after it, and the page says so", async () => {
  await open();
  robot.latch("fault");
  await pass(100);
  tap("stop");
  await pass(100);
  says("complaint", "STOP is latched, too");
  says("hint", "Press Release fault first");
  await pass(1200);
  tap("clear");
  await pass(100);
  says("mode", "STOPPED");
  assert.equal(text("complaint"), "");
});

story("the buttons for on and off are offered where they change something", async () => {
  await open();
  const offered = () => ["activate", "deactivate"].map((id) => !grey(id));
  assert.deepEqual(offered(), [false, true]);
  tap("deactivate");
  await pass(200);
  says("mode", "INACTIVE");
  assert.deepEqual(offered(), [true, false]);
  robot.release(robot.state.causes.map(({ number }) => number));
  robot.now({ mode: "waiting", code: "port_released" });
  await pass(200);
  assert.deepEqual(offered(), [true, true], "activate opens a port that was lent");
  robot.now({ code: "" });
  robot.latch("stop");
  await pass(200);
  assert.deepEqual(offered(), [false, false]);
});

// A part of the page is missing or the browser is old

story("a page whose STOP does not run does not drive, and says so", async () => {
  const error = await open({ stops: false });
  assert.match(String(error), /a page without STOP does not drive/);
  says("alarm", "STOP does not work here");
  assert.ok(!document.documentElement.classList.contains("stops"));
  assert.ok(grey("stick"));
});

story("a browser of 2021, which has no AbortSignal.timeout, stops by HTTP", async () => {
  delete AbortSignal.timeout;
  robot.reachable = false;
  await open();
  robot.reachable = true;
  tap("stop");
  await pass(50);
  assert.equal(robot.state.mode, "stopped");
});

story("a page of which a file did not load says so and stops all the same", async () => {
  await open();
  // This is the page before its modules run.
  const parts = new Stopping(stopping.send, (words) => ($("alarm").textContent = words));
  parts.lacks();
  says("mode", "NOT LOADED");
  says("alarm", "did not load, so only STOP works here. Reload the page.");
  parts.press();
  await pass(100);
  says("alarm", "STOP: the robot has confirmed it");
});

// What is not known now

story("old values are grey until messages return", async () => {
  await open();
  await hold();
  robot.talks = false;
  await pass(800);
  says("mode", "NO DATA"); // the page cannot know whether it still drives
  assert.ok(document.body.classList.contains("stale"));
  robot.talks = true;
  push(0, 1, "pointerup");
  await pass(500);
  says("mode", "READY");
  assert.equal(text("doubt"), "");
  assert.ok(!document.body.classList.contains("stale"));
});

story("a page that is opened while the daemon is silent shows no old measurements", async () => {
  robot.ages = 60000;
  await open();
  robot.send({ gone: "nothing is received from the daemon" });
  await pass(500);
  says("reason", "nothing is received from the daemon");
  assert.deepEqual(["mode", "age", "speed", "turn", "who"].map(text), ["NO DATA", "waiting", "–", "–", "–"]);
  assert.ok(!document.body.classList.contains("stale") && grey("stick") && grey("reset"));
  robot.ages = 0;
  await pass(200);
  says("speed", "0.00 m/s");
});

story("a robot without its board says that nobody can stop the motors from here", async () => {
  await open();
  robot.now({ mode: "waiting", link: "down", linear: null, angular: null });
  await pass(200);
  says("mode", "NO BOARD");
  says("doubt", "Nobody can stop the motors from here");
  says("hint", "No board: nothing can drive.");
  assert.equal(text("speed"), "– m/s");
  assert.ok(document.body.classList.contains("boardless") && grey("stick"));
});

story("a pressed emergency stop or bumper and a low battery are shown with the remedy", async () => {
  await open();
  assert.deepEqual([$("estop").hidden, $("battery").hidden, $("volts").hidden], [true, true, true]);
  robot.now({ battery: { percent: 21, volts: 22.5, level: "warning" } });
  assert.deepEqual([text("battery"), $("volts").hidden], ["21 %", false]);
  says("doubt", "battery low");
  robot.now({ pose_doubt: "not_calibrated" });
  says("doubt", "battery low; not calibrated");
  robot.now({ pose_doubt: "later_doubt" });
  says("doubt", "later_doubt");
  robot.now({ pose_doubt: "" });
  robot.now({ emergency_stop: "pressed" });
  robot.latch("stop");
  await pass(100);
  assert.equal(text("estop"), "⬢ E-STOP");
  says("hint", "Emergency stop pressed: release it at the robot first.");
  robot.now({ emergency_stop: "released", bumpers: [false, true] });
  await pass(100);
  assert.ok($("estop").hidden);
  says("doubt", "bumper 2 pressed");
  says("hint", "Stopped. Press Release STOP first.");
});

story("the turn dial shows degrees on request", async () => {
  await open();
  robot.now({ angular: 1 });
  tap("unit");
  assert.equal(text("turn"), "57 °/s");
  tap("unit");
  assert.equal(text("turn"), "1.00 rad/s");
});

// Invitations and roles

const barred = (...verbs) => Object.fromEntries(verbs.map((verb) => [verb, "for operators; your role is viewer"]));

story("a viewer sees why each control is grey, and stops", async () => {
  const verbs = ["drive", "clear", "activate", "deactivate", "reset_odometry", "set", "recordings"];
  Object.assign(robot.hello, { role: "viewer", barred: barred(...verbs) });
  await open();
  const controls = document.querySelectorAll("[data-does]");
  assert.ok(controls.length >= 6);
  for (const control of controls) {
    assert.ok(control.disabled || control.attributes["aria-disabled"] === "true", control.id);
    assert.match(control.title, /your role is viewer/);
    const described = control.attributes["aria-describedby"].split(" ").map(text).join(" ");
    assert.match(described, /for operators; your role is viewer/);
  }
  says("hint", "You may watch and stop, but not drive");
  assert.ok($("tab-set").hidden);
  tap("tab-events");
  await pass(100);
  says("recordings", "the download is for operators");
  assert.equal($("recordings").querySelector("a"), null);
  tap("stop");
  await pass(100);
  says("reason", "an operator releases it");
  robot.clear();
  robot.latch("inactive");
  await pass(100);
  says("reason", "an operator switches it on");
});

story("an invitation outlives a network that fails, and stays in the address until it is answered", async () => {
  robot.reachable = false;
  await open({ token: "abc" });
  says("reason", "Your invitation has no answer yet");
  assert.equal(location.hash, "#token=abc");
  robot.reachable = true;
  await pass(2000);
  says("mode", "READY");
  assert.equal(location.hash, "");
});

for (const [what, token, times] of [["a wrong invitation", "x", 1], ["no token", "", 0]])
  story(`a page with ${what} says so and asks again only after a press`, async () => {
    robot.refusal = [401, "a token is missing"];
    const http = robot.http.bind(robot);
    robot.http = (path, how) => (path === "token" ? [401, { error: "no" }] : http(path, how));
    await open({ token });
    await pass(1000);
    const asked = [...robot.asked];
    assert.equal(asked.filter((path) => path === "token").length, times);
    says("reason", token ? "This invitation is not valid" : "a token is missing");
    await pass(20000);
    assert.deepEqual(robot.asked, asked);
    assert.ok(!document.documentElement.classList.contains("stops"));
    tap("stop");
    await pass(50);
    says("alarm", "STOP needs an invitation to this page");
    tap("again");
    assert.equal(robot.asked.at(-1), "reload");
  });

story("a page that is refused for a while says why and connects by itself afterwards", async () => {
  robot.refusal = [503, "8 connections with this token are open already"];
  await open();
  await pass(1000);
  says("reason", "8 connections with this token are open already");
  assert.ok($("again").hidden);
  robot.refusal = null;
  await pass(6000);
  says("mode", "READY");
});

story("a revoked token ends with the robot's reason, and a new link in the tab reloads the page", async () => {
  await open();
  robot.refusal = [401, "this token is not valid: ask for a new one"];
  robot.lose("your token was revoked");
  robot.reachable = true;
  await pass(2000);
  says("mode", "NO CONNECTION");
  says("reason", "this token is not valid");
  fire(window, "hashchange");
  assert.equal(robot.asked.at(-1), "reload");
});

for (const agrees of [false, true])
  story(`a link with fewer permissions is used only if the person ${agrees ? "agrees" : "agrees, and not here"}`, async () => {
    let asked = "";
    globalThis.confirm = (words) => ((asked = words), agrees);
    const tried = [];
    robot.http = (path, how) => {
      tried.push(JSON.parse(how.body).replace);
      return tried.at(-1) ? [303, {}] : [409, { error: "the link would sign it in as tv (viewer)" }];
    };
    await open({ token: "lesser" });
    await pass(500);
    assert.match(asked, /would sign it in as tv \(viewer\)\. Use the link anyway\?/);
    assert.deepEqual(tried, agrees ? [false, true] : [false]);
    assert.equal(location.hash, "");
    says("mode", "READY");
  });

story("after a reconnection the stick is grey until a beat of this connection arrives", async () => {
  await open();
  robot.beats = false;
  robot.lose("", true);
  await pass(2000);
  says("mode", "READY");
  assert.ok(grey("stick"));
  robot.beats = true;
  await pass(200);
  assert.ok(!grey("stick"));
});

story("a page that is left disconnects, and connects again when the person comes back", async () => {
  await open();
  fire(window, "pagehide");
  await pass(3000);
  assert.ok(!robot.socket.opened);
  fire(window, "pageshow", { persisted: true });
  await pass(200);
  assert.ok(robot.socket.opened);
  says("mode", "READY");
});

story("a connection on which nothing arrives is replaced after three seconds", async () => {
  await open();
  const first = robot.socket;
  robot.passes = false;
  await pass(4500);
  assert.ok(!first.opened);
  says("mode", "NO CONNECTION");
  robot.passes = true;
  await pass(8000);
  says("mode", "READY");
});

/** Play a story in a thread of its own, and return what failed. */
const played = (name) => new Promise((done) => {
  const worker = new Worker(new URL(import.meta.url), { workerData: name });
  const late = setTimeout(() => done("it does not end"), 20000);
  worker.on("error", (error) => done(error.stack ?? String(error)));
  worker.on("exit", (code) => (clearTimeout(late), done(code ? "it has ended itself" : "")));
});

if (isMainThread) {
  const names = [...stories.keys()].filter((name) => name.includes(process.argv[2] ?? ""));
  for (const name of names) {
    const failed = await played(name);
    if (failed) console.log(`${name}: ${failed}`);
  }
  console.log(`${names.length} stories`);
  process.exit();
}
await stories.get(workerData)();
process.exit();
