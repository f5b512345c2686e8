"use strict";
// The files that the user gives, how they are read, and the choices of part and tool.

const ARRAYS = { part: "height_nm.npy", tool: "rate_nm_per_s.npy", varying: "weight.npy", after: "height_nm.npy" };
/** Files of each role: { file } or { arrays }. */
const chosen = { part: null, tool: null, before: null, varying: null, after: null };
/** Time at which the files of a step were given, ms, until its map is drawn. */
const given = {};

/** Fields of a reading: name, unit, kind, sentence. */
const READING = [
  ["unit", "", "text", "Unit of the values, if the file does not state it: m, mm, um, nm, angstrom, in, mil, waves; rates over a time, such as nm/min."],
  ["wavelength_nm", "nm", "number", "Wavelength of the light, for heights in waves."],
  ["pixel_mm", "mm", "number", "Distance of pixel centres, if the file does not state it."],
  ["coordinate_unit", "", "text", "Unit of the coordinates, if the file does not state it: m, mm, um, in."],
  ["dataset", "", "text", "Array to read, if the file has several."],
  ["surface_per_value", "", "number", "Height of the surface per height in the file: 0.5 for the wavefront of one reflection. Default 1."],
  ["first_row", "", ["", "top", "bottom"], "Side of the map that the first row of the file is. Default: as the format has it."],
  ["rotate_deg", "degree", ["0", "90", "180", "270"], "Turn counterclockwise, after mirroring."],
  ["flip_x", "", "check", "Mirror x."], ["flip_y", "", "check", "Mirror y."],
  ["negate", "", "check", "The file counts material as negative."],
];
/** Number of coordinates of an aperture. */
const CORNERS = { rectangle: 4, circle: 3 };
/** Forms to begin with, as form files. */
const FORMS = {
  sphere: { kind: "sphere", radius_mm: 1000, fit: { radius_mm: "free" } },
  paraboloid: { kind: "paraboloid", radius_mm: 1000 },
  asphere: { kind: "asphere", radius_mm: 1000, conic_constant: -1, even_terms: [0], vertex_mm: [0, 0] },
  cylinder: { kind: "cylinder", radius_mm: 1000, fit: { radius_mm: "free" } },
  "elliptic-cylinder": { kind: "elliptic-cylinder", p_mm: 30000, q_mm: 500, theta_mrad: 3, fit: { theta_mrad: "free" } },
};

/** A number of a field; null if it is empty. */
function numberOf(id, name) {
  const text = $(id).value.trim().replace(",", ".");
  if (text === "") return null;
  if (!Number.isFinite(+text)) throw new Error(`${name} is '${text}'; give a number`);
  return +text;
}

function makeReading(step) {
  for (const [name, unit, kind, help] of READING) {
    const id = `${step}-${name}`, label = element("label");
    const words = name.replace(/_(mm|nm|deg)$/, "").replaceAll("_", " ") + " ";
    let field;
    if (Array.isArray(kind)) field = element("select", { id }, ...kind.map((word) => element("option", { value: word, textContent: word || "as the format has it" })));
    else field = element("input", kind === "check" ? { id, type: "checkbox" } : { id, inputMode: kind === "number" ? "decimal" : "text" });
    if (kind === "check") {
      label.className = "check";
      label.append(field, help);
    } else label.append(words, element("span", { className: "unit", textContent: unit }), field, element("small", { textContent: help }));
    // Every change is seen at once.
    field.addEventListener("change", () => state?.session[step] && chosen[step] && $(`${step}-form`).requestSubmit());
    $(`${step}-reading`).append(label);
  }
}

function readingOf(step) {
  const reading = {};
  for (const [name, , kind] of READING) {
    const id = `${step}-${name}`;
    if (kind === "check") reading[name] = $(id).checked;
    else if (kind === "number") reading[name] = numberOf(id, name);
    else reading[name] = $(id).value.trim() === "" ? null : name === "rotate_deg" ? (+$(id).value || null) : $(id).value.trim();
  }
  return reading;
}

function setReading(step, reading) {
  for (const [name, , kind] of READING) {
    const value = reading[name];
    if (kind === "check") $(`${step}-${name}`).checked = value === true;
    else $(`${step}-${name}`).value = value ?? (name === "rotate_deg" ? "0" : "");
  }
}

