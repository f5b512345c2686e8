//! State of a plan: whether its optimality is proven. It follows from the end that is stated by the stage which chose
//! the motion or the dwell times.
//!
//! | state | meaning |
//! |---|---|
//! | certified | the objective of the motion is proven to be within a stated fraction of its minimum |
//! | dwell-optimal | the same is proven of the dwell times; a scheduler made the motion from them |
//! | converged | the method ended by itself, or states no end; nothing proves how near the optimum it is |
//! | unconverged | it stagnated, reached a limit, ended with a negative verdict, or was solved for something else |
//! | baseline | made by a stage that exists to compare with the literature: never recommended |
//! | without-motion | dwell times without a motion: nothing that runs |
//! | unknown | a manifest is missing, the motion was read back from a program, or its end says nothing of an optimum |

use planish_types::{
    End,
    outcome::{
        StageStatus,
        plan::{PlanReport, StatedEnd},
    },
    text::significant,
};
use serde::Serialize;

use crate::made::Made;

/// Name of the scheduler that applies the dwell times at the dwell points, without a motion between them; its result
/// is no plan.
pub const WITHOUT_MOTION: &str = "position";

/// Stages that exist to compare with the literature (folders `baselines`), as pairs of program and method. Their
/// plans are shown, and never recommended.
pub const BASELINES: [(&str, &str); 7] = [
    ("planish-schedule", "average-velocity"),
    ("planish-schedule", "position"),
    ("planish-schedule", "pvt-as-published"),
    ("planish-dwell", "bcls"),
    ("planish-dwell", "feed-law"),
    ("planish-dwell", "non-negative-least-squares"),
    ("planish-dwell", "truncated-svd"),
];

/// Largest gap, relative to the objective, that counts as rounding of its sum. Larger: a small gap is called optimal
/// to rounding. Smaller: a gap that is rounding is printed. Chosen: some thousand times the rounding of one number.
const ROUNDING: f64 = 1e-12;

/// Word for the state of a motion that was read back from a controller program.
pub const PROGRAM: &str = "program";

/// State of a plan; the table of the module explains the variants.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum State {
    /// The motion is proven to be near the optimum, within a stated gap.
    Certified,
    /// The dwell times are proven to be near their optimum; nothing is proven of the motion.
    DwellOptimal,
    /// The method ended by itself without a proof, or its manifest states no end.
    Converged,
    /// The method stagnated, reached a limit or ended with a negative verdict, or the dwell times were solved for
    /// something else.
    Unconverged,
    /// The plan was made by a stage that exists to compare with the literature.
    Baseline,
    /// The result is dwell times without a motion, which is no plan.
    WithoutMotion,
    /// A manifest is missing, the motion was read back from a program, or the end says nothing of an optimum.
    Unknown,
}

/// State of a plan, also as text for people.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PlanStatus {
    /// State of the plan.
    pub state: State,
    /// State in one or two words, for a table.
    pub word: String,
    /// State in a sentence or clause, with its reasons.
    pub text: String,
}

impl PlanStatus {
    fn new(state: State, word: &str, text: impl Into<String>) -> Self {
        Self { state, word: word.into(), text: text.into() }
    }

    /// Returns the state of the plan of the method `name`. `trajectory` and `dwell` are the manifests of its motion and
    /// of the dwell times from which the motion was scheduled; without one that matters the state is unknown.
    /// `solved_for_another` holds the roles (such as `surface`) for which those dwell times were solved with another
    /// artifact.
    pub fn of_method(
        name: &str,
        trajectory: Option<&Made>,
        dwell: Option<&Made>,
        solved_for_another: &[&str],
    ) -> Self {
        if name == WITHOUT_MOTION {
            let text = "the dwell times at the dwell points without a motion between them: not a plan; no machine \
                        can run it, and a plan may leave less";
            return Self::new(State::WithoutMotion, "no motion", text);
        }
        if let Some(method) = [trajectory, dwell].into_iter().flatten().find_map(baseline) {
            let text =
                format!("{method} is there to compare with, and its plan is not recommended");
            return Self::new(State::Baseline, "baseline", text);
        }
        if let Some(trajectory) = trajectory {
            match trajectory.shown.tool.as_str() {
                "planish-refine" | "planish-joint" | "planish-bspline-feed" => {
                    return Self::of_manifest(trajectory);
                }
                "planish-import" => {
                    let text = "read back from a controller's program; how good the plan is that it was made of, \
                                the plan says";
                    return Self::new(State::Unknown, PROGRAM, text);
                }
                _ => {}
            }
        }
        if !trajectory.is_some_and(|made| made.is_from_dwell_times) {
            let text = "no manifest says which dwell times its motion follows";
            return Self::new(State::Unknown, "not known", text);
        }
        let Some(dwell) = dwell else { return Self::without_manifest() };
        if let Some(role) = solved_for_another.first() {
            let role = role.replace('-', " ");
            let text = format!("its dwell times were found for another {role}");
            return Self::new(State::Unconverged, "other plan", text);
        }
        Self::of_dwell(dwell)
    }

