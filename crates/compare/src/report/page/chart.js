// What the charts below the panels share.

function chartBox(canvas) {
  return { l: 66, t: 18, w: Math.max(30, canvas.clientWidth - 66 - 14), h: canvas.clientHeight - 18 - 38 };
}
function clipped(ctx, box, draw) {
  ctx.save();
  ctx.beginPath();
  ctx.rect(box.l, box.t, box.w, box.h);
  ctx.clip();
  draw();
  ctx.restore();
}
function legend(ctx, box, entries) {
  ctx.textAlign = "left";
  ctx.save();
  const total = entries.reduce((sum, [name]) => sum + 30 + ctx.measureText(name).width, 0);
  if (total > box.w) ctx.font = "10px system-ui, sans-serif";
  let x = total > box.w ? 2 : box.l + 4;
  for (const [name, colour] of entries) {
    ctx.fillStyle = colour;
    ctx.fillRect(x, box.t - 12, 14, 4);
    ctx.fillStyle = theme.ink;
    ctx.fillText(name, x + 18, box.t - 6);
    x += (total > box.w ? 23 : 30) + ctx.measureText(name).width;
  }
  ctx.restore();
}
function curve(ctx, x, y, points, colour, width = 1.5) {
  ctx.beginPath();
  let down = false;
  for (const [u, v] of points) {
    if (!(v === v)) { down = false; continue; }
    if (down) ctx.lineTo(x.at(u), y.at(v)); else ctx.moveTo(x.at(u), y.at(v));
    down = true;
  }
  ctx.strokeStyle = colour;
  ctx.lineWidth = width;
  ctx.stroke();
}
