// What every drawing on a canvas needs: axes, scales, a button that saves it.

/** The context in CSS pixels, cleared. */
function begin(canvas) {
  const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
    canvas.width = Math.round(w * ratio);
    canvas.height = Math.round(h * ratio);
  }
  const ctx = canvas.getContext("2d");
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.fillStyle = theme.paper;
  ctx.fillRect(0, 0, w, h);
  ctx.font = "12px system-ui, sans-serif";
  return ctx;
}

/** Axes around the box {l, t, w, h}; sx, sy map values to pixels. */
function axes(ctx, box, x, y, labels) {
  ctx.strokeStyle = theme.line;
  ctx.fillStyle = theme.soft;
  ctx.lineWidth = 1;
  ctx.strokeRect(box.l + 0.5, box.t + 0.5, box.w, box.h);
  ctx.beginPath();
  ctx.textAlign = "center";
  for (const v of x.ticks) {
    const p = x.at(v);
    ctx.moveTo(p, box.t + box.h);
    ctx.lineTo(p, box.t + box.h + 4);
    ctx.fillText(short(v), p, box.t + box.h + 16);
  }
  ctx.textAlign = "right";
  for (const v of y.ticks) {
    const p = y.at(v);
    ctx.moveTo(box.l, p);
    ctx.lineTo(box.l - 4, p);
    ctx.fillText(short(v), box.l - 6, p + 4);
  }
  ctx.stroke();
  ctx.fillStyle = theme.ink;
  ctx.textAlign = "center";
  if (labels[0]) ctx.fillText(labels[0], box.l + box.w / 2, box.t + box.h + 31);
  ctx.save();
  ctx.translate(11, box.t + box.h / 2);
  ctx.rotate(-Math.PI / 2);
  if (labels[1]) ctx.fillText(labels[1], 0, 0);
  ctx.restore();
  ctx.textAlign = "left";
}

function linear(low, high, from, to, most) {
  const at = (v) => from + ((v - low) / (high - low)) * (to - from);
  return { at, back: (p) => low + ((p - from) / (to - from)) * (high - low), ticks: ticks(low, high, most) };
}
function logarithmic(low, high, from, to) {
  const at = (v) => from + (Math.log(v / low) / Math.log(high / low)) * (to - from);
  const all = [];
  if (low > 0 && high < Infinity) for (let e = Math.ceil(Math.log10(low)); 10 ** e <= high; e++) all.push(10 ** e);
  const every = Math.max(1, Math.ceil(all.length / (Math.abs(to - from) / 40)));
  return { at, back: (p) => low * (high / low) ** ((p - from) / (to - from)), ticks: all.filter((_, i) => i % every === 0) };
}

/** A button that saves a canvas as PNG. */
function saveButton(canvas, name) {
  const button = document.createElement("button");
  button.type = "button";
  button.className = "screen";
  button.textContent = "PNG";
  button.title = "Save as PNG";
  button.setAttribute("aria-label", "Save " + name + " as PNG");
  button.addEventListener("click", () => canvas.toBlob((blob) => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = name.replace(/[^a-z0-9]+/gi, "-") + ".png";
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }));
  return button;
}
