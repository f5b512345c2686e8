"use strict";
// The result: what the run says, its maps with one point for all, profiles across them, its report, and the program.

const RESULT_MAPS = { before: "before the run", removal: "predicted removal", residual: "predicted residual" };
const LINE_COLOURS = { before: "x", removal: "soft", residual: "y" };

/** Moves the point of all maps of the result, and draws the profiles through it. */
function resultPoint(from, mm) {
  for (const name of Object.keys(RESULT_MAPS)) if (name !== from) views[name]?.goTo(mm);
  drawAcross();
}

async function showResultMaps() {
  await Promise.all(Object.entries(RESULT_MAPS).map(async ([name, title]) => {
    const map = readMap(await (await ask(`map/${name}`)).arrayBuffer());
    if (!views[name]) {
      views[name] = new MapView($(`${name}-view`), title, state.colours, false);
      views[name].onPoint = (mm) => resultPoint(name, mm);
    }
    views[name].show(map);
  }));
  $("across-box").hidden = false;
  drawAcross();
}

function drawAcross() {
  const canvas = $("across");
  if ($("across-box").hidden || canvas.clientWidth === 0) return;
  paintAcross(begin(canvas, 420), canvas.clientWidth);
}

/** Profiles of the three maps along x and along y through one point, each about its mean. */
function paintAcross(context, width) {
  const names = Object.keys(RESULT_MAPS).filter((name) => $("across-scale").value === "all" || name === "residual");
  for (const axis of [0, 1]) {
    const box = { x: 64, y: 10 + 210 * axis, width: Math.max(width - 80, 50), height: 150 };
    const [low, high] = views.before.map.edges_mm.slice(2 * axis, 2 * axis + 2);
    const most = Math.max(...names.map((name) => views[name].reach(1)));
    const px = ([mm, value]) => [box.x + ((mm - low) / (high - low)) * box.width, box.y + (0.5 - value / most / 2) * box.height];
    const [x, y] = views.before.place(views.before.point);
    axes(context, box, [low, high], [-most, most], axis ? `along y at x = ${number(x)} mm, mm` : `along x at y = ${number(y)} mm, mm`, "nm about the mean");
    for (const name of names) {
      const { centre } = views[name].map;
      line(context, views[name].profile(axis).map(([mm, value]) => [mm, value - centre]), px, themeColour(LINE_COLOURS[name]));
    }
  }
  const values = Object.entries(RESULT_MAPS).map(([name, title]) => `${title} ${number(views[name].at(views.before.place(views.before.point)))} nm`);
  $("across-values").textContent = "Before blue, removal grey, residual orange. At the point: " + values.join(", ") + ".";
}

/** The text of the profiles through the point, for a spreadsheet. */
function acrossText() {
  const rows = ["axis\tmm\tbefore_nm\tremoval_nm\tresidual_nm"];
  for (const axis of [0, 1]) {
    const [before, removal, residual] = Object.keys(RESULT_MAPS).map((name) => views[name].profile(axis));
    before.forEach(([mm, value], i) => rows.push(["xy"[axis], mm, value, removal[i]?.[1], residual[i]?.[1]].join("\t")));
  }
  return rows.join("\n") + "\n";
}

/** A frame with a report. Its own program can reach neither the page nor the server. */
function reportFrame(title, src) {
  const frame = element("iframe", { title, src });
  frame.setAttribute("sandbox", "allow-scripts allow-downloads");
  return frame;
}

async function showResult() {
  const plan = state.session.plan, key = JSON.stringify([plan, state.has_reports[0]]);
  if (drawn.result === key) return;
  drawn.result = key;
  const isDone = plan && ["done", "negative", "outdated"].includes(plan.end) && state.has_reports[0];
  $("download").hidden = state.program === "";
  $("download").textContent = "Save " + state.program;
  if (!isDone) {
    $("sentence").textContent = plan?.end === "running" ? "The plan is running." : "There is no plan yet.";
    return;
  }
  const { answer } = await (await ask("answer")).json();
  $("sentence").textContent = (plan.end === "outdated" ? "Of an earlier plan: " : "") + (answer.sentence || "No plan is recommended.");
  $("why").textContent = answer.why;
  $("problems").replaceChildren(...(answer.problems ?? []).map((text) => element("li", { textContent: text })));
  if (answer.method) await showResultMaps();
  $("report").replaceChildren(reportFrame("Report of the run", state.reports[0]));
}

function showProgram(messages) {
  // The verdicts of the other plans are in the messages of the plan.
  const readBack = `+${state.session.plan?.choice.settings.export}/verdict`;
  const lines = messages.split("\n").filter((line) => /^(program|warning: the program)/.test(line) || line.startsWith("planish verify:") && line.includes(readBack));
  $("program-verdict").textContent = lines.join("\n");
  $("program-verdict").hidden = state.program === "" || lines.length === 0;
  const isExport = !!state.session.plan?.choice.settings.export;
  document.querySelector("#program .end").textContent = isExport && state.program ? "(written)" : "";
}

function startResult() {
  $("across-box").querySelector(".save").append(...saveButtons("profiles", $("across"), (context) => paintAcross(context, $("across").clientWidth)));
  $("across-box").querySelector(".copy").addEventListener("click", () => navigator.clipboard.writeText(acrossText()));
  $("across-scale").addEventListener("change", drawAcross);
  new ResizeObserver(drawAcross).observe($("across-box"));
  onTheme(drawAcross);
}
