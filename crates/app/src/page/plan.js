"use strict";
// The plan: kinds of paths, their settings with units, defaults and sentences, and what the tool proposes.

const pipelines = {};
let toolNumbers = null;
/** Settings that stand above the others. */
const FIRST = new Set(["pitch_mm", "min_pitch_mm", "step_mm", "scan", "overscan_mm", "min_dwell_s_per_mm", "refine", "passes", "spacing_mm", "seed"]);
/** Settings that are texts for the heads of the report and of the program. */
const STATED = new Set(["part_name", "part_number", "date", "operator"]);
/** Pipelines that the page does not run, and what they are for. */
const OTHERS = {
  bspline: "speeds along straight passes as B-splines", "trig-spline": "a motion of trigonometric splines", rest: "moves and stops at every dwell point",
  "compare-dwell": "all dwell solvers on this mirror", line: "a strip of a mirror from a profile", several: "several tools of a rack, from coarse to fine",
};

function selectedPipeline() {
  return document.querySelector("#pipelines input:checked")?.value;
}

function planChoice(controller) {
  const settings = {};
  for (const field of document.querySelectorAll("#plan-form [data-setting]"))
    if (field.value.trim() !== "") settings[field.dataset.setting] = field.value.trim();
  if (controller) settings.export = controller;
  return { pipeline: selectedPipeline(), settings };
}

function settingField(setting, value) {
  const field = setting.words.length
    ? element("select", {}, element("option", { value: "", textContent: "default" + (setting.default ? ": " + setting.default : "") }),
      ...setting.words.map((word) => element("option", { value: word, textContent: word })))
    : element("input", { inputMode: "text", placeholder: setting.default ? "default: " + setting.default : "no value" });
  field.dataset.setting = setting.name;
  field.value = value ?? "";
  field.addEventListener("change", estimateSoon);
  const words = setting.name.replace(/_(s_per_mm|nm2_per_s|mm_per_s|percent|mm2|deg|mm|nm|s)$/, "").replaceAll("_", " ");
  const label = element("label", {}, words + " ", element("span", { className: "unit", textContent: setting.unit }),
    field, element("small", { textContent: setting.help + (setting.words.length ? "" : ` (${setting.allowed})`) }),
    element("small", { className: "bad refused" }));
  if (["pitch_mm", "overscan_mm", "min_dwell_s_per_mm"].includes(setting.name)) label.append(element("small", { id: "proposal-" + setting.name, className: "proposal" }));
  return label;
}

async function pipelineNamed(name) {
  pipelines[name] ??= await (await ask(`pipeline/${name}`)).json();
  return pipelines[name];
}

/** Fields of the settings of a pipeline, with the values of the choice. */
async function showPipeline(name, values = {}) {
  const pipeline = await pipelineNamed(name);
  $("pipeline-title").textContent = pipeline.title;
  const plain = pipeline.settings.filter((s) => (s.is_plain || STATED.has(s.name)) && s.name !== "export");
  $("settings").replaceChildren(...plain.filter((s) => FIRST.has(s.name)).map((s) => settingField(s, values[s.name])));
  $("more-settings").replaceChildren(...plain.filter((s) => !FIRST.has(s.name)).map((s) => settingField(s, values[s.name])));
  const controllers = pipeline.settings.find((s) => s.name === "export").words;
  fillSelect($("controller"), controllers);
  if (values.export) $("controller").value = values.export;
  propose();
  showOthers();
}

/** Rounds down to two digits: a larger value is beyond its limit. */
function twoDigitsBelow(value) {
  const digit = 10 ** (Math.floor(Math.log10(value)) - 1);
  return +(Math.floor(value / digit + 1e-9) * digit).toPrecision(2);
}

function proposal(setting, value, reason) {
  const place = $("proposal-" + setting);
  if (!place) return;
  const take = element("button", { type: "button", textContent: "Take it" });
  take.addEventListener("click", () => {
    const field = place.closest("label").querySelector("[data-setting]");
    field.value = String(value);
    estimateSoon();
  });
  place.replaceChildren(`Proposed: ${number(value)} mm. ${reason} `, take);
}

/** What the tool proposes: pitch, overscan, and the least removal of the floor (docs/how-to/choose-pitch-overscan-floor.md). */
function propose() {
  if (!toolNumbers) return;
  const { peak, vrr, size } = toolNumbers, sigma = Math.sqrt(vrr / (2 * Math.PI * peak));
  const ripple = Math.PI * sigma * Math.sqrt(2 / Math.log(4 / 0.001)), pitch = twoDigitsBelow(Math.min(ripple, size / 6));
  proposal("pitch_mm", pitch, `The smaller of a sixth of the tool (${number(size / 6, 3)} mm) and the pitch with a ripple of 0.1 % (${number(ripple, 3)} mm).`);
  const overscan = $("proposal-overscan_mm"), floor = $("proposal-min_dwell_s_per_mm");
  if (overscan) overscan.textContent = "Proposed: leave it empty. The tool removes as much at the edge as inside only if it passes over the edge by half its size, which is the default.";
  if (floor) {
    const given = document.querySelector("[data-setting=pitch_mm]")?.value || pitch;
    floor.textContent = `Proposed: leave it empty, which takes the largest velocity. A floor of 0.02 s/mm removes at least ${number((vrr * 0.02) / given, 3)} nm at a pitch of ${number(+given, 3)} mm.`;
  }
}

/** The command lines of pipelines that the page does not run. */
function showOthers() {
  const { part, tool } = state.session, source = part?.choice.source, map = source === "arrays" ? "files/part" : "part/surface";
  const isOwn = !source?.fixture || tool?.choice.source.fixture !== source.fixture;
  const tif = tool?.choice.source.varying ? "tool/varying" : "tool/tif";
  const mirror = isOwn ? `surface=${map} tif=${tif}` : `fixture=${source.fixture}`;
  const machine = state.session.machine?.fixture ? `${state.folder}fixtures/machines/${state.session.machine.fixture}.json` : "machine.json";
  const lines = Object.entries(OTHERS).map(([name, what]) => {
    if (name === "several") return `# ${what}; rack.json lists the tools\nplanish several surface=${map} rack=rack.json machine=${machine} out=runs/several`;
    if (name === "line") return `# ${what}; profile.csv has the profile\nplanish surface line --profile profile.csv --tif ${tif} --strip-width-mm 10 --out runs/strip`;
    return `# ${what}\nplanish run ${name} ${mirror} machine=${machine} out=runs/${name}`;
  });
  $("other-commands").textContent = lines.join("\n");
}

function startPlan() {
  onSubmit("plan-form", "plan", () => planChoice(""));
  onSubmit("program-form", "plan", () => planChoice($("controller").value));
}
