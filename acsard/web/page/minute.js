// The plots of the last minute. They begin with the data that the page's server has kept, and the page says
// which part is missing.

import { GAP, Plot, SPAN } from "./plot.js";

const COMPARED = [{ name: "measured", colour: "--accent" }, { name: "commanded", colour: "--wished" }];
const WHEELS = ["front right", "front left", "rear left", "rear right"].map((name, n) => ({ name, colour: `--w${n}` }));
const LATE = [{ name: "99 %", colour: "--accent" }, { name: "maximum", colour: "--bad" }];

export class Minute {
  #before = performance.now(); // nothing is known from before this time
  #wished = -Infinity; // the wished speeds have gaps before this time

  constructor() {
    const plot = (name, ...rest) => new Plot(document.getElementById(`plot-${name}`), ...rest);
    this.speed = plot("speed", COMPARED, { low: -0.1, high: 0.3 });
    this.turn = plot("turn", COMPARED, { low: -0.3, high: 0.3 });
    this.wheels = plot("wheels", WHEELS, { low: -1, high: 3 });
    this.late = plot("late", LATE, { low: 0, high: 1 });
  }

  /** Add the server's data: a column for each line, as long as `age` (ms before `now`). */
  begin(now, kept) {
    const times = kept.age.map((age) => now - age);
    this.speed.begin(times, kept.linear, kept.wished_linear);
    this.turn.begin(times, kept.angular, kept.wished_angular);
    this.wheels.begin(times, ...kept.wheels);
    this.late.begin(times, kept.late_p99, kept.late_max);
    const first = times[0] ?? now;
    this.#before = Math.min(this.#before, first < now - SPAN + GAP ? -Infinity : first);
    let known = first;
    times.forEach((at, row) => {
      if (kept.wished_linear[row] !== null) known = at;
      else if (at - known > GAP) this.#wished = at;
    });
  }

  draw(now) {
    for (const plot of [this.speed, this.turn, this.wheels, this.late]) plot.draw(now);
  }

  /** Return which part of the last minute is missing, in words, or "". */
  lacks(now) {
    const recent = now - SPAN + GAP;
    const clock = (at) => new Date(Date.now() - now + at).toLocaleTimeString();
    const said = [];
    if (this.#before > recent) said.push(`There is no data from before ${clock(this.#before)}.`);
    if (this.#wished > recent) said.push(`Commanded speeds from before ${clock(this.#wished)} are known only for times at which this page was open in a browser.`);
    return said.join(" ");
  }
}
