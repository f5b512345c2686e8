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

/** The lines of the messages that say what was learnt, which are the first table, and what was decided. */
function learntLines(messages) {
  const lines = messages.split("\n"), begin = lines.findIndex((line) => line.startsWith("parameter "));
  const end = lines.findIndex((line, i) => i > begin && !/^\S+ {2,}/.test(line));
  const decided = lines.filter((line) => /^(now |next run |gain |RUN AGAIN|STOP|the plan: )/.test(line));
  return [...(begin < 0 ? [] : lines.slice(begin, end < 0 ? undefined : end)), "", ...decided];
}

function showAfter(messages) {
  const found = state.session.after, isDone = found && ["done", "negative", "outdated"].includes(found.end);
  const lines = learntLines(messages);
  $("learnt").textContent = lines.join("\n");
  $("learnt").hidden = !isDone || lines.length < 2;
  const key = JSON.stringify([found, state.has_reports[1]]);
  if (drawn.next === key) return;
  drawn.next = key;
  $("next-report").replaceChildren(...(isDone && state.has_reports[1] ? [reportFrame("Report of the next run", state.reports[1])] : []));
}

function startAfter() {
  onSubmit("after-form", "after", afterChoice);
}
