// The scene of a robot: ground with metres, obstacles, goal and target, and the particles. The page to play on serves
// this file, and the page of a replay holds it. Its colours are custom properties of the page's style.

export class Scene {
  // ``labels``: the ground has a number at every so many tenths of a metre.
  constructor(canvas, labels = 5) {
    Object.assign(this, { canvas, labels, context: canvas.getContext("2d"), discs: new Discs() });
    this.style = getComputedStyle(document.documentElement);  // follows changes
    new ResizeObserver(() => { this.resize(); this.redraw?.(); }).observe(canvas);
  }

  // ``task``: the bodies, the obstacles, ... as `Scene.as_json` of Python describes them.
  setTask(task) {
    this.task = task;
    this.floor = task.solids.find(([left, right, bottom]) => left === null && right === null && bottom === null)?.[3];
  }

  colour(name) { return this.style.getPropertyValue(`--${name}`).trim(); }

  resize() {
    const ratio = window.devicePixelRatio || 1, { clientWidth, clientHeight } = this.canvas;
    this.canvas.width = Math.max(1, Math.round(clientWidth * ratio));
    this.canvas.height = Math.max(1, Math.round(clientHeight * ratio));
    this.ratio = ratio;
  }

  // Look at a point of the world, in the middle of a picture of so many metres in height.
  look(x, y, height) {
    this.camera = { x, y, height };
    this.scale = this.canvas.height / height;
  }

  toPixel(x, y) {
    return [(x - this.camera.x) * this.scale + this.canvas.width / 2, (this.camera.y - y) * this.scale + this.canvas.height / 2];
  }

  // A moment: ``positions`` (x, y, x, y, ...) of the particles in the world, m, the ``codes`` from 0 to 254 of their
  // colours in the scale called ``by``, and the robot's ``centre``.
  draw({ positions, codes, centre }, by) {
    const { context, canvas, task } = this;
    context.fillStyle = this.colour("sky");
    context.fillRect(0, 0, canvas.width, canvas.height);
    this.drawMetres(false);
    this.drawTarget(centre);
    for (const solid of task.solids) this.drawSolid(solid);
    this.drawParticles(positions, codes, task.scales[by]);
    this.drawMetres(true);
    if (task.goal) this.drawGoal(task.goal);  // in the soil of DIG
  }

  drawMetres(labels) {
    const { context, canvas, ratio } = this;
    const surface = this.floor === undefined ? canvas.height : this.toPixel(0, this.floor)[1];
    const half = canvas.width / 2 / this.scale, left = this.camera.x - half, right = this.camera.x + half;
    context.font = `${11 * ratio}px system-ui, sans-serif`;
    context.textAlign = "center";
    for (let k = Math.ceil(left * 10); k <= right * 10; k++) {
      const [column] = this.toPixel(k / 10, 0), major = k % 5 === 0;
      if (!labels) {
        context.fillStyle = this.colour("grid");
        context.fillRect(Math.round(column), 0, (major ? 2 : 1) * ratio, surface);
        continue;
      }
      const inside = canvas.height - surface > 24 * ratio, top = inside ? surface : canvas.height - 22 * ratio;
      context.fillStyle = this.colour(inside ? "ground-text" : "faint");
      context.globalAlpha = 0.75;
      context.fillRect(Math.round(column), top, ratio, (major ? 8 : 4) * ratio);
      if (k % this.labels === 0) context.fillText(`${(k / 10).toFixed(1)} m`, column, top + 20 * ratio);
      context.globalAlpha = 1;
    }
  }

  drawSolid([left, right, bottom, top, filled]) {
    const { context, canvas, ratio } = this, far = 20 * ratio;
    const [x0, y0] = this.toPixel(left ?? -1e4, top ?? 1e4), [x1, y1] = this.toPixel(right ?? 1e4, bottom ?? -1e4);
    const clip = (value, high) => Math.min(Math.max(value, -far), high + far);
    const a = clip(x0, canvas.width), b = clip(y0, canvas.height), c = clip(x1, canvas.width), d = clip(y1, canvas.height);
    context.beginPath();
    context.roundRect(a, b, c - a, d - b, (left === null || right === null ? 0 : 3) * ratio);
    if (filled) {
      context.fillStyle = this.colour("ground");
      context.fill();
    } else {
      context.setLineDash([6 * ratio, 5 * ratio]);
      context.lineWidth = ratio;
      context.strokeStyle = this.colour("ground");
      context.stroke();
      context.setLineDash([]);
    }
  }