/** Asks for what a reader has missed: opens the fields, marks those whose flags its message names, and goes to the first. */
function askFor(step, messages) {
  const error = messages.split("\n").filter((line) => line.startsWith("error: ")).join("\n");
  const flags = new Set([...error.matchAll(/--([a-z][a-z-]*[a-z])/g)].map((match) => match[1].replaceAll("-", "_")));
  const asked = READING.map(([name]) => name).filter((name) => flags.has(name)).map((name) => $(`${step}-${name}`));
  for (const [name] of READING) {
    const label = $(`${step}-${name}`).closest("label");
    label.classList.toggle("asked", flags.has(name));
    label.querySelector(".refused")?.remove();
    if (flags.has(name)) label.append(element("small", { className: "bad refused", textContent: error.replace("error: ", "") }));
  }
  if (asked.length === 0) return;
  $(`${step}-reading`).closest("details").open = true;
  if (!document.activeElement?.closest(`#${step}-reading`)) asked[0].focus();
}

/** Sends files to the session. Three arrays are one map. */
async function upload(role, files) {
  try {
    fail("");
    given[role] = performance.now();
    const names = [...files].map((file) => file.name.replace(/[^A-Za-z0-9._+-]/g, "_").replace(/^[.-]+/, "").slice(-100) || "file");
    if (role === "varying" && !names.includes(ARRAYS.varying)) throw new Error("A tool that varies has weight.npy among its files; give all of them.");
    if (names.length > 1 && !names.includes(ARRAYS[role]))
      throw new Error(`Several files are ${ARRAYS[role] ?? "no map before the tool"}, x_mm.npy and y_mm.npy; otherwise give one file.`);
    $(`${role}-chosen`).textContent = `Reading ${names.join(", ")} ...`;
    for (const [i, file] of [...files].entries()) await ask(`upload/${role}/${names[i]}`, { method: "POST", body: file });
    chosen[role] = names.length > 1 ? { arrays: names } : { file: names[0] };
    $(`${role}-chosen`).textContent = names.join(", ");
    if (role === "part") $("part-fixture").value = "";
    if (role === "tool" && ["fixture", "formula"].includes($("tool-source").value)) {
      $("tool-source").value = "rates";
      showSource();
    }
    if (role === "part" || role === "after") $(`${role}-form`).requestSubmit();
    if (role === "varying" || role === "tool" && $("tool-source").value === "rates") $("tool-form").requestSubmit();
  } catch (error) {
    chosen[role] = null;
    $(`${role}-chosen`).textContent = "No file.";
    fail(error.message);
  }
}

function sourceOf(role) {
  if (!chosen[role]) throw new Error("Give the file first.");
  return chosen[role].arrays ? "arrays" : { file: chosen[role].file };
}

function apertureOf() {
  const kind = $("part-aperture").value;
  if (kind === "") return null;
  const numbers = $("part-aperture-mm").value.trim().split(/[\s,;]+/).map(Number);
  if (numbers.length !== CORNERS[kind] || !numbers.every(Number.isFinite))
    throw new Error(`The aperture is ${CORNERS[kind]} numbers in mm: ${kind === "circle" ? "centre x, centre y, radius" : "smallest x, largest x, smallest y, largest y"}.`);
  return { [kind]: numbers };
}

/** Proposes the aperture that the whole map has. */
function proposeAperture() {
  const kind = $("part-aperture").value, map = views.part?.map;
  $("part-aperture-mm").closest("label").hidden = kind === "";
  if (kind === "" || !map) return;
  const [x0, x1, y0, y1] = map.edges_mm;
  const numbers = kind === "circle" ? [(x0 + x1) / 2, (y0 + y1) / 2, Math.min(x1 - x0, y1 - y0) / 2] : [x0, x1, y0, y1];
  $("part-aperture-mm").value = numbers.map((mm) => +mm.toFixed(4)).join(" ");
}

function partChoice() {
  const fixture = $("part-fixture").value, target = $("part-target").value.trim();
  if (!fixture && !chosen.part) throw new Error("Give the file of the part, or choose a fixture.");
  return { source: fixture ? { fixture } : sourceOf("part"), reading: readingOf("part"), aperture: apertureOf(), target: target || null,
    level: $("part-level").value, feature_mm: numberOf("part-feature", "the width of the tool") };
}

