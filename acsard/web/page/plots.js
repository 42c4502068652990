// The plots of the last minute: lines over time, the scale at the left, the present at the right, and below each plot
// a legend with the present values. They shade the time before the first value.

import { colours, sized } from "./map.js";
import { $, made } from "./views.js";
import { signed } from "./words.js";

const SPAN = 60000;
const GAP = 2000; // a line is broken where its values are missing for longer, ms
const ROOM = 44;

// Dash pattern and offset of each line, px. With this drawing order, four lines on top of each other all stay
// visible.
const LOOKS = [[[], 0], [[12, 12], 0], [[4, 8], 0], [[5, 19], 5]];
const COMPARED = [{ name: "measured", colour: "--accent" }, { name: "commanded", colour: "--wished" }];
const wheels = (...names) => names.map((name, n) => ({ name, colour: `--w${n}` }));
const WHEELS = { 2: wheels("right", "left"), 4: wheels("front right", "front left", "rear left", "rear right") };
const VOLTS = [{ name: "voltage", colour: "--accent" }];
const LATE = [{ name: "99 %", colour: "--accent" }, { name: "maximum", colour: "--bad" }];

export class Minute {
  constructor() {
    const plot = (name, ...rest) => new Plot($(`plot-${name}`), ...rest);
    this.speed = plot("speed", COMPARED, { low: -0.1, high: 0.3 });
    this.turn = plot("turn", COMPARED, { low: -0.3, high: 0.3 });
    this.wheels = plot("wheels", [], { low: -1, high: 3 }); // its lines come with the first values
    this.late = plot("late", LATE, { low: 0, high: 1 });
    this.volts = plot("volts", VOLTS, { span: 1 });
  }

  /** Add the speeds of four wheels or two, measured at `now`, ms. */
  rolled(now, speeds) {
    if (!(speeds.length in WHEELS)) return;
    this.wheels.of(WHEELS[speeds.length]);
    this.wheels.add(now, ...speeds);
  }

  draw(now) {
    for (const plot of [this.speed, this.turn, this.wheels, this.late, this.volts]) plot.draw(now);
  }
}

/** Return [top, bottom, marks]: the upper and the lower end of a scale, and its marks as pairs [value, label]. */
function scaled(floor, values) {
  if (floor.span) {
    const [least, most] = values.length ? [Math.min(...values), Math.max(...values)] : [0, 0];
    const half = (Math.max(floor.span, most - least) / 2) * 1.08;
    const [top, bottom] = [(least + most) / 2 + half, (least + most) / 2 - half];
    return [top, bottom, [top, bottom].map((value) => [value, signed(value, 1)])];
  }
  const top = Math.max(floor.high, ...values) * 1.08;
  const bottom = Math.min(floor.low, ...values) * 1.08;
  const label = (value) => signed(value / 1.08, Math.abs(top) < 10 ? 2 : 0);
  return [top, bottom, (bottom < 0 ? [top, 0, bottom] : [top, bottom]).map((value) => [value, label(value)])];
}

class Plot {
  #canvas;
  #lines;
  #floor;
  #names;
  #legend = made("p", "legend");

  /** `lines` has an entry {name, colour} for each value of `add`. `floor` is the smallest range of the scale, {low,
   *  high}, or for values that are far from zero its smallest span around the values, {span}. */
  constructor(canvas, lines, floor) {
    this.#canvas = canvas;
    this.#floor = floor;
    canvas.after(this.#legend);
    this.of(lines);
  }

  /** Draw these lines from now on, if they are others. */
  of(lines) {
    if (lines === this.#names) return;
    this.#names = lines;
    this.#lines = lines.map((line) => ({ ...line, points: [], sample: made("canvas"), said: made("span") }));
    for (const { sample } of this.#lines) sample.setAttribute("aria-hidden", "true");
    this.#legend.replaceChildren(...this.#lines.map((line) => made("span", "", line.sample, line.said)));
  }

  /** Add one value per line at `now`, ms; null adds nothing to its line. */
  add(now, ...values) {
    values.forEach((value, n) => {
      if (value === null || value === undefined) return;
      const { points } = this.#lines[n];
      points.push([now, value]);
      while (points.length && points[0][0] < now - SPAN) points.shift();
    });
  }

  draw(now) {
    const [paper, width, height] = sized(this.#canvas);
    if (!width) return;
    const look = colours();
    const all = this.#lines.flatMap((line) => line.points.map((point) => point[1]));
    const [top, bottom, marks] = scaled(this.#floor, all);
    const x = (at) => ROOM + ((at - now + SPAN) / SPAN) * (width - ROOM - 6);
    const y = (value) => 8 + ((top - value) / (top - bottom)) * (height - 18);
    const first = Math.min(now, ...this.#lines.flatMap((line) => line.points.slice(0, 1).map((point) => point[0])));
    paper.fillStyle = look("--ground"); // shade the time before the first value
    if (first > now - SPAN) paper.fillRect(ROOM, 8, x(first) - ROOM, height - 18);
    paper.font = "12px system-ui, sans-serif";
    paper.fillStyle = look("--quiet");
    paper.strokeStyle = look("--line");
    paper.lineWidth = 1;
    for (const [value, mark] of marks) {
      paper.beginPath();
      paper.moveTo(ROOM, y(value));
      paper.lineTo(width - 6, y(value));
      paper.stroke();
      // Leave out a label that would overlap the label of zero.
      if (value && Math.abs(y(value) - y(0)) < 14) continue;
      paper.fillText(mark, 6, y(value) + 4);
    }
    this.#lines.forEach(({ name, colour, points, sample, said }, n) => {
      const last = points.at(-1);
      const words = `${name} ${last && now - last[0] <= GAP ? signed(last[1], 2) : "–"}`;
      if (said.textContent !== words) said.textContent = words;
      const [small, wide, high] = sized(sample);
      for (const context of [small, paper]) {
        context.strokeStyle = look(colour);
        context.lineWidth = 2;
        context.setLineDash(LOOKS[n][0]);
        context.lineDashOffset = LOOKS[n][1];
        context.beginPath();
      }
      small.moveTo(0, high / 2);
      small.lineTo(wide, high / 2);
      small.stroke();
      let before = -Infinity;
      for (const [at, value] of points) {
        if (at < now - SPAN) continue;
        paper[at - before > GAP ? "moveTo" : "lineTo"](x(at), y(value));
        before = at;
      }
      paper.stroke();
    });
    paper.setLineDash([]);
  }
}
