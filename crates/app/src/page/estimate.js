"use strict";
// Estimates: residual against time while the user chooses, and the kinds of paths side by side.

/** Pause after the last change before an estimate begins, ms. */
const PAUSE_BEFORE = 200;
/** Elasticities of the slider: percentages by which one percent more time lowers the mean square. */
const ELASTICITIES = [0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1, 1.5, 2, 3];
const DEFAULT_ELASTICITY = 4;

/** Estimates by pipeline: { key, answer } or { key, error }. */
const estimates = {};
let estimateTimer = 0;

/** What an estimate depends on. */
function estimateKey(choice) {
  const { part, tool, machine } = state.session;
  const settings = { ...choice.settings };
  for (const name of ["time_elasticity", "export", "step_mm", "frames", ...STATED]) delete settings[name];
  return JSON.stringify([part?.number, tool?.number, machine, choice.pipeline, settings]);
}

function canEstimate() {
  const { part, tool, machine } = state.session, isDone = (step) => step && ["done", "negative"].includes(step.end);
  return !state.running && isDone(part) && isDone(tool) && machine;
}

function estimateSoon() {
  clearTimeout(estimateTimer);
  estimateTimer = setTimeout(() => estimate(planChoice("")), PAUSE_BEFORE);
}

/** Estimates a choice, unless it is known. The server answers the latest question alone. */
async function estimate(choice) {
  if (!canEstimate() || !choice.pipeline) return;
  const key = estimateKey(choice), settings = { ...choice.settings };
  propose();
  if (estimates[choice.pipeline]?.key === key) return showEstimates();
  // The slider goes along the front, which has all elasticities.
  delete settings.time_elasticity;
  delete settings.export;
  $("estimate").textContent = "Estimating ...";
  try {
    const begun = performance.now();
    const found = await (await ask("estimate", { method: "POST", body: JSON.stringify({ pipeline: choice.pipeline, settings }) })).json();
    if (found !== "replaced") estimates[choice.pipeline] = { key, answer: found.estimate, error: found.refused };
    if (found.estimate) found.estimate.seen_s = (performance.now() - begun) / 1000;
  } catch (error) {
    estimates[choice.pipeline] = { key, error: error.message };
  }
  showEstimates();
}

/** The point of a front for an elasticity e: the least ln(M) + e ln(T), linear in the logarithms between the points. */
function pointOf(points, elasticity) {
  let best = null;
  for (let i = 0; i + 1 < points.length; i++)
    for (let k = 0; k <= 20; k++) {
      const between = (a, b) => Math.exp(Math.log(a) + (k / 20) * (Math.log(b) - Math.log(a)));
      const [a, b] = [points[i], points[i + 1]];
      const point = { rms_nm: between(a.rms_nm, b.rms_nm), time_s: between(a.time_s, b.time_s) };
      const value = 2 * Math.log(point.rms_nm) + elasticity * Math.log(point.time_s);
      if (!best || value < best.value) best = { ...point, value };
    }
  return best ?? points[0];
}

/** The point that the settings choose: at their price of a second, else at their elasticity, 0.5 by default. */
function chosenPoint(answer) {
  const price = document.querySelector("[data-setting=time_weight_nm2_per_s]")?.value.trim();
  const elasticity = document.querySelector("[data-setting=time_elasticity]")?.value.trim();
  return price ? answer.chosen : pointOf(answer.points, elasticity > 0 ? +elasticity : ELASTICITIES[DEFAULT_ELASTICITY]);
}

function sentenceOf(answer) {
  const point = chosenPoint(answer), map = answer.square_px > 1 ? `, on means of ${answer.square_px} x ${answer.square_px} pixels` : "";
  const lines = answer.coarser > 1 ? `, along lines ${number(answer.coarser, 2)} times as far apart as yours` : "";
  return `Estimate: ${number(point.rms_nm, 3)} nm RMS in ${duration(point.time_s)}, from dwell times without a motion${map}${lines}. ` +
    "The plan may leave a quarter more or less, and take a quarter longer, because of corners and limits. " +
    `The path is ${number(answer.length_mm / 1000, 3)} m long. The exact plan follows when you press Plan.`;
}

function showEstimates() {
  const name = selectedPipeline(), known = estimates[name];
  const isKnown = known && known.key === estimateKey(planChoice(""));
  $("estimate").textContent = !isKnown ? "" : known.error ? "No estimate: " + known.error : sentenceOf(known.answer);
  $("estimate-warnings").textContent = isKnown && known.answer ? known.answer.warnings.join("\n") : "";
  markRefused(isKnown && known.error ? known.error : "");
  $("front-box").hidden = !(isKnown && known.answer);
  if (!$("front-box").hidden) drawFront();
  for (const [pipeline, { answer, error }] of Object.entries(estimates)) showCard(pipeline, answer, error).catch((problem) => fail(problem.message));
}

