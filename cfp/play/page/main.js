// The page: what its controls send, and what is drawn of each frame.
import { Link } from "./link.js";
import { Pad } from "./pad.js";
import { Images, Plot } from "./panels.js";
import { legend, table } from "./scene.js";
import { Stage } from "./stage.js";

const $ = (id) => document.getElementById(id);
const scene = new Stage($("scene")), plot = new Plot($("plot"), $("terms"));
const observation = new Images($("observation"), ["occupancy", "velocity →", "velocity ↑"]);
const actions = new Images($("action"), ["horizontal", "vertical"]);
const gates = new Images($("action"), ["gate, hor.", "gate, vert."]);
const ui = { tool: "pull", colour: "deformation", pointer: null, brush: false, wave: null };
let task = null, frame = null, fresh = false, ids = 0, shades = null, policy = null, chosen = false, toldSlow = false;
const presses = new Map();
// For tests and the console: frames drawn, and milliseconds from the pointer to the frame that it has changed.
const stats = window.stats = { frames: 0, latencies: [], place: (x, y) => scene.toClient(x, y) };

const link = new Link({
  hello(message) {
    task = message;
    document.title = `${task.title} · dittogym`;
    $("task").textContent = task.title;
    $("speed").value = task.speed;
    ui.colour = task.colour;
    $("horizon").textContent = ` / ${task.horizon}`;
    scene.setTask(task);
    plot.setTerms(task.terms);
    shades = { muscle: table(task.scales.muscle.stops), grey: table([[250, 250, 248], [38, 70, 83]]), gate: table([[245, 245, 243], [122, 94, 168]]) };
    options($("policy"), [["", "off"], ...task.policies.map((name) => [name, name])], task.policy ?? "");
    options($("colour"), Object.keys(task.scales).map((name) => [name, name]), ui.colour);
    policy = task.policy ?? policy;
    if (pad.waiting) pad.accept();
    pad.setTask(task);
    $("back").disabled = !task.saved;
    showScale();
    if (!matterSet()) setMatter();
  },
  terms({ names }) { plot.setTerms(names); },
  policy(message) { $("policy").value = message.name ?? ""; policy = message.name ?? policy; task.reach = message.reach; },
  reset() { plot.reset(); },
  notice(message) { toast(message.message); },
  error({ message }) { pad.waiting ? pad.refuse(message) : toast(message, "error"); },
  file({ name, content }) {
    download(name, new Blob([Uint8Array.from(atob(content), (c) => c.charCodeAt(0))]));
    if (name.endsWith(".pt")) $("back").disabled = false;
  },
  frame(next) {
    plot.add(next.rewards);
    // There is nothing to see of a failed simulation: the picture stays that of the last frame before.
    if (next.invalid && frame) for (const name of ["centre", "corner", "positions", "codes"]) next[name] = frame[name];
    frame = next;
    fresh = true;
  },
  closed({ code }) {
    for (const dialog of document.querySelectorAll("dialog")) dialog.close();
    $("lost").hidden = false;
    $("lost").textContent = code === 1013 ? "Too many pages play at once. Close another one, then load this page again."
      : "The program has stopped, or this page is no longer known to it. Start it again and open the new address.";
  },
});
const pad = new Pad((fields) => link.send("draw", fields));

function show() {
  requestAnimationFrame(show);
  if (!frame || !fresh) return;
  fresh = false;
  stats.frames++;
  link.send("seen", { frame: frame.number });
  const start = performance.now();
  scene.show(frame, ui);
  stats.draw = 0.9 * (stats.draw ?? 0) + 0.1 * (performance.now() - start);
  if (presses.has(frame.echo)) {
    stats.latencies.push(performance.now() - presses.get(frame.echo));
    presses.clear();
  }
  $("return").textContent = frame.total.toFixed(1).replace(/^-0\.0$/, "0.0");
  $("step").textContent = frame.step;
  $("rate").textContent = frame.playing ? `${frame.rate.toFixed(2)} ×` : "paused";
  if (!toldSlow && frame.playing && frame.step > 100 && frame.rate < 0.7 * $("speed").value) {
    toldSlow = true;
    toast(`this machine simulates the task at ${frame.rate.toFixed(2)} × real time, slower than chosen`);
  }
  $("play").textContent = frame.playing ? "Pause" : "Play";
  verdict();
  if (stats.frames % 3 && frame.playing) return;  // pictures for people to read need no more than 20 a second
  plot.draw();
  observation.draw(frame.observation, 64, (value, channel) => (channel ? shades.muscle : shades.grey)[Math.round(value * 254 / 255)]);
  const size = frame.resolution, gate = Math.sqrt(frame.gate.length / 2);
  actions.draw(frame.action, size, (value) => shades.muscle[value + 127]);
  $("size").textContent = `2 × ${size} × ${size}`;
  for (const canvas of gates.canvases) canvas.parentElement.hidden = !gate;
  if (gate) gates.draw(frame.gate, gate, (value) => shades.gate[Math.min(value, 254)]);
}
requestAnimationFrame(show);
scene.redraw = () => { fresh = Boolean(frame); };

