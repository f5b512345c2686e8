// Residual against time of all plans, with the front of those that can be run.

const FRONT = DATA.front;
/** Number of plans from which only those on the front have their names in the picture. */
const MANY_PLANS = 16;

const nameOfPoint = (p) => (FRONT.points.some((q) => q.run !== p.run) ? p.run + " / " : "") + p.plan;

function frontScale(values, from, to, most) {
  const low = Math.min(...values), high = Math.max(...values), room = 0.12;
  if (low > 0 && high > 10 * low) return logarithmic(low / (1 + room), high * (1 + room), from, to);
  const rim = room * (high - low) || 0.1 * high || 1;
  return linear(low - rim, high + rim, from, to, most);
}

/** The first box beside a point that covers no other; the boxes are [left, top, right, bottom]. */
function freeBox(box, px, py, width, taken) {
  const height = 14, isLeft = px + 12 + width > box.l + box.w, left = isLeft ? px - 12 - width : px + 12;
  let first = null;
  for (let k = 0; k < 20; k++) {
    const row = Math.ceil(k / 2) * (k % 2 ? height : -height), top = py + row - height / 2;
    const one = [left, top, left + width, top + height];
    first = first || one;
    const inside = top >= box.t && top + height <= box.t + box.h;
    if (inside && !taken.some((t) => one[0] < t[2] && t[0] < one[2] && one[1] < t[3] && t[1] < one[3])) return one;
  }
  return first;
}

function drawFront() {
  const points = FRONT.points, canvas = byId("front");
  byId("front-section").hidden = points.length < 2;
  if (points.length < 2) return;
  const ctx = begin(canvas), box = chartBox(canvas);
  const x = frontScale(points.map((p) => p.time_s), box.l, box.l + box.w, box.w / 70);
  const y = frontScale(points.map((p) => p.rms_nm), box.t + box.h, box.t, 5);
  const mayRun = (p) => p.kind === "plan" && p.limits_kept === true;
  const stairs = [];
  for (const p of FRONT.on_the_front.map((i) => points[i])) {
    if (stairs.length) stairs.push([p.time_s, stairs.at(-1)[1]]);
    stairs.push([p.time_s, p.rms_nm]);
  }
  curve(ctx, x, y, stairs, theme.soft);
  const taken = [];
  for (const p of points) {
    const px = x.at(p.time_s), py = y.at(p.rms_nm);
    taken.push([px - 7, py - 7, px + 7, py + 7]);
    ctx.beginPath();
    ctx.arc(px, py, 5, 0, 7);
    ctx.fillStyle = p.kind === "dwell-times" ? theme.y : mayRun(p) ? theme.x : theme.soft;
    ctx.fill();
    if (!p.is_recommended) continue;
    ctx.beginPath();
    ctx.arc(px, py, 9, 0, 7);
    ctx.strokeStyle = theme.ink;
    ctx.lineWidth = 2;
    ctx.stroke();
  }
  ctx.fillStyle = theme.ink;
  ctx.textAlign = "left";
  for (const [i, p] of points.entries()) {
    if (points.length > MANY_PLANS && !p.is_recommended && !FRONT.on_the_front.includes(i)) continue;
    const label = nameOfPoint(p);
    const one = freeBox(box, x.at(p.time_s), y.at(p.rms_nm), ctx.measureText(label).width, taken);
    taken.push(one);
    // A rim of paper keeps the letters apart from the line of the front.
    ctx.strokeStyle = theme.paper;
    ctx.lineWidth = 3;
    ctx.strokeText(label, one[0], one[3] - 3);
    ctx.fillText(label, one[0], one[3] - 3);
  }
  axes(ctx, box, x, y, ["time (s)", "RMS of the residual (nm)"]);
  legend(ctx, box, [["can be run", theme.x], ["not to be run", theme.soft], ["dwell times without a motion", theme.y]]);
  drawFront.places = points.map((p) => [x.at(p.time_s), y.at(p.rms_nm)]);
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", "Residual against time of all plans: " + points.map((p) => `${p.plan} ${number(p.rms_nm)} nm in ${number(p.time_s)} s`).join(", "));
}

/** Says which plan is nearest to the pointer. */
function readFront(event) {
  const r = byId("front").getBoundingClientRect(), at = [event.clientX - r.left, event.clientY - r.top];
  const far = drawFront.places.map(([px, py]) => Math.hypot(px - at[0], py - at[1]));
  const p = FRONT.points[far.indexOf(Math.min(...far))];
  const kept = p.limits_kept === null ? "no motion" : "limits " + (p.limits_kept ? "kept" : "exceeded");
  byId("front-read").textContent = `${nameOfPoint(p)}: ${number(p.rms_nm)} nm RMS in ${number(p.time_s)} s, ${kept}`;
}

/** Saves a text as a file. */
function saveText(text, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}
