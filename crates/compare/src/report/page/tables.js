// The tables of numbers, and the sentences about the methods.

function element(name, text, attributes = {}) {
  const e = document.createElement(name);
  if (text !== undefined) e.textContent = text;
  for (const [key, value] of Object.entries(attributes)) e.setAttribute(key, value);
  return e;
}

// Key, decimals, and whether the row is rated: whether less is better, whatever the plan. Velocity and acceleration are
// limited, not minimised; an overshoot is measured against segments, which differ from plan to plan.
const ROWS = [
  ["RMS (nm)", "rms_nm", 4, true], ["of which short waves (nm)", "short_wave_rms_nm", 4, true],
  ["RMS, plane removed (nm)", "rms_detilted_nm", 4, true], ["PV (nm)", "pv_nm", 3, true],
  ["RMS slope x, y (nrad)", "slope_rms_nrad", 1, true],
  ["RMS after the servo (nm)", "after_servo_rms_nm", 4, true],
  ["time (s)", "total_time_s", 2, true],
  ["largest velocity x, y (mm/s)", "max_velocity_mm_per_s", 2],
  ["largest acceleration x, y (mm/s²)", "max_acceleration_mm_per_s2", 1],
  ["largest velocity step x, y (mm/s)", "max_velocity_step_mm_per_s", 3, true],
  ["largest acceleration step x, y (mm/s²)", "max_acceleration_step_mm_per_s2", 1, true],
  ["largest jerk inside segments x, y (mm/s³)", "max_jerk_mm_per_s3", 0, true],
  ["dwell error, RMS (s)", "dwell_error_rms_s", 6, true], ["dwell error, worst (s)", "dwell_error_worst_s", 6, true],
  ["points with overshoot x, y", "overshoot_points", 0], ["largest overshoot x, y (mm)", "max_overshoot_mm", 6],
  ["limits of the machine", "limits_respected"],
  ["limits that are not kept", "broken_limits"],
  ["plan", "plan"],
  ["schedule (s of computing)", "schedule_wall_s", 3, true], ["simulate (s of computing)", "simulate_wall_s", 3, true],
];