  drawGoal([x, y]) {
    const { context, ratio } = this, [column, row] = this.toPixel(x, y);
    for (const [radius, name] of [[0.018, "mark"], [0.011, "sky"], [0.005, "mark"]]) {
      context.beginPath();
      context.arc(column, row, Math.max(radius * this.scale, 3 * ratio), 0, 7);
      context.fillStyle = this.colour(name);
      context.fill();
    }
  }

  drawTarget([x, y]) {
    const { context } = this;
    context.beginPath();
    for (const outline of this.task.target) {
      outline.forEach(([dx, dy], k) => context[k ? "lineTo" : "moveTo"](...this.toPixel(x + dx, y + dy)));
      context.closePath();
    }
    context.fillStyle = this.colour("mark");
    context.fill("evenodd");
  }

  drawParticles(positions, codes, { robot_only, stops }) {
    const { task: { bodies }, canvas, discs, ratio } = this, shades = table(stops).map(packed);
    const outline = packed(this.colour("outline").match(/\w\w/g).map((digits) => parseInt(digits, 16)));
    discs.begin(canvas.width, canvas.height);
    let end = positions.length / 2;
    for (let index = bodies.length - 1; index >= 0; index--) {  // the robot last, on top
      const body = bodies[index], first = end - body.count, plain = robot_only && index > 0 && packed(body.colour);
      const radius = Math.max(body.radius * this.scale, 1.2 * ratio), passes = [[radius, plain]];
      if (body.count <= 3000) passes.unshift([radius + 1.3 * ratio, index && !robot_only ? packed(body.colour) : outline]);
      for (const [reach, shade] of passes) {
        for (let i = first; i < end; i++) {
          const [x, y] = this.toPixel(positions[2 * i], positions[2 * i + 1]);
          if (x > -reach && x < canvas.width + reach) discs.disc(x, y, reach, shade || shades[codes[i]]);
        }
      }
      end = first;
    }
    this.context.drawImage(discs.end(), 0, 0);
  }
}

// Discs drawn into an image by hand, which is several times faster than a canvas where there is no GPU.
class Discs {
  constructor() {
    this.canvas = new OffscreenCanvas(1, 1);
    this.context = this.canvas.getContext("2d");
  }

  begin(width, height) {
    if (this.image?.width !== width || this.image?.height !== height) {
      Object.assign(this.canvas, { width, height });
      this.image = this.context.createImageData(width, height);
      this.pixels = new Uint32Array(this.image.data.buffer);
    }
    this.pixels.fill(0);
  }

  // ``colour`` as from `packed`; its outer edge is smooth where nothing has been drawn before.
  disc(x, y, radius, colour) {
    const { pixels, image: { width, height } } = this;
    const bottom = Math.min(height - 1, Math.floor(y + radius));
    for (let row = Math.max(0, Math.ceil(y - radius)); row <= bottom; row++) {
      const half = Math.sqrt(radius * radius - (row - y) * (row - y)), base = row * width;
      const left = Math.max(x - half, 0), right = Math.min(x + half, width - 1);
      const from = Math.ceil(left), to = Math.floor(right);
      for (let k = base + from; k <= base + to; k++) pixels[k] = colour;
      if (from > 0 && from <= to) this.edge(base + from - 1, from - left, colour);
      if (to < width - 1 && from <= to) this.edge(base + to + 1, right - to, colour);
    }
  }

  edge(k, cover, colour) {
    const alpha = Math.round(255 * cover);
    if (this.pixels[k] >>> 24 < alpha) this.pixels[k] = (colour & 0xffffff | alpha << 24) >>> 0;
  }

  end() {
    this.context.putImageData(this.image, 0, 0);
    return this.canvas;
  }
}

// RGB from 0 to 255 as one number, as images keep it.
const packed = ([r, g, b]) => (255 << 24 | b << 16 | g << 8 | r) >>> 0;

// RGB at 255 places between stops at equal distances, for codes from 0 to 254.
export const table = (stops) => Array.from({ length: 255 }, (_, code) => {
  const place = code / 254 * (stops.length - 1), k = Math.min(Math.floor(place), stops.length - 2);
  return stops[k].map((from, i) => Math.round(from + (place - k) * (stops[k + 1][i] - from)));
});

// Show a scale of colours in three elements.
export function legend({ label, low, high, stops }, lowest, ramp, highest) {
  const ends = label.includes(" to ") ? label.split(" to ") : [low, `${high} ${label}`];
  [lowest.textContent, highest.textContent] = ends;
  ramp.style.background = `linear-gradient(to right, ${stops.map((stop) => `rgb(${stop})`)})`;
}
