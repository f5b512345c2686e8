"use strict";
// The steps of a session: forms that send choices, and the state that the server returns.

const $ = (id) => document.getElementById(id);
const LEVELS = { done: "done", negative: "done, with a negative verdict", refused: "refused", cancelled: "cancelled",
  interrupted: "interrupted: the server ended; do this step again, what was finished is not repeated", running: "running",
  outdated: "an earlier step has changed: do it again" };
/** Time between two looks at the state, ms: while a step runs, and else (another tab may have begun one). */
const PAUSES = [150, 2000];

let state = null;
const views = {}, drawn = {};

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
  if (!answer.ok) throw Object.assign(new Error(await answer.text()), { status: answer.status });
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

async function drawMap(step, title) {
  const found = state.session[step], key = JSON.stringify(found);
  if (!found || !["done", "negative", "outdated"].includes(found.end) || drawn[step] === key) return;
  drawn[step] = key;
  const map = readMap(await (await ask(`map/${step}`)).arrayBuffer());
  views[step] ??= new MapView($(`${step}-view`), title, state.colours);
  views[step].show(map);
  if (given[step]) views[step].seen_s = (performance.now() - given[step]) / 1000;
  delete given[step];
  showLimits();
  if (step !== "after") await showPlaces();
  if (step !== "tool") return;
  const value = (name) => map.numbers.find(([known]) => known === name)[1];
  const [x0, x1] = map.edges_mm;
  toolNumbers = { peak: value("peak rate"), vrr: value("volumetric removal rate"), size: x1 - x0 - map.pitch_mm[0] };
  propose();
}

/** Shows a tool that varies at some places of the part. */
async function showPlaces() {
  const { tool } = state.session, isVarying = !!tool?.choice.source.varying && tool.end === "done";
  $("places-view").hidden = !isVarying || !views.part;
  if ($("places-view").hidden) return;
  views.places ??= new MapView($("places-view"), "tool at nine places of the part", state.colours, false);
  views.places.show(readMap(await (await ask("map/places")).arrayBuffer()));
}

function shellWord(word) {
  return /^[A-Za-z0-9_./=:,+-]+$/.test(word) ? word : "'" + word.replaceAll("'", "'\\''") + "'";
}

function showStep(step, messages) {
  const section = $(step), found = state.session[step], end = section.querySelector(".end");
  end.textContent = found ? `(${LEVELS[found.end]})` : "";
  end.classList.toggle("bad", !!found && !["done", "running"].includes(found.end));
  if (!found) return;
  const place = section.querySelector(".done");
  const said = messages.split("\n").filter((line) => /^(warning|error): /.test(line) || line.startsWith("verdict: ") && found.end === "negative");
  // Three arrays need no manifest here, and a verdict of the end may repeat an earlier one.
  const warnings = said.filter((line, i) => !line.includes("no manifest.json, read as bare arrays") &&
    !said.slice(0, i).some((earlier) => line.includes(earlier.replace(/^[a-z]+: /, ""))));
  const key = JSON.stringify([found.commands, found.end, messages]);
  if (place.dataset.key === key) return;
  place.dataset.key = key;
  if (step !== "plan") askFor(step, found.end === "refused" ? messages : "");
  const isOpen = place.querySelector("details")?.open ?? false;
  const lines = found.commands.map((words) => words.map(shellWord).join(" ")).join("\n");
  const log = element("pre", { className: "messages", textContent: messages, tabIndex: 0 });
  // Below the heading, where a long form does not push them off the screen.
  section.querySelector(".said")?.remove();
  section.querySelector("h2").after(element("div", { className: "said" }, ...warnings.map((line) => element("p", { className: "doubt", textContent: line }))));
  place.replaceChildren(
    element("details", {}, element("summary", { textContent: "The same in a script" }), element("pre", { className: "command", textContent: lines })),
    element("details", { open: isOpen || found.end === "running" && step === "plan" }, element("summary", { textContent: "All messages of this step" }), log));
  log.scrollTop = log.scrollHeight;
}

