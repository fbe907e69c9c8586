// The world: floor with metres, obstacles, goal and target, and the particles.
import { Discs, packed, table } from "./discs.js";
import { world } from "./link.js";

export class Scene {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.zoom = 1;
    this.camera = null;
    this.discs = new Discs();
    const restyle = () => {
      this.style = getComputedStyle(document.documentElement);
      this.outline = this.colour("outline").match(/\w\w/g).map((digits) => parseInt(digits, 16));
    };
    restyle();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", restyle);
    new ResizeObserver(() => { this.resize(); this.redraw?.(); }).observe(canvas);
  }

  setTask(task) {
    this.task = task;
    this.floor = task.solids.find(([left, right, bottom]) => left === null && right === null && bottom === null)?.[3];
    const goal = task.goal ? [[...task.goal, ...task.goal]] : [];
    const solids = task.follow ? [] : task.solids.filter((solid) => solid[4] && !solid.includes(null));
    const boxes = [...task.boxes, ...goal, ...solids.map(([left, right, bottom, top]) => [left, bottom, right, top])];
    this.bounds = [0, 1, 2, 3].map((side) => Math[side < 2 ? "min" : "max"](...boxes.map((box) => box[side])));
    this.camera = null;
    this.zoom = 1;
  }

  colour(name) { return this.style.getPropertyValue(`--${name}`).trim(); }

  resize() {
    const ratio = window.devicePixelRatio || 1, { clientWidth, clientHeight } = this.canvas;
    this.canvas.width = Math.max(1, Math.round(clientWidth * ratio));
    this.canvas.height = Math.max(1, Math.round(clientHeight * ratio));
    this.ratio = ratio;
  }

  // Look at the whole scene where it has a fixed window, else at the robot.
  aim(frame) {
    const { task, bounds: [left, bottom, right, top], canvas } = this;
    const aspect = canvas.width / canvas.height;
    const width = task.follow ? 0.55 : right - left + 0.16, height = top - bottom + (task.follow ? 0.2 : 0.22);
    const span = Math.max(height, width / aspect, 0.46) / this.zoom;
    const target = task.follow || this.zoom > 1.01 ? frame.centre[0] + (task.follow ? 0.06 * aspect : 0) : (left + right) / 2;
    const level = task.follow ? Math.max(bottom + 0.36 * span, 0) : this.zoom > 1.01 ? frame.centre[1] : (bottom + top) / 2;
    const ease = this.camera ? 0.18 : 1, old = this.camera ?? { x: target, y: level, span };
    const mix = (a, b) => a + (b - a) * ease;
    this.camera = { x: mix(old.x, target), y: mix(old.y, level), span: mix(old.span, span) };
    this.scale = canvas.height / this.camera.span;
  }

  toPixel(x, y) {
    return [(x - this.camera.x) * this.scale + this.canvas.width / 2, (this.camera.y - y) * this.scale + this.canvas.height / 2];
  }

  toWorld(clientX, clientY) {
    const box = this.canvas.getBoundingClientRect();
    const x = (clientX - box.left) * this.ratio, y = (clientY - box.top) * this.ratio;
    return [(x - this.canvas.width / 2) / this.scale + this.camera.x, this.camera.y - (y - this.canvas.height / 2) / this.scale];
  }

  toClient(x, y) {
    const box = this.canvas.getBoundingClientRect(), [column, row] = this.toPixel(x, y);
    return [box.left + column / this.ratio, box.top + row / this.ratio];
  }

  draw(frame, ui) {
    if (!this.task || !this.ratio) return;
    this.aim(frame);
    const { context, canvas } = this;
    context.fillStyle = this.colour("sky");
    context.fillRect(0, 0, canvas.width, canvas.height);
    this.drawMetres(false);
    this.drawTarget(frame);
    if (this.task.goal) this.drawGoal(this.task.goal);
    for (const solid of this.task.solids) this.drawSolid(solid);
    this.drawMetres(true);
    this.drawParticles(frame, ui.colour);
    if (ui.brush) this.drawCells(frame);
    if (ui.pointer) this.drawPointer(ui);
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
      if (major) context.fillText(`${(k / 10).toFixed(1)} m`, column, top + 20 * ratio);
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

  drawTarget({ centre: [x, y] }) {
    const { context } = this;
    context.beginPath();
    for (const outline of this.task.target) {
      outline.forEach(([dx, dy], k) => context[k ? "lineTo" : "moveTo"](...this.toPixel(x + dx, y + dy)));
      context.closePath();
    }
    context.fillStyle = this.colour("mark");
    context.fill("evenodd");
  }

  drawParticles({ positions, colours, origin }, scale) {
    const { bodies } = this.task, { canvas, discs } = this, { robot_only, stops } = this.task.scales[scale];
    discs.begin(canvas.width, canvas.height);
    const shades = table(stops).map(packed);
    let end = bodies.reduce((sum, body) => sum + body.count, 0);
    for (let index = bodies.length - 1; index >= 0; index--) {  // the robot last, on top
      const body = bodies[index], first = end - body.count, plain = robot_only && index > 0 && packed(body.colour);
      const radius = Math.max(body.radius * this.scale, 1.2 * this.ratio);
      const outline = packed(index && !robot_only ? body.colour : this.outline), passes = [[radius, null]];
      if (body.count <= 3000) passes.unshift([radius + 1.3 * this.ratio, outline]);
      for (const [reach, shade] of passes) {
        for (let i = first; i < end; i++) {
          const [x, y] = this.toPixel(world(positions[2 * i], origin[0]), world(positions[2 * i + 1], origin[1]));
          if (x > -reach && x < canvas.width + reach) discs.disc(x, y, reach, shade ?? (plain || shades[colours[i]]));
        }
      }
      end = first;
    }
    this.context.drawImage(discs.end(), 0, 0);
  }

  drawCells({ corner: [x, y], action, resolution: size }) {
    const { context, ratio } = this, step = this.task.patch / size;
    const [left, top] = this.toPixel(x, y + this.task.patch), width = step * this.scale;
    context.strokeStyle = this.colour("faint");
    context.lineWidth = ratio;
    context.globalAlpha = size > 20 ? 0.25 : 0.5;
    context.beginPath();
    for (let k = 0; k <= size; k++) {
      context.moveTo(left + k * width, top); context.lineTo(left + k * width, top + size * width);
      context.moveTo(left, top + k * width); context.lineTo(left + size * width, top + k * width);
    }
    context.stroke();
    for (let k = 0; k < size * size; k++) {
      const value = (action[k] + action[size * size + k]) / 254;
      if (Math.abs(value) < 0.02) continue;
      context.globalAlpha = 0.35 * Math.abs(value);
      context.fillStyle = `rgb(${this.task.scales.muscle.stops.at(value > 0 ? -1 : 0)})`;
      context.fillRect(left + k % size * width, top + Math.floor(k / size) * width, width, width);
    }
    context.globalAlpha = 1;
  }

  drawPointer({ pointer: [x, y], tool }) {
    const { context, ratio } = this, [column, row] = this.toPixel(x, y), { reach } = this.task;
    context.beginPath();
    context.arc(column, row, (tool === "pull" ? reach.pull : reach.muscles) * this.scale, 0, 7);
    context.strokeStyle = this.colour(tool === "expand" ? "accent" : tool === "pull" ? "text" : "alert");
    context.lineWidth = 1.5 * ratio;
    context.stroke();
  }
}
