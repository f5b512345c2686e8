// What made the artifacts, and what of them is in the page.

function fillProvenance() {
  const parent = byId("provenance");
  const show = (owner, list) => {
    for (const p of list) {
      const details = element("details"), head = element("summary");
      head.append(element("strong", `${owner}${p.role} `), element("span", `${p.tool} ${p.tool_version} ${p.method}${p.status ? ", " + p.status : ""}`));
      const inputs = (p.inputs || []).map((i) => `${i.role}  ${i.path}  ${i.kind}  blake3 ${i.blake3}`).join("\n");
      details.append(head, element("pre", p.command), element("pre", "settings " + JSON.stringify(p.settings, null, 1)));
      if (inputs) details.append(element("pre", inputs));
      parent.append(details);
    }
  };
  for (const r of RUNS) {
    const prefix = RUNS.length > 1 ? r.name + " / " : "";
    show(prefix, r.provenance);
    for (const m of r.methods) show(prefix + m.name + " / ", m.provenance);
  }
  const list = byId("contents");
  const map = ENTRIES.length ? A().residual : null;
  const add = (text) => list.append(element("li", text));
  for (const r of map ? RUNS : []) {
    const l = r.desired, size = `${l.nx} x ${l.ny}`;
    const how = l.every === 1 ? "every pixel of the arrays" : `means over ${l.every} x ${l.every} pixels of the arrays`;
    const s = r.spectrum;
    const spectrum = s
      ? `the spectrum is of their largest rectangle of valid pixels, ${number(s.size_mm[0])} x ${number(s.size_mm[1])} mm, ${fixed(100 * s.fraction_of_valid_pixels, 1)} % of them`
      : "there is no spectrum: no rectangle of valid pixels has 8 along both sides";
    add(`${RUNS.length > 1 ? r.name + ": " : ""}maps of ${size} pixels, ${how}, in steps of ${number(l.step, 2)} nm (desired removal) and ${number(map.step, 2)} nm (residual); RMS, PV and histogram are of the whole arrays; ${spectrum}`);
  }
  for (const e of ENTRIES) {
    const m = e.method, each = (n, what) => (n > 1 ? `every ${n} ${what} together` : `every one of the ${what}`);
    const f = m.frames ? `, ${m.frames.time_s.length} frames of ${m.frames.size.join(" x ")} pixels` : "";
    add(`${e.label}: line with ${each(m.line.every, "segments")}, ranges of ${each(m.ranges.every, "segments")} (no peak is lost)${m.dwell ? `, ${m.dwell.every > 1 ? "one in " + m.dwell.every : "all"} dwell points` : ""}${f}`);
  }
}
