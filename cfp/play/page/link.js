// The connection to the program: JSON both ways, binary frames from it.

export class Link {
  constructor(handlers) {
    this.handlers = handlers;
    this.flags = [];
    const address = new URL(`ws${location.search}`, location.href);  // below the page's own, whatever is before it
    address.protocol = address.protocol.replace("http", "ws");
    this.socket = new WebSocket(address);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = (event) => this.receive(event.data);
    this.socket.onclose = (event) => handlers.closed(event);
  }

  send(type, fields = {}) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ type, ...fields }));
  }

  receive(data) {
    if (data instanceof ArrayBuffer) return this.handlers.frame(decode(data, this.flags));
    const message = JSON.parse(data);
    this.flags = message.flags ?? this.flags;
    this.handlers[message.type]?.(message);
  }
}

function decode(buffer, flags) {
  let at = 0;
  const take = (type, length) => {
    const array = new type(buffer, at, length);
    at += array.byteLength;
    return array;
  };
  const [number, step, echo, bits, rows, width, count, resolution, gate] = take(Uint32Array, 9);
  const [x, y, cornerX, cornerY, total, rate] = take(Float32Array, 6);
  const frame = { number, step, echo, resolution, centre: [x, y], corner: [cornerX, cornerY], total, rate };
  flags.forEach((name, bit) => { frame[name] = Boolean(bits >> bit & 1); });
  frame.rewards = Array.from({ length: rows }, () => take(Float32Array, width).slice());  // not a view, which would keep the frame
  frame.positions = take(Float32Array, 2 * count);
  frame.codes = take(Uint8Array, count);
  frame.observation = take(Uint8Array, 3 * 64 * 64);
  frame.action = take(Int8Array, 2 * resolution ** 2);
  frame.gate = take(Uint8Array, 2 * gate ** 2);
  return frame;
}
