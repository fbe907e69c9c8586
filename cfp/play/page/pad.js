// The pad on which a robot or a target is drawn.

const $ = (id) => document.getElementById(id);
const HINTS = {
  body: "The drawing is scaled to the area of the task's robot and takes its place.",
  target: "The drawing is scaled to the area of the robot and centred on it.",
};

export class Pad {
  constructor(use) {
    this.context = $("paper").getContext("2d", { willReadFrequently: true });
    this.ink = new OffscreenCanvas(256, 256).getContext("2d", { willReadFrequently: true });
    this.last = null;
    $("what").onchange = () => this.wipe();
    $("wipe").onclick = () => this.wipe();
    $("cancel").onclick = () => $("pad").close();
    $("use").onclick = () => { use(this.drawing()); $("pad").close(); scrollTo(0, 0); };
    $("paper").addEventListener("pointerdown", (event) => { $("paper").setPointerCapture(event.pointerId); this.stroke(event); });
    $("paper").addEventListener("pointermove", (event) => { if (event.buttons) this.stroke(event); });
    for (const name of ["pointerup", "pointercancel"]) $("paper").addEventListener(name, () => { this.last = null; });
  }

  setTask(task) {
    $("what").replaceChildren(...task.draws.map((kind) => new Option(kind === "body" ? "a robot" : "a target", kind)));
  }

  open() {
    this.wipe();
    $("pad").showModal();
  }

  wipe() {
    this.ink.clearRect(0, 0, 256, 256);
    $("hint").textContent = HINTS[$("what").value];
    this.show();
  }

  show() {
    this.context.fillStyle = "#14171a";
    this.context.fillRect(0, 0, 256, 256);
    this.context.drawImage(this.ink.canvas, 0, 0);
  }

  stroke(event) {
    const box = $("paper").getBoundingClientRect();
    const point = [(event.clientX - box.left) / box.width * 256, (event.clientY - box.top) / box.height * 256];
    this.ink.globalCompositeOperation = $("erase").checked ? "destination-out" : "source-over";
    Object.assign(this.ink, { lineWidth: 26, lineCap: "round", strokeStyle: "#f2efe6" });
    this.ink.beginPath();
    this.ink.moveTo(...(this.last ?? point));
    this.ink.lineTo(...point);
    this.ink.stroke();
    this.last = point;
    this.show();
  }

  drawing() {
    const { data } = this.ink.getImageData(0, 0, 256, 256);
    let bytes = "";
    for (let k = 3; k < data.length; k += 4) bytes += data[k] > 127 ? "\xff" : "\0";
    return { what: $("what").value, pixels: btoa(bytes) };
  }
}
