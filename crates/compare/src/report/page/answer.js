// The answer: which plan is to be run, what it leaves, and why this one.

/** Whether what is wrong with a method is a fault of the run: of its plan, or of all where there is none to run. */
const concerns = (entry) => entry.run.best === null || entry.method.name === entry.run.best;
/** Dwell times without a motion are no plan, and nobody runs them. */
const isStill = (entry) => entry.run.summary.methods[entry.method.name].plan.state === "without-motion";
const alarm = (entry) => (concerns(entry) && !isStill(entry) ? theme.bad : theme.soft);

function fillAnswer() {
  const winner = DATA.summary.winner;
  if (winner) byId("answer").append(element("p", winner.sentence, { class: "sentence", id: "winner" }));
  for (const run of RUNS) {
    const { sentence, why, without_motion, problems } = run.summary.answer;
    const part = element("div", undefined, { class: "run" }), add = (name, text, look) => part.append(element(name, text, { class: look }));
    if (RUNS.length > 1) add("h2", run.name, "whose");
    add("p", sentence, "sentence");
    for (const text of problems) add("p", text, "violation");
    add("p", why, "why");
    if (without_motion) add("p", without_motion, "note still");
    byId("answer").append(part);
  }
}
