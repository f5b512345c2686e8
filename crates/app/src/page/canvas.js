"use strict";
// Drawings with one set of calls, on a canvas or as SVG text: axes, colours, numbers, and files of what was drawn.

/** Reads the bytes of a map: the length of the head, the head, the values. */
function readMap(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  // A copy begins at a multiple of four bytes.
  return { ...head, values: new Float32Array(buffer.slice(4 + length)) };
}

function number(value, digits = 4) {
  if (!Number.isFinite(value)) return "-";
  const size = Math.abs(value);
  return size !== 0 && (size < 1e-3 || size >= 1e6) ? value.toExponential(digits - 1) : String(+value.toPrecision(digits));
}

/** A time in the unit that a person reads. */
function duration(seconds) {
  if (seconds < 120) return number(seconds, 3) + " s";
  return seconds < 7200 ? number(seconds / 60, 3) + " min" : number(seconds / 3600, 3) + " h";
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

/** Draws again when the page turns dark or light. */
function onTheme(draw) {
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
}

/** Number of colours of a palette. */
const COLOURS = 256;

/** Returns red, green and blue of the colours between stops written #rrggbb, from the first to the last stop. */
function palette(stops) {
  const colours = new Uint8ClampedArray(3 * COLOURS);
  for (let i = 0; i < COLOURS; i++) {
    const place = (i / (COLOURS - 1)) * (stops.length - 1), k = Math.min(Math.floor(place), stops.length - 2);
    for (let part = 0; part < 3; part++) {
      const [a, b] = [stops[k], stops[k + 1]].map((stop) => parseInt(stop.slice(1 + 2 * part, 3 + 2 * part), 16));
      colours[3 * i + part] = Math.round(a + (b - a) * (place - k));
    }
  }
  return colours;
}

/** Returns the place in a palette of a fraction from 0 to 1. */
function paletteIndex(fraction) {
  return 3 * Math.round(Math.min(1, Math.max(0, fraction)) * (COLOURS - 1));
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

/** What the drawings ask of a canvas, written as the elements of an SVG. */
class SvgContext {
  constructor(width, height) {
    this.size = [width, height];
    this.elements = [];
    this.transform = "";
    this.dash = "";
    this.lineWidth = 1;
    this.fillRectangle(0, 0, width, height, themeColour("paper"));
  }

  element(tag, attributes, text = "") {
    const transform = this.transform && `transform="${this.transform.trim()}"`;
    const escaped = String(text).replace(/[&<>]/g, (sign) => `&#${sign.charCodeAt(0)};`);
    this.elements.push(`<${tag} ${attributes} ${transform}>${escaped}</${tag}>`);
  }

  fillRectangle(x, y, width, height, colour) {
    this.element("rect", `x="${x}" y="${y}" width="${width}" height="${height}" fill="${colour}"`);
  }

  fillRect(x, y, width, height) {
    this.fillRectangle(x, y, width, height, this.fillStyle);
  }

  strokeRect(x, y, width, height) {
    this.element("rect", `x="${x}" y="${y}" width="${width}" height="${height}" fill="none" stroke="${this.strokeStyle}"`);
  }

  fillText(text, x, y) {
    const anchor = { left: "start", center: "middle", right: "end" }[this.textAlign ?? "left"];
    this.element("text", `x="${x}" y="${y}" text-anchor="${anchor}" font-family="sans-serif" font-size="12" fill="${this.fillStyle}"`, text);
  }

  beginPath() { this.path = ""; }
  moveTo(x, y) { this.path += `M${x.toFixed(2)} ${y.toFixed(2)}`; }
  lineTo(x, y) { this.path += `L${x.toFixed(2)} ${y.toFixed(2)}`; }
  stroke() {
    this.element("path", `d="${this.path}" fill="none" stroke="${this.strokeStyle}" stroke-width="${this.lineWidth}" ${this.dash}`);
  }
  setLineDash(dashes) { this.dash = dashes.length ? `stroke-dasharray="${dashes.join(" ")}"` : ""; }
  save() { this.saved = this.transform; }
  restore() { this.transform = this.saved; }
  translate(x, y) { this.transform += ` translate(${x} ${y})`; }
  rotate(radians) { this.transform += ` rotate(${(radians * 180) / Math.PI})`; }

  /** Draws a part of a canvas: its place in the canvas, then its place in the drawing. */
  drawImage(canvas, fromX, fromY, fromWidth, fromHeight, x, y, width, height) {
    const part = Object.assign(document.createElement("canvas"), { width: Math.ceil(fromWidth), height: Math.ceil(fromHeight) });
    part.getContext("2d").drawImage(canvas, fromX, fromY, fromWidth, fromHeight, 0, 0, part.width, part.height);
    this.element("image", `x="${x}" y="${y}" width="${width}" height="${height}" preserveAspectRatio="none" ` +
      `style="image-rendering: pixelated" href="${part.toDataURL()}"`);
  }

  toString() {
    const [width, height] = this.size;
    return `<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 ${width} ${height}" width="${width}" height="${height}">\n` +
      this.elements.join("\n") + "\n</svg>\n";
  }
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

/** A line through points [x, y], with gaps where y is no number. `px` gives the place of a point. */
function line(context, points, px, colour) {
  context.strokeStyle = colour;
  context.beginPath();
  let isDown = false;
  for (const point of points) {
    const isThere = Number.isFinite(point[1]);
    if (isThere) context[isDown ? "lineTo" : "moveTo"](...px(point));
    isDown = isThere;
  }
  context.stroke();
}

/** Saves a file that the page has made. */
function saveAs(name, blob) {
  const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

/** A row of buttons that save a drawing: `paint` draws on a context of the size of the canvas. */
function saveButtons(name, canvas, paint) {
  const button = (text, save) => {
    const made = Object.assign(document.createElement("button"), { type: "button", textContent: text });
    made.addEventListener("click", save);
    return made;
  };
  return [
    button("PNG", () => canvas.toBlob((blob) => saveAs(name + ".png", blob))),
    button("SVG", () => {
      const svg = new SvgContext(canvas.clientWidth, canvas.clientHeight);
      paint(svg);
      saveAs(name + ".svg", new Blob([svg.toString()], { type: "image/svg+xml" }));
    }),
  ];
}