    /// Returns the state of the dwell times of a solver. `manifest` is their manifest; `None` if they have none.
    pub fn of_solver(manifest: Option<&Made>) -> Self {
        manifest.map_or_else(Self::without_manifest, Self::of_dwell)
    }

    fn without_manifest() -> Self {
        let text = "no manifest says how its dwell times were found";
        Self::new(State::Unknown, "not known", text)
    }

    /// Returns the state of dwell times from their manifest. A proof of their optimality says nothing of a motion.
    fn of_dwell(manifest: &Made) -> Self {
        match Self::of_manifest(manifest) {
            Self { state: State::Certified, text, .. } => {
                let text = format!("the dwell times are {text}; nothing is proven of the motion");
                Self::new(State::DwellOptimal, "dwell times optimal", text)
            }
            other => other,
        }
    }

    /// Returns the state that follows from the status, the end and the optimality gap in the manifest of a stage.
    fn of_manifest(manifest: &Made) -> Self {
        let report = manifest.outcome.report.as_ref();
        // A stage that is not ours may end with a word of its own.
        let stated = report.and_then(|r| r.end.as_ref()).or(manifest.outcome.end.as_ref());
        let (end, foreign) = match stated {
            Some(StatedEnd::Known(end)) => (Some(*end), None),
            Some(StatedEnd::Foreign(word)) => (None, Some(word)),
            None => (None, None),
        };
        let unconverged = match end {
            Some(End::Stagnated) => "stagnated",
            Some(End::IterationLimit) => "iteration limit",
            Some(End::RoundLimit) => "round limit",
            Some(End::StepLimit) => "step limit",
            _ => "not converged",
        };
        let proven = proven(manifest);
        if manifest.shown.status == Some(StageStatus::Negative) {
            let reason = manifest.reason.as_deref().unwrap_or("it ended with a negative verdict");
            return Self::new(State::Unconverged, unconverged, reason);
        }
        if let Some(why) = end.and_then(without_proof) {
            let text = format!("{why}, which proves nothing of an optimum");
            return Self::new(State::Unknown, "no certificate", text);
        }
        match (end, foreign) {
            (Some(End::Optimal), _) => match proven {
                Some(proven) => Self::new(State::Certified, "certified", proven),
                None => {
                    let text = "optimal to its tolerance, without a bound on what is left to gain";
                    Self::new(State::Converged, "converged", text)
                }
            },
            (Some(End::Stagnated), _) => {
                let left =
                    proven.map_or("no certificate".into(), |proven| format!("only {proven}"));
                let text = format!("stagnated: the objective changes no more; {left}");
                Self::new(State::Unconverged, unconverged, text)
            }
            (Some(End::RoundLimit), _) => {
                let text = "the last round that was allowed still improved it";
                Self::new(State::Unconverged, unconverged, text)
            }
            (
                Some(
                    End::IterationLimit
                    | End::StepLimit
                    | End::SweepLimit
                    | End::LiftLimit
                    | End::LinkLimit,
                ),
                _,
            ) => {
                let text = "the limit of its iterations was reached before it converged";
                Self::new(State::Unconverged, unconverged, text)
            }
            (Some(End::NoImprovement), _) => {
                let text = "corrected until no round improved it; no certificate of optimality";
                Self::new(State::Converged, "converged", text)
            }
            (Some(_), _) => Self::ended_by_itself(),
            // What another program wrote.
            (None, Some(name)) => {
                let text = format!("ended with `{name}`, of which nothing is known here");
                Self::new(State::Unknown, "not known", text)
            }
            (None, None) => match report.and_then(|r| r.converged) {
                Some(true) => Self::ended_by_itself(),
                Some(false) => Self::new(State::Unconverged, "not converged", "not converged"),
                None => {
                    let by = match manifest.shown.method.as_str() {
                        "" => String::new(),
                        method => format!("by {method}, "),
                    };
                    let text = format!("{by}which gives no certificate of optimality");
                    Self::new(State::Converged, "no certificate", text)
                }
            },
        }
    }

    fn ended_by_itself() -> Self {
        let text = "ended by itself; no certificate of optimality";
        Self::new(State::Converged, "converged", text)
    }
}

