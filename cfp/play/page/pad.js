// The pad on which a robot or a target is drawn.

const $ = (id) => document.getElementById(id);
const BRUSH = 26, MOST_TRIES = 20;
const HINTS = {
  body: "The drawing is scaled to the area of the task's robot, whose outline is shown, and takes its place.",
  target: "The drawing is scaled to the area of the robot, whose outline is shown, and centred on it.",
};

export class Pad {
  // ``send`` sends a drawing; then `accept` or `refuse` is called.
  constructor(send) {
    this.send = send;
    this.context = $("paper").getContext("2d");
    this.ink = new OffscreenCanvas(256, 256).getContext("2d", { willReadFrequently: true });
    this.last = this.pointer = this.remedy = null;
    this.waiting = false;
    $("what").onchange = () => this.wipe();
    $("wipe").onclick = () => this.wipe();
    $("cancel").onclick = () => $("pad").close();
    $("use").onclick = () => this.use();
    $("thicken").onclick = () => this.mend(() => this.thicken());
    $("shrink").onclick = () => this.mend(() => { this.scale *= 0.93; });
    $("paper").addEventListener("pointerdown", (event) => { $("paper").setPointerCapture(event.pointerId); this.stroke(event); });
    $("paper").addEventListener("pointermove", (event) => this.stroke(event));
    for (const name of ["pointerup", "pointercancel"]) $("paper").addEventListener(name, () => { this.last = null; });
    $("paper").addEventListener("pointerleave", () => { this.pointer = null; this.show(); });
  }

  setTask(task) {
    this.outline = task.outline;
    $("what").replaceChildren(...task.draws.map((kind) => new Option(kind === "body" ? "a robot" : "a target", kind)));
    this.wipe();
  }

  wipe() {
    this.ink.clearRect(0, 0, 256, 256);
    this.tell(HINTS[$("what").value]);
    this.scale = 1;
    this.show();
  }

  tell(text, refused = false) {
    $("hint").textContent = text;
    $("hint").className = refused ? "error" : "";
    $("remedies").hidden = !refused || $("what").value !== "body";
  }

  show() {
    const { context, ink, pointer } = this;
    context.globalCompositeOperation = "source-over";
    context.fillStyle = "#14171a";
    context.fillRect(0, 0, 256, 256);
    context.drawImage(ink.canvas, 0, 0);
    context.globalCompositeOperation = "difference";  // seen on paper and ink
    context.beginPath();
    for (const line of this.outline) {
      line.forEach(([x, y], k) => context[k ? "lineTo" : "moveTo"](128 + x, 128 - y));
      context.closePath();
    }
    context.setLineDash([4, 4]);
    context.strokeStyle = "#999";
    context.stroke();
    if (!pointer) return;
    context.beginPath();
    context.arc(...pointer, BRUSH / 2, 0, 7);
    context.setLineDash([]);
    context.strokeStyle = "#ccc";
    context.stroke();
  }

  stroke(event) {
    const box = $("paper").getBoundingClientRect();
    this.pointer = [(event.clientX - box.left) / box.width * 256, (event.clientY - box.top) / box.height * 256];
    if (event.buttons) {
      this.ink.globalCompositeOperation = $("erase").checked ? "destination-out" : "source-over";
      Object.assign(this.ink, { lineWidth: BRUSH, lineCap: "round", strokeStyle: "#f2efe6" });
      this.ink.beginPath();
      this.ink.moveTo(...(this.last ?? this.pointer));
      this.ink.lineTo(...this.pointer);
      this.ink.stroke();
      this.last = this.pointer;
    }
    this.show();
  }

  use() {
    const { data } = this.ink.getImageData(0, 0, 256, 256);
    let bytes = "";
    for (let k = 3; k < data.length; k += 4) bytes += data[k] > 127 ? "\xff" : "\0";
    this.waiting = true;
    this.send({ what: $("what").value, pixels: btoa(bytes), scale: this.scale });
  }

  accept() {
    this.waiting = false;
    this.remedy = null;
    $("pad").close();
    scrollTo(0, 0);  // the robot is in sight again
  }

  refuse(message) {
    this.waiting = false;
    if (this.remedy?.tries > 0) return this.change();
    if (this.remedy) this.ink.putImageData(this.remedy.drawn, 0, 0);
    this.scale = 1;
    this.remedy = null;
    this.tell(message, true);
    this.show();
  }

  // Change the drawing little by little until it is accepted.
  mend(step) {
    this.remedy = { step, tries: MOST_TRIES, drawn: this.ink.getImageData(0, 0, 256, 256) };
    this.change();
  }

  change() {
    this.remedy.tries--;
    this.remedy.step();
    this.use();
  }

  thicken() {
    this.ink.globalCompositeOperation = "source-over";
    for (let k = 0; k < 8; k++) this.ink.drawImage(this.ink.canvas, 1.5 * Math.cos(k * Math.PI / 4), 1.5 * Math.sin(k * Math.PI / 4));
    this.show();
  }
}
