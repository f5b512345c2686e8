"use strict";
// A map on a canvas: colours about zero, values under the pointer, profiles, histogram.

/** Reads the bytes of a map: the length of the head, the head, the values. */
function readMap(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  // A copy begins at a multiple of four bytes.
  return { ...head, values: new Float32Array(buffer.slice(4 + length)) };
}

const PAD = { left: 58, right: 84, top: 10, bottom: 40 };
const BINS = 60;
/** Least and largest height of a drawing, px. */
const HEIGHTS = [120, 460];

function number(value, digits = 4) {
  if (!Number.isFinite(value)) return "-";
  const size = Math.abs(value);
  return size !== 0 && (size < 1e-3 || size >= 1e6) ? value.toExponential(digits - 1) : String(+value.toPrecision(digits));
}

function ticks(low, high, most) {
  const raw = (high - low) / Math.max(most, 1), power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw);
  const all = [];
  for (let i = Math.ceil(low / step); i * step <= high; i++) all.push(+(i * step).toPrecision(12));
  return all;
}

function themeColour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
}

/** Red, green and blue at a fraction from 0 to 1 between stops written #rrggbb. */
function colourAt(stops, fraction) {
  const place = Math.min(1, Math.max(0, fraction)) * (stops.length - 1), i = Math.min(Math.floor(place), stops.length - 2);
  return [1, 3, 5].map((k) => {
    const [a, b] = [stops[i], stops[i + 1]].map((stop) => parseInt(stop.slice(k, k + 2), 16));
    return Math.round(a + (b - a) * (place - i));
  });
}

function begin(canvas, height) {
  const ratio = window.devicePixelRatio || 1;
  canvas.style.height = height + "px";
  canvas.width = Math.round(canvas.clientWidth * ratio);
  canvas.height = Math.round(height * ratio);
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.font = "12px system-ui, sans-serif";
  context.lineWidth = 1;
  return context;
}

/** Axes around a box, with ticks and labels. */
function axes(context, box, [x0, x1], [y0, y1], xLabel, yLabel) {
  context.strokeStyle = themeColour("line");
  context.fillStyle = themeColour("ink");
  context.strokeRect(box.x + 0.5, box.y + 0.5, box.width, box.height);
  context.textAlign = "center";
  for (const v of ticks(x0, x1, box.width / 70))
    context.fillText(number(v), box.x + ((v - x0) / (x1 - x0)) * box.width, box.y + box.height + 15);
  context.fillText(xLabel, box.x + box.width / 2, box.y + box.height + 32);
  context.textAlign = "right";
  for (const v of ticks(y0, y1, box.height / 35))
    context.fillText(number(v), box.x - 5, box.y + box.height - ((v - y0) / (y1 - y0)) * box.height + 4);
  context.save();
  context.translate(12, box.y + box.height / 2);
  context.rotate(-Math.PI / 2);
  context.textAlign = "center";
  context.fillText(yLabel, 0, 0);
  context.restore();
}