function fillSummary() {
  const table = byId("summary"), head = element("tr");
  head.append(element("th", "", { scope: "col" }));
  // The plan that is to be run comes first, the dwell times without a motion last.
  // The tools of a plan stand in the order in which they run.
  const rank = (e) => (SEVERAL || isStill(e) ? 2 : e.method.name === e.run.best ? 0 : 1);
  const order = ENTRIES.map((_, i) => i).sort((i, j) => rank(ENTRIES[i]) - rank(ENTRIES[j]));
  for (const e of order.map((i) => ENTRIES[i])) {
    const th = element("th", e.label, { scope: "col" });
    if (rank(e) === 0) th.append(element("small", "to be run"));
    head.append(th);
  }
  table.append(element("thead"), element("tbody"));
  table.tHead.append(head);
  const numbers = ENTRIES.map((e) => e.run.summary.methods[e.method.name]).map((m) => ({ ...m, ...m.execution }));
  const kept = numbers.map((m) => m.limits_respected && !["without-motion", "baseline"].includes(m.plan.state));
  const rated = kept.some(Boolean) ? kept : kept.map(() => true);
  // Where the acceleration steps, the jerk has no bound: what is inside the segments compares with nothing.
  const smooth = numbers.map((m) => m.max_acceleration_step_mm_per_s2.every((a) => +a.toFixed(1) === 0));
  for (const [title, key, decimals, isRated] of ROWS) {
    const row = element("tr"), values = numbers.map((m) => m[key]);
    row.append(element("th", title, { scope: "row" }));
    const inWords = { limits_respected: (v) => (v ? "kept" : "exceeded"), broken_limits: (v) => v.join(", ") || "-", plan: (v) => v.word }[key];
    // Equal where the digits shown are: a step of 1e-13 is none.
    const size = (v) => +Math.max(...[v].flat().map(Math.abs)).toFixed(decimals);
    const compares = (i) => key !== "max_jerk_mm_per_s3" || smooth[i];
    const counts = (i) => isRated && values[i] !== null && (key.endsWith("wall_s") || (rated[i] && compares(i)));
    const best = inWords ? null : Math.min(...values.filter((_, i) => counts(i)).map(size));
    for (const i of order) {
      const v = values[i];
      const one = (u) => (u === null ? "-" : fixed(u, decimals));
      const text = inWords ? inWords(v) : [v].flat().map(one).join(", ");
      const exact = inWords ? v.text || text : [v].flat().map((u) => (u === null ? "-" : +u.toPrecision(9))).join(", ");
      const cell = element("td", text, { "data-key": key, "data-entry": i, "data-value": JSON.stringify(v), title: exact });
      const fault = concerns(ENTRIES[i]) && !isStill(ENTRIES[i]);
      if (fault && (key === "limits_respected" ? !v : key === "plan" && v.state === "unconverged")) cell.className = "bad";
      else if (!inWords && !SEVERAL && ENTRIES.length > 1 && counts(i) && size(v) === best) cell.className = "best";
      row.append(cell);
    }
    table.tBodies[0].append(row);
  }
  byId("stars").hidden = SEVERAL !== null;
  byId("heading").textContent = RUNS.map((r) => {
    const s = r.summary;
    const words = RUNS.length > 1 || !s.fixture ? [r.name, s.pipeline, s.fixture] : [s.fixture, s.pipeline];
    const name = words.filter((n, i, all) => n && all.indexOf(n) === i).join(", ");
    return `${name}: ${number(s.initial.rms_nm)} nm RMS, ${number(s.initial.pv_nm)} nm PV before`;
  }).join(". ") + ".";
  // What concerns the plan that is to be run stays open, the rest folds.
  const note = (text, bad) => byId(bad ? "faults" : "remarks").append(element("p", text, { class: bad ? "violation" : "note" }));
  for (const r of RUNS) {
    const whose = (name) => (RUNS.length > 1 ? r.name + " / " + name : name);
    for (const left of r.summary.left_out) {
      const words = { "not-valid": "not valid", "out-of-date": "out of date, left out", "refused": "refused by its stage" };
      const bad = left.standing !== "out-of-date" && r.best === null;
      note(`${whose(left.name)}: ${words[left.standing]}: ${left.reasons.join("; ")}`, bad);
    }
    // Methods of which the same is said share a line.
    const said = new Map();
    for (const [name, m] of Object.entries(r.summary.methods))
      for (const text of [`${m.plan.word}: ${m.plan.text}`, ...m.remarks]) {
        const fault = r.best === null || name === r.best;
        const bad = fault && m.plan.state === "unconverged" && text.startsWith(m.plan.word);
        if (!said.has(text)) said.set(text, { names: [], bad });
        said.get(text).names.push(whose(name));
        said.get(text).bad ||= bad;
      }
    for (const [text, { names, bad }] of said) note(`${names.join(", ")}: ${text}`, bad);
  }
  for (const e of ENTRIES)
    for (const text of e.method.violations) {
      const why = isStill(e) ? "; expected, because it has no motion between the dwell points and is not run" : concerns(e) ? "" : "; it is not to be run";
      note(`${e.label}: ${text}${why}`, !why);
    }
  const count = byId("remarks").querySelectorAll("p").length;
  byId("remarks").hidden = count === 0;
  byId("remarks").firstElementChild.textContent = `Notes on the plans (${count})`;
}

