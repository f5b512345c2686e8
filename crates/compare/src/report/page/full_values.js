// Full values from a file of the run.

/** An array of 64-bit floats from the bytes of a .npy file. */
function parseNpy(buffer) {
  const bytes = new Uint8Array(buffer), long = bytes[6] > 1;
  const view = new DataView(buffer), length = long ? view.getUint32(8, true) : view.getUint16(8, true), start = long ? 12 : 10;
  const header = new TextDecoder("latin1").decode(bytes.subarray(start, start + length));
  const shape = /'shape': \((\d+), (\d+)\)/.exec(header);
  if (bytes[0] !== 0x93 || !header.includes("'<f8'") || !header.includes("'fortran_order': False") || !shape) return null;
  return { ny: +shape[1], nx: +shape[2], values: new Float64Array(buffer.slice(start + length)) };
}
async function loadFull(file) {
  const layer = { "removal_nm.npy": A().removal, "residual_nm.npy": A().residual, "height_nm.npy": A().run.desired }[file.name];
  const array = parseNpy(await file.arrayBuffer());
  const k = layer && layer.every;
  const fits = layer && array && Math.ceil(array.nx / k) === layer.nx && Math.ceil(array.ny / k) === layer.ny;
  if (!fits) {
    byId("loaded").textContent = `${file.name}: is not a map of this method with its ${layer ? `${layer.nx * layer.every} x ${layer.ny * layer.every} pixels or a little less` : "usual name"}.`;
    return;
  }
  Object.assign(layer, { x0: layer.x0 - ((k - 1) / 2) * (layer.dx / k), y0: layer.y0 - ((k - 1) / 2) * (layer.dy / k), dx: layer.dx / k, dy: layer.dy / k,
    nx: array.nx, ny: array.ny, every: 1, step: 0, reach99: undefined, values: () => array.values });
  differences.clear();
  slopeLayers.clear();
  byId("loaded").textContent = `${layer.title} of ${A().label}: all ${array.nx} x ${array.ny} values of ${file.name}.`;
  for (const p of panels) { p.baseKey = null; p.imageKey = null; }
  redraw();
}
