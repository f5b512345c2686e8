// The profiles through the pinned place.

/** Heights along a row (axis 0) or a column (axis 1) through the pin. */
function profile(layer, axis) {
  const at = valueAt(layer, ...state.pin), values = layer.values();
  if (!at) return [];
  return axis === 0
    ? Array.from({ length: layer.nx }, (_, c) => [layer.x0 + c * layer.dx, values[at.row * layer.nx + c]])
    : Array.from({ length: layer.ny }, (_, r) => [layer.y0 + r * layer.dy, values[r * layer.nx + at.column]]);
}
function drawProfiles() {
  byId("pin").textContent = `x ${number(state.pin[0], 5)} mm, y ${number(state.pin[1], 5)} mm`;
  for (const axis of [0, 1]) {
    const canvas = byId(["profile-x", "profile-y"][axis]), ctx = begin(canvas), box = chartBox(canvas);
    const wanted = [[A().run.desired, "desired"], [A().removal, "removal"], [A().residual, "residual"]];
    if (B()) wanted.push([B().residual, "residual, " + B().label]);
    const colours = LINES();
    const series = wanted.map(([layer, name], i) => ({ name, colour: colours[i], points: profile(layer, axis).map(([u, v]) => [u, v - layer.mean]) }));
    const all = series.flatMap((s) => s.points.map((p) => p[1])).filter((v) => v === v);
    const low = all.length ? Math.min(...all) : -1, high = all.length ? Math.max(...all) : 1, rim = 0.05 * (high - low) || 1;
    const [from, to] = viewOfMaps().slice(2 * axis, 2 * axis + 2);
    const x = linear(from, to, box.l, box.l + box.w, box.w / 70), y = linear(low - rim, high + rim, box.t + box.h, box.t, 5);
    clipped(ctx, box, () => {
      for (const s of series) curve(ctx, x, y, s.points, s.colour);
      curve(ctx, x, y, [[state.pin[axis], low - rim], [state.pin[axis], high + rim]], theme.line, 1);
    });
    axes(ctx, box, x, y, [["x (mm)", "y (mm)"][axis], "from the mean (nm)"]);
    legend(ctx, box, series.map((s) => [s.name, s.colour]));
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", "Profile along " + ["x", "y"][axis]);
  }
}
