// All of it together: time, methods, redrawing, and the start.

function setTime(t) {
  state.time = Math.max(0, Math.min(A().total, t));
  byId("time").value = Math.round((1000 * state.time) / A().total);
  redraw();
}
function showMethod(a, b) {
  state.a = a;
  state.b = b === a ? -1 : b;
  byId("a").value = a;
  byId("b").value = state.b;
  state.timeView = [0, A().total];
  for (const option of byId("b").options) option.disabled = +option.value === a;
  byId("frame-note").hidden = SEVERAL !== null && !A().frames;
  byId("frame-note").textContent = A().frames
    ? `The surface is the one simulated at the last of ${A().frames.time.length} times before the slider.`
    : "No frames for this method: planish simulate --frames N writes them to methods/<method>/frames; the tool moves all the same.";
  const d = A().method.dwell;
  byId("dwell-section").hidden = !d;
  if (d) byId("dwell-note").textContent = d.executed_s
    ? `Time at every dwell point as planned, and what the motion takes there instead; differences add up to ${number(d.total_error_s)} s.`
    : "Time at every dwell point, as the plan of this program has it. A program names no dwell points, so the times of its motion there are not known.";
  fillBands();
  fillLowOrder();
  fillPlaces();
  hintTables();
  setTime(A().total);
}

/** Chooses the scale of the colours; by hand it begins with that of the residual. */
function setScale(scale) {
  if (scale === "hand" && state.hand === null) {
    state.hand = +reachOf(A().residual).toPrecision(3);
    byId("hand-nm").value = state.hand;
  }
  state.scale = scale;
  byId("hand").hidden = scale !== "hand";
  redraw();
}

/** Takes the end of the colours from its field; a number that is not above zero is marked and changes nothing. */
function setHand(field) {
  const value = field.valueAsNumber, isGood = Number.isFinite(value) && value > 0;
  field.setCustomValidity(isGood ? "" : "A height above 0 nm.");
  field.setAttribute("aria-invalid", String(!isGood));
  if (!isGood) return;
  state.hand = value;
  redraw();
}

let asked = false;
function redraw() {
  if (asked) return;
  asked = true;
  requestAnimationFrame(() => {
    asked = false;
    drawAll();
  });
}
function drawAll() {
  const most = arrangeFirstScreen();
  for (const p of panels) p.draw(p.parent === byId("maps") ? most : undefined);
  drawProfiles();
  drawMotion();
  if (drawAll.key !== [state.a, state.b, theme.paper, innerWidth].join()) {
    drawAll.key = [state.a, state.b, theme.paper, innerWidth].join();
    drawHistogram();
    drawSpectrum();
    drawFront();
    drawRounds();
    drawProcess();
  }
  const tool = toolAt(A(), state.time);
  byId("now").textContent = `${fixed(state.time, 2)} of ${fixed(A().total, 2)} s, x ${fixed(tool.x, 2)}, y ${fixed(tool.y, 2)} mm`;
}

let last = 0;
function tick(now) {
  if (!state.playing) return;
  const pace = +byId("pace").value, seconds = Math.min(0.1, (now - last) / 1000);
  last = now;
  const t = state.time + seconds * (pace ? A().total / pace : 1);
  setTime(t);
  if (t >= A().total) play(false);
  else requestAnimationFrame(tick);
}
function play(on) {
  state.playing = on;
  byId("play").textContent = on ? "pause" : "play";
  if (!on) return;
  if (state.time >= A().total) setTime(0);
  last = performance.now();
  requestAnimationFrame(tick);
}

/** Says of every table that is wider than its place that it goes on, and shades the edge where it does. */
function hintTables() {
  for (const box of document.querySelectorAll(".scroll")) {
    let hint = box.querySelector(".more");
    if (!hint) {
      hint = element("p", "This table goes on to the right: scroll it sideways.", { class: "note more screen" });
      box.prepend(hint);
      box.addEventListener("scroll", hintTables);
    }
    const beyond = box.scrollWidth - box.clientWidth;
    hint.hidden = beyond <= 1;
    box.classList.toggle("cut", beyond - box.scrollLeft > 1);
  }
}

/** Opens what is folded of the answer and the notes, for paper; returns what it has opened. */
function unfoldNotes() {
  const folded = [...document.querySelectorAll("#answer details, #remarks")].filter((e) => !e.open);
  for (const e of folded) e.open = true;
  return folded;
}

