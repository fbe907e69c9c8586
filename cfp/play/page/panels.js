// The pictures beside the robot: rewards, observation, action and gate.

const COLOURS = ["#26798c", "#de7a3c", "#7a5ea8", "#4c9a57", "#c2527f", "#9a7d2e", "#5b7fd1", "#888e94"];
const LONGEST = 6000;

export class Plot {
  constructor(canvas, list) {
    Object.assign(this, { canvas, list, rows: [], terms: [] });
  }

  reset() { this.rows = []; }

  setTerms(terms) {
    this.terms = terms;
    this.list.replaceChildren(...terms.map((name, k) => {
      const item = document.createElement("li"), dot = document.createElement("i"), text = document.createElement("span");
      dot.style.background = COLOURS[k % COLOURS.length];
      text.textContent = name.replaceAll("_", " ");
      text.title = text.textContent;
      item.append(dot, text, document.createElement("b"));
      return item;
    }));
  }

  add(rewards) {
    this.rows.push(...rewards);
    if (this.rows.length > LONGEST) this.rows.splice(0, 1000);
  }

  draw() {
    const ratio = devicePixelRatio || 1, { canvas, rows } = this, style = getComputedStyle(document.documentElement);
    canvas.width = canvas.clientWidth * ratio;
    canvas.height = canvas.clientHeight * ratio;
    const context = canvas.getContext("2d"), faint = style.getPropertyValue("--faint"), gap = 12 * ratio;
    const half = (canvas.height - gap) / 2;
    context.font = `${10 * ratio}px system-ui, sans-serif`;
    const last = rows.slice(-200);
    this.curve(context, [rows.map((row) => row[0])], 0, half, [style.getPropertyValue("--text")], "return", faint, ratio);
    const series = this.terms.map((_, k) => last.map((row) => row[k + 1]));
    this.curve(context, series, half + gap, half, COLOURS, `terms, last ${last.length || 200} steps`, faint, ratio);
    const now = rows.at(-1);
    [...this.list.children].forEach((item, k) => { item.lastChild.textContent = now ? now[k + 1].toFixed(2).replace(/^-0.00$/, "0.00") : ""; });
  }

  curve(context, series, top, height, colours, title, faint, ratio) {
    const width = context.canvas.width;
    let low = 0, high = 0;
    for (const values of series) for (const value of values) { if (value < low) low = value; if (value > high) high = value; }
    const head = 14 * ratio, span = high - low || 1;
    const y = (value) => top + height - (value - low) / span * (height - head - 2 * ratio) - ratio;
    context.fillStyle = faint;
    context.globalAlpha = 0.5;
    context.fillRect(0, y(0), width, ratio);
    context.globalAlpha = 1;
    context.fillText(title, 0, top + 10 * ratio);
    series.forEach((values, k) => {
      context.beginPath();
      const step = Math.max(1, Math.floor(values.length / width));
      for (let i = 0; i < values.length; i += step) context.lineTo(i / Math.max(values.length - 1, 1) * width, y(values[i]));
      context.strokeStyle = colours[k % colours.length];
      context.lineWidth = 1.5 * ratio;
      context.stroke();
    });
    const most = high > -low ? high : low, label = most.toLocaleString(undefined, { maximumFractionDigits: Math.abs(most) < 100 ? 1 : 0 });
    // Beside the end of the scale that it belongs to.
    const place = [width - context.measureText(label).width, most < 0 ? top + height - 3 * ratio : top + 10 * ratio];
    context.strokeStyle = getComputedStyle(document.documentElement).getPropertyValue("--card");
    context.lineWidth = 3 * ratio;
    context.strokeText(label, ...place);  // the curves end behind it
    context.fillStyle = faint;
    context.fillText(label, ...place);
  }
}

// Images of one channel each, in a row.
export class Images {
  constructor(parent, captions) {
    this.canvases = captions.map((caption) => {
      const figure = document.createElement("figure"), canvas = document.createElement("canvas"), text = document.createElement("figcaption");
      text.textContent = caption;
      figure.append(canvas, text);
      parent.append(figure);
      return canvas;
    });
  }

  // ``shade(value, channel)`` gives RGB from 0 to 255.
  draw(values, size, shade) {
    this.canvases.forEach((canvas, channel) => {
      if (canvas.width !== size) canvas.width = canvas.height = size;
      const context = canvas.getContext("2d"), image = context.createImageData(size, size);
      for (let k = 0; k < size * size; k++) {
        const [r, g, b] = shade(values[channel * size * size + k], channel);
        image.data.set([r, g, b, 255], 4 * k);
      }
      context.putImageData(image, 0, 0);
    });
  }
}
