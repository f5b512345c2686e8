"use strict";
// After the run: the map that was measured then, what it teaches, and the next run.

function afterChoice() {
  return { source: sourceOf("after"), reading: readingOf("after") };
}

function fillAfter({ source, reading }) {
  chosen.after = source === "arrays" ? { arrays: [] } : { file: source.file };
  $("after-chosen").textContent = source.file ?? "height_nm.npy, x_mm.npy, y_mm.npy";
  setReading("after", reading);
}

/** What was learnt and decided: the lines of the messages that are no commands. */
function showAfter(messages) {
  const found = state.session.after, isDone = found && ["done", "negative", "outdated"].includes(found.end);
  const lines = messages.split("\n").filter((line) => /^(parameter |[a-z_]+ {2,}\S|now |next run |gain |RUN AGAIN|STOP|the plan: )/.test(line));
  $("learnt").textContent = lines.join("\n");
  $("learnt").hidden = !isDone || lines.length === 0;
  const key = JSON.stringify([found, state.has_reports[1]]);
  if (drawn.after === key) return;
  drawn.after = key;
  $("next-report").replaceChildren(...(isDone && state.has_reports[1] ? [reportFrame("Report of the next run", state.reports[1])] : []));
}

function startAfter() {
  onSubmit("after-form", "after", afterChoice);
}