function start() {
  readTheme();
  fillAnswer();
  fillSummary();
  fillSpecifications();
  fillReach();
  fillPart();
  fillSeveral();
  fillProvenance();
  if (!ENTRIES.length) {
    // Every method is left out, and why is said: there is nothing to draw.
    byId("bar").hidden = true;
    for (const section of document.querySelectorAll("section")) section.hidden = !["answer", "reasons"].includes(section.id) && !section.querySelector("#summary, #provenance");
    byId("guide").hidden = true;
    return;
  }
  ENTRIES.forEach((e, i) => {
    byId("a").append(element("option", e.label, { value: i }));
    byId("b").append(element("option", e.label, { value: i }));
  });
  byId("b").prepend(element("option", "none", { value: -1 }));
  new Panel("maps", "desired", () => mapContent(A().run.desired, "desired" + A().run.name, beforeWords(A().run)));
  new Panel("maps", "residual", () => mapContent(A().residual, "residual" + state.a, { ...afterWords(A()), marks: worstMarks(A()) }));
  new Panel("maps", "residual-b", () => B() && mapContent(B().residual, "residual" + state.b, { ...afterWords(B()), marks: worstMarks(B()) }));
  new Panel("maps", "difference", () => B() && mapContent(difference(), "difference" + state.a + "," + state.b, { title: `residual of ${A().label} - residual of ${B().label}` }));
  new Panel("surfaces", "measured", () => mapContent(A().run.measured, "measured" + A().run.name));
  if (SEVERAL)
    ENTRIES.forEach((e, i) => new Panel("surfaces", "removal-" + i, () => mapContent(e.removal, "removal" + i, { title: "removal by " + e.label })));
  else new Panel("surfaces", "removal", () => mapContent(A().removal, "removal" + state.a, { title: "predicted removal: " + A().label }));
  if (SEVERAL)
    ENTRIES.slice(0, -1).forEach((e, i) => new Panel("surfaces", "after-" + i, () => mapContent({ ...e.residual, own: false }, "after" + i, { title: "map after " + e.label })));
  addSlopePanels();
  new Panel("paths", "frame", () => {
    const layer = frameAt(A(), state.time);
    return layer && mapContent(layer, "frame" + layer.key, { title: layer.title });
  });
  new Panel("paths", "path", () => pathContent(A()));
  new Panel("paths", "path-b", () => pathContent(B()));
  new Panel("dwells", "dwell", () => dwellContent(A(), "planned"));
  new Panel("dwells", "dwell-error", () => dwellContent(A(), "error"));
  new Panel("dwells", "dwell-error-b", () => B() && dwellContent(B(), "error"));
  new Panel("process-maps", "deviation", () => deviationContent(A()));
  for (const [name] of CHARTS) listenToChart(byId(name));
  for (const canvas of document.querySelectorAll("canvas.chart")) {
    const caption = element("figcaption");
    caption.append(element("span", ""), saveButton(canvas, canvas.id));
    canvas.before(caption);
  }
  byId("front").addEventListener("pointermove", readFront);
  byId("front-csv").addEventListener("click", () => saveText(FRONT.csv, "front.csv"));
  byId("a").addEventListener("change", (event) => showMethod(+event.target.value, state.b));
  byId("b").addEventListener("change", (event) => showMethod(state.a, +event.target.value));
  byId("scale").addEventListener("change", (event) => setScale(event.target.value));
  byId("hand-nm").addEventListener("input", (event) => setHand(event.target));
  byId("hand-nm").addEventListener("change", (event) => event.target.reportValidity());
  byId("zoom-in").addEventListener("click", () => zoom(0.6, null, viewOfMaps()));
  byId("zoom-out").addEventListener("click", () => zoom(1 / 0.6, null, state.view));
  byId("zoom-all").addEventListener("click", showAll);
  byId("time").addEventListener("input", (event) => setTime((A().total * event.target.value) / 1000));
  byId("play").addEventListener("click", () => play(!state.playing));
  byId("npy").addEventListener("change", (event) => event.target.files[0] && loadFull(event.target.files[0]));
  const themed = () => { readTheme(); redraw(); };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", themed);
  let unfolded = [];
  window.addEventListener("beforeprint", () => { unfolded = unfoldNotes(); document.documentElement.classList.add("paper"); readTheme(); drawAll(); });
  window.addEventListener("afterprint", () => { for (const e of unfolded) e.open = false; document.documentElement.classList.remove("paper"); themed(); });
  new ResizeObserver(() => { redraw(); hintTables(); }).observe(document.body);
  const lead = leadingRun(), best = ENTRIES.findIndex((e) => e.run === lead && e.method.name === lead.best);
  showMethod(best < 0 ? ENTRIES.length - 1 : best, -1);
  drawAll();
  hintTables();
}
start();

// For tests.
window.planish = { DATA, ENTRIES, RUNS, state, valueAt, panels, drawAll, zoom, toolAt };
