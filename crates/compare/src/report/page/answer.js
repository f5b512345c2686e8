// The answer: which plan is to be run, what it leaves, and why this one.

/** Whether what is wrong with a method is a fault of the run: of its plan, or of all where there is none to run. */
const concerns = (entry) => SEVERAL !== null || entry.run.best === null || entry.method.name === entry.run.best;
/** Dwell times without a motion are no plan, and nobody runs them. */
const isStill = (entry) => entry.run.summary.methods[entry.method.name].plan.state === "without-motion";
const alarm = (entry) => (concerns(entry) && !isStill(entry) ? theme.bad : theme.soft);

/** The run that the page opens with: that of the plan to be run, else the first that has such a plan, else the first. */
function leadingRun() {
  const winner = DATA.summary.winner;
  return RUNS.find((run) => winner && winner.run !== null && run.name === winner.run && run.best === winner.method)
    || RUNS.find((run) => run.best !== null) || RUNS[0];
}

/** Appends one text of the answer of a run to an element. */
function addAnswer(parent, run, look, text, name = "p") {
  parent.append(element(name, text, { class: look, "data-answer": RUNS.indexOf(run) }));
}

/** Appends the reasons against a run's plan; of more than two, those after the second fold. */
function addProblems(parent, run) {
  const { problems } = run.summary.answer, shown = problems.length > 2 ? 2 : problems.length;
  for (const text of problems.slice(0, shown)) addAnswer(parent, run, "violation", text);
  if (shown === problems.length) return;
  const more = element("details");
  more.append(element("summary", `${problems.length - shown} more reasons against this plan`));
  for (const text of problems.slice(shown)) addAnswer(more, run, "violation", text);
  parent.append(more);
}

/** Says the answer above the maps, and its reasons below them; of several runs, also the answer of each below them. */
function fillAnswer() {
  const answer = byId("answer"), reasons = byId("reasons"), lead = leadingRun(), one = RUNS.length === 1;
  if (one) addAnswer(answer, lead, "sentence", lead.summary.answer.sentence);
  else answer.append(element("p", DATA.summary.winner ? DATA.summary.winner.sentence : "No run has a plan that is to be run.", { class: "sentence", id: "winner" }));
  if (lead) addProblems(answer, lead);
  byId("reasons-of").textContent = one ? "Reasons" : "Every run";
  for (const run of RUNS) {
    const { sentence, why, without_motion } = run.summary.answer;
    const part = element("div", undefined, { class: "run" });
    if (!one) {
      part.append(element("h3", run.name));
      addAnswer(part, run, "sentence", sentence);
      if (run !== lead) addProblems(part, run);
    }
    addAnswer(part, run, "why", why);
    if (without_motion) addAnswer(part, run, "note still", without_motion);
    reasons.append(part);
  }
}

/** Shows what the user states about the part. */
function fillPart() {
  const { name, number: code, date, operator } = RUNS.length ? RUNS[0].summary.part : {};
  const stated = [["Part", name], ["number", code], ["date", date], ["operator", operator]].filter(([, value]) => value);
  byId("part").hidden = !stated.length;
  byId("part").textContent = stated.map(([what, value]) => `${what} ${value}`).join(", ");
}
