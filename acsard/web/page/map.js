// The map: path, robot, and a grid in metres. Dragging moves it, wheel and pinch zoom it, ◎ follows the robot
// again.

const MOST = 20000;

export class PathMap {
  #canvas;
  #pose = null;
  #truth = null;
  #trail = [];
  #zoom = 90; // pixels per metre
  #centre = [0, 0];
  #follow = true;
  #fingers = new Map();
  #asked = false;

  constructor(canvas) {
    this.#canvas = canvas;
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY / 400));
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.#fingers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => this.#dragged(event));
    for (const name of ["pointerup", "pointercancel"])
      canvas.addEventListener(name, (event) => this.#fingers.delete(event.pointerId));
    new ResizeObserver(() => this.redraw()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.redraw());
  }

  /** Set the path so far, [[x, y], …] in m. */
  trail(points) {
    this.#trail = points.slice(-MOST);
    this.redraw();
  }

  pose(x, y, yaw) {
    this.#pose = { x, y, yaw };
    if (this.#follow) this.#centre = [x, y];
    const last = this.#trail.at(-1);
    const way = last ? Math.hypot(x - last[0], y - last[1]) : Infinity;
    if (last && way > 1) this.#trail.push([NaN, NaN]); // a jump: the pose was set, so break the line
    if (way > 0.02) this.#trail.push([x, y]);
    if (this.#trail.length > MOST) this.#trail.splice(0, MOST / 10);
    this.redraw();
  }

  /** Set the true position of a simulated robot, m. */
  truth(x, y) {
    this.#truth = [x, y];
  }

  zoom(factor) {
    this.#zoom = Math.min(1000, Math.max(2, this.#zoom * factor));
    this.redraw();
  }

  recentre() {
    this.#follow = true;
    this.#zoom = 90;
    if (this.#pose) this.#centre = [this.#pose.x, this.#pose.y];
    this.redraw();
  }

  erase() {
    this.#trail = [];
    this.redraw();
  }

  redraw() {
    if (this.#asked) return;
    this.#asked = true;
    requestAnimationFrame(() => {
      this.#asked = false;
      this.#draw();
    });
  }

  #dragged(event) {
    const before = this.#fingers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    if (this.#fingers.size === 2) {
      const other = [...this.#fingers].find(([id]) => id !== event.pointerId)[1];
      const far = (one) => Math.hypot(one[0] - other[0], one[1] - other[1]);
      if (far(before) > 10) this.zoom(far(now) / far(before));
    } else {
      this.#follow = false;
      this.#centre[0] -= (now[0] - before[0]) / this.#zoom;
      this.#centre[1] += (now[1] - before[1]) / this.#zoom;
      this.redraw();
    }
    this.#fingers.set(event.pointerId, now);
  }

  #draw() {
    const [paper, width, height] = sized(this.#canvas);
    if (!width) return;
    const look = colours();
    const at = (x, y) => [width / 2 + (x - this.#centre[0]) * this.#zoom, height / 2 - (y - this.#centre[1]) * this.#zoom];
    this.#grid(paper, width, height, look, at);
    paper.strokeStyle = look("--accent");
    paper.lineWidth = 2;
    paper.beginPath();
    let lifted = true;
    for (const [x, y] of this.#trail) {
      if (Number.isNaN(x)) lifted = true;
      else {
        paper[lifted ? "moveTo" : "lineTo"](...at(x, y));
        lifted = false;
      }
    }
    paper.stroke();
    if (this.#truth) {
      paper.strokeStyle = look("--truth");
      paper.beginPath();
      paper.arc(...at(...this.#truth), 5, 0, 7);
      paper.stroke();
    }
    if (this.#pose) robot(paper, at(this.#pose.x, this.#pose.y), this.#pose.yaw, Math.max(9, 0.2 * this.#zoom), look);
  }

  #grid(paper, width, height, look, at) {
    const step = [0.1, 0.5, 1, 5, 10, 50, 100].find((one) => one * this.#zoom >= 40) ?? 500;
    paper.strokeStyle = look("--line");
    paper.lineWidth = 1;
    paper.beginPath();
    const [left, right] = [-1, 1].map((side) => this.#centre[0] + (side * width) / 2 / this.#zoom);
    const [low, high] = [-1, 1].map((side) => this.#centre[1] + (side * height) / 2 / this.#zoom);
    for (let n = Math.ceil(left / step); n * step <= right; n++) {
      const [x] = at(n * step, 0);
      paper.moveTo(x, 0);
      paper.lineTo(x, height);
    }
    for (let n = Math.ceil(low / step); n * step <= high; n++) {
      const [, y] = at(0, n * step);
      paper.moveTo(0, y);
      paper.lineTo(width, y);
    }
    paper.stroke();
    paper.fillStyle = look("--quiet");
    paper.font = "12px system-ui, sans-serif";
    paper.fillText(`grid ${step} m`, 10, 18);
  }
}

function robot(paper, [x, y], yaw, size, look) {
  paper.save();
  paper.translate(x, y);
  paper.rotate(-yaw);
  paper.fillStyle = look("--accent");
  paper.beginPath();
  paper.moveTo(size, 0);
  paper.lineTo(-size * 0.7, size * 0.7);
  paper.lineTo(-size * 0.35, 0);
  paper.lineTo(-size * 0.7, -size * 0.7);
  paper.closePath();
  paper.fill();
  paper.restore();
}

/** Return a cleared canvas in the screen's resolution: [context, width, height], in CSS pixels. */
export function sized(canvas) {
  const { clientWidth: width, clientHeight: height } = canvas;
  const sharp = devicePixelRatio || 1;
  if (canvas.width !== Math.round(width * sharp)) canvas.width = Math.round(width * sharp);
  if (canvas.height !== Math.round(height * sharp)) canvas.height = Math.round(height * sharp);
  const paper = canvas.getContext("2d");
  paper.setTransform(sharp, 0, 0, sharp, 0, 0);
  paper.clearRect(0, 0, width, height);
  return [paper, width, height];
}

/** Return a function that reads the page's present colours, light or dark. */
export function colours() {
  const style = getComputedStyle(document.documentElement);
  return (name) => style.getPropertyValue(name).trim();
}
