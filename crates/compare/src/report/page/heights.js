// Histogram and spectrum of the heights.

function drawHistogram() {
  const canvas = byId("histogram"), ctx = begin(canvas), box = chartBox(canvas), colours = LINES();
  const series = [["before", A().run.histogram], [A().label, A().method.histogram]];
  if (B()) series.push([B().label, B().method.histogram]);
  const top = Math.max(...series.flatMap(([, h]) => h.density_per_nm)), low = top * 1e-5;
  const reach = Math.max(...series.map(([, h]) => -h.low_nm));
  const x = linear(-reach, reach, box.l, box.l + box.w, box.w / 70), y = logarithmic(low, top * 2, box.t + box.h, box.t);
  clipped(ctx, box, () => series.forEach(([, h], i) =>
    curve(ctx, x, y, h.density_per_nm.map((v, k) => [h.low_nm + (k + 0.5) * h.width_nm, Math.max(v, low)]), colours[i])));
  axes(ctx, box, x, y, ["height from the mean (nm)", "fraction of the pixels (1/nm)"]);
  legend(ctx, box, series.map(([name], i) => [name, colours[i]]));
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", "Histogram of the heights before and after");
}

function drawSpectrum() {
  const canvas = byId("spectrum"), all = [["before", A().run.spectrum], [A().label, A().method.spectrum]];
  if (B()) all.push([B().label, B().method.spectrum]);
  // A map whose valid pixels hold no rectangle that is large enough has none.
  const series = all.filter(([, s]) => s);
  canvas.parentElement.hidden = !series.length;
  if (!series.length) return;
  const ctx = begin(canvas), box = chartBox(canvas), colours = LINES();
  const f = series.flatMap(([, s]) => s.frequency_per_mm), p = series.flatMap(([, s]) => s.psd_nm2_mm2).filter((v) => v > 0);
  const high = p.length ? Math.max(...p) * 2 : 1, low = Math.max(p.length ? Math.min(...p) : 0.1, high * 1e-10);
  const x = logarithmic(Math.min(...f), Math.max(...f) * 1.0001, box.l, box.l + box.w), y = logarithmic(low, high, box.t + box.h, box.t);
  clipped(ctx, box, () => {
    for (const period of DATA.band_period_mm) {
      ctx.setLineDash([3, 3]);
      curve(ctx, x, y, [[1 / period, low], [1 / period, high]], theme.soft, 1);
      ctx.setLineDash([]);
      ctx.fillStyle = theme.soft;
      ctx.fillText(period + " mm", x.at(1 / period) + 4, box.t + box.h - 6);
    }
    series.forEach(([, s], i) => curve(ctx, x, y, s.frequency_per_mm.map((v, k) => [v, Math.max(s.psd_nm2_mm2[k], low)]), colours[i]));
  });
  axes(ctx, box, x, y, ["spatial frequency (1/mm)", "PSD (nm² mm²)"]);
  legend(ctx, box, series.map(([name], i) => [name, colours[i]]));
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", "Power spectral density before and after");
}
