// The low-order terms before and after: the terms in rows, the maps in columns.

function fillLowOrder() {
  const table = byId("low-order"), before = A().run.summary.initial.low_order;
  const after = [A(), B()].filter(Boolean).map((e) => [e.label, e.run.summary.methods[e.method.name].low_order]);
  byId("low-order-section").hidden = !before;
  if (!before) return;
  const columns = [["before", before], ...after].filter(([, terms]) => terms && terms.family === before.family);
  const row = (cells, parent) => { const tr = element("tr"); tr.append(...cells); parent.append(tr); };
  table.replaceChildren();
  const title = before.family === "zernike" ? "Zernike term [n, m]" : "Legendre term [i, j]";
  row([title, ...columns.map(([name]) => name + " (nm RMS)")].map((text) => element("th", text, { scope: "col" })), table);
  before.terms.forEach((term, i) => {
    const cells = columns.map(([, o]) => element("td", fixed(o.terms[i].coefficient_nm, 4), { "data-value": o.terms[i].coefficient_nm }));
    row([element("th", `${term.name} [${term.order.join(", ")}]`, { scope: "row" }), ...cells], table);
  });
  row([element("th", "all other shapes", { scope: "row" }), ...columns.map(([, o]) => element("td", fixed(o.rest_rms_nm, 4)))], table);
}
