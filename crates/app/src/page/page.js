"use strict";
// The steps of a session: forms that send choices, and the state that the server returns.

const $ = (id) => document.getElementById(id);
const LEVELS = { done: "done", negative: "done, with a negative verdict", refused: "refused", cancelled: "cancelled",
  interrupted: "interrupted: the server ended; do this step again, what was finished is not repeated", running: "running",
  outdated: "an earlier step has changed: do it again" };
/** Time between two looks at the state, ms: while a step runs, and else (another tab may have begun one). */
const PAUSES = [150, 2000];
const ARRAYS = { part: "height_nm.npy", tool: "rate_nm_per_s.npy" };

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

let state = null;
const views = {}, drawn = {}, pipelines = {}, chosen = { part: null, tool: null, before: null };
let toolNumbers = null;

function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

function fail(text) {
  $("error").textContent = text;
  $("error").hidden = text === "";
}

async function ask(path, options) {
  let answer;
  try {
    answer = await fetch(path, options);
  } catch {
    throw new Error("The server does not answer. Start planish app again in the same directory; the session is kept.");
  }
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}

async function send(path, choice) {
  try {
    fail("");
    const answer = await ask(path, { method: "POST", body: choice === undefined ? "" : JSON.stringify(choice) });
    await show(await answer.json());
    look();
  } catch (error) {
    fail(error.message);
  }
}

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
    // Turns and mirrors are seen at once.
    if (kind === "check" || Array.isArray(kind))
      field.addEventListener("change", () => state?.session[step]?.choice.source !== undefined && chosen[step] && $(`${step}-form`).requestSubmit());
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

/** Sends files to the session. Three arrays are one map. */
async function upload(role, files) {
  try {
    fail("");
    const names = [];
    for (const file of files) {
      const name = file.name.replace(/[^A-Za-z0-9._+-]/g, "_").replace(/^[.-]+/, "").slice(-100) || "file";
      $(`${role}-chosen`).textContent = `Reading ${file.name} ...`;
      await ask(`upload/${role}/${name}`, { method: "POST", body: file });
      names.push(name);
    }
    chosen[role] = names.length > 1 ? { arrays: names } : { file: names[0] };
    if (names.length > 1 && !names.includes(ARRAYS[role]))
      throw new Error(`Several files are ${ARRAYS[role]}, x_mm.npy and y_mm.npy; otherwise give one file.`);
    $(`${role}-chosen`).textContent = names.join(", ");
    if (role === "part") {
      $("part-fixture").value = "";
      $("part-form").requestSubmit();
    } else if (role === "tool" && $("tool-source").value === "rates") $("tool-form").requestSubmit();
  } catch (error) {
    chosen[role] = null;
    $(`${role}-chosen`).textContent = "No file.";
    fail(error.message);
  }
}

function partChoice() {
  const fixture = $("part-fixture").value;
  let source;
  if (fixture) source = { fixture };
  else if (!chosen.part) throw new Error("Give the file of the part, or choose a fixture.");
  else source = chosen.part.arrays ? "arrays" : { file: chosen.part.file };
  return { source, reading: readingOf("part"), level: $("part-level").value, feature_mm: numberOf("part-feature", "the width of the tool") };
}

function toolChoice() {
  const kind = $("tool-source").value;
  let source;
  if (kind === "fixture") source = { fixture: $("tool-fixture").value };
  else if (kind === "formula") source = { formula: { peak_nm_per_s: numberOf("tool-peak", "the peak rate"), fwhm_mm: numberOf("tool-fwhm", "the width") } };
  else if (!chosen.tool) throw new Error("Give the file of the tool.");
  else if (kind === "rates") source = chosen.tool.arrays ? "arrays" : { rates: chosen.tool.file };
  else source = { spot: { file: chosen.tool.file ?? "", before: chosen.before?.file ?? null,
    dwell_s: numberOf("tool-dwell", "the time at the spot"), half_size_mm: numberOf("tool-half", "the half size") } };
  const values = Object.values(source.formula ?? source.spot ?? {});
  if (source.formula && values.includes(null) || source.spot && (source.spot.dwell_s === null || source.spot.half_size_mm === null))
    throw new Error("A number is missing: fill in the fields with a unit.");
  return { source, reading: readingOf("tool") };
}

function planChoice(controller) {
  const settings = {};
  for (const field of document.querySelectorAll("#plan-form [data-setting]"))
    if (field.value.trim() !== "") settings[field.dataset.setting] = field.value.trim();
  if (controller) settings.export = controller;
  return { pipeline: document.querySelector("#pipelines input:checked").value, settings };
}

