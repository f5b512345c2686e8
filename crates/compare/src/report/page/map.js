// What a panel shows of a map of heights.

/** Distance from the mean that gets the last colour. */
function reachOf(layer) {
  const apart = state.scale === "apart";
  const isHeight = layer.unit === undefined;
  if (isHeight && state.scale === "hand" && state.hand !== null) return state.hand;
  if (isHeight && (state.scale === "common" || (apart && !layer.own)) && layer.title !== "difference of the residuals")
    return Math.max(...RUNS.map((r) => r.desired.reach));
  if (state.scale !== "own") {
    if (layer.reach99 === undefined) {
      const sizes = Float64Array.from(layer.values()).filter((v) => !Number.isNaN(v)).map((v) => Math.abs(v - layer.mean)).sort();
      layer.reach99 = (sizes.length && sizes[Math.floor(0.99 * (sizes.length - 1))]) || layer.reach;
    }
    return layer.reach99;
  }
  return layer.reach;
}

/** The layer in colours, on the panel's own canvas; drawn anew when layer or scale change. */
function imageOf(panel, layer, key) {
  const reach = reachOf(layer), imageKey = key + "|" + reach + "|" + layer.nx;
  if (panel.imageKey !== imageKey) {
    panel.imageKey = imageKey;
    panel.image.width = layer.nx;
    panel.image.height = layer.ny;
    const ctx = panel.image.getContext("2d"), data = ctx.createImageData(layer.nx, layer.ny);
    const out = new Uint32Array(data.data.buffer), values = layer.values();
    const table = HEIGHT.map(([r, g, b]) => (255 << 24) | (b << 16) | (g << 8) | r);
    for (let r = 0; r < layer.ny; r++)
      for (let c = 0, i = r * layer.nx, o = (layer.ny - 1 - r) * layer.nx; c < layer.nx; c++, i++, o++) {
        const v = values[i];
        if (v === v) out[o] = table[Math.max(0, Math.min(254, Math.round(127 + (127 * (v - layer.mean)) / reach)))];
      }
    ctx.putImageData(data, 0, 0);
  }
  return panel.image;
}

function mapContent(layer, key, more = {}) {
  if (!layer) return null;
  const reach = reachOf(layer), unit = layer.unit || "nm", isOwn = layer.unit ? state.scale !== "own" : state.scale === "apart" && layer.own;
  const scale = isOwn ? `; its own scale, 99 % within ±${number(reach, 3)} ${unit}` : "";
  return {
    title: (more.title || layer.title) + (more.note ? "" : scale), note: more.note && more.note + scale, layer, marks: more.marks, still: more.still, key: key + "|" + reach + "|" + layer.nx,
    bar: { table: HEIGHT.filter((_, i) => i % 4 === 0), range: [-reach, reach], unit },
    paint(ctx, box, panel) {
      const image = imageOf(panel, layer, key);
      const left = box.x.at(layer.x0 - layer.dx / 2), top = box.y.at(layer.y0 + (layer.ny - 0.5) * layer.dy);
      ctx.imageSmoothingEnabled = layer.dx * box.k < 1;
      ctx.drawImage(image, left, top, layer.nx * layer.dx * box.k, layer.ny * layer.dy * box.k);
    },
    read() {
      const at = state.pointer && valueAt(layer, ...state.pointer);
      if (!at) return more.idle || `RMS ${number(layer.rms)} ${unit}`;
      const value = Number.isNaN(at.value) ? "invalid" : `${number(at.value, 6)} ${unit} (${number(at.value - layer.mean, 4)} from the mean)`;
      return `x ${number(at.x, 5)}, y ${number(at.y, 5)} mm, [${at.row}, ${at.column}]: ${value}`;
    },
  };
}
