// One plot of the last minute: lines over time, the scale at the left, now at the right.

import { colours, sized } from "./map.js";

const SPAN = 60000;
const ROOM = 44;

export class Plot {
  #canvas;
  #lines;
  #floor;

  /** `lines`: [{name, colour}], as many as each `add` has values; `floor`: the least range. */
  constructor(canvas, lines, floor) {
    this.#canvas = canvas;
    this.#lines = lines.map((line) => ({ ...line, points: [] }));
    this.#floor = floor;
  }

  /** Values at `now`, ms; null leaves a line as it is. */
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
    const top = Math.max(this.#floor.high, ...all) * 1.08;
    const bottom = Math.min(this.#floor.low, ...all) * 1.08;
    const x = (at) => ROOM + ((at - now + SPAN) / SPAN) * (width - ROOM - 6);
    const y = (value) => 8 + ((top - value) / (top - bottom)) * (height - 26);
    paper.font = "11px system-ui, sans-serif";
    paper.fillStyle = look("--quiet");
    paper.strokeStyle = look("--line");
    paper.lineWidth = 1;
    for (const value of bottom < 0 ? [top, 0, bottom] : [top, bottom]) {
      paper.beginPath();
      paper.moveTo(ROOM, y(value));
      paper.lineTo(width - 6, y(value));
      paper.stroke();
      paper.fillText((value / (value ? 1.08 : 1)).toFixed(Math.abs(top) < 10 ? 2 : 0), 6, y(value) + 4);
    }
    let side = ROOM;
    for (const { name, colour, points } of this.#lines) {
      paper.strokeStyle = paper.fillStyle = look(colour);
      paper.fillText(name, side, height - 5);
      side += paper.measureText(name).width + 14;
      paper.lineWidth = 1.6;
      paper.beginPath();
      let before = -Infinity;
      for (const [at, value] of points) {
        if (at < now - SPAN) continue;
        paper[at - before > 2000 ? "moveTo" : "lineTo"](x(at), y(value));
        before = at;
      }
      paper.stroke();
    }
  }
}