function onSubmit(id, path, choice) {
  $(id).addEventListener("submit", (event) => {
    event.preventDefault();
    let value;
    try {
      value = choice();
    } catch (error) {
      return fail(error.message);
    }
    send(path, value);
  });
}

function fillSelect(select, words, first) {
  select.replaceChildren(...(first === undefined ? [] : [element("option", { value: "", textContent: first })]),
    ...words.map((word) => element("option", { value: word, textContent: word })));
}

function settingField(setting, value) {
  const field = setting.words.length
    ? element("select", {}, element("option", { value: "", textContent: "default" + (setting.default ? ": " + setting.default : "") }),
      ...setting.words.map((word) => element("option", { value: word, textContent: word })))
    : element("input", { inputMode: "text", placeholder: setting.default ? "default: " + setting.default : "no value" });
  field.dataset.setting = setting.name;
  field.value = value ?? "";
  const words = setting.name.replace(/_(s_per_mm|nm2_per_s|mm_per_s|percent|mm2|deg|mm|nm|s)$/, "").replaceAll("_", " ");
  const label = element("label", {}, words + " ", element("span", { className: "unit", textContent: setting.unit }),
    field, element("small", { textContent: setting.help + (setting.words.length ? "" : ` (${setting.allowed})`) }));
  if (setting.name === "pitch_mm") label.append(element("small", { id: "proposal" }));
  return label;
}

/** Fields of the settings of a pipeline, with the values of the choice. */
async function showPipeline(name, values = {}) {
  pipelines[name] ??= await (await ask(`pipeline/${name}`)).json();
  const pipeline = pipelines[name];
  $("pipeline-title").textContent = pipeline.title;
  const plain = pipeline.settings.filter((s) => s.is_plain && s.name !== "export");
  const first = new Set(["pitch_mm", "step_mm", "scan", "overscan_mm", "min_dwell_s_per_mm", "refine", "passes", "spacing_mm", "seed"]);
  $("settings").replaceChildren(...plain.filter((s) => first.has(s.name)).map((s) => settingField(s, values[s.name])));
  $("more-settings").replaceChildren(...plain.filter((s) => !first.has(s.name)).map((s) => settingField(s, values[s.name])));
  const controllers = pipeline.settings.find((s) => s.name === "export").words;
  fillSelect($("controller"), controllers);
  if (values.export) $("controller").value = values.export;
  propose();
}

/** Pitch at which the ripple of a Gaussian of this tool is 0.1 %, and a sixth of the tool; the smaller one. */
function propose() {
  if (!$("proposal") || !toolNumbers) return;
  const { peak, vrr, size } = toolNumbers, sigma = Math.sqrt(vrr / (2 * Math.PI * peak));
  const ripple = Math.PI * sigma * Math.sqrt(2 / Math.log(4 / 0.001)), pitch = Math.min(ripple, size / 6);
  // Two digits, rounded down: a larger pitch is beyond the limit.
  const digit = 10 ** (Math.floor(Math.log10(pitch)) - 1), proposed = Math.floor(pitch / digit + 1e-9) * digit;
  $("proposal").textContent = `Proposed by the tool: ${number(proposed)} mm, the smaller of a sixth of its size (${number(size / 6, 3)} mm) ` +
    `and the pitch with a ripple of 0.1 % (${number(ripple, 3)} mm).`;
}

async function drawMap(step) {
  const root = $(`${step}-view`), found = state.session[step];
  const key = JSON.stringify(found);
  if (!found || !["done", "negative"].includes(found.end) || drawn[step] === key) return;
  drawn[step] = key;
  const map = readMap(await (await ask(`map/${step}`)).arrayBuffer());
  views[step] ??= new MapView(root, state.colours);
  views[step].show(map);
  if (step === "tool") {
    const value = (name) => map.numbers.find(([known]) => known === name)[1];
    const [x0, x1] = map.edges_mm;
    toolNumbers = { peak: value("peak rate"), vrr: value("volumetric removal rate"), size: x1 - x0 - map.pitch_mm[0] };
    propose();
  }
}

function shellWord(word) {
  return /^[A-Za-z0-9_./=:,+-]+$/.test(word) ? word : "'" + word.replaceAll("'", "'\\''") + "'";
}