function verdict() {
  const over = frame.invalid ? "the simulation has failed: reset" : frame.terminated ? "episode over" : frame.truncated ? "horizon reached" : "";
  const text = frame.success ? (over ? `success · ${over}` : "success") : over;
  $("verdict").hidden = !text;
  $("verdict").textContent = text;
  $("verdict").className = frame.success ? "good" : "";
}

function options(select, entries, chosen) {
  select.replaceChildren(...entries.map(([value, text]) => new Option(text, value, false, value === chosen)));
}

function toast(text, kind = "") {
  const note = document.createElement("p");
  note.textContent = text;
  note.className = kind;
  $("toasts").append(note);
  while ($("toasts").children.length > 3) $("toasts").firstChild.remove();
  setTimeout(() => note.remove(), 7000);
}

function download(name, blob) {
  const anchor = document.createElement("a");
  anchor.href = URL.createObjectURL(blob);
  anchor.download = name;
  anchor.click();
  setTimeout(() => URL.revokeObjectURL(anchor.href), 1000);
}

function showScale() { legend(task.scales[ui.colour], $("low"), $("ramp"), $("high")); }

// Muscles that are driven by hand should be seen, unless something else was chosen.
function showMuscles() { if (!chosen && ui.colour !== "muscle") setColour("muscle"); }

function setColour(by) {
  ui.colour = $("colour").value = by;
  link.send("colour", { by });
  showScale();
}

function setTool(tool) {
  ui.tool = tool;
  ui.brush = tool === "brush";
  $("brush").hidden = !ui.brush;
  $("scene").dataset.tool = tool;
  for (const button of $("tools").children) {
    button.setAttribute("role", "radio");
    button.setAttribute("aria-checked", String(button.dataset.tool === tool));
  }
  scene.redraw();
}
setTool("pull");

// Dragging in the scene.
function hand(event) {
  ui.pointer = scene.toWorld(event.clientX, event.clientY);
  const [x, y] = ui.pointer;
  if (ui.tool !== "pull") showMuscles();
  if (ui.brush) return paintWorld(x, y);
  link.send("hand", { tool: ui.tool, x, y, id: ++ids });
  presses.set(ids, performance.now());
}

function paintWorld(x, y) {
  const size = frame.resolution, step = task.patch / size;
  const column = Math.floor((x - frame.corner[0]) / step), row = size - 1 - Math.floor((y - frame.corner[1]) / step);
  paint($("muscles").value, row, column, size);
}

function paint(muscles, row, column, size) {
  const reach = Math.max(0, Math.round(size / 32)), cells = [];
  for (let r = row - reach; r <= row + reach; r++)
    for (let c = column - reach; c <= column + reach; c++) if (r >= 0 && c >= 0 && r < size && c < size) cells.push([r, c]);
  if (cells.length) link.send("paint", { muscles, value: Number($("value").value), cells });
}

$("scene").addEventListener("pointerdown", (event) => {
  if (!frame || event.button) return;
  $("scene").setPointerCapture(event.pointerId);
  $("scene").classList.add("held");
  hand(event);
});
$("scene").addEventListener("pointermove", (event) => { if ($("scene").hasPointerCapture(event.pointerId)) hand(event); });
for (const name of ["pointerup", "pointercancel"])
  $("scene").addEventListener(name, () => {
    $("scene").classList.remove("held");
    ui.pointer = null;
    link.send("hand", { tool: null });
  });
$("scene").addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(-event.deltaY / 500)); }, { passive: false });

function zoom(factor) {
  scene.zoom = Math.min(Math.max(scene.zoom * factor, 0.5), 8);
  scene.redraw();
}

// Painting in the pictures of the action.
actions.canvases.forEach((canvas, channel) => {
  const stroke = (event) => {
    if (!event.buttons) return;
    const box = canvas.getBoundingClientRect(), size = canvas.width;
    paint(channel ? "vertical" : "horizontal", Math.floor((event.clientY - box.top) / box.height * size), Math.floor((event.clientX - box.left) / box.width * size), size);
    setTool("brush");
  };
  canvas.addEventListener("pointerdown", stroke);
  canvas.addEventListener("pointermove", stroke);
});

