// The scene with what one does to it: the camera that follows, the cells of the action, and the pointer.
import { Scene } from "./scene.js";

export class Stage extends Scene {
  setTask(task) {
    super.setTask(task);
    const goal = task.goal ? [[...task.goal, ...task.goal]] : [];
    const solids = task.follow ? [] : task.solids.filter((solid) => solid[4] && !solid.includes(null));
    const boxes = [...task.boxes, ...goal, ...solids.map(([left, right, bottom, top]) => [left, bottom, right, top])];
    this.bounds = [0, 1, 2, 3].map((side) => Math[side < 2 ? "min" : "max"](...boxes.map((box) => box[side])));
    this.camera = null;
    this.zoom = 1;
  }

  // Look at the whole scene where it has a fixed window, else at the robot.
  aim({ centre }) {
    const { task: { follow }, bounds: [left, bottom, right, top], canvas } = this;
    const aspect = canvas.width / canvas.height;
    const width = follow ? 0.55 : right - left + 0.16, height = top - bottom + (follow ? 0.2 : 0.22);
    const span = Math.max(height, width / aspect, 0.46) / this.zoom;
    const x = follow || this.zoom > 1.01 ? centre[0] + (follow ? 0.06 * aspect : 0) : (left + right) / 2;
    const y = follow ? Math.max(bottom + 0.36 * span, 0) : this.zoom > 1.01 ? centre[1] : (bottom + top) / 2;
    const old = this.camera ?? { x, y, height: span }, mix = (a, b) => a + (b - a) * 0.18;
    this.look(mix(old.x, x), mix(old.y, y), mix(old.height, span));
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

  show(frame, ui) {
    if (!this.task || !this.ratio) return;
    this.aim(frame);
    this.draw(frame, ui.colour);
    if (ui.brush) this.drawCells(frame);
    if (ui.pointer) this.drawPointer(ui);
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