class MapView {
  constructor(root, colours) {
    this.root = root;
    this.colours = colours;
    const name = root.dataset.name;
    root.innerHTML = `<canvas tabindex="0" role="img"></canvas><p class="note" aria-live="polite"></p>
      <div class="tools"><label>Colours to <select><option value="1">the largest value</option><option value="0.99">99 % of the pixels</option>
      <option value="0.95">95 % of the pixels</option></select></label><button type="button">Save as PNG</button></div>
      <p class="note">The colours are symmetric about ${name === "tool" ? "0" : "the mean"}.</p><table><caption class="note">Statistics of the whole map</caption><tbody></tbody></table>
      <p class="doubt" hidden></p><canvas role="img"></canvas><canvas role="img"></canvas>`;
    root.hidden = true;
    [this.canvas, this.profiles, this.histogram] = root.querySelectorAll("canvas");
    this.canvas.setAttribute("aria-label", `Map of the ${name}; arrow keys move the point whose value is read`);
    this.profiles.setAttribute("aria-label", `Profiles of the ${name} through this point`);
    this.histogram.setAttribute("aria-label", `Histogram of the ${name}`);
    this.value = root.querySelector("p");
    this.clip = root.querySelector("select");
    this.clip.addEventListener("change", () => this.draw());
    root.querySelector("button").addEventListener("click", () => this.save(name));
    this.canvas.addEventListener("pointermove", (event) => {
      const place = this.canvas.getBoundingClientRect();
      this.moveTo(event.clientX - place.left, event.clientY - place.top);
    });
    this.canvas.addEventListener("keydown", (event) => this.step(event));
    new ResizeObserver(() => this.draw()).observe(root);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  show(map) {
    this.map = map;
    this.point = map.shape.map((n) => Math.floor(n / 2));
    const sizes = map.values.filter(Number.isFinite).map((value) => Math.abs(value - map.centre)).sort();
    this.reach = (part) => sizes[Math.max(0, Math.ceil(part * sizes.length) - 1)] || 1;
    const rows = [["size", map.pixels.join(" x ") + " pixels", ""], ["pitch", map.pitch_mm.map((v) => number(v)).join(" x "), "mm"],
      ...map.numbers.map(([name, value, unit]) => [name, number(value), unit])];
    this.root.querySelector("tbody").replaceChildren(...rows.map((row) => {
      const line = document.createElement("tr");
      line.append(...row.map((text, i) => Object.assign(document.createElement(i ? "td" : "th"), { textContent: text })));
      return line;
    }));
    const doubt = this.root.querySelector(".doubt");
    doubt.textContent = map.doubt;
    doubt.hidden = map.doubt === "";
    this.root.hidden = false;
    this.draw();
  }

  draw() {
    const { map, canvas } = this;
    if (!map || canvas.clientWidth === 0) return;
    const [x0, x1, y0, y1] = map.edges_mm, room = canvas.clientWidth - PAD.left - PAD.right;
    // Both axes have the same scale.
    const tall = Math.min(Math.max((room * (y1 - y0)) / (x1 - x0), HEIGHTS[0] / 4), HEIGHTS[1]);
    const width = Math.min(room, (tall * (x1 - x0)) / (y1 - y0)), height = (width * (y1 - y0)) / (x1 - x0);
    this.box = { x: PAD.left, y: PAD.top, width, height };
    const context = begin(canvas, Math.max(height, HEIGHTS[0]) + PAD.top + PAD.bottom);
    const most = this.reach(+this.clip.value);
    this.image(context, most);
    axes(context, this.box, [x0, x1], [y0, y1], "x, mm", "y, mm");
    this.bar(context, most);
    this.cross(context);
    this.drawProfiles(most);
    this.drawHistogram(most);
    this.read();
  }

  image(context, most) {
    const { map, box } = this, [nx, ny] = map.shape, picture = new ImageData(nx, ny);
    for (let row = 0; row < ny; row++)
      for (let column = 0; column < nx; column++) {
        const value = map.values[row * nx + column], k = 4 * ((ny - 1 - row) * nx + column);
        if (!Number.isFinite(value)) continue;
        picture.data.set([...colourAt(this.colours, 0.5 + (value - map.centre) / most / 2), 255], k);
      }
    const whole = Object.assign(document.createElement("canvas"), { width: nx, height: ny });
    whole.getContext("2d").putImageData(picture, 0, 0);
    context.imageSmoothingEnabled = false;
    context.drawImage(whole, box.x, box.y, box.width, box.height);
  }

  bar(context, most) {
    const { box } = this, x = box.x + box.width + 12, height = Math.max(box.height, HEIGHTS[0]);
    for (let i = 0; i < height; i++) {
      context.fillStyle = `rgb(${colourAt(this.colours, 1 - i / height)})`;
      context.fillRect(x, box.y + i, 12, 1.5);
    }
    context.fillStyle = themeColour("ink");
    context.textAlign = "left";
    for (const part of [1, 0, -1])
      context.fillText(number(this.map.centre + part * most, 3), x + 16, box.y + ((1 - part) / 2) * (height - 12) + 10);
    context.fillText(this.map.unit, x, box.y + height + 15);
  }

  /** Coordinates of the middle of a value, mm. */
  place([column, row]) {
    const [x0, x1, y0, y1] = this.map.edges_mm, [nx, ny] = this.map.shape;
    return [x0 + ((column + 0.5) / nx) * (x1 - x0), y0 + ((row + 0.5) / ny) * (y1 - y0)];
  }

  cross(context) {
    const { box, map, point } = this;
    const x = box.x + ((point[0] + 0.5) / map.shape[0]) * box.width, y = box.y + box.height - ((point[1] + 0.5) / map.shape[1]) * box.height;
    context.strokeStyle = "#000000";
    context.setLineDash([3, 3]);
    context.beginPath();
    context.moveTo(box.x, y);
    context.lineTo(box.x + box.width, y);
    context.moveTo(x, box.y);
    context.lineTo(x, box.y + box.height);
    context.stroke();
    context.setLineDash([]);
  }

  read() {
    const [x, y] = this.place(this.point), value = this.map.values[this.point[1] * this.map.shape[0] + this.point[0]];
    this.value.textContent = `x ${number(x)} mm, y ${number(y)} mm: ${Number.isFinite(value) ? number(value) + " " + this.map.unit : "invalid"}`;
  }

  moveTo(x, y) {
    if (!this.map) return;
    const { box, map } = this, fractions = [(x - box.x) / box.width, 1 - (y - box.y) / box.height];
    this.point = fractions.map((f, i) => Math.min(map.shape[i] - 1, Math.max(0, Math.floor(f * map.shape[i]))));
    this.draw();
  }

  step(event) {
    const move = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowDown: [0, -1], ArrowUp: [0, 1] }[event.key];
    if (!move || !this.map) return;
    event.preventDefault();
    this.point = this.point.map((p, i) => Math.min(this.map.shape[i] - 1, Math.max(0, p + move[i])));
    this.draw();
  }