function fillPart({ source, reading, aperture, target, level, feature_mm }) {
  $("part-fixture").value = source.fixture ?? "";
  if (source.file) chosen.part = { file: source.file };
  if (source === "arrays") chosen.part = { arrays: [] };
  if (chosen.part) $("part-chosen").textContent = source.file ?? "height_nm.npy, x_mm.npy, y_mm.npy";
  setReading("part", reading);
  const [kind, numbers] = Object.entries(aperture ?? {})[0] ?? ["", []];
  $("part-aperture").value = kind;
  $("part-aperture-mm").value = numbers.join(" ");
  $("part-aperture-mm").closest("label").hidden = kind === "";
  $("part-target").value = target ?? "";
  $("part-level").value = level;
  $("part-feature").value = feature_mm ?? "";
}

function toolChoice() {
  const kind = $("tool-source").value;
  let source;
  if (kind === "fixture") source = { fixture: $("tool-fixture").value };
  else if (kind === "formula") source = { formula: { peak_nm_per_s: numberOf("tool-peak", "the peak rate"), fwhm_mm: numberOf("tool-fwhm", "the width") } };
  else if (kind === "varying" && chosen.varying) source = { varying: chosen.varying.arrays };
  else if (kind === "varying" || !chosen.tool) throw new Error("Give the file of the tool.");
  else if (kind === "rates") source = chosen.tool.arrays ? "arrays" : { rates: chosen.tool.file };
  else source = { spot: { file: chosen.tool.file ?? "", before: chosen.before?.file ?? null,
    dwell_s: numberOf("tool-dwell", "the time at the spot"), half_size_mm: numberOf("tool-half", "the half size") } };
  const values = Object.values(source.formula ?? source.spot ?? {});
  if (source.formula && values.includes(null) || source.spot && (source.spot.dwell_s === null || source.spot.half_size_mm === null))
    throw new Error("A number is missing: fill in the fields with a unit.");
  const isMeasured = kind === "rates" || kind === "spot";
  return { source, reading: readingOf("tool"), fit: (isMeasured && $("tool-fit").value) || null };
}

function fillTool({ source, reading, fit }) {
  const kind = source === "arrays" ? "rates" : Object.keys(source)[0];
  $("tool-source").value = kind;
  $("tool-fit").value = fit ?? "";
  if (kind === "fixture") $("tool-fixture").value = source.fixture;
  if (kind === "formula") [$("tool-peak").value, $("tool-fwhm").value] = [source.formula.peak_nm_per_s, source.formula.fwhm_mm];
  if (kind === "rates") chosen.tool = source === "arrays" ? { arrays: [] } : { file: source.rates };
  if (kind === "spot") {
    chosen.tool = { file: source.spot.file };
    chosen.before = source.spot.before ? { file: source.spot.before } : null;
    [$("tool-dwell").value, $("tool-half").value] = [source.spot.dwell_s, source.spot.half_size_mm];
  }
  if (kind === "varying") chosen.varying = { arrays: source.varying };
  if (chosen.varying) $("varying-chosen").textContent = chosen.varying.arrays.join(", ");
  if (chosen.tool) $("tool-chosen").textContent = chosen.tool.file ?? "rate_nm_per_s.npy, x_mm.npy, y_mm.npy";
  setReading("tool", reading);
  showSource();
}

function showSource() {
  for (const part of document.querySelectorAll("[data-source]"))
    part.hidden = !part.dataset.source.split(" ").includes($("tool-source").value);
}

function startReading() {
  for (const step of ["part", "tool", "after"]) makeReading(step);
  showSource();
  $("tool-source").addEventListener("change", showSource);
  for (const role of ["part", "tool", "before", "varying", "after"]) {
    const field = $(`${role}-file`), drop = field.closest(".drop");
    field.addEventListener("change", () => field.files.length && upload(role, field.files));
    for (const kind of ["dragover", "dragleave", "drop"])
      drop.addEventListener(kind, (event) => {
        event.preventDefault();
        drop.classList.toggle("over", kind === "dragover");
        if (kind === "drop") upload(role, event.dataTransfer.files);
      });
  }
  onSubmit("part-form", "part", partChoice);
  onSubmit("tool-form", "tool", toolChoice);
  $("part-fixture").addEventListener("change", () => $("part-fixture").value && $("part-form").requestSubmit());
  $("part-level").addEventListener("change", () => state.session.part && $("part-form").requestSubmit());
  $("part-aperture").addEventListener("change", proposeAperture);
  fillSelect($("part-form-kind"), Object.keys(FORMS), "no form: the map is the error");
  $("part-form-kind").addEventListener("change", () => {
    const form = FORMS[$("part-form-kind").value];
    $("part-target").value = form ? JSON.stringify(form, null, 1) : "";
  });
}
