"use strict";
// The machine: its limits as fields with units over the text of its file.

/** Keys of an axis: key, words, unit. A key of two words with a number is an entry of a list. */
const LIMITS = [
  ["max_velocity_mm_per_s", "largest velocity", "mm/s"], ["max_acceleration_mm_per_s2", "largest acceleration", "mm/s^2"],
  ["max_jerk_mm_per_s3", "largest jerk", "mm/s^3"], ["travel_mm 0", "travel from", "mm"], ["travel_mm 1", "travel to", "mm"],
];

/** The text of the machine file as an object; null while it cannot be read. */
function machineFile() {
  try {
    return JSON.parse($("machine-text").value);
  } catch {
    return null;
  }
}

function limitOf(axis, key) {
  const [name, entry] = key.split(" ");
  return entry === undefined ? axis[name] : axis[name]?.[entry];
}

function setLimit(axis, key, value) {
  const [name, entry] = key.split(" ");
  if (entry === undefined) {
    if (value === null) delete axis[name];
    else axis[name] = value;
    return;
  }
  const pair = axis[name] ?? [null, null];
  pair[entry] = value;
  if (pair.every((v) => v === null)) delete axis[name];
  else axis[name] = pair;
}

/** Writes a field into the text, which is what the server gets. */
function editMachine(change) {
  const file = machineFile();
  if (!file) return fail("The machine file is no JSON; mend its text first.");
  change(file);
  $("machine-text").value = JSON.stringify(file, null, 2);
  $("machine-note").textContent = "Changed. Keep this machine as yours, so that the plan takes it.";
}

function limitField(label, value, change) {
  const field = element("input", { inputMode: "decimal", value: value ?? "", placeholder: "not stated" });
  field.setAttribute("aria-label", label);
  field.addEventListener("change", () => {
    const text = field.value.trim().replace(",", ".");
    if (text !== "" && !Number.isFinite(+text)) return fail(`${label} is '${text}'; give a number`);
    fail("");
    editMachine((file) => change(file, text === "" ? null : +text));
  });
  return field;
}

/** Shows the limits of the text as fields. */
function showLimits() {
  const file = machineFile(), table = $("machine-limits");
  if (!file || !Array.isArray(file.axes)) return table.replaceChildren();
  const head = element("tr", {}, element("th", { textContent: "limit" }), ...file.axes.map((axis) => element("th", { textContent: "axis " + axis.name })));
  // The axes of a rotation state other keys, which stay in the text.
  const rows = LIMITS.map(([key, words, unit]) => element("tr", {}, element("th", {}, words + " ", element("span", { className: "unit", textContent: unit })),
    ...file.axes.map((axis, i) => element("td", {}, limitField(`${words} of axis ${axis.name}, ${unit}`, limitOf(axis, key),
      (edited, value) => setLimit(edited.axes[i], key, value))))));
  const rest = element("tr", {}, element("th", {}, "time to full acceleration ", element("span", { className: "unit", textContent: "s" })),
    element("td", { colSpan: file.axes.length }, limitField("time to full acceleration, s", file.time_to_full_acceleration_s, (edited, value) => {
      if (value === null) delete edited.time_to_full_acceleration_s;
      else edited.time_to_full_acceleration_s = value;
    })));
  table.replaceChildren(head, ...rows, rest);
  $("machine-note").textContent = travelNote(file);
}

/** Says whether a path over the part, with half the tool beyond its edges, is longer than the travel. */
function travelNote(file) {
  const part = views.part?.map, tool = views.tool?.map;
  if (!part || !tool) return "";
  const notes = ["x", "y"].map((name, i) => {
    const axis = file.axes.find((known) => known.name === name);
    const need = part.edges_mm[2 * i + 1] - part.edges_mm[2 * i] + tool.edges_mm[2 * i + 1] - tool.edges_mm[2 * i];
    if (!axis?.travel_mm) return `${name}: the path is about ${number(need, 3)} mm long; the file states no travel`;
    const room = axis.travel_mm[1] - axis.travel_mm[0];
    return `${name}: the path is about ${number(need, 3)} mm long, the travel ${number(room)} mm${need > room ? " - too short" : ""}`;
  });
  return notes.join("; ") + ".";
}

async function showMachine() {
  const key = JSON.stringify(state.session.machine);
  if (!state.session.machine || drawn.machine === key) return;
  drawn.machine = key;
  $("machine-text").value = await (await ask("machine.json")).text();
  showLimits();
}

function startMachine() {
  onSubmit("machine-form", "machine", () => ({ own: $("machine-text").value }));
  $("machine-text").addEventListener("change", showLimits);
  $("machine-fixture").addEventListener("change", () => $("machine-fixture").value && send("machine", { fixture: $("machine-fixture").value }));
  $("machine-file").addEventListener("change", async () => {
    const file = $("machine-file").files[0];
    if (!file) return;
    $("machine-text").value = await file.text();
    showLimits();
    send("machine", { own: $("machine-text").value });
  });
}
