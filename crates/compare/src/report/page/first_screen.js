// The first screen: the maps before and after beside the answer, with their numbers.

/** A duration for people, as the sentences of the answer have it. */
function duration(seconds) {
  const [size, unit] = seconds < 120 ? [1, "s"] : seconds < 7200 ? [60, "min"] : [3600, "h"];
  return `${number(seconds / size, 3)} ${unit}`;
}

const POINT_TO_READ = "Point to read values; click for profiles.";

function beforeWords(run) {
  const { rms_nm, pv_nm } = run.summary.initial;
  const whose = RUNS.length > 1 ? ", " + run.name : "";
  return { title: `before${whose}: ${number(rms_nm)} nm RMS, ${number(pv_nm)} nm PV`, note: "desired removal", still: true, idle: POINT_TO_READ };
}

/** The plan of several tools after the tool of an entry: the tools so far, and the time with changes. */
function afterTools(entry) {
  const k = ENTRIES.indexOf(entry), names = SEVERAL.tools.slice(0, k + 1).map((t) => t.name);
  return `after ${names.join(", then ")}, ${duration(SEVERAL.tools[k].elapsed_s)}`;
}

function afterWords(entry) {
  const m = entry.run.summary.methods[entry.method.name], judged = m.specification;
  const limits = `limits of the machine ${m.limits_respected ? "kept" : "exceeded"}`;
  const specification = judged ? `, specification ${judged.passed ? "kept" : "not kept"}` : "";
  return {
    title: `${SEVERAL ? afterTools(entry) : `after ${entry.label}, ${duration(m.total_time_s)}`}: ${number(m.rms_nm)} nm RMS, ${number(m.pv_nm)} nm PV`,
    note: `${SEVERAL && entry !== ENTRIES.at(-1) ? "map before the next tool" : "residual"}; ${limits}${specification}`,
    still: true,
    idle: POINT_TO_READ,
  };
}

/** Pixels that caption and values of a map take, where they are not measured. */
const WORDS_OF_MAP = 64;
/** Pixels of the line of values below a map. */
const VALUES_OF_MAP = 20;

/**
 * Puts the maps before and after beside or below each other, whichever shows them larger in what the answer leaves of
 * the window. Returns the pixels that a map may be high so that both end on the first screen.
 */
function arrangeFirstScreen() {
  const maps = byId("maps"), top = maps.getBoundingClientRect().top + scrollY;
  const bar = getComputedStyle(byId("bar")).position === "sticky" ? byId("bar").offsetHeight : 0;
  const room = document.documentElement.clientHeight - top - bar - 12;
  const size = [WHOLE_MAP[1] - WHOLE_MAP[0], WHOLE_MAP[3] - WHOLE_MAP[2]];
  const scale = (columns) => Math.min((maps.clientWidth / columns - BESIDE_MAP - 12) / size[0],
    ((room * columns) / 2 - WORDS_OF_MAP - BELOW_MAP) / size[1]);
  maps.classList.toggle("stacked", scale(1) > scale(2));
  const shown = panels.filter((p) => p.parent === maps).slice(0, 2);
  for (const p of shown) p.describe();
  const captions = shown.map((p) => p.caption.offsetHeight);
  const words = scale(1) > scale(2) ? captions[0] + captions[1] + 2 * VALUES_OF_MAP : Math.max(...captions) + VALUES_OF_MAP;
  return scale(1) > scale(2) ? (room - words) / 2 - BELOW_MAP : room - words - BELOW_MAP;
}
