// A panel in mm: a map, a path or dwell times. All panels show the same part of the mirror.

const EXTENT = (() => {
  const of = (l) => [l.x0 - l.dx / 2, l.x0 + (l.nx - 0.5) * l.dx, l.y0 - l.dy / 2, l.y0 + (l.ny - 0.5) * l.dy];
  return RUNS.map((r) => of(r.desired)).reduce((p, q) => [Math.min(p[0], q[0]), Math.max(p[1], q[1]), Math.min(p[2], q[2]), Math.max(p[3], q[3])]);
})();
const around = ([a, b, c, d], rim) => {
  const w = rim * (b - a), h = rim * (d - c);
  return [a - w, b + w, c - h, d + h];
};
const PATH_EXTENT = (() => {
  const all = [...EXTENT];
  for (const e of ENTRIES) {
    const { x_mm, y_mm } = e.method.line;
    const reach = (p) => p.scale * 32767;
    all[0] = Math.min(all[0], x_mm.offset - reach(x_mm)); all[1] = Math.max(all[1], x_mm.offset + reach(x_mm));
    all[2] = Math.min(all[2], y_mm.offset - reach(y_mm)); all[3] = Math.max(all[3], y_mm.offset + reach(y_mm));
  }
  return all;
})();
const WHOLE = around(PATH_EXTENT, 0.02);
/** What maps show of the part when all is shown: no path beyond its edges, so that the part is as large as it can be. */
const WHOLE_MAP = around(EXTENT, 0.04);
state.view = [...WHOLE];
const showsAll = () => state.view.every((v, i) => v === WHOLE[i]);
const viewOfMaps = () => (showsAll() ? WHOLE_MAP : state.view);
state.pin = [(EXTENT[0] + EXTENT[1]) / 2, (EXTENT[2] + EXTENT[3]) / 2];

const panels = [];
/** Pixels that axes and colour bar of a panel take beside its map, and below it. */
const BESIDE_MAP = 112, BELOW_MAP = 40;

/** One panel; `content()` says what to draw, null hides it. */
class Panel {
  constructor(parent, name, content) {
    this.name = name;
    this.parent = byId(parent);
    this.whole = ["maps", "surfaces", "slope-maps"].includes(parent) ? WHOLE_MAP : WHOLE;
    this.content = content;
    this.figure = document.createElement("figure");
    this.caption = document.createElement("figcaption");
    this.title = document.createElement("span");
    this.canvas = document.createElement("canvas");
    this.canvas.tabIndex = 0;
    this.canvas.dataset.panel = name;
    this.canvas.setAttribute("role", "application");
    this.read = document.createElement("div");
    this.read.className = "read";
    this.caption.append(this.title, saveButton(this.canvas, name));
    this.figure.append(this.caption, this.canvas, this.read);
    this.parent.append(this.figure);
    this.base = document.createElement("canvas");
    this.image = document.createElement("canvas");
    this.listen();
    panels.push(this);
  }

  /** Part of the plane that the panel shows: [x low, x high, y low, y high], mm. */
  view() {
    return showsAll() ? this.whole : state.view;
  }

  /** Where the view is: equal scales, centred. */
  box() {
    const l = 46, t = 4, w = Math.max(20, this.canvas.clientWidth - l - 66), h = this.canvas.clientHeight - t - 36;
    const [x0, x1, y0, y1] = this.view();
    const k = Math.min(w / (x1 - x0), h / (y1 - y0));
    const cx = (x0 + x1) / 2, cy = (y0 + y1) / 2;
    const low = [cx - w / 2 / k, cy - h / 2 / k], high = [cx + w / 2 / k, cy + h / 2 / k];
    return { l, t, w, h, k, low, high, x: linear(low[0], high[0], l, l + w, w / 70), y: linear(low[1], high[1], t + h, t, h / 45) };
  }

  resize(most) {
    const width = this.canvas.clientWidth - BESIDE_MAP;
    const [x0, x1, y0, y1] = this.whole, shape = (y1 - y0) / (x1 - x0);
    this.canvas.style.height = Math.round(Math.max(90, Math.min(most, width * shape)) + BELOW_MAP) + "px";
  }

