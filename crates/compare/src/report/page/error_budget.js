// What the errors of the process add: bars, distribution, map of the expected deviation.

const processOf = (entry) => entry.run.error_budget;
const inWords = (kind) => kind.replaceAll("_", " ");
const deviationLayers = new Map();

/** The map of the deviations over the runs, from 0 upwards. */
function deviationContent(entry) {
  const process = processOf(entry);
  if (!process || !process.deviation) return null;
  const name = entry.run.name;
  if (!deviationLayers.has(name)) deviationLayers.set(name, layerOf("expected deviation", process.deviation));
  const layer = deviationLayers.get(name), top = process.deviation.range_nm[1] || 1;
  return {
    title: "standard deviation over the runs: " + process.method, layer, key: "deviation" + name, still: true,
    bar: { table: SPEED, range: [0, top], unit: "nm" },
    paint(ctx, box, panel) {
      const image = panel.image;
      if (panel.imageKey !== name) {
        panel.imageKey = name;
        image.width = layer.nx;
        image.height = layer.ny;
        const own = image.getContext("2d"), data = own.createImageData(layer.nx, layer.ny), values = layer.values();
        for (let r = 0; r < layer.ny; r++)
          for (let c = 0; c < layer.nx; c++) {
            const v = values[r * layer.nx + c], at = 4 * ((layer.ny - 1 - r) * layer.nx + c);
            if (Number.isNaN(v)) continue;
            const colour = SPEED[Math.max(0, Math.min(SPEED.length - 1, Math.floor((v / top) * SPEED.length)))];
            data.data.set([...colour, 255], at);
          }
        own.putImageData(data, 0, 0);
      }
      const left = box.x.at(layer.x0 - layer.dx / 2), up = box.y.at(layer.y0 + (layer.ny - 0.5) * layer.dy);
      ctx.imageSmoothingEnabled = layer.dx * box.k < 1;
      ctx.drawImage(image, left, up, layer.nx * layer.dx * box.k, layer.ny * layer.dy * box.k);
    },
    read() {
      const at = state.pointer && valueAt(layer, ...state.pointer);
      if (!at) return `${number(process.deviation.range_nm[0])} to ${number(top)} nm`;
      return `x ${number(at.x, 5)}, y ${number(at.y, 5)} mm: ${Number.isNaN(at.value) ? "invalid" : number(at.value) + " nm"}`;
    },
  };
}

/** A bar per error, the largest first: what it adds alone, and of that what the tool reaches. */
function drawBudget() {
  const process = processOf(A()), canvas = byId("budget");
  const lines = [...process.errors].sort((a, b) => b.adds_rms_nm - a.adds_rms_nm), pitch = 22;
  canvas.style.height = pitch * lines.length + 68 + "px";
  const ctx = begin(canvas), narrow = canvas.clientWidth < 500;
  const box = { l: narrow ? 128 : 210, t: 24, w: 0, h: pitch * lines.length };
  box.w = Math.max(30, canvas.clientWidth - box.l - 58);
  const top = Math.max(process.nominal_rms_nm, ...lines.map((l) => l.adds_rms_nm)) * 1.02 || 1;
  const x = linear(0, top, box.l, box.l + box.w, box.w / 60), y = { at: (i) => box.t + pitch * i, ticks: [] };
  axes(ctx, box, x, y, ["adds alone (nm RMS)", ""]);
  lines.forEach((l, i) => {
    const at = y.at(i), size = `${l.distribution === "fixed" ? "" : "±"}${number(l.size, 3)} ${l.unit}`.replace(/(\.\d*?)0+ /, "$1 ").replace(". ", " ");
    ctx.fillStyle = theme.ink;
    ctx.textAlign = "right";
    ctx.fillText(inWords(l.kind) + (narrow ? "" : ", " + size), box.l - 6, at + 15);
    ctx.fillStyle = theme.x;
    ctx.globalAlpha = 0.35;
    ctx.fillRect(box.l, at + 4, x.at(l.adds_rms_nm) - box.l, pitch - 8);
    ctx.globalAlpha = 1;
    ctx.fillRect(box.l, at + 4, x.at(l.reached_rms_nm) - box.l, pitch - 8);
    ctx.fillStyle = theme.soft;
    ctx.textAlign = "left";
    ctx.fillText(number(l.adds_rms_nm, 3), x.at(l.adds_rms_nm) + 4, at + 15);
  });
  ctx.setLineDash([4, 3]);
  ctx.strokeStyle = theme.y;
  ctx.beginPath();
  ctx.moveTo(x.at(process.nominal_rms_nm), box.t);
  ctx.lineTo(x.at(process.nominal_rms_nm), box.t + box.h);
  ctx.stroke();
  ctx.setLineDash([]);
  legend(ctx, { ...box, l: 2, w: canvas.clientWidth - 4 }, [["what the tool reaches", theme.x], ["with what it does not", theme.x + "59"], ["left without errors", theme.y]]);
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", "What each error adds alone: " + lines.map((l) => `${inWords(l.kind)} ${number(l.adds_rms_nm)} nm`).join(", "));
}

/** The part of the runs that is below an RMS. */
function drawDistribution() {
  const process = processOf(A()), canvas = byId("distribution"), ctx = begin(canvas), box = chartBox(canvas);
  const { part, rms_nm } = process.distribution, { median_nm, below_95_percent_nm } = process.residual;
  const low = Math.min(process.nominal_rms_nm, rms_nm[0]), high = rms_nm[Math.floor(0.995 * (rms_nm.length - 1))];
  const rim = 0.04 * (high - low) || 0.1 * high || 1;
  const x = linear(Math.max(0, low - rim), high + rim, box.l, box.l + box.w, box.w / 70), y = linear(0, 100, box.t + box.h, box.t, 5);
  const marks = [["without errors", process.nominal_rms_nm, theme.y], ["median", median_nm, theme.ink], ["95 % below", below_95_percent_nm, theme.bad]];
  clipped(ctx, box, () => {
    ctx.setLineDash([4, 3]);
    for (const [, at, colour] of marks) curve(ctx, x, y, [[at, 0], [at, 100]], colour, 1.5);
    ctx.setLineDash([]);
    curve(ctx, x, y, rms_nm.map((v, i) => [v, 100 * part[i]]), theme.x, 2);
  });
  axes(ctx, box, x, y, ["RMS of the residual (nm)", "% of the runs below"]);
  legend(ctx, box, marks.map(([name, at, colour]) => [`${name} ${number(at, 3)}`, colour]));
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", `Distribution of the residual: half of the runs below ${number(median_nm)} nm, 95 % below ${number(below_95_percent_nm)} nm`);
}

function drawProcess() {
  const process = processOf(A());
  byId("process-section").hidden = !process;
  if (!process) return;
  const without = process.free === "plane" ? " Every RMS of this section is without the best plane." : "";
  byId("process-sentence").textContent = process.sentence;
  byId("process-note").textContent = `${process.simulated ? "The distribution is that of simulated runs." : "The distribution is drawn to first order."}${without} Errors that the error budget does not state are not in it.`;
  drawBudget();
  drawDistribution();
}
