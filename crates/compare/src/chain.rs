//! Check that the artifacts of a run belong together.
//!
//! Every artifact that a stage writes records the role and BLAKE3 of each input. That hash must be the one of the
//! artifact that is in the run now.
//!
//! | artifact | records | must be |
//! |---|---|---|
//! | verdict | trajectory | the method's |
//! | removal, frames | trajectory, surface, tif | the method's, the run's, the run's |
//! | trajectory | tool-path, dwell; of a stage that also chooses the dwell times, surface and tif | the run's |
//! | dwell of a method | surface, tif, tool-path | the run's |
//!
//! A verdict or a removal of another motion says nothing about the method: it is not valid. A plan for other dwell
//! times, another path or another surface is a plan, but not of this run: it is out of date. Arrays without a record
//! cannot be checked, and a remark says so.

use std::collections::BTreeSet;

use serde::Serialize;

/// Record of an artifact in its manifest: its program and its inputs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Record {
    /// Name of the program that made the artifact.
    pub tool: String,
    /// Hash of program, settings and inputs. It is the same for all artifacts of one run of a stage.
    pub key: String,
    /// Role (flag) and BLAKE3 hash of each input.
    pub inputs: Vec<(String, String)>,
}

impl Record {
    /// Returns the BLAKE3 hash of the input with this role; `None` if the record has no such input.
    pub fn input(&self, role: &str) -> Option<&str> {
        self.inputs.iter().find(|(r, _)| r == role).map(|(_, digest)| digest.as_str())
    }
}

/// An artifact, as its hash and its record.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Recorded {
    /// BLAKE3 hash of the content of the artifact.
    pub digest: String,
    /// Record in the manifest; `None` for arrays without a manifest.
    pub record: Option<Record>,
}

/// Artifacts that all methods of a run share. A method is one plan: a scheduler or solver with its results.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RunRecords {
    /// Map of the desired removal, which all methods shall remove.
    pub surface: Recorded,
    /// Tool path; `None` if the run has none.
    pub tool_path: Option<Recorded>,
    /// Dwell times; `None` if the run has none.
    pub dwell: Option<Recorded>,
}

/// Artifacts of one method of a run, each as its hash and its record.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MethodRecords {
    /// Motion of the method along the tool path.
    pub trajectory: Recorded,
    /// Predicted removal of the motion, with the residual that it leaves.
    pub removal: Recorded,
    /// Record of the verdict on the limits of the machine.
    pub verdict: Record,
    /// Two statements on the limits of the machine, true if they are kept: that of the verdict, and that of the
    /// scheduler, which is `None` if the manifest of the motion has none.
    pub limits_kept: (bool, Option<bool>),
    /// Dwell times of the method's own; `None` if it uses those of the run.
    pub dwell: Option<Recorded>,
    /// Removal at chosen times of the run; `None` if it was not simulated.
    pub frames: Option<Recorded>,
    /// Rounds of a refinement; `None` if there was none.
    pub iterations: Option<Recorded>,
}

/// Validity of a method in the comparison.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Standing {
    /// The method takes part in the comparison.
    Valid,
    /// The method is a plan for another surface, tool, path or dwell times than the run has now. Or a part is missing,
    /// because a run was ended early, or its parts `on-axes` or `removal-after-servo` were made from other artifacts.
    OutOfDate,
    /// The artifacts of the method do not belong together. Verdict, removal or frames are of another motion, or the
    /// removal is of another surface or tool. Or the machines, refinements or statements on the limits contradict each
    /// other.
    NotValid,
    /// The stage of the method refused to make a plan.
    Refused,
}

/// Result of the check of a method's artifacts.
#[derive(Clone, Debug, PartialEq)]
pub struct Chain {
    /// Validity of the method.
    pub standing: Standing,
    /// Reasons why the method takes no part; empty if it is valid.
    pub reasons: Vec<String>,
    /// Remarks on what could not be checked, and on a verdict about another machine. A report shows them only if the
    /// method is valid.
    pub remarks: Vec<String>,
}

