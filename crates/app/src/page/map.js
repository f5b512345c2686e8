"use strict";
// A map with its colours about zero, the value under the pointer, zoom, profiles and histogram.

const PAD = { left: 58, right: 84, top: 10, bottom: 40 };
const BINS = 60;
/** Least and largest height of a drawing, px. */
const HEIGHTS = [120, 460];
/** Factor of one step of the zoom. */
const ZOOM = 1.6;

class MapView {
  /** `title` names the map in words; `colours` are its stops; without `details` the view has no profiles and histogram. */
  constructor(root, title, colours, details = true) {
    Object.assign(this, { root, title, details, palette: palette(colours), onPoint: () => {} });
    root.innerHTML = (details ? "" : `<h3>${title[0].toUpperCase()}${title.slice(1)}</h3>`) +
      `<div><canvas tabindex="0" role="img"></canvas><p class="note value" aria-live="polite"></p>
      <div class="tools"><label>Colours to <select class="clip"><option value="1">the largest value</option><option value="0.99">99 % of the pixels</option>
      <option value="0.95">95 % of the pixels</option></select></label>
      <button type="button" class="in" aria-label="Zoom in">+</button><button type="button" class="out" aria-label="Zoom out">&minus;</button>
      <button type="button" class="whole">Whole map</button><span class="save">Save: </span>
      <button type="button" class="copy">Copy numbers</button></div>
      <p class="note scale"></p><p class="doubt" hidden></p></div>
      <div><details><summary>Statistics of the whole map</summary><table><tbody></tbody></table></details>` +
      (details ? `<canvas role="img"></canvas><canvas role="img"></canvas></div>` : "</div>");
    root.hidden = true;
    root.querySelector("details").open = details;
    [this.canvas, this.profiles, this.histogram] = root.querySelectorAll("canvas");
    this.canvas.setAttribute("aria-label", `Map: ${title}; arrow keys move the point whose value is read, + and - zoom, 0 shows the whole map`);
    this.value = root.querySelector(".value");
    this.clip = root.querySelector(".clip");
    this.clip.addEventListener("change", () => this.draw());
    root.querySelector(".save").append(...saveButtons(title.replaceAll(" ", "-"), this.canvas, (context) => this.paint(context)));
    root.querySelector(".copy").addEventListener("click", () => navigator.clipboard.writeText(this.text()));
    for (const [name, factor] of [["in", 1 / ZOOM], ["out", ZOOM], ["whole", Infinity]])
      root.querySelector("." + name).addEventListener("click", () => this.zoom(factor));
    this.canvas.addEventListener("pointermove", (event) => this.moveTo(event));
    this.canvas.addEventListener("dblclick", (event) => {
      this.moveTo(event);
      this.zoom(1 / ZOOM);
    });
    this.canvas.addEventListener("keydown", (event) => this.key(event));
    if (details) {
      this.profiles.setAttribute("aria-label", `Profiles through this point: ${title}`);
      this.histogram.setAttribute("aria-label", `Histogram: ${title}`);
    }
    new ResizeObserver(() => this.draw()).observe(root);
    onTheme(() => this.draw());
  }

  show(map) {
    this.map = map;
    this.point = map.shape.map((n) => Math.floor(n / 2));
    this.window = map.edges_mm;
    const sizes = map.values.filter(Number.isFinite).map((value) => Math.abs(value - map.centre)).sort();
    this.reach = (part) => sizes[Math.max(0, Math.ceil(part * sizes.length) - 1)] || 1;
    this.image = null;
    const rows = [["size", map.pixels.join(" x "), "pixels"], ["pitch", map.pitch_mm.map((v) => number(v)).join(" x "), "mm"],
      ...map.numbers.map(([name, value, unit]) => [name, number(value), unit])];
    this.text = () => rows.map((row) => row.join("\t")).join("\n") + "\n" + this.value.textContent + "\n";
    this.root.querySelector("tbody").replaceChildren(...rows.map((row) => {
      const line = document.createElement("tr");
      line.append(...row.map((text, i) => Object.assign(document.createElement(i ? "td" : "th"), { textContent: text })));
      return line;
    }));
    const block = Math.round(map.pixels[0] / map.shape[0]);
    this.root.querySelector(".scale").textContent = `The colours are symmetric about ${map.centre === 0 ? "0" : "the mean"}. ` +
      (block > 1 ? `The drawing has means of ${block} x ${block} pixels.` : "");
    const doubt = this.root.querySelector(".doubt");
    doubt.textContent = map.doubt;
    doubt.hidden = map.doubt === "";
    this.root.hidden = false;
    this.draw();
  }