/// Returns a clause on an end that proves nothing about an optimum; `None` for the other ends, including limits.
fn without_proof(end: End) -> Option<&'static str> {
    match end {
        End::Settled => Some("its residual no longer changed"),
        End::Threshold => Some("its threshold was reached"),
        End::Stopped => Some("its next step would have made the residual larger"),
        End::StepsDone | End::RoundsDone => Some("it made the number of steps that was asked for"),
        End::AllPrices => Some("it made the plans of all prices"),
        End::Direct => Some("a formula gives it, without a search"),
        End::Optimal | End::Converged | End::NoImprovement | End::Stagnated => None,
        End::IterationLimit | End::RoundLimit | End::StepLimit => None,
        End::SweepLimit | End::LiftLimit | End::LinkLimit => None,
    }
}

/// Returns the method of the stage that wrote the manifest, if the stage is a baseline; otherwise `None`.
fn baseline(manifest: &Made) -> Option<&str> {
    let made_by = (manifest.shown.tool.as_str(), manifest.shown.method.as_str());
    if BASELINES.contains(&made_by) { Some(made_by.1) } else { None }
}

/// Returns a clause on the optimality gap that a stage has proven, with the plans that it covers; `None` if it states
/// no finite gap. The gap is relative to the objective if the stage states it so.
fn proven(manifest: &Made) -> Option<String> {
    let PlanReport { proven, .. } = manifest.outcome.report.as_ref()?;
    let gap = proven.relative_gap.or(proven.gap)?;
    if !gap.is_finite() {
        return None;
    }
    let covered = match (&proven.gap_covers, manifest.shown.tool.as_str()) {
        (Some(covered), _) => format!("; it compares with {covered}"),
        // The limits on a motion are not convex: its certificate is that of the convex problem around it.
        (None, "planish-joint" | "planish-bspline-feed") => {
            " with the limits linearised at this plan, so it is a local optimum".into()
        }
        (None, _) => String::new(),
    };
    if gap <= ROUNDING {
        return Some(format!("proven optimal to rounding{covered}"));
    }
    let gap = significant(gap, 2);
    Some(format!("proven within {gap} of the least objective, relative to it{covered}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::outcome::{StageEnd, plan::PlanOutcome};
    use serde::Deserialize;
    use serde_json::{Value, json};

    use crate::made::Shown;

    /// Reads the parts of a manifest that a test states.
    fn read(manifest: &Value) -> Made {
        let word = |key: &str| manifest[key].as_str().unwrap_or_default().to_string();
        let has_dwell = |list: &str, key: &str| {
            manifest[list].as_array().into_iter().flatten().any(|entry| entry[key] == "dwell")
        };
        let none = json!({});
        let outcome = manifest.get("outcome").unwrap_or(&none);
        let end = StageEnd::deserialize(outcome).unwrap();
        let shown = Shown {
            tool: word("tool"),
            method: word("method"),
            status: end.status,
            ..Shown::default()
        };
        Made {
            shown,
            reason: end.reason,
            is_from_dwell_times: has_dwell("inputs", "role") || has_dwell("lineage", "kind"),
            outcome: PlanOutcome::deserialize(outcome).unwrap(),
        }
    }

    /// Returns the plan of these manifests.
    fn plan_of(
        name: &str,
        trajectory: Option<&Value>,
        dwell: Option<&Value>,
        other: &[&str],
    ) -> PlanStatus {
        PlanStatus::of_method(name, trajectory.map(read).as_ref(), dwell.map(read).as_ref(), other)
    }

    fn dwell(outcome: Value) -> Value {
        json!({ "tool": "planish-dwell", "method": "bounded-least-squares", "outcome": outcome })
    }

    fn scheduled() -> Value {
        json!({ "tool": "planish-schedule", "inputs": [{ "role": "tool-path" }, { "role": "dwell" }] })
    }

    #[test]
    fn every_end_of_a_solver_is_said() {
        let done = |report: Value| dwell(json!({ "status": "done", "report": report }));
        for (manifest, state, word, text) in [
            (
                done(json!({ "end": "optimal", "relative_gap": 4.2e-5 })),
                State::DwellOptimal,
                "dwell times optimal",
                "within 4.2e-5 of",
            ),
            (
                done(json!({ "end": "optimal", "relative_gap": 7.4e-22 })),
                State::DwellOptimal,
                "dwell times optimal",
                "optimal to rounding; nothing is proven of the motion",
            ),
            (
                done(json!({ "end": "optimal", "relative_gap": null })),
                State::Converged,
                "converged",
                "without a bound",
            ),
            (
                done(json!({ "end": "stagnated", "relative_gap": 0.25 })),
                State::Unconverged,
                "stagnated",
                "only proven within 0.25",
            ),
            (
                done(json!({ "end": "stagnated" })),
                State::Unconverged,
                "stagnated",
                "no certificate",
            ),
            (done(json!({ "end": "converged" })), State::Converged, "converged", "no certificate"),
            (
                done(json!({ "gain": 1.0 })),
                State::Converged,
                "no certificate",
                "by bounded-least-squares, which gives no certificate",
            ),
            (
                dwell(json!({
                    "status": "negative", "reason": "not converged: a dwell time would still move",
                    "report": { "end": "iteration-limit", "relative_gap": 0.1 },
                })),
                State::Unconverged,
                "iteration limit",
                "would still move",
            ),
            (done(json!({ "end": "tired" })), State::Unknown, "not known", "`tired`"),
            (done(json!({ "end": "settled" })), State::Unknown, "no certificate", "no longer"),
            (done(json!({ "end": "direct" })), State::Unknown, "no certificate", "a formula"),
            (done(json!({ "end": "lift-limit" })), State::Unconverged, "not converged", "limit"),
        ] {
            let plan = plan_of("pvt", Some(&scheduled()), Some(&manifest), &[]);
            assert_eq!((plan.state, plan.word.as_str()), (state, word), "{manifest}");
            assert!(plan.text.contains(text), "{plan:?}");
        }
    }

    #[test]
    fn a_stage_that_chooses_dwell_times_speaks_for_itself() {
        let made = |tool: &str, outcome: Value| json!({ "tool": tool, "outcome": outcome });
        let certified = dwell(json!({ "report": { "end": "optimal", "relative_gap": 1e-5 } }));
        for (trajectory, state, word) in [
            (
                made("planish-refine", json!({ "status": "done", "end": "no-improvement" })),
                State::Converged,
                "converged",
            ),
            (
                made("planish-refine", json!({ "status": "done", "end": "round-limit" })),
                State::Unconverged,
                "round limit",
            ),
            (
                made("planish-bspline-feed", json!({ "report": { "converged": false } })),
                State::Unconverged,
                "not converged",
            ),
            (
                made("planish-bspline-feed", json!({ "report": { "converged": true } })),
                State::Converged,
                "converged",
            ),
            (made("planish-import", json!({})), State::Unknown, "program"),
            (
                made(
                    "planish-joint",
                    json!({ "report": { "end": "optimal", "relative_gap": 1e-4 } }),
                ),
                State::Certified,
                "certified",
            ),
            (scheduled(), State::DwellOptimal, "dwell times optimal"),
            // Moved to where the part lies: made from a trajectory that was made from dwell times.
            (
                json!({ "tool": "planish-register", "lineage": [{ "kind": "dwell" }] }),
                State::DwellOptimal,
                "dwell times optimal",
            ),
            // A motion whose manifest names no dwell times is not known to follow any.
            (made("planish-schedule", json!({})), State::Unknown, "not known"),
        ] {
            let plan = plan_of("mine", Some(&trajectory), Some(&certified), &[]);
            assert_eq!((plan.state, plan.word.as_str()), (state, word), "{trajectory}");
        }
        let covers = "plans on this curve";
        let covers =
            json!({ "report": { "end": "optimal", "relative_gap": 6.9e-4, "gap_covers": covers } });
        let joint = plan_of("mine", Some(&made("planish-joint", covers)), None, &[]);
        let text = "proven within 0.00069 of the least objective, relative to it; it compares with plans on this curve";
        assert_eq!((joint.state, joint.text.as_str()), (State::Certified, text));
        // Dwell times without a motion are never taken for a plan.
        let still = plan_of("position", Some(&scheduled()), Some(&certified), &[]);
        assert_eq!(still.state, State::WithoutMotion);
        // A trajectory of one's own, beside dwell times that are optimal.
        let own = plan_of("pvt", None, Some(&certified), &[]);
        assert_eq!((own.state, own.word.as_str()), (State::Unknown, "not known"));
        // A motion of a baseline, and one of dwell times of a baseline.
        let made = |tool: &str, method: &str| json!({ "tool": tool, "method": method, "inputs": [{ "role": "dwell" }] });
        let published = made("planish-schedule", "pvt-as-published");
        let of_motion = plan_of("mine", Some(&published), Some(&certified), &[]);
        let law = made("planish-dwell", "feed-law");
        let of_dwell = plan_of("pvt", Some(&scheduled()), Some(&law), &[]);
        assert_eq!([of_motion.state, of_dwell.state], [State::Baseline; 2]);
        let other = plan_of("pvt", Some(&scheduled()), Some(&certified), &["tool-path"]);
        assert_eq!(other.state, State::Unconverged);
        assert!(other.text.contains("another tool path"), "{other:?}");
        assert_eq!(plan_of("pvt", Some(&scheduled()), None, &[]).state, State::Unknown);
    }
}
