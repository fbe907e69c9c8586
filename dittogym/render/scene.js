// The scene of a robot: ground with metres, obstacles, goal and target, and the particles. The page to play on serves
// this file, and the page of a replay holds it. Its colours are custom properties of the page's style.

// As in `frame.py`: matter is drawn as one piece where nodes of the grid join its particles, in cells of a width, m. A
// browser has to draw many pictures a second, so they are wider here.
const BRIDGE = 3 / 128, CELL = 2.5e-3;

export class Scene {
  // ``labels``: the ground has a number at every so many tenths of a metre.
  constructor(canvas, labels = 5) {
    Object.assign(this, { canvas, labels, context: canvas.getContext("2d"), raster: new Raster() });
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
    const tenth = this.scale / 10, inside = canvas.height - surface > 24 * ratio;
    context.font = `${11 * ratio}px system-ui, sans-serif`;
    context.textAlign = "center";
    const first = Math.floor(left * 10), number = Math.floor(right * 10) - first;
    for (let n = 0; n <= number; n++) {  // very far away, a number and the next one may be equal
      const k = first + n;
      const column = Math.round(this.toPixel(k / 10, 0)[0]), next = Math.round(this.toPixel((k + 1) / 10, 0)[0]);
      context.fillStyle = this.colour("grid");
      if (!labels) {
        context.fillRect(column, 0, ratio, surface);
        context.globalAlpha = 0.3;
        if (Math.floor(k / 5) % 2) context.fillRect(column, 0, next - column, surface);
      } else if (k % 2 && inside) {  // every second tenth of a metre of the floor, so that motion along it shows
        context.fillStyle = "#fff";
        context.globalAlpha = 0.13;
        context.fillRect(column, surface, next - column, canvas.height - surface);
      }
      if (labels && k % this.labels === 0 && column > 18 * ratio && column < canvas.width - 18 * ratio) {
        context.fillStyle = this.colour(inside ? "ground-text" : "faint");
        context.globalAlpha = 0.8;
        context.fillText(`${(k / 10).toFixed(1)} m`, column, inside ? surface + 18 * ratio : canvas.height - 6 * ratio);
      }
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
    const { task: { bodies }, canvas, raster, ratio } = this, scale = table(stops);
    const outline = this.colour("outline").match(/\w\w/g).map((digits) => parseInt(digits, 16));
    raster.begin(canvas.width, canvas.height);
    let end = positions.length / 2;
    for (let index = bodies.length - 1; index >= 0; index--) {  // the robot last, on top
      const { count, radius, colour, grains } = bodies[index], first = end - count;
      const plain = robot_only && index > 0, shades = plain ? scale.map(() => colour) : scale;
      if (grains && index > 0) {
        for (const [size, share] of [[1.4, 0.5], [0.6, 1]]) {  // the second time smaller and darker
          const reach = Math.max(size * radius * this.scale, 1.2 * ratio);
          const paints = shades.map((shade) => packed(shade.map((value) => share * value + (1 - share) * 255)));
          for (let i = first; i < end; i++) {
            const [x, y] = this.toPixel(positions[2 * i], positions[2 * i + 1]);
            if (x > -reach && x < canvas.width + reach) raster.disc(x, y, reach, paints[Math.round(codes[i])]);
          }
        }
      } else {
        const line = index > 0 && !plain ? colour : outline;
        this.drawSurface({ positions, codes, first, end }, shades, radius, 1.3 * ratio, line);
      }
      end = first;
    }
    this.context.drawImage(raster.end(), 0, 0);
  }

  // A body with a smooth outline of some ``width`` in pixels: the closing of its particles by discs.
  drawSurface({ positions, codes, first, end }, shades, radius, width, outline) {
    const { camera, scale, canvas, raster } = this;
    const reach = Math.max(radius, BRIDGE / 2) / CELL, edge = radius / 2.5 / CELL;  // half a distance of particles
    const far = [canvas.width, canvas.height].map((pixels) => pixels / 2 / scale + 2 * reach * CELL);
    const xs = [], ys = [], values = [];  // of what can be seen, in cells
    for (let i = first; i < end; i++) {
      const x = positions[2 * i], y = positions[2 * i + 1];
      if (!(Math.abs(x - camera.x) < far[0] && Math.abs(y - camera.y) < far[1])) continue;  // also where it is not finite
      xs.push(x / CELL);
      ys.push(y / CELL);
      values.push(codes[i]);
    }
    if (!xs.length) return;
    const field = new Field(xs, ys, Math.ceil(reach) + 3), distance = field.distances(xs, ys);
    const near = Float32Array.from(field.nearest, (i) => values[i] ?? 0);
    field.blur(near);
    field.blur(near);
    // Below the surface, pixels: from the distance to the rim of the cells that the discs cover.
    const rim = field.rim(distance, reach), depth = field.distances(rim.xs, rim.ys);
    for (let k = 0; k < depth.length; k++) {
      const inside = distance[k] < reach ? depth[k] - rim.beyond[field.nearest[k]] : reach - distance[k];
      depth[k] = (inside - reach + edge) * CELL * scale;
    }
    const paints = shades.map(packed), step = 1 / scale / CELL;
    const x0 = ((0.5 - canvas.width / 2) / scale + camera.x) / CELL - field.left;
    const y0 = ((canvas.height / 2 - 0.5) / scale + camera.y) / CELL - field.bottom;
    const clip = (pixel, high) => Math.min(Math.max(Math.ceil(pixel), 0), high);
    const left = clip(-x0 / step, canvas.width), right = clip((field.columns - 1.001 - x0) / step, canvas.width);
    const top = clip((y0 - field.rows + 1.001) / step, canvas.height), bottom = clip(y0 / step, canvas.height);
    for (let row = top; row < bottom; row++) {
      const y = y0 - row * step, j = Math.floor(y), v = y - j;
      for (let column = left; column < right; column++) {
        const x = x0 + column * step, i = Math.floor(x), u = x - i, k = j * field.columns + i, above = k + field.columns;
        const mix = (of) => (1 - v) * ((1 - u) * of[k] + u * of[k + 1]) + v * ((1 - u) * of[above] + u * of[above + 1]);
        const pixels = mix(depth);
        if (!(pixels > -0.5)) continue;
        const code = Math.round(mix(near)), at = row * canvas.width + column;
        if (pixels > width + 0.5) {
          raster.pixels[at] = paints[code];
        } else {
          const line = 0.75 * Math.min(width + 0.5 - pixels, 1);
          const shade = shades[code].map((value, channel) => value + line * (outline[channel] - value));
          raster.cover(at, shade, Math.min(pixels + 0.5, 1));
        }
      }
    }
  }
}

// Cells around some points, in which distances are measured; points are given in units of their width.
class Field {
  constructor(xs, ys, border) {
    const lowest = (values) => Math.floor(values.reduce((low, value) => Math.min(low, value))) - border;
    const highest = (values) => Math.ceil(values.reduce((high, value) => Math.max(high, value))) + border;
    Object.assign(this, { left: lowest(xs), bottom: lowest(ys) });  // the middle of the first cell
    Object.assign(this, { columns: highest(xs) - this.left + 1, rows: highest(ys) - this.bottom + 1 });
    this.nearest = new Int32Array(this.columns * this.rows);
  }