/// Checks the artifacts of every method of a run. Returns one result per method, in the same order.
pub fn check(run: &RunRecords, methods: &[MethodRecords]) -> Vec<Chain> {
    // The tool of the run: that of its dwell times, else of its path, else of the first prediction.
    let shared = run.dwell.iter().chain(&run.tool_path);
    let tif = shared.chain(methods.iter().map(|m| &m.removal)).find_map(|p| record_input(p, "tif"));
    let machines: BTreeSet<&str> =
        methods.iter().filter_map(|m| m.verdict.input("machine")).collect();
    let context = Context { run, tif, one_machine: machines.len() <= 1 };
    methods.iter().map(|method| context.check(method)).collect()
}

/// Returns those of the roles `surface` and `tool-path` for which the dwell times `artifact` record another input than
/// the artifact that the run has now.
pub(crate) fn solved_for_another(run: &RunRecords, artifact: &Recorded) -> Vec<&'static str> {
    let path = run.tool_path.as_ref().map(|p| p.digest.as_str());
    let known = [("surface", Some(run.surface.digest.as_str())), ("tool-path", path)];
    let others = known.iter().filter(|(role, digest)| differs(artifact, role, *digest));
    others.map(|(role, _)| *role).collect()
}

/// Returns sentences on shared artifacts of the run that are out of date: a tool path for another surface, or dwell
/// times for another surface or tool path. The list is empty if none is.
pub fn check_run(run: &RunRecords) -> Vec<String> {
    let mut sentences = Vec::new();
    let path = run.tool_path.as_ref();
    if path.is_some_and(|path| differs(path, "surface", Some(&run.surface.digest))) {
        sentences
            .push("the tool path was made for another surface; run planish toolpath again".into());
    }
    let dwell = run.dwell.as_ref();
    for role in dwell.map(|dwell| solved_for_another(run, dwell)).unwrap_or_default() {
        let name = spoken(role);
        sentences
            .push(format!("the dwell times are for another {name}; run the dwell solver again"));
    }
    sentences
}

/// Artifacts of the run with which those of a method are compared. `tif` is the BLAKE3 hash of its tool, `None` if no
/// record names one; `one_machine` is true if all verdicts are about one machine file.
struct Context<'a> {
    run: &'a RunRecords,
    tif: Option<&'a str>,
    one_machine: bool,
}