function showStep(step, messages) {
  const section = $(step), found = state.session[step], end = section.querySelector(".end");
  end.textContent = found ? `(${LEVELS[found.end]})` : "";
  if (found?.end === "refused" && step !== "plan") section.querySelector("form details:not([hidden])").open = true;
  end.classList.toggle("bad", !!found && !["done", "running"].includes(found.end));
  if (!found) return;
  const place = section.querySelector(".done");
  const warnings = messages.split("\n").filter((line) => /^(warning|error): /.test(line) || line.startsWith("verdict: ") && found.end === "negative");
  const key = JSON.stringify([found.commands, found.end, messages]);
  if (place.dataset.key === key) return;
  place.dataset.key = key;
  const isOpen = place.querySelector("details")?.open ?? false;
  const lines = found.commands.map((words) => words.map(shellWord).join(" ")).join("\n");
  const log = element("pre", { className: "messages", textContent: messages, tabIndex: 0 });
  place.replaceChildren(element("p", { className: "note", textContent: "The same in a script:" }), element("pre", { className: "command", textContent: lines }),
    ...warnings.map((line) => element("p", { className: "doubt", textContent: line })),
    element("details", { open: isOpen || found.end === "running" && step === "plan" }, element("summary", { textContent: "All messages of this step" }), log));
  log.scrollTop = log.scrollHeight;
}

async function showResult() {
  const plan = state.session.plan, key = JSON.stringify([plan, state.has_report]);
  if (drawn.result === key) return;
  drawn.result = key;
  const isDone = plan && ["done", "negative", "outdated"].includes(plan.end) && state.has_report;
  $("download").hidden = state.program === "";
  $("download").textContent = "Save " + state.program;
  if (!isDone) {
    if (plan?.end === "running") $("sentence").textContent = "The plan is running.";
    return;
  }
  const { answer } = await (await ask("answer")).json();
  $("sentence").textContent = (plan.end === "outdated" ? "Of an earlier plan: " : "") + (answer.sentence || "No plan is recommended.");
  $("why").textContent = answer.why;
  $("problems").replaceChildren(...(answer.problems ?? []).map((text) => element("li", { textContent: text })));
  // The report has a program of its own; in this frame it can reach neither the page nor the server.
  const frame = element("iframe", { title: "Report of the run", src: state.report });
  frame.setAttribute("sandbox", "allow-scripts allow-downloads");
  $("report").replaceChildren(frame);
}

function showProgram(messages) {
  // The verdicts of the other plans are in the messages of the plan.
  const readBack = `+${state.session.plan?.choice.settings.export}/verdict`;
  const lines = messages.split("\n").filter((line) => /^(program|warning: the program)/.test(line) || line.startsWith("planish-verify:") && line.includes(readBack));
  $("program-verdict").textContent = lines.join("\n");
  $("program-verdict").hidden = state.program === "" || lines.length === 0;
  const isExport = !!state.session.plan?.choice.settings.export;
  document.querySelector("#program .end").textContent = isExport && state.program ? "(written)" : "";
}

/** Shows what the server says, the choices only once: what the user types stays. */
let isFilled = false;
async function fill() {
  if (isFilled) return;
  isFilled = true;
  const { part, tool, machine, plan } = state.session;
  for (const name of state.pipelines) {
    const id = `pipeline-${name}`, radio = element("input", { type: "radio", name: "pipeline", value: name, id });
    radio.addEventListener("change", () => showPipeline(name).catch((error) => fail(error.message)));
    $("pipelines").append(element("label", {}, radio, " " + name));
  }
  const first = plan?.choice.pipeline ?? "raster";
  $(`pipeline-${first}`).checked = true;
  await showPipeline(first, plan?.choice.settings);
  fillSelect($("part-fixture"), pipelines[first].fixtures, "no fixture: my own file");
  fillSelect($("tool-fixture"), pipelines[first].fixtures);
  fillSelect($("machine-fixture"), pipelines[first].machines, "choose one");
  if (part) fillPart(part.choice);
  if (tool) fillTool(tool.choice);
  if (machine?.fixture) $("machine-fixture").value = machine.fixture;
}

function fillPart({ source, reading, level, feature_mm }) {
  $("part-fixture").value = source.fixture ?? "";
  if (source.file) chosen.part = { file: source.file };
  if (source === "arrays") chosen.part = { arrays: [] };
  if (chosen.part) $("part-chosen").textContent = source.file ?? "height_nm.npy, x_mm.npy, y_mm.npy";
  setReading("part", reading);
  $("part-level").value = level;
  $("part-feature").value = feature_mm ?? "";
}

