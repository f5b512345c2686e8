// The answer: which plan is to be run, what it leaves, and why this one.

/** Whether what is wrong with a method is a fault of the run: of its plan, or of all where there is none to run. */
const concerns = (entry) => entry.run.best === null || entry.method.name === entry.run.best;
/** Nobody runs the ideal. */
const isIdeal = (entry) => entry.run.summary.methods[entry.method.name].plan.state === "ideal";
const alarm = (entry) => (concerns(entry) && !isIdeal(entry) ? theme.bad : theme.soft);

function fillAnswer() {
  for (const run of RUNS) {
    const { sentence, why, ideal, problems } = run.summary.answer;
    const part = element("div", undefined, { class: "run" }), add = (name, text, look) => part.append(element(name, text, { class: look }));
    if (RUNS.length > 1) add("h2", run.name, "whose");
    add("p", sentence, "sentence");
    for (const text of problems) add("p", text, "violation");
    add("p", why, "why");
    if (ideal) add("p", ideal, "note ideal");
    byId("answer").append(part);
  }
}