impl Context<'_> {
    fn check(&self, m: &MethodRecords) -> Chain {
        let mut foreign = self.foreign(m);
        let mut stale = self.stale(m);
        let elsewhere = self.elsewhere(m);
        let (standing, reasons) = if !foreign.is_empty() {
            foreign.extend(elsewhere);
            (Standing::NotValid, foreign)
        } else if !stale.is_empty() {
            stale.extend(elsewhere);
            (Standing::OutOfDate, stale)
        } else if !elsewhere.is_empty() {
            (Standing::NotValid, elsewhere)
        } else {
            (Standing::Valid, vec![])
        };
        Chain { standing, reasons, remarks: self.remarks(m) }
    }

    /// Returns reasons against the method because its own artifacts do not belong together. Verdict, prediction,
    /// frames, rounds or dwell times belong to another motion, or verdict and motion differ on the machine or its
    /// limits.
    fn foreign(&self, m: &MethodRecords) -> Vec<String> {
        let mut reasons = Vec::new();
        let trajectory = m.trajectory.digest.as_str();
        if m.verdict.input("trajectory").is_some_and(|digest| digest != trajectory) {
            reasons.push("its verdict is of another trajectory: run planish verify again".into());
        }
        if differs(&m.removal, "trajectory", Some(trajectory)) {
            reasons.push("its removal is of another trajectory: run planish simulate again".into());
        }
        if m.frames.as_ref().is_some_and(|f| differs(f, "trajectory", Some(trajectory))) {
            let remedy = "run planish simulate --frames again, or remove its frames";
            reasons.push(format!("its frames are of another trajectory: {remedy}"));
        }
        let motion = m.trajectory.record.as_ref();
        let record = |artifact: &'_ Option<Recorded>| artifact.clone().and_then(|a| a.record);
        let dwell = record(&m.dwell);
        // Dwell times, motion and rounds of a refinement come from one run of it.
        let mut others = [record(&m.iterations), dwell.clone()].into_iter().flatten();
        if others.any(|other| motion.is_some_and(|m| m.tool == other.tool && m.key != other.key)) {
            reasons.push("its artifacts are of two refinements: run planish refine again".into());
        }
        if let (Some(made), Some(own)) = (record_input(&m.trajectory, "dwell"), m.dwell.as_ref())
            && dwell.as_ref().map(|d| &d.tool) != motion.map(|m| &m.tool)
            && made != own.digest
        {
            reasons
                .push("its motion is of other dwell times than its own: schedule it again".into());
        }
        if !self.one_machine && self.machine_differs(m) {
            let remedy = "run planish verify again with the machine of the run";
            reasons.push(format!(
                "its verdict is about another machine than it was scheduled for: {remedy}"
            ));
        }
        if m.limits_kept == (true, Some(false)) && !self.machine_differs(m) {
            let problem =
                "its verdict says that the limits are kept, its schedule that they are not";
            reasons.push(format!("{problem}: run planish verify again"));
        }
        reasons
    }

    /// Returns reasons against the method because its removal or its frames were predicted with another surface or tool
    /// than those of the run.
    fn elsewhere(&self, m: &MethodRecords) -> Vec<String> {
        let mut reasons = Vec::new();
        let surface = Some(self.run.surface.digest.as_str());
        for (artifact, name, how) in [
            (Some(&m.removal), "removal is", "planish simulate"),
            (m.frames.as_ref(), "frames are", "planish simulate --frames"),
        ] {
            for (role, digest) in [("surface", surface), ("tif", self.tif)] {
                if artifact.is_some_and(|artifact| differs(artifact, role, digest)) {
                    let role = spoken(role);
                    reasons.push(format!("its {name} of another {role}: run {how} again"));
                }
            }
        }
        reasons
    }

    /// Returns reasons against the method because it was planned for another surface, tool, path or dwell times.
    fn stale(&self, m: &MethodRecords) -> Vec<String> {
        let run = self.run;
        let mut others: Vec<&str> = Vec::new();
        let path = run.tool_path.as_ref().map(|p| p.digest.as_str());
        let known = [
            ("surface", Some(run.surface.digest.as_str())),
            ("tif", self.tif),
            ("tool-path", path),
        ];
        for artifact in std::iter::once(&m.trajectory).chain(&m.dwell) {
            others.extend(known.iter().filter(|(r, d)| differs(artifact, r, *d)).map(|(r, _)| *r));
        }
        // The dwell times that the motion, or the refinement, started from.
        let from = record_input(&m.trajectory, "dwell");
        let own = m.dwell.as_ref().map(|d| d.digest.as_str());
        let shared = run.dwell.as_ref().map(|d| d.digest.as_str());
        if from.is_some() && shared.is_some() && from != shared && from != own {
            others.push("dwell");
        }
        others.sort_unstable();
        others.dedup();
        let remedy = "plan it again, or remove its directory";
        others
            .iter()
            .map(|role| match *role {
                "dwell" => format!(
                    "it is a plan from other dwell times: if they are its own, put them in dwell/ of its directory; \
                     else {remedy}"
                ),
                role => format!("it is a plan for another {}: {remedy}", spoken(role)),
            })
            .collect()
    }

    /// Returns remarks on a method: artifacts that could not be checked, since no record names their inputs, and a
    /// verdict about another machine than the motion was scheduled for.
    fn remarks(&self, m: &MethodRecords) -> Vec<String> {
        let mut unknown: Vec<&str> = Vec::new();
        let known = |artifact: &Recorded, role: &str| record_input(artifact, role).is_some();
        if !known(&m.trajectory, "tool-path") && !known(&m.trajectory, "dwell") {
            unknown.push("trajectory");
        }
        if !known(&m.removal, "trajectory") || !known(&m.removal, "surface") {
            unknown.push("removal");
        }
        if m.verdict.input("trajectory").is_none() {
            unknown.push("verdict");
        }
        let mut remarks = Vec::new();
        if !unknown.is_empty() {
            remarks.push(format!(
                "not checked, because there is no record of what they were made from: {}",
                unknown.join(", ")
            ));
        }
        if self.machine_differs(m) {
            remarks.push("its verdict is about another machine than it was scheduled for".into());
        }
        remarks
    }

    /// Returns true if the verdict is about another machine than that for which the motion was scheduled; false if
    /// either machine is not recorded.
    fn machine_differs(&self, m: &MethodRecords) -> bool {
        differs(&m.trajectory, "machine", m.verdict.input("machine"))
    }
}

/// Returns the BLAKE3 hash of the input `role` in the record of an artifact; `None` if it is not recorded.
fn record_input<'a>(artifact: &'a Recorded, role: &str) -> Option<&'a str> {
    artifact.record.as_ref()?.input(role)
}