  // From each cell to the nearest point, which is noted; cells pass on to their neighbours what they have found. Cells at
  // the border stay at infinity.
  distances(xs, ys) {
    const { nearest, columns, rows, left, bottom } = this, squares = new Float32Array(nearest.length).fill(Infinity);
    const square = (point, column, row) => (xs[point] - left - column) ** 2 + (ys[point] - bottom - row) ** 2;
    nearest.fill(-1);
    for (let i = 0; i < xs.length; i++) {
      const column = Math.round(xs[i]) - left, row = Math.round(ys[i]) - bottom;
      const k = row * columns + column, found = square(i, column, row);
      if (found < squares[k]) squares[k] = found, nearest[k] = i;
    }
    const update = (column, row, neighbours) => {
      const k = row * columns + column;
      for (let n = 0; n < neighbours.length; n++) {
        const point = nearest[k + neighbours[n]];
        if (point < 0) continue;
        const found = square(point, column, row);
        if (found < squares[k]) squares[k] = found, nearest[k] = point;
      }
    };
    for (const way of [1, -1]) {
      const before = -way * columns, along = [before - 1, before, before + 1, -1], back = [1];
      for (let row = way > 0 ? 1 : rows - 2; row > 0 && row < rows - 1; row += way) {
        for (let column = 1; column < columns - 1; column++) update(column, row, along);
        for (let column = columns - 2; column > 0; column--) update(column, row, back);
      }
    }
    return squares.map(Math.sqrt);
  }

  // The cells from ``reach`` on that touch nearer ones, and how far they lie beyond it.
  rim(distance, reach) {
    const { columns, rows } = this, found = { xs: [], ys: [], beyond: [] };
    for (let row = 1; row < rows - 1; row++) {
      for (let column = 1; column < columns - 1; column++) {
        const k = row * columns + column;
        const around = [k - 1, k + 1, k - columns, k + columns];
        if (distance[k] < reach || !around.some((other) => distance[other] < reach)) continue;
        found.xs.push(this.left + column);
        found.ys.push(this.bottom + row);
        found.beyond.push(distance[k] - reach);
      }
    }
    return found;
  }

  // Means over squares of 5 by 5 cells, in place.
  blur(values) {
    const { columns, rows } = this;
    for (const [count, step, lines, next] of [[columns, 1, rows, columns], [rows, columns, columns, 1]]) {
      const line = new Float32Array(count);
      for (let start = 0; start < lines * next; start += next) {
        for (let i = 0; i < count; i++) line[i] = values[start + i * step];
        for (let i = 2; i < count - 2; i++) {
          values[start + i * step] = (line[i - 2] + line[i - 1] + line[i] + line[i + 1] + line[i + 2]) / 5;
        }
      }
    }
  }
}

// Pixels written by hand, which is several times faster than a canvas where there is no GPU.
class Raster {
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

  // Paint a share of a pixel.
  cover(k, [red, green, blue], share) {
    const { data } = this.image, below = data[4 * k + 3] / 255 * (1 - share), alpha = share + below;
    data[4 * k] = (share * red + below * data[4 * k]) / alpha;
    data[4 * k + 1] = (share * green + below * data[4 * k + 1]) / alpha;
    data[4 * k + 2] = (share * blue + below * data[4 * k + 2]) / alpha;
    data[4 * k + 3] = 255 * alpha;
  }

  // ``colour`` as from `packed`.
  disc(x, y, radius, colour) {
    const { pixels, image: { width, height } } = this;
    const bottom = Math.min(height - 1, Math.floor(y + radius));
    for (let row = Math.max(0, Math.ceil(y - radius)); row <= bottom; row++) {
      const half = Math.sqrt(radius * radius - (row - y) * (row - y)), base = row * width;
      const from = Math.ceil(Math.max(x - half, 0)), to = Math.floor(Math.min(x + half, width - 1));
      for (let k = base + from; k <= base + to; k++) pixels[k] = colour;
    }
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