/** Shows what the server says, the choices only once: what the user types stays. */
let isFilled = false;
async function fill() {
  if (isFilled) return;
  isFilled = true;
  const { part, tool, machine, plan, after } = state.session;
  for (const name of state.pipelines) {
    const radio = element("input", { type: "radio", name: "pipeline", value: name, id: `pipeline-${name}` });
    radio.addEventListener("change", () => showPipeline(name).then(estimateSoon).catch((error) => fail(error.message)));
    $("pipelines").append(element("label", { id: `card-${name}`, className: "card" }, element("span", {}, radio, " " + name),
      element("img", { alt: `Drawing of the path: ${name}`, hidden: true }), element("small", { className: "numbers" })));
  }
  const first = plan?.choice.pipeline ?? "raster";
  $(`pipeline-${first}`).checked = true;
  await showPipeline(first, plan?.choice.settings);
  fillSelect($("part-fixture"), pipelines[first].fixtures, "no fixture: my own file");
  fillSelect($("tool-fixture"), pipelines[first].fixtures);
  fillSelect($("machine-fixture"), pipelines[first].machines, "choose one");
  if (part) fillPart(part.choice);
  if (tool) fillTool(tool.choice);
  if (after) fillAfter(after.choice);
  if (machine?.fixture) $("machine-fixture").value = machine.fixture;
}

/** Shows the state; a change of the choices by the demonstration or another tab fills the forms again. */
let choices = "", estimated = "";
async function show(next) {
  state = next;
  const { session, running } = state, messages = Object.fromEntries(state.messages);
  $("directory").textContent = "Session: " + state.directory;
  $("busy").hidden = !running;
  if (running) $("busy-text").textContent = progress(running, messages[running[0]]);
  for (const button of document.querySelectorAll("button[type=submit], #demo, #compare-paths")) button.disabled = !!running;
  $("script").hidden = !session.part;
  await fill();
  const now = JSON.stringify([session.part?.choice, session.tool?.choice, session.machine]);
  if (choices !== "" && now !== choices) {
    if (session.part) fillPart(session.part.choice);
    if (session.tool) fillTool(session.tool.choice);
    $("machine-fixture").value = session.machine?.fixture ?? "";
  }
  if (now !== choices) showOthers();
  choices = now;
  for (const step of ["part", "tool", "plan", "after"]) showStep(step, messages[step]);
  document.querySelector("#machine .end").textContent = session.machine ? `(${session.machine.fixture ?? "your own"})` : "";
  const ends = { part: session.part?.end, tool: session.tool?.end, machine: session.machine && "done", plan: session.plan?.end,
    result: session.plan?.end, program: state.program && "done", after: session.after?.end };
  for (const link of document.querySelectorAll("#steps a"))
    link.parentElement.classList.toggle("done", ["done", "negative"].includes(ends[link.hash.slice(1)]));
  await Promise.all([drawMap("part", "part"), drawMap("tool", "tool"), drawMap("after", "part after the run"), showMachine(), showResult()]);
  showProgram(messages.plan);
  showAfter(messages.after);
  const toEstimate = canEstimate() ? now : "";
  if (toEstimate !== "" && toEstimate !== estimated) estimateSoon();
  estimated = toEstimate;
}

/** What runs, and how long it will take: as its program says, else as the last plan took. */
function progress([step, seconds], messages) {
  const commands = messages.split("\n").filter((line) => line.startsWith("planish ") && / --(out|force|run) /.test(line + " "));
  const last = commands.pop(), told = messages.split("\n").filter((line) => line.includes("it takes about")).pop();
  const command = last ? `, command ${commands.length + 1}: ${last.split(" ", 2).join(" ")}` : "";
  const before = step === "plan" ? state.session.plan_took_s : null;
  let left = "";
  if (told && last && messages.lastIndexOf(told) > messages.lastIndexOf(last)) left = ` It says: ${told.split("it takes ").pop()}.`;
  else if (before) left = before > seconds ? ` About ${duration(before - seconds)} are left if it takes as long as the last plan.` : " It takes longer than the last plan.";
  return `${step} has been running for ${seconds.toFixed(0)} s${command}.${left}`;
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
  startReading();
  startMachine();
  startPlan();
  startEstimates();
  startResult();
  startAfter();
  $("demo").addEventListener("click", () => send("demo"));
  $("cancel").addEventListener("click", () => send("cancel"));
  window.planish = { get state() { return state; }, views, estimates };
  look();
}

start();