/// Returns true if the input `role` of `artifact` has another hash than `digest`; false if either is not known.
fn differs(artifact: &Recorded, role: &str, digest: Option<&str>) -> bool {
    record_input(artifact, role).zip(digest).is_some_and(|(recorded, digest)| recorded != digest)
}

/// Returns the name of a role that people read, such as "tool path" for `tool-path`.
fn spoken(role: &str) -> &str {
    match role {
        "tif" => "TIF",
        "tool-path" => "tool path",
        role => role,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(tool: &str, key: &str, inputs: &[(&str, &str)]) -> Record {
        let inputs = inputs.iter().map(|(r, d)| (r.to_string(), d.to_string())).collect();
        Record { tool: tool.into(), key: key.into(), inputs }
    }

    fn recorded(digest: &str, tool: &str, key: &str, inputs: &[(&str, &str)]) -> Recorded {
        Recorded { digest: digest.into(), record: Some(record(tool, key, inputs)) }
    }

    fn run() -> RunRecords {
        let path =
            recorded("path", "planish-toolpath", "1", &[("surface", "surface"), ("tif", "tif")]);
        let from = [("surface", "surface"), ("tif", "tif"), ("tool-path", "path")];
        RunRecords {
            surface: Recorded { digest: "surface".into(), record: None },
            tool_path: Some(path),
            dwell: Some(recorded("dwell", "planish-dwell", "2", &from)),
        }
    }

    fn scheduled() -> MethodRecords {
        let predicted = [("trajectory", "motion"), ("tif", "tif"), ("surface", "surface")];
        let planned = [("tool-path", "path"), ("dwell", "dwell"), ("machine", "m")];
        MethodRecords {
            trajectory: recorded("motion", "planish-schedule", "3", &planned),
            removal: recorded("removal", "planish-simulate", "4", &predicted),
            verdict: record("planish-verify", "5", &[("trajectory", "motion"), ("machine", "m")]),
            limits_kept: (true, Some(true)),
            dwell: None,
            frames: Some(recorded("frames", "planish-simulate", "6", &predicted)),
            iterations: None,
        }
    }

    fn refined() -> MethodRecords {
        let from = [
            ("surface", "surface"),
            ("tif", "tif"),
            ("tool-path", "path"),
            ("machine", "m"),
            ("dwell", "dwell"),
        ];
        let made = |digest| recorded(digest, "planish-refine", "7", &from);
        MethodRecords {
            trajectory: made("motion"),
            dwell: Some(made("better")),
            iterations: Some(made("rounds")),
            ..scheduled()
        }
    }

    fn set(artifact: &mut Recorded, role: &str, digest: &str) {
        let record = artifact.record.as_mut().unwrap();
        record.inputs.iter_mut().find(|(r, _)| r == role).unwrap().1 = digest.into();
    }

    fn one(run: &RunRecords, method: MethodRecords) -> (Standing, String) {
        let found = check(run, &[method]).remove(0);
        (found.standing, found.reasons.join("; "))
    }

    #[test]
    fn what_belongs_together_is_valid_and_checked() {
        for method in [scheduled(), refined()] {
            let found = check(&run(), &[method]).remove(0);
            assert_eq!(found.standing, Standing::Valid, "{found:?}");
            assert!(found.reasons.is_empty() && found.remarks.is_empty(), "{found:?}");
        }
        assert!(check_run(&run()).is_empty());
    }

    #[test]
    fn one_changed_hash_is_found_whichever_it_is() {
        type Change = fn(&mut MethodRecords);
        let cases: [(Change, Standing, &str); 13] = [
            (
                |m| m.verdict.inputs[0].1 = "x".into(),
                Standing::NotValid,
                "verdict is of another traj",
            ),
            (
                |m| set(&mut m.removal, "trajectory", "x"),
                Standing::NotValid,
                "removal is of another",
            ),
            (|m| set(&mut m.removal, "surface", "x"), Standing::NotValid, "another surface: run"),
            (|m| set(&mut m.removal, "tif", "x"), Standing::NotValid, "removal is of another TIF"),
            (
                |m| set(m.frames.as_mut().unwrap(), "trajectory", "x"),
                Standing::NotValid,
                "frames are of another trajectory",
            ),
            (|m| m.trajectory.digest = "x".into(), Standing::NotValid, "verdict is of another"),
            (
                |m| m.limits_kept.1 = Some(false),
                Standing::NotValid,
                "its schedule that they are not",
            ),
            (|m| set(&mut m.trajectory, "dwell", "x"), Standing::OutOfDate, "other dwell times"),
            (
                |m| set(&mut m.trajectory, "tool-path", "x"),
                Standing::OutOfDate,
                "another tool path",
            ),
            (
                |m| m.iterations.as_mut().unwrap().record.as_mut().unwrap().key = "x".into(),
                Standing::NotValid,
                "two refinements",
            ),
            (
                |m| m.dwell.as_mut().unwrap().record.as_mut().unwrap().key = "x".into(),
                Standing::NotValid,
                "two refinements",
            ),
            (|m| set(&mut m.trajectory, "surface", "x"), Standing::OutOfDate, "another surface"),
            (
                |m| set(m.dwell.as_mut().unwrap(), "tif", "x"),
                Standing::OutOfDate,
                "a plan for another TIF",
            ),
        ];
        for (i, (change, standing, words)) in cases.into_iter().enumerate() {
            let mut method = refined();
            change(&mut method);
            let (found, reasons) = one(&run(), method);
            assert!(found == standing && reasons.contains(words), "{i}: {found:?} {reasons}");
        }
    }

    #[test]
    fn a_refinement_left_over_from_another_surface_is_out_of_date() {
        // Its prediction is of that surface too; nothing about it is false.
        let run = RunRecords { surface: Recorded { digest: "new".into(), record: None }, ..run() };
        let (standing, reasons) = one(&run, refined());
        assert_eq!(standing, Standing::OutOfDate, "{reasons}");
        assert!(
            reasons.contains("a plan for another surface") && reasons.contains("removal is of")
        );
        // A schedule knows no surface: its prediction alone is wrong.
        assert_eq!(one(&run, scheduled()).0, Standing::NotValid);
        let of_run = check_run(&run).join("; ");
        assert!(of_run.contains("the dwell times are for another surface"), "{of_run}");
        assert!(of_run.contains("the tool path was made for another surface"), "{of_run}");
    }

    #[test]
    fn a_method_with_dwell_times_of_its_own_is_scheduled_from_them() {
        let own = |digest: &str| {
            let mut m = scheduled();
            m.dwell = Some(Recorded { digest: digest.into(), record: None });
            set(&mut m.trajectory, "dwell", "own");
            m
        };
        assert_eq!(one(&run(), own("own")).0, Standing::Valid);
        let (standing, reasons) = one(&run(), own("x"));
        assert!(standing == Standing::NotValid && reasons.contains("than its own"), "{reasons}");
    }

    #[test]
    fn arrays_without_a_record_are_not_checked_and_that_is_said() {
        let bare = |digest: &str| Recorded { digest: digest.into(), record: None };
        let method = MethodRecords {
            trajectory: bare("motion"),
            removal: bare("removal"),
            verdict: Record::default(),
            limits_kept: (true, None),
            ..MethodRecords::default()
        };
        let found = check(&run(), &[method]).remove(0);
        assert_eq!(found.standing, Standing::Valid);
        assert!(found.remarks[0].ends_with("trajectory, removal, verdict"), "{found:?}");
        // A script in the place of the dwell solver: everything after it is checked all the same.
        let run = RunRecords { dwell: Some(bare("dwell")), ..run() };
        assert!(check(&run, &[scheduled()])[0].remarks.is_empty());
        let mut other = scheduled();
        set(&mut other.trajectory, "dwell", "x");
        assert_eq!(one(&run, other).0, Standing::OutOfDate);
    }

    #[test]
    fn verdicts_of_one_run_are_about_one_machine() {
        let lax = || {
            let mut m = scheduled();
            m.verdict.inputs[1].1 = "lax".into();
            m
        };
        // All on another machine: a question that may be asked. One of them: no comparison.
        let found = check(&run(), &[lax(), lax()]);
        assert!(found.iter().all(|c| c.standing == Standing::Valid && c.remarks.len() == 1));
        let found = check(&run(), &[lax(), scheduled()]);
        assert_eq!(found[0].standing, Standing::NotValid);
        assert_eq!(found[1].standing, Standing::Valid);
    }
}