/** What each run keeps of a specification: limits in rows; before, methods and measured after in columns. */
function fillSpecifications() {
  for (const r of RUNS) {
    const { before, after } = r.summary.specification, known = (c) => c[1];
    // The plan that is to be run, what it starts from and what was measured after it; then the others, those without a motion last.
    const of = (m) => [m.name, r.summary.methods[m.name].specification, r.summary.methods[m.name].plan.state === "without-motion"];
    const methods = r.methods.map(of).sort((a, b) => a[2] - b[2]), chosen = (c) => c[0] === r.best;
    const columns = [...methods.filter(chosen), ["before", before], ["measured after", after], ...methods.filter((c) => !chosen(c))].filter(known);
    // What fails of the plan that is to run, or after the run, is a fault; before, it is why the run is made.
    const fault = (column, passed) => (!passed && (column === r.best || column === "measured after") ? "bad" : "");
    if (!columns.length) continue;
    const table = element("table", undefined, { class: "specification" }), first = columns[0][1];
    const row = (cells) => { const tr = element("tr"); tr.append(...cells); table.append(tr); };
    const title = (RUNS.length > 1 ? r.name + ": " : "") + "specification " + first.name;
    row([title, "limit", ...columns.map(([name, , still]) => name + (still ? " (without a motion)" : ""))].map((text) => element("th", text, { scope: "col" })));
    first.limits.forEach((limit, i) => {
      const one = columns.every(([, judged]) => judged.limits[i].limit === limit.limit);
      const bound = (limit.bound === "at-most" ? "≤ " : "≥ ") + (one ? number(limit.limit) : "line");
      const name = limit.quantity + (limit.unit ? ` (${limit.unit})` : "");
      row([element("th", name, { scope: "row" }), element("td", bound), ...columns.map(([column, judged]) => {
        const l = judged.limits[i], text = l.value === null ? "-" : number(l.value);
        const more = { "data-value": JSON.stringify(l.value), title: l.worst ? "worst " + l.worst : "" };
        return element("td", text + (l.passed ? "" : " exceeded"), { ...more, class: fault(column, l.passed) });
      })]);
    });
    row([element("th", "kept", { scope: "row" }), element("td", ""), ...columns.map(([column, judged]) =>
      element("td", judged.passed ? "yes" : "no", { class: fault(column, judged.passed) }))]);
    const scroll = element("div", undefined, { class: "scroll" });
    scroll.append(table);
    byId("specifications").append(scroll);
  }
}

/** The base of the slopes, and the waves that count as short. */
function fillReach() {
  const s = RUNS.map((r) => r.summary), reach = s.map((o) => o.reach).find(Boolean), notes = [];
  const bases = s[0].slope_base_mm;
  if (bases.some((b) => b !== null)) notes.push(`Slopes are over ${bases.map((b) => (b === null ? "-" : +b.toPrecision(4))).join(", ")} mm along x, y.`);
  if (reach) {
    const periods = reach.period_mm.map((p) => (p === null ? "none" : number(p, 3) + " mm")).join(" along x, ");
    notes.push(`Short waves are those at which the transfer function of the tool is below ${+(100 * reach.transfer_threshold).toPrecision(3)} %: periods of ${periods} along y and less, except in its side lobes. Ripple of the path is part of them, and other dwell times change it.`);
  }
  byId("reach").textContent = notes.join(" ");
}

function fillBands() {
  const table = byId("bands");
  table.replaceChildren();
  const [long, short_] = DATA.band_period_mm;
  const head = element("tr"), names = ["RMS by period", `above ${long} mm (nm)`, `${short_} to ${long} mm (nm)`, `below ${short_} mm (nm)`, "not in the spectrum (nm)", "all, plane removed (nm)"];
  names.forEach((n) => head.append(element("th", n)));
  table.append(head);
  const rows = [["before", A().run.spectrum], [A().label, A().method.spectrum]];
  if (B()) rows.push([B().label, B().method.spectrum]);
  for (const [name, s] of rows) {
    const row = element("tr");
    row.append(element("th", name), ...(s ? [...s.band_rms_nm, s.not_in_spectrum_rms_nm, s.rms_detilted_nm] : names.slice(1).map(() => null)).map((v) => element("td", v === null ? "-" : number(v))));
    table.append(row);
  }
}
