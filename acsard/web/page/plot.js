// One plot of the last minute: lines over time, the scale at the left, the present at the right, and below it
// a legend with the present values.

import { colours, sized } from "./map.js";
import { made } from "./views.js";
import { signed } from "./words.js";

export const SPAN = 60000;
export const GAP = 2000; // a line is broken where its values are missing for longer, ms
const ROOM = 44;

// Dash pattern and offset of each line, px. With this drawing order, four lines on top of each other all stay
// visible.
const LOOKS = [[[], 0], [[12, 12], 0], [[4, 8], 0], [[5, 19], 5]];

export class Plot {
  #canvas;
  #lines;
  #floor;

  /** `lines`: [{name, colour}], one for each value of `add`; `floor`: the smallest range of the scale. */
  constructor(canvas, lines, floor) {
    this.#canvas = canvas;
    this.#lines = lines.map((line) => ({ ...line, points: [], sample: made("canvas"), said: made("span") }));
    this.#floor = floor;
    const legend = this.#lines.map((line) => made("span", "", line.sample, line.said));
    for (const { sample } of this.#lines) sample.setAttribute("aria-hidden", "true");
    canvas.after(made("p", "legend", ...legend));
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

  /** Insert earlier values and replace the points of the same time span: times in ms, and a column for each
   *  line with null where a value is unknown. */
  begin(times, ...columns) {
    if (!times.length) return;
    columns.forEach((column, n) => {
      const line = this.#lines[n];
      const before = line.points.filter(([at]) => at < times[0]);
      const after = line.points.filter(([at]) => at > times.at(-1));
      const known = times.map((at, row) => [at, column[row]]).filter(([, value]) => value !== null);
      line.points = [...before, ...known, ...after];
    });
  }

  draw(now) {
    const [paper, width, height] = sized(this.#canvas);
    if (!width) return;
    const look = colours();
    const all = this.#lines.flatMap((line) => line.points.map((point) => point[1]));
    const top = Math.max(this.#floor.high, ...all) * 1.08;
    const bottom = Math.min(this.#floor.low, ...all) * 1.08;
    const x = (at) => ROOM + ((at - now + SPAN) / SPAN) * (width - ROOM - 6);
    const y = (value) => 8 + ((top - value) / (top - bottom)) * (height - 18);
    const first = Math.min(now, ...this.#lines.flatMap((line) => line.points.slice(0, 1).map((point) => point[0])));
    paper.fillStyle = look("--ground"); // shade the time before the first value
    if (first > now - SPAN) paper.fillRect(ROOM, 8, x(first) - ROOM, height - 18);
    paper.font = "11px system-ui, sans-serif";
    paper.fillStyle = look("--quiet");
    paper.strokeStyle = look("--line");
    paper.lineWidth = 1;
    for (const value of bottom < 0 ? [top, 0, bottom] : [top, bottom]) {
      paper.beginPath();
      paper.moveTo(ROOM, y(value));
      paper.lineTo(width - 6, y(value));
      paper.stroke();
      // Leave out a label that would overlap the label of zero.
      if (value && Math.abs(y(value) - y(0)) < 14) continue;
      paper.fillText(signed(value / (value ? 1.08 : 1), Math.abs(top) < 10 ? 2 : 0), 6, y(value) + 4);
    }
    this.#lines.forEach(({ name, colour, points, sample, said }, n) => {
      const last = points.at(-1);
      const words = `${name} ${last && now - last[0] <= GAP ? signed(last[1], 2) : "–"}`;
      if (said.textContent !== words) said.textContent = words;
      const [small, wide, high] = sized(sample);
      for (const one of [small, paper]) {
        one.strokeStyle = look(colour);
        one.lineWidth = 2;
        one.setLineDash(LOOKS[n][0]);
        one.lineDashOffset = LOOKS[n][1];
        one.beginPath();
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
