// The connection to the program: JSON both ways, binary frames from it.

const HEAD = { counters: 5, numbers: 8 };
const LOW = -0.5, SPAN = 2, HIDDEN = 65535;

export class Link {
  constructor(handlers) {
    this.handlers = handlers;
    this.layout = null;
    this.socket = new WebSocket(`ws://${location.host}/ws${location.search}`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = (event) => this.receive(event.data);
    this.socket.onclose = (event) => handlers.closed(event);
  }

  send(type, fields = {}) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ type, ...fields }));
  }

  receive(data) {
    if (data instanceof ArrayBuffer) return this.handlers.frame(decode(data, this.layout));
    const message = JSON.parse(data);
    if (message.type === "hello") this.layout = { count: message.bodies.reduce((n, body) => n + body.count, 0), flags: message.flags };
    if (message.type === "hello" || message.type === "layout") {
      const { resolution, gate, terms } = message;
      Object.assign(this.layout, { resolution, gate, terms });
    }
    this.handlers[message.type]?.(message);
  }
}

function decode(buffer, { count, flags, resolution, gate, terms }) {
  const [number, step, echo, bits, rows] = new Uint32Array(buffer, 0, HEAD.counters);
  let at = 4 * HEAD.counters;
  const take = (type, length) => {
    const array = new type(buffer, at, length);
    at += array.byteLength;
    return array;
  };
  const [originX, originY, x, y, cornerX, cornerY, total, rate] = take(Float32Array, HEAD.numbers);
  const frame = { number, step, echo, origin: [originX, originY], centre: [x, y], corner: [cornerX, cornerY], total, rate };
  flags.forEach((name, bit) => { frame[name] = Boolean(bits >> bit & 1); });
  const width = rows ? 1 + terms.length : 0;
  frame.rewards = Array.from({ length: rows }, () => take(Float32Array, width));
  frame.positions = take(Uint16Array, 2 * count);
  frame.colours = take(Uint8Array, count);
  frame.observation = take(Uint8Array, 3 * 64 * 64);
  frame.action = take(Int8Array, 2 * resolution ** 2);
  frame.gate = take(Uint8Array, 2 * gate ** 2);
  return frame;
}

// Where a coordinate that was sent lies in the world, m; NaN for a particle that is elsewhere.
export const world = (value, origin) => value === HIDDEN ? NaN : origin + LOW + value / (HIDDEN - 1) * SPAN;
