// A plan of several tools: its tools, the subsets of the rack, and the other plans that were executed.

function tableRow(parent, name, cells) {
  const tr = element("tr");
  for (const [i, cell] of cells.entries()) {
    if (cell instanceof Node) { const td = element(name); td.append(cell); tr.append(td); }
    else tr.append(element(i === 0 && name === "td" ? "th" : name, cell, i === 0 && name === "td" ? { scope: "row" } : {}));
  }
  parent.append(tr);
  return tr;
}

/** A link to a file of the run, or a dash without one. */
function linkTo(path, text) {
  return path ? element("a", text, { href: path }) : "-";
}

function fillSeveral() {
  byId("several-section").hidden = !SEVERAL;
  if (!SEVERAL) return;
  const { tools, subsets, others, warnings } = SEVERAL;
  for (const text of warnings) byId("reasons").append(element("p", text, { class: "warning" }));
  const kept = (limits) => (limits ? "kept" : "exceeded");
  const rows = byId("several-tools");
  tableRow(rows, "th", ["tool", "width at half of its peak (mm)", "map before (nm RMS)", "removes (nm, mean)", "planned after (nm RMS)", "executed after (nm RMS)", "motion (s)", "change (s)", "ready after (s)", "largest velocity x, y (mm/s)", "machine", "limits", "program"]);
  for (const t of tools) {
    const planned = t.planned_rms_nm === null ? "-" : fixed(t.planned_rms_nm, 4);
    const row = tableRow(rows, "td", [t.name, number(t.width_mm), fixed(t.before_rms_nm, 4), fixed(t.mean_removal_nm, 3), planned, fixed(t.rms_nm, 4), fixed(t.time_s, 2), fixed(t.change_s, 2),
      fixed(t.elapsed_s, 2), t.max_velocity_mm_per_s.map((v) => fixed(v, 2)).join(", "), t.machine || "-", kept(t.limits_kept), linkTo(t.program, (t.program || "").split("/").at(-1))]);
    if (!t.limits_kept) row.cells[11].className = "bad";
  }
  byId("several-subsets-section").hidden = !subsets.length && !others.length;
  const table = byId("several-subsets");
  tableRow(table, "th", ["tools", "what", "RMS (nm)", "time of each tool (s)", "with changes (s)", "cost (nm\u00b2)", "limits"]);
  for (const s of subsets) {
    const row = tableRow(table, "td", [s.tools.join(" + "), s.is_chosen ? "dwell times alone, chosen" : "dwell times alone", fixed(s.rms_nm, 4), s.time_s.map((t) => fixed(t, 2)).join(" + "), fixed(s.time_with_changes_s, 2), fixed(s.cost_nm2, 4), "-"]);
    if (s.is_chosen) row.cells[1].className = "best";
  }
  const executed = (names, what, p, times) => tableRow(table, "td", [names, what, fixed(p.rms_nm, 4), times.map((t) => fixed(t, 2)).join(" + "), fixed(p.time_with_changes_s, 2), fixed(p.cost_nm2, 4), kept(p.limits_kept)]);
  for (const other of others) {
    const factor = other.price_factor === 1 ? "" : ", prices \u00d7 " + number(other.price_factor);
    executed(other.tools.join(" + ") + factor, linkTo(other.report, "executed"), other, other.time_s);
  }
  const own = { rms_nm: tools.at(-1).rms_nm, time_with_changes_s: SEVERAL.total_time_s, cost_nm2: SEVERAL.cost_nm2, limits_kept: tools.every((t) => t.limits_kept) };
  executed(tools.map((t) => t.name).join(" + "), "executed, this plan", own, tools.map((t) => t.time_s));
}