  drawProfiles(most) {
    const { map, point } = this, [nx, ny] = map.shape, [x0, x1, y0, y1] = map.edges_mm;
    const context = begin(this.profiles, 190);
    const box = { x: PAD.left, y: PAD.top, width: this.profiles.clientWidth - PAD.left - 12, height: 190 - PAD.top - PAD.bottom };
    const lines = [["x", Array.from({ length: nx }, (_, i) => map.values[point[1] * nx + i]), x0, x1],
      ["y", Array.from({ length: ny }, (_, i) => map.values[i * nx + point[0]]), y0, y1]];
    const [low, high] = [Math.min(x0, y0), Math.max(x1, y1)];
    axes(context, box, [low, high], [map.centre - most, map.centre + most], "profiles along x (blue) and y (orange), mm", map.unit);
    for (const [name, values, from, to] of lines) {
      context.strokeStyle = themeColour(name);
      context.beginPath();
      let isDown = false;
      values.forEach((value, i) => {
        const mm = from + ((i + 0.5) / values.length) * (to - from);
        const at = [box.x + ((mm - low) / (high - low)) * box.width, box.y + (0.5 - Math.max(-1, Math.min(1, (value - map.centre) / most)) / 2) * box.height];
        if (Number.isFinite(value)) context[isDown ? "lineTo" : "moveTo"](...at);
        isDown = Number.isFinite(value);
      });
      context.stroke();
    }
  }

  drawHistogram(most) {
    const counts = new Array(BINS).fill(0);
    const { centre } = this.map;
    for (const value of this.map.values)
      if (Math.abs(value - centre) <= most) counts[Math.min(BINS - 1, Math.floor((0.5 + (value - centre) / most / 2) * BINS))]++;
    const context = begin(this.histogram, 150), largest = Math.max(...counts, 1);
    const box = { x: PAD.left, y: PAD.top, width: this.histogram.clientWidth - PAD.left - 12, height: 150 - PAD.top - PAD.bottom };
    counts.forEach((count, i) => {
      const height = (count / largest) * box.height;
      context.fillStyle = `rgb(${colourAt(this.colours, (i + 0.5) / BINS)})`;
      context.fillRect(box.x + (i / BINS) * box.width, box.y + box.height - height, box.width / BINS, height);
    });
    axes(context, box, [centre - most, centre + most], [0, largest], "histogram, " + this.map.unit, "values");
  }

  save(name) {
    this.canvas.toBlob((blob) => {
      const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name + ".png" });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    });
  }
}