// Buttons and keys.
const wave = (direction) => {
  if (direction) showMuscles();
  ui.wave = direction;
  link.send("wave", { direction });
  for (const button of $("waves").children) button.classList.toggle("on", button.dataset.wave === direction);
};
for (const button of $("tools").children) button.onclick = () => setTool(button.dataset.tool);
for (const button of $("waves").children) {
  button.addEventListener("pointerdown", (event) => { button.setPointerCapture(event.pointerId); wave(button.dataset.wave); });
  for (const name of ["pointerup", "pointercancel"]) button.addEventListener(name, () => wave(null));
}
const toggle = () => link.send("play", { playing: !frame?.playing });
const setPolicy = (name) => { if (name) showMuscles(); link.send("policy", { name: name || null }); };
$("play").onclick = toggle;
$("once").onclick = () => link.send("step");
$("reset").onclick = () => link.send("reset");
$("clear").onclick = () => link.send("clear");
$("speed").onchange = () => link.send("speed", { factor: Number($("speed").value) });
$("policy").onchange = () => setPolicy($("policy").value);
$("colour").onchange = () => { chosen = true; setColour($("colour").value); };
$("moment").onclick = () => link.send("save", { what: "moment" });
$("actions").onclick = () => link.send("save", { what: "actions" });
$("replay").onclick = () => link.send("save", { what: "replay" });
$("back").onclick = () => link.send("back");
$("draw").onclick = () => {
  if (!task) return;
  pad.wipe();
  showDialog($("pad"));
};
$("help").onclick = () => showDialog($("about"));
$("close").onclick = () => $("about").close();

// Time stops while a dialog is open.
function showDialog(dialog) {
  const playing = frame?.playing ?? true;
  link.send("play", { playing: false });
  dialog.addEventListener("close", () => link.send("play", { playing }), { once: true });
  dialog.showModal();
}

const ARROWS = { ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down" };
const KEYS = {
  " ": toggle, ".": $("once").onclick, r: $("reset").onclick, p: () => setPolicy($("policy").value ? null : policy ?? task.policies[0]),
  c: () => { chosen = true; const names = Object.keys(task.scales); setColour(names[(names.indexOf(ui.colour) + 1) % names.length]); },
  "+": () => zoom(1.25), "-": () => zoom(0.8), 0: () => { scene.zoom = 1; scene.redraw(); },
  1: () => setTool("pull"), 2: () => setTool("contract"), 3: () => setTool("expand"), 4: () => setTool("brush"),
};
addEventListener("keydown", (event) => {
  if (!task || event.target.closest("input, select, dialog") || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === " " && event.target.closest("button")) return;
  const action = ARROWS[event.key] ? () => event.repeat || wave(ARROWS[event.key]) : KEYS[event.key.toLowerCase()];
  if (!action) return;
  event.preventDefault();
  action();
});
addEventListener("keyup", (event) => { if (ui.wave && ARROWS[event.key] === ui.wave) wave(null); });
addEventListener("blur", () => wave(null));

// Matter: factors are powers of two.
const factor = (id) => 2 ** Number($(id).value);
const matterSet = () => $("gravity").dataset.set;
function setMatter() {
  $("stiffness").value = $("yield").value = 0;
  const { gravity } = task.matter;
  Object.assign($("gravity"), { min: Math.min(-10, gravity), max: Math.max(30, gravity), value: gravity });
  $("gravity").dataset.set = true;
  tellMatter();
}
function tellMatter() {
  $("stiffness-out").textContent = `μ = ${Math.round(factor("stiffness") * task.matter.mu)} Pa`;
  $("yield-out").textContent = `${Math.round(factor("yield") * task.matter.yield_stress)} Pa`;
  $("gravity-out").textContent = `${Number(Number($("gravity").value).toFixed(2))} m/s²`;
}
function sendMatter() {
  tellMatter();
  link.send("matter", { stiffness: factor("stiffness"), yield_stress: factor("yield"), gravity: Number($("gravity").value) });
}
for (const id of ["stiffness", "yield", "gravity"]) $(id).oninput = sendMatter;
$("default").onclick = () => { setMatter(); sendMatter(); };

// A film of what is shown, by the browser.
let recorder = null;
$("film").onclick = () => {
  if (recorder) return recorder.stop();
  const kind = ["video/mp4;codecs=avc1", "video/webm;codecs=vp9", "video/webm"].find((type) => window.MediaRecorder?.isTypeSupported(type));
  if (!kind) return toast("this browser cannot record films", "error");
  const parts = [];
  recorder = new MediaRecorder($("scene").captureStream(60), { mimeType: kind, videoBitsPerSecond: 8e6 });
  recorder.ondataavailable = ({ data }) => parts.push(data);
  recorder.onstop = () => {
    download(`${task.task}.${kind.startsWith("video/mp4") ? "mp4" : "webm"}`, new Blob(parts, { type: kind }));
    recorder = null;
    $("film").textContent = "Film";
    $("film").classList.remove("on");
  };
  recorder.start();
  $("film").textContent = "Stop filming";
  $("film").classList.add("on");
};
