// Where something remains, and where the time goes.

/** The method's numbers of places. */
const placesOf = (entry) => entry.run.summary.methods[entry.method.name].places;

/** A number of the summary of a run: the keys that lead to it stand beside what is shown. */
function told(run, path, decimals, name = "td", before = "", after = "") {
  const value = path.reduce((at, key) => at[key], run.summary);
  const text = value === null ? "-" : before + fixed(value, decimals) + after;
  return element(name, text, { "data-path": JSON.stringify(path), "data-run": RUNS.indexOf(run) });
}

function fillPlaces() {
  const entry = A(), { run } = entry, name = entry.method.name, division = run.summary.division;
  const at = (...keys) => ["methods", name, "places", ...keys];
  const heads = (id, names) => {
    const row = element("tr");
    row.append(...names.map((text) => element("th", text, { scope: "col" })));
    byId(id).replaceChildren(row);
  };
  const add = (id, title, cells) => {
    const row = element("tr");
    row.append(element("th", title, { scope: "row" }), ...cells);
    byId(id).append(row);
    return row;
  };
  byId("places-of").textContent = entry.label;

  const width = division.edge_width_mm, zone = (place) => (place.at_edge === null ? "-" : place.at_edge ? "edge zone" : "inside");
  heads("worst", ["worst", "x (mm)", "y (mm)", "from the mean (nm)", "where"]);
  placesOf(entry).worst.forEach((place, i) => {
    const go = element("button", String(i + 1), { type: "button", title: "Profiles through this place" });
    go.addEventListener("click", () => { state.pin = [place.x_mm, place.y_mm]; redraw(); });
    const cell = (key, decimals) => told(run, at("worst", i, key), decimals);
    const row = add("worst", "", [cell("x_mm", 2), cell("y_mm", 2), cell("from_mean_nm", 4), element("td", zone(place))]);
    row.firstChild.append(go);
  });
  byId("worst-note").textContent = `The places farthest from the mean, at least ${number(division.worst_apart_mm, 3)} mm apart, marked in the map of the residual; positive is material that stays.`;

  heads("zones", ["zone", "RMS before (nm)", "RMS after (nm)", "time (s)"]);
  const none = () => element("td", "-");
  const zones = (key) => [told(run, ["initial", "zone_rms", key + "_nm"], 4), told(run, at("zone_rms", key + "_nm"), 4), told(run, at("time", key + "_s"), 2)];
  if (width !== null) add("zones", "edge zone", zones("edge"));
  add("zones", width === null ? "on the mirror" : "inside", zones("inside"));
  add("zones", "beyond the mirror", [none(), none(), told(run, at("time", "beyond_s"), 2)]);
  add("zones", "tool off", [none(), none(), told(run, at("time", "tool_off_s"), 2)]);
  byId("zones-note").textContent = width === null
    ? "No edge zone: it is as wide as the tool, which is not known here (planish compare report --tif)."
    : `The edge zone is ${number(width, 3)} mm wide, the radius of the tool at half its peak; ${fixed(100 * division.edge_fraction, 1)} % of the pixels lie in it. Each RMS is about the mean of the whole map.`;

  const [x, y] = division.region_bounds_mm, span = (b, k) => `${number(b[k], 3)} to ${number(b[k + 1], 3)} mm`;
  heads("regions", ["time, RMS after", ...x.slice(1).map((_, k) => "x " + span(x, k))]);
  for (let row = y.length - 2; row >= 0; row--)
    add("regions", "y " + span(y, row), x.slice(1).map((_, column) => {
      const cell = element("td");
      cell.append(told(run, at("region_time_s", row, column), 1, "span", "", " s, "), told(run, at("region_rms_nm", row, column), 4, "span", "", " nm"));
      return cell;
    }));

  heads("travel", ["travel", "from (mm)", "to (mm)", "used (mm)"]);
  ["x", "y"].forEach((axis, k) => {
    const [low, high] = placesOf(entry).travel_mm[k];
    add("travel", axis, [told(run, at("travel_mm", k, 0), 3), told(run, at("travel_mm", k, 1), 3), element("td", fixed(high - low, 3))]);
  });
}

/** The worst places of the residual, as marks of its map. */
function worstMarks(entry) {
  return placesOf(entry).worst.map((place, i) => ({ at: [place.x_mm, place.y_mm], text: String(i + 1), colour: "#000000" }));
}