  /** Says what the panel shows; hides it and returns null if it shows nothing. */
  describe() {
    const content = this.content();
    this.figure.hidden = !content;
    if (!content) return null;
    const title = content.title + (content.note ? ", " + content.note : "");
    // Words that stay leave the layout of the page as it is.
    if (title === this.words) return content;
    this.words = title;
    this.title.replaceChildren(content.title, ...(content.note ? [element("small", content.note)] : []));
    this.canvas.setAttribute("aria-label", title + "; arrows move the pointer, Shift and arrows the map, + and - zoom, 0 shows all, Enter pins the profiles");
    return content;
  }

  /** Draws the panel unless it is folded; its map is at most so many pixels high. */
  draw(most = 560) {
    if (this.parent.closest("details:not([open])")) return;
    const content = this.describe();
    if (!content) return;
    this.resize(most);
    const box = this.box();
    const key = [content.key, state.view, state.moving && content.heavy, this.canvas.clientWidth, this.canvas.clientHeight, theme.paper, state.scale].join("|");
    if (key !== this.baseKey) {
      this.baseKey = key;
      const ctx = begin(this.canvas);
      ctx.fillStyle = theme.field;
      ctx.fillRect(box.l, box.t, box.w, box.h);
      ctx.save();
      ctx.beginPath();
      ctx.rect(box.l, box.t, box.w, box.h);
      ctx.clip();
      content.paint(ctx, box, this);
      ctx.restore();
      axes(ctx, box, box.x, box.y, ["x (mm)", "y (mm)"]);
      colourBar(ctx, box, content);
      this.base.width = this.canvas.width;
      this.base.height = this.canvas.height;
      this.base.getContext("2d").drawImage(this.canvas, 0, 0);
    } else {
      const ctx = this.canvas.getContext("2d");
      ctx.setTransform(1, 0, 0, 1, 0, 0);
      ctx.drawImage(this.base, 0, 0);
      const ratio = window.devicePixelRatio || 1;
      ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    }
    this.overlay(box, content);
  }

  /** Pointer, pin and tool. */
  overlay(box, content) {
    const ctx = this.canvas.getContext("2d");
    ctx.save();
    ctx.beginPath();
    ctx.rect(box.l, box.t, box.w, box.h);
    ctx.clip();
    const cross = ([x, y], colour, size) => {
      const px = box.x.at(x), py = box.y.at(y);
      ctx.strokeStyle = colour;
      ctx.beginPath();
      ctx.moveTo(px - size, py); ctx.lineTo(px + size, py);
      ctx.moveTo(px, py - size); ctx.lineTo(px, py + size);
      ctx.stroke();
    };
    ctx.lineWidth = 1;
    if (content.layer && state.pin) cross(state.pin, "#00000099", 4000);
    for (const { at, text, colour } of content.marks || []) {
      const [px, py] = [box.x.at(at[0]), box.y.at(at[1])];
      for (const [width, stroke] of text ? [[4, "#ffffff"], [1.5, colour]] : [[2, colour]]) {
        ctx.strokeStyle = stroke;
        ctx.lineWidth = width;
        ctx.beginPath();
        ctx.arc(px, py, 6, 0, 7);
        ctx.stroke();
        if (!text) continue;
        // Inside the frame, whatever side the place is at.
        const side = px + 20 > box.l + box.w ? -16 : 9, up = py - 6 < box.t + 10 ? 14 : -6;
        ctx.lineWidth = 3;
        if (stroke === "#ffffff") ctx.strokeText(text, px + side, py + up);
        ctx.fillStyle = colour;
        if (stroke === colour) ctx.fillText(text, px + side, py + up);
      }
    }
    if (state.pointer) {
      ctx.lineWidth = 3;
      cross(state.pointer, "#ffffffcc", 9);
      ctx.lineWidth = 1;
      cross(state.pointer, "#000000", 9);
    }
    const tool = toolAt(A(), state.hoverTime ?? state.time);
    if (tool && !content.still) {
      const [px, py] = [box.x.at(tool.x), box.y.at(tool.y)];
      ctx.beginPath();
      ctx.arc(px, py, 5, 0, 7);
      ctx.fillStyle = "#ff2bd6";
      ctx.fill();
      ctx.lineWidth = 2;
      ctx.strokeStyle = "#ffffff";
      ctx.stroke();
    }
    ctx.restore();
    const read = content.read();
    if (read !== this.read.textContent) this.read.textContent = read;
  }

