// The map: the path, the robot with the direction that it faces, and a grid with a scale in meters. Dragging moves the
// map, wheel and pinch zoom it, and after "Center map" it follows the robot again. The x axis points to the right, or
// after "Rotate map" the robot's front points up.

const MOST = 20000;
const WORDS = 24; // height of the text with the pose at the lower edge of the map, px

export class PathMap {
  #canvas;
  #pose = null;
  #truth = null;
  #trail = [];
  #zoom = 90; // pixels per meter
  #centre = [0, 0];
  #follow = true;
  #turns = false; // the robot's front is up
  #lost = false; // the robot may be somewhere else
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
    const way = last && !Number.isNaN(last[0]) ? Math.hypot(x - last[0], y - last[1]) : Infinity;
    if (way > 1) this.#cut(); // a jump: the pose was set
    if (way > 0.02 && !this.#lost) this.#trail.push([x, y]);
    if (this.#trail.length > MOST) this.#trail.splice(0, MOST / 10);
    this.redraw();
  }

  /** Interrupt the path and draw the robot in gray while the robot may move without feedback (`lost`). */
  lose(lost) {
    if (lost === this.#lost) return;
    this.#lost = lost;
    this.#cut();
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

  /** Switch whether the map turns with the robot. Returns whether it does from now on. */
  turn() {
    this.#turns = !this.#turns;
    this.redraw();
    return this.#turns;
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

  #cut() {
    if (this.#trail.length && !Number.isNaN(this.#trail.at(-1)[0])) this.#trail.push([NaN, NaN]);
  }

  #dragged(event) {
    const before = this.#fingers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    if (this.#fingers.size === 2) {
      const other = [...this.#fingers].find(([id]) => id !== event.pointerId)[1];
      const far = (finger) => Math.hypot(finger[0] - other[0], finger[1] - other[1]);
      if (far(before) > 10) this.zoom(far(now) / far(before));
    } else {
      this.#follow = false;
      const [x, y] = rotated(now[0] - before[0], before[1] - now[1], -this.#angle);
      this.#centre = [this.#centre[0] - x / this.#zoom, this.#centre[1] - y / this.#zoom];
      this.redraw();
    }
    this.#fingers.set(event.pointerId, now);
  }

  /** Rotation of the map, rad. */
  get #angle() {
    return this.#turns && this.#pose ? Math.PI / 2 - this.#pose.yaw : 0;
  }

  #draw() {
    const [paper, width, height] = sized(this.#canvas);
    if (!width) return;
    const look = colours();
    const angle = this.#angle;
    // The middle of the area between the buttons and the text with the pose.
    const tools = this.#canvas.nextElementSibling;
    const middle = (tools.offsetTop + tools.offsetHeight + height - WORDS) / 2;
    const at = (x, y) => {
      const [right, up] = rotated(x - this.#centre[0], y - this.#centre[1], angle);
      return [width / 2 + right * this.#zoom, middle - up * this.#zoom];
    };
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
      const [right, down] = at(...this.#truth);
      paper.arc(right, down, 5, 0, 7);
      paper.stroke();
      paper.fillStyle = look("--truth");
      paper.fillText("true place", right + 8, down + 16);
    }
    if (this.#pose) robot(paper, at(this.#pose.x, this.#pose.y), this.#pose.yaw + angle, Math.max(9, 0.2 * this.#zoom), look(this.#lost ? "--quiet" : "--accent"));
  }

  #grid(paper, width, height, look, at) {
    const step = [0.1, 0.5, 1, 5, 10, 50, 100].find((meters) => meters * this.#zoom >= 40) ?? 500;
    paper.strokeStyle = look("--line");
    paper.lineWidth = 1;
    paper.beginPath();
    const far = Math.hypot(width, height) / this.#zoom; // the lines reach every corner, m
    const [[left, right], [low, high]] = this.#centre.map((middle) => [middle - far, middle + far]);
    for (let n = Math.ceil(left / step); n * step <= right; n++) {
      paper.moveTo(...at(n * step, low));
      paper.lineTo(...at(n * step, high));
    }
    for (let n = Math.ceil(low / step); n * step <= high; n++) {
      paper.moveTo(...at(left, n * step));
      paper.lineTo(...at(right, n * step));
    }
    paper.stroke();
    scale(paper, height - 34, step, step * this.#zoom, look("--ink"));
  }
}

function rotated(x, y, angle) {
  const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
  return [x * cos - y * sin, x * sin + y * cos];
}

/** Draw a scale bar at the left, above the text with the pose: `metres` m are `wide` px long. */
function scale(paper, low, metres, wide, colour) {
  paper.strokeStyle = paper.fillStyle = colour;
  paper.lineWidth = 2;
  paper.beginPath();
  paper.moveTo(10, low - 6);
  paper.lineTo(10, low);
  paper.lineTo(10 + wide, low);
  paper.lineTo(10 + wide, low - 6);
  paper.stroke();
  paper.font = "12px system-ui, sans-serif";
  paper.fillText(`${metres} m`, 16, low - 5);
}

/** Draw the robot, and a dashed ray from its front in the direction that it faces. */
function robot(paper, [x, y], yaw, size, colour) {
  paper.save();
  paper.translate(x, y);
  paper.rotate(-yaw);
  paper.fillStyle = colour;
  paper.beginPath();
  paper.moveTo(size, 0);
  paper.lineTo(-size * 0.7, size * 0.7);
  paper.lineTo(-size * 0.35, 0);
  paper.lineTo(-size * 0.7, -size * 0.7);
  paper.closePath();
  paper.fill();
  paper.strokeStyle = colour;
  paper.lineWidth = 2;
  paper.setLineDash([6, 5]);
  paper.beginPath();
  paper.moveTo(size * 1.3, 0);
  paper.lineTo(size * 1.3 + 60, 0);
  paper.stroke();
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

/** Return a function that maps the name of a color to the page's present color, light or dark. */
export function colours() {
  const style = getComputedStyle(document.documentElement);
  return (name) => style.getPropertyValue(name).trim();
}