  draw() {
    const { map, canvas } = this;
    if (!map || canvas.clientWidth === 0) return;
    const [x0, x1, y0, y1] = this.window, room = canvas.clientWidth - PAD.left - PAD.right;
    // Both axes have the same scale.
    const tall = Math.min(Math.max((room * (y1 - y0)) / (x1 - x0), HEIGHTS[0] / 4), HEIGHTS[1]);
    const width = Math.min(room, (tall * (x1 - x0)) / (y1 - y0)), height = (width * (y1 - y0)) / (x1 - x0);
    this.box = { x: PAD.left, y: PAD.top, width, height };
    this.paint(begin(canvas, Math.max(height, HEIGHTS[0]) + PAD.top + PAD.bottom));
    this.cross(canvas.getContext("2d"));
    if (this.details) {
      this.drawProfiles();
      this.drawHistogram();
    }
    this.read();
  }

  /** Draws map, axes and colour bar. */
  paint(context) {
    const { map, box } = this, [x0, x1, y0, y1] = this.window, most = this.reach(+this.clip.value);
    const [left, right, low, high] = map.edges_mm, [nx, ny] = map.shape;
    const [perX, perY] = [nx / (right - left), ny / (high - low)];
    context.imageSmoothingEnabled = false;
    context.drawImage(this.picture(most), (x0 - left) * perX, (high - y1) * perY, (x1 - x0) * perX, (y1 - y0) * perY,
      box.x, box.y, box.width, box.height);
    axes(context, box, [x0, x1], [y0, y1], "x, mm", "y, mm");
    this.bar(context, most);
  }

  /** The whole map as a canvas with a pixel for each value. */
  picture(most) {
    if (this.image?.most === most) return this.image.canvas;
    const { map } = this, [nx, ny] = map.shape, picture = new ImageData(nx, ny), data = picture.data, colours = this.palette;
    for (let row = 0; row < ny; row++)
      for (let column = 0; column < nx; column++) {
        const value = map.values[row * nx + column], k = 4 * ((ny - 1 - row) * nx + column);
        if (Number.isNaN(value)) continue;
        const colour = paletteIndex(0.5 + (value - map.centre) / most / 2);
        data[k] = colours[colour];
        data[k + 1] = colours[colour + 1];
        data[k + 2] = colours[colour + 2];
        data[k + 3] = 255;
      }
    const canvas = Object.assign(document.createElement("canvas"), { width: nx, height: ny });
    canvas.getContext("2d").putImageData(picture, 0, 0);
    this.image = { most, canvas };
    return canvas;
  }

  colour(fraction) {
    return `rgb(${this.palette.slice(paletteIndex(fraction), paletteIndex(fraction) + 3)})`;
  }