/** Says a refusal beside the fields of the settings that it names, as settings or as flags. */
function markRefused(error) {
  for (const place of document.querySelectorAll("#plan-form .refused")) {
    const field = place.closest("label").querySelector("[data-setting]"), name = field.dataset.setting;
    const isNamed = error.includes(`${name} is `) || error.includes(`--${name.replaceAll("_", "-")} `);
    place.textContent = isNamed ? error.replace("error: ", "") : "";
    field.ariaInvalid = isNamed;
  }
}

/** The card of a kind of path: its drawing and its numbers. */
async function showCard(pipeline, answer, error) {
  const card = $(`card-${pipeline}`);
  if (!card) return;
  card.querySelector(".numbers").textContent = error ? error.replace("error: ", "") : `${number(answer.length_mm / 1000, 3)} m; about ${number(chosenPoint(answer).rms_nm, 3)} nm in ${duration(chosenPoint(answer).time_s)}`;
  const picture = card.querySelector("img");
  picture.hidden = !answer;
  if (!answer || picture.dataset.key === estimates[pipeline].key) return;
  picture.dataset.key = estimates[pipeline].key;
  const drawing = await (await ask(`path/${pipeline}`)).blob();
  URL.revokeObjectURL(picture.src);
  picture.src = URL.createObjectURL(drawing);
}

/** Estimates every kind of path with the settings that it shares with the selected one. */
async function comparePaths() {
  const base = planChoice("");
  for (const name of state.pipelines) {
    const known = new Set((await pipelineNamed(name)).settings.map((setting) => setting.name));
    const settings = Object.fromEntries(Object.entries(base.settings).filter(([setting]) => known.has(setting)));
    // A pitch that is not given has the default of its kind; the same pitch for all can be compared.
    settings.pitch_mm ??= known.has("pitch_mm") ? pipelines[base.pipeline].settings.find((s) => s.name === "pitch_mm")?.default : undefined;
    if (!settings.pitch_mm || !known.has("pitch_mm")) delete settings.pitch_mm;
    await estimate({ pipeline: name, settings: name === base.pipeline ? base.settings : settings });
    if (!canEstimate()) return;
  }
}

function drawFront() {
  const canvas = $("front");
  if ($("front-box").hidden || canvas.clientWidth === 0) return;
  paintFront(begin(canvas, 240), canvas.clientWidth, estimates[selectedPipeline()].answer);
}

function paintFront(context, width, answer) {
  const box = { x: 64, y: 10, width: Math.max(width - 80, 50), height: 190 };
  const times = answer.points.map((p) => p.time_s), residuals = answer.points.map((p) => p.rms_nm), chosenAt = chosenPoint(answer);
  const [t0, t1, r1] = [0, 1.05 * Math.max(...times), 1.05 * Math.max(...residuals)];
  const inMinutes = t1 > 600 ? 60 : 1;
  axes(context, box, [t0, t1 / inMinutes], [0, r1], inMinutes === 60 ? "time, min" : "time, s", "residual, nm RMS");
  const px = ([time, rms]) => [box.x + (time / t1) * box.width, box.y + box.height - (rms / r1) * box.height];
  line(context, answer.points.map((p) => [p.time_s, p.rms_nm]), px, themeColour("x"));
  context.fillStyle = themeColour("x");
  for (const point of answer.points) {
    const [x, y] = px([point.time_s, point.rms_nm]);
    context.fillRect(x - 2.5, y - 2.5, 5, 5);
  }
  const [x, y] = px([chosenAt.time_s, chosenAt.rms_nm]);
  context.fillStyle = themeColour("bad");
  context.fillRect(x - 5, y - 5, 10, 10);
}

function sayElasticity(elasticity) {
  $("worth-text").textContent = `${elasticity} % of the mean square for 1 % of the time`;
}

function startEstimates() {
  const slider = $("worth");
  slider.max = ELASTICITIES.length - 1;
  slider.value = DEFAULT_ELASTICITY;
  slider.addEventListener("input", () => {
    const elasticity = ELASTICITIES[slider.value];
    document.querySelector("[data-setting=time_elasticity]").value = String(elasticity);
    const price = document.querySelector("[data-setting=time_weight_nm2_per_s]");
    if (price.value) {
      price.value = "";
      estimateSoon();
    }
    sayElasticity(elasticity);
    showEstimates();
  });
  sayElasticity(ELASTICITIES[DEFAULT_ELASTICITY]);
  $("front-box").querySelector(".save").append(...saveButtons("front", $("front"), (context) =>
    paintFront(context, $("front").clientWidth, estimates[selectedPipeline()].answer)));
  $("front-box").querySelector(".copy").addEventListener("click", () => navigator.clipboard.writeText("time_s\trms_nm\tprice_nm2_per_s\n" +
    estimates[selectedPipeline()].answer.points.map((p) => [p.time_s, p.rms_nm, p.price_nm2_per_s].join("\t")).join("\n") + "\n"));
  $("compare-paths").addEventListener("click", () => comparePaths().catch((error) => fail(error.message)));
  new ResizeObserver(drawFront).observe($("front-box"));
  onTheme(drawFront);
}
