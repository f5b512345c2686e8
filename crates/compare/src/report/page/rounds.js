// The rounds of a refinement.

function drawRounds() {
  const rounds = A().method.rounds || (B() && B().method.rounds);
  byId("rounds-section").hidden = !rounds;
  if (!rounds) return;
  const canvas = byId("rounds"), ctx = begin(canvas), box = chartBox(canvas);
  const n = rounds.rms_nm.length, top = Math.max(...rounds.rms_nm) * 1.1;
  const x = linear(-0.3, Math.max(n - 0.7, 0.7), box.l, box.l + box.w, Math.min(n, 12)), y = linear(0, top, box.t + box.h, box.t, 5);
  x.ticks = x.ticks.filter((v) => Number.isInteger(v));
  const points = rounds.rms_nm.map((v, i) => [i, v]);
  curve(ctx, x, y, points, theme.x);
  points.forEach(([i, v]) => {
    ctx.beginPath();
    ctx.arc(x.at(i), y.at(v), 4, 0, 7);
    ctx.fillStyle = rounds.best === i ? theme.x : theme.paper;
    ctx.fill();
    ctx.stroke();
    ctx.fillStyle = theme.soft;
    ctx.textAlign = "center";
    ctx.fillText(`${number(rounds.total_time_s[i], 5)} s`, x.at(i), y.at(v) + 18);
  });
  axes(ctx, box, x, y, ["round (the full dot is kept)", "executed RMS (nm)"]);
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", "RMS of the executed residual in every round: " + rounds.rms_nm.map((v) => number(v)).join(", ") + " nm");
}