  bar(context, most) {
    const { box } = this, x = box.x + box.width + 12, height = Math.max(box.height, HEIGHTS[0]);
    for (let i = 0; i < height; i++) {
      context.fillStyle = this.colour(1 - i / height);
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

  /** Value at a point, mm; NaN outside. */
  at([x, y]) {
    const [x0, x1, y0, y1] = this.map.edges_mm, [nx, ny] = this.map.shape;
    const column = Math.floor(((x - x0) / (x1 - x0)) * nx), row = Math.floor(((y - y0) / (y1 - y0)) * ny);
    return column < 0 || row < 0 || column >= nx || row >= ny ? NaN : this.map.values[row * nx + column];
  }

  cross(context) {
    const { box } = this, [x0, x1, y0, y1] = this.window, [x, y] = this.place(this.point);
    const [px, py] = [box.x + ((x - x0) / (x1 - x0)) * box.width, box.y + ((y1 - y) / (y1 - y0)) * box.height];
    context.strokeStyle = "#000000";
    context.setLineDash([3, 3]);
    context.beginPath();
    context.moveTo(box.x, py);
    context.lineTo(box.x + box.width, py);
    context.moveTo(px, box.y);
    context.lineTo(px, box.y + box.height);
    context.stroke();
    context.setLineDash([]);
  }

  read() {
    // A nanometre is less than any step of a map.
    const [x, y] = this.place(this.point).map((mm) => +mm.toFixed(6));
    const value = this.map.values[this.point[1] * this.map.shape[0] + this.point[0]];
    this.value.textContent = `x ${number(x)} mm, y ${number(y)} mm: ${Number.isFinite(value) ? number(value) + " " + this.map.unit : "invalid"}`;
  }

  /** Moves the point to coordinates in mm, within the map. */
  goTo([x, y]) {
    if (!this.map) return;
    const [x0, x1, y0, y1] = this.map.edges_mm, fractions = [(x - x0) / (x1 - x0), (y - y0) / (y1 - y0)];
    this.point = fractions.map((f, i) => Math.min(this.map.shape[i] - 1, Math.max(0, Math.floor(f * this.map.shape[i]))));
    this.draw();
  }

  moveTo(event) {
    if (!this.map) return;
    const { box } = this, [x0, x1, y0, y1] = this.window, canvas = this.canvas.getBoundingClientRect();
    const within = [(event.clientX - canvas.left - box.x) / box.width, (event.clientY - canvas.top - box.y) / box.height];
    const [across, down] = within.map((f) => Math.min(1, Math.max(0, f)));
    this.goTo([x0 + across * (x1 - x0), y1 - down * (y1 - y0)]);
    this.onPoint(this.place(this.point));
  }

  /** Shows a part of the map about the point; a factor below 1 zooms in. */
  zoom(factor) {
    if (!this.map) return;
    const whole = this.map.edges_mm, centre = this.place(this.point);
    this.window = [0, 1].flatMap((axis) => {
      const [low, high] = [whole[2 * axis], whole[2 * axis + 1]];
      const size = Math.min((this.window[2 * axis + 1] - this.window[2 * axis]) * factor, high - low);
      // At least four values are seen.
      const shown = Math.max(size, (4 * (high - low)) / this.map.shape[axis]);
      const start = Math.min(Math.max(centre[axis] - shown / 2, low), high - shown);
      return [start, start + shown];
    });
    this.draw();
  }

  key(event) {
    const move = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowDown: [0, -1], ArrowUp: [0, 1] }[event.key];
    const factor = { "+": 1 / ZOOM, "-": ZOOM, 0: Infinity }[event.key];
    if (!this.map || (!move && !factor)) return;
    event.preventDefault();
    if (factor) return this.zoom(factor);
    this.point = this.point.map((p, i) => Math.min(this.map.shape[i] - 1, Math.max(0, p + move[i])));
    this.draw();
    this.onPoint(this.place(this.point));
  }

  /** Points [mm, value] along x (axis 0) or y through the point. */
  profile(axis) {
    const { map, point } = this, nx = map.shape[0];
    return Array.from({ length: map.shape[axis] }, (_, i) => {
      const [column, row] = axis ? [point[0], i] : [i, point[1]];
      return [this.place([column, row])[axis], map.values[row * nx + column]];
    });
  }

  drawProfiles() {
    const { map } = this, [x0, x1, y0, y1] = map.edges_mm, most = this.reach(+this.clip.value);
    const context = begin(this.profiles, 190);
    const box = { x: PAD.left, y: PAD.top, width: this.profiles.clientWidth - PAD.left - 12, height: 190 - PAD.top - PAD.bottom };
    const [low, high] = [Math.min(x0, y0), Math.max(x1, y1)];
    axes(context, box, [low, high], [map.centre - most, map.centre + most], "profiles along x (blue) and y (orange), mm", map.unit);
    const px = ([mm, value]) => [box.x + ((mm - low) / (high - low)) * box.width,
      box.y + (0.5 - Math.max(-1, Math.min(1, (value - map.centre) / most)) / 2) * box.height];
    line(context, this.profile(0), px, themeColour("x"));
    line(context, this.profile(1), px, themeColour("y"));
  }

  drawHistogram() {
    const counts = new Array(BINS).fill(0), { centre, unit } = this.map, most = this.reach(+this.clip.value);
    for (const value of this.map.values)
      if (Math.abs(value - centre) <= most) counts[Math.min(BINS - 1, Math.floor((0.5 + (value - centre) / most / 2) * BINS))]++;
    const context = begin(this.histogram, 150), largest = Math.max(...counts, 1);
    const box = { x: PAD.left, y: PAD.top, width: this.histogram.clientWidth - PAD.left - 12, height: 150 - PAD.top - PAD.bottom };
    counts.forEach((count, i) => {
      const height = (count / largest) * box.height;
      context.fillStyle = this.colour((i + 0.5) / BINS);
      context.fillRect(box.x + (i / BINS) * box.width, box.y + box.height - height, box.width / BINS, height);
    });
    axes(context, box, [centre - most, centre + most], [0, largest], "histogram, " + unit, "values");
  }
}