function fillTool({ source, reading }) {
  const kind = source === "arrays" ? "rates" : Object.keys(source)[0];
  $("tool-source").value = kind;
  if (kind === "fixture") $("tool-fixture").value = source.fixture;
  if (kind === "formula") [$("tool-peak").value, $("tool-fwhm").value] = [source.formula.peak_nm_per_s, source.formula.fwhm_mm];
  if (kind === "rates") chosen.tool = source === "arrays" ? { arrays: [] } : { file: source.rates };
  if (kind === "spot") {
    chosen.tool = { file: source.spot.file };
    chosen.before = source.spot.before ? { file: source.spot.before } : null;
    [$("tool-dwell").value, $("tool-half").value] = [source.spot.dwell_s, source.spot.half_size_mm];
  }
  if (chosen.tool) $("tool-chosen").textContent = chosen.tool.file ?? "rate_nm_per_s.npy, x_mm.npy, y_mm.npy";
  setReading("tool", reading);
  showSource();
}

function showSource() {
  for (const part of document.querySelectorAll("[data-source]"))
    part.hidden = !part.dataset.source.split(" ").includes($("tool-source").value);
}

/** Shows the state; a change of the choices by the demonstration or another tab fills the forms again. */
let choices = "";
async function show(next) {
  state = next;
  const { session, running } = state, messages = Object.fromEntries(state.messages);
  $("directory").textContent = "Session: " + state.directory;
  $("busy").hidden = !running;
  if (running) $("busy-text").textContent = `${running[0]} has been running for ${running[1].toFixed(0)} s${stage(messages[running[0]])}.`;
  for (const button of document.querySelectorAll("button[type=submit], #demo")) button.disabled = !!running;
  $("script").hidden = !session.part;
  await fill();
  const now = JSON.stringify([session.part?.choice, session.tool?.choice, session.machine]);
  if (choices !== "" && now !== choices) {
    if (session.part) fillPart(session.part.choice);
    if (session.tool) fillTool(session.tool.choice);
    $("machine-fixture").value = session.machine?.fixture ?? "";
  }
  choices = now;
  for (const step of ["part", "tool", "plan"]) showStep(step, messages[step]);
  document.querySelector("#machine .end").textContent = session.machine ? `(${session.machine.fixture ?? "your own"})` : "";
  const ends = { part: session.part?.end, tool: session.tool?.end, machine: session.machine && "done", plan: session.plan?.end,
    result: session.plan?.end, program: state.program && "done" };
  for (const link of document.querySelectorAll("#steps a"))
    link.parentElement.classList.toggle("done", ["done", "negative"].includes(ends[link.hash.slice(1)]));
  await Promise.all([drawMap("part"), drawMap("tool"), showMachine(), showResult()]);
  showProgram(messages.plan);
}

/** The command of the run that is under way, from its messages. */
function stage(messages) {
  const commands = messages.split("\n").filter((line) => line.startsWith("planish-"));
  const last = commands.filter((line) => / --(out|force|run) /.test(line + " ")).pop();
  return last ? `, command ${commands.length}: ${last.split(" ")[0]}` : "";
}

async function showMachine() {
  const key = JSON.stringify(state.session.machine);
  if (!state.session.machine || drawn.machine === key) return;
  drawn.machine = key;
  $("machine-text").value = await (await ask("machine.json")).text();
}

let timer = 0;
async function look() {
  clearTimeout(timer);
  try {
    await show(await (await ask("state")).json());
    if ($("error").dataset.lost) {
      delete $("error").dataset.lost;
      fail("");
    }
  } catch (error) {
    $("error").dataset.lost = "yes";
    fail(error.message);
  }
  timer = setTimeout(look, PAUSES[state?.running ? 0 : 1]);
}

function start() {
  makeReading("part");
  makeReading("tool");
  showSource();
  $("tool-source").addEventListener("change", showSource);
  for (const role of ["part", "tool", "before"]) {
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
  onSubmit("machine-form", "machine", () => ({ own: $("machine-text").value }));
  onSubmit("plan-form", "plan", () => planChoice(""));
  onSubmit("program-form", "plan", () => planChoice($("controller").value));
  $("part-fixture").addEventListener("change", () => $("part-fixture").value && $("part-form").requestSubmit());
  $("part-level").addEventListener("change", () => state.session.part && $("part-form").requestSubmit());
  $("machine-fixture").addEventListener("change", () => $("machine-fixture").value && send("machine", { fixture: $("machine-fixture").value }));
  $("machine-file").addEventListener("change", async () => {
    const file = $("machine-file").files[0];
    if (file) send("machine", { own: await file.text() });
  });
  $("demo").addEventListener("click", () => send("demo"));
  $("cancel").addEventListener("click", () => send("cancel"));
  window.planish = { get state() { return state; }, views };
  look();
}

start();