  listen() {
    const canvas = this.canvas;
    const place = (event) => {
      const r = canvas.getBoundingClientRect(), box = this.box();
      return [box.x.back(event.clientX - r.left), box.y.back(event.clientY - r.top)];
    };
    let from = null;
    canvas.addEventListener("pointerdown", (event) => {
      from = { at: place(event), x: event.clientX, y: event.clientY, view: [...this.view()], k: this.box().k, moved: false };
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (from && Math.hypot(event.clientX - from.x, event.clientY - from.y) > 4) from.moved = true;
      if (from && from.moved) {
        const dx = (event.clientX - from.x) / from.k, dy = (event.clientY - from.y) / from.k, v = from.view;
        state.view = [v[0] - dx, v[1] - dx, v[2] + dy, v[3] + dy];
        moving();
      } else this.point(place(event));
      redraw();
    });
    canvas.addEventListener("pointerup", (event) => {
      if (from && !from.moved) this.pick(place(event));
      from = null;
      redraw();
    });
    canvas.addEventListener("pointercancel", () => { from = null; });
    canvas.addEventListener("pointerleave", () => { state.pointer = null; state.hoverTime = null; redraw(); });
    canvas.addEventListener("dblclick", showAll);
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas && !event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      zoom(Math.exp(event.deltaY * 0.0015), place(event), this.view());
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
      const v = this.view(), w = v[1] - v[0], h = v[3] - v[2];
      if (step && event.shiftKey) {
        const [dx, dy] = [step[0] * 0.1 * w, step[1] * 0.1 * h];
        state.view = [v[0] + dx, v[1] + dx, v[2] + dy, v[3] + dy];
        moving();
      } else if (step) {
        const layer = A().residual, at = state.pointer || [(v[0] + v[1]) / 2, (v[2] + v[3]) / 2];
        const many = Math.max(1, Math.round(2 / this.box().k / layer.dx));
        this.point([at[0] + step[0] * many * layer.dx, at[1] + step[1] * many * layer.dy]);
      } else if (event.key === "+" || event.key === "=") zoom(0.7, state.pointer, v);
      else if (event.key === "-") zoom(1 / 0.7, state.pointer, v);
      else if (event.key === "0") showAll();
      else if (event.key === "Enter" && state.pointer) this.pick(state.pointer);
      else return;
      event.preventDefault();
      redraw();
    });
  }

  point(at) {
    state.pointer = at;
    const content = this.content();
    if (content && content.point) content.point(at, this.box());
  }

  pick(at) {
    const content = this.content();
    if (content && content.pick) content.pick(at, this.box());
    else state.pin = at;
  }
}

function colourBar(ctx, box, { bar }) {
  if (!bar) return;
  const x = box.l + box.w + 8, n = bar.table.length;
  for (let i = 0; i < n; i++) {
    ctx.fillStyle = css(bar.table[n - 1 - i]);
    ctx.fillRect(x, box.t + (box.h * i) / n, 10, box.h / n + 0.6);
  }
  ctx.fillStyle = theme.ink;
  ctx.textAlign = "left";
  ctx.fillText(short(+bar.range[1].toPrecision(3)), x + 13, box.t + 10);
  ctx.fillText(short(+bar.range[0].toPrecision(3)), x + 13, box.t + box.h);
  ctx.fillText(bar.unit, x + 13, box.t + box.h / 2 + 4);
}

/** Shows `factor` times as much as the view `v`, about the place [x, y], mm, or about its middle. */
function zoom(factor, about, v) {
  const [x, y] = about || [(v[0] + v[1]) / 2, (v[2] + v[3]) / 2];
  const size = (v[1] - v[0]) * factor, whole = WHOLE[1] - WHOLE[0];
  if (size > 4 * whole || size < whole * 1e-4) return;
  state.view = [x + (v[0] - x) * factor, x + (v[1] - x) * factor, y + (v[2] - y) * factor, y + (v[3] - y) * factor];
  moving();
  redraw();
}
function showAll() {
  state.view = [...WHOLE];
  redraw();
}

/** While something moves, heavy panels draw a part of their lines; soon after, all. */
let settle = 0;
function moving() {
  state.moving = true;
  clearTimeout(settle);
  settle = setTimeout(() => { state.moving = false; redraw(); }, 160);
}
