//! Choice of the step after the run: the map that was measured then, and the commands that learn from it.

use planish_pipeline::description::PipelineDescription;
use serde::{Deserialize, Serialize};

use crate::{
    choice::{MachineChoice, PartChoice, PartSource, PlanChoice, Reading, Words},
    refusal::Refusal,
};

/// Directory of the next run, in that of the session.
pub const NEXT_RUN: &str = "runs/next";
/// Settings of a plan that the next one leaves out: its program is that of the motion in the axes of the machine.
const NOT_PLANNED_AGAIN: [&str; 2] = ["export", "program_of"];

/// Choice of the map after a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AfterChoice {
    /// Map after the run; no fixture.
    pub source: PartSource,
    /// Reading of its file.
    #[serde(default)]
    pub reading: Reading,
}

/// The run that was measured: what was planned for which part on which machine.
pub struct MeasuredRun<'a> {
    /// Choice of the part.
    pub part: &'a PartChoice,
    /// Directory of the tool, in that of the session.
    pub tif: &'a str,
    /// Choice of the machine.
    pub machine: &'a MachineChoice,
    /// Choice of the plan.
    pub plan: &'a PlanChoice,
    /// Directory of the motion that ran, in that of the session.
    pub trajectory: &'a str,
}

impl AfterChoice {
    /// Returns the commands that read the map, learn from the run, plan the next one, and decide about it.
    ///
    /// # Errors
    /// Refuses a name that cannot be that of a file, a fixture, and settings that the pipeline does not have.
    pub fn commands(
        &self,
        run: &MeasuredRun,
        description: &PipelineDescription,
    ) -> Result<Vec<Words>, Refusal> {
        let mut commands: Vec<Words> =
            self.source.import("after", &self.reading)?.into_iter().collect();
        let mut next: Words = ["planish", "next-run"].map(String::from).into();
        next.push(format!("before={}", run.part.source.surface("part")));
        next.push(format!("after={}", self.source.surface("after")));
        next.push(format!("trajectory={}", run.trajectory));
        next.push(format!("tif={}", run.tif));
        next.push(format!("machine={}", run.machine.path(&description.folder)?));
        next.push(format!("pipeline={}", run.plan.pipeline));
        next.push(format!("prepare={}", run.part.preparation()?.join(" ")));
        next.extend(run.plan.setting_words(description, &NOT_PLANNED_AGAIN)?);
        next.push(format!("out={NEXT_RUN}"));
        commands.push(next);
        Ok(commands)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    #[test]
    fn the_map_after_the_run_is_read_and_leads_to_the_next_run() {
        let part = PartChoice {
            source: PartSource::File("m.datx".into()),
            reading: Reading::default(),
            aperture: None,
            target: None,
            level: "plane".into(),
            feature_mm: None,
        };
        let settings = [("pitch_mm", "2"), ("export", "galil")];
        let settings = settings.map(|(a, b)| (a.to_string(), b.to_string()));
        let plan = PlanChoice { pipeline: "raster".into(), settings: BTreeMap::from(settings) };
        let description = PipelineDescription {
            pipeline: "raster".into(),
            title: String::new(),
            folder: "/share/".into(),
            fixtures: vec![],
            machines: vec![],
            settings: vec![],
        };
        let run = MeasuredRun {
            part: &part,
            tif: "tool/tif",
            machine: &MachineChoice::Own,
            plan: &plan,
            trajectory: "runs/raster-own/methods/joint+galil/trajectory",
        };
        let choice =
            AfterChoice { source: PartSource::File("a.datx".into()), reading: Reading::default() };
        let [read, next] = choice.commands(&run, &description).unwrap().try_into().unwrap();
        assert_eq!(
            read.join(" "),
            "planish import surface files/after/a.datx --out after/surface --force"
        );
        assert_eq!(
            next.join(" "),
            "planish next-run before=part/surface after=after/surface \
             trajectory=runs/raster-own/methods/joint+galil/trajectory tif=tool/tif machine=machine.json \
             pipeline=raster prepare=--level plane pitch_mm=2 out=runs/next"
        );
        for source in [PartSource::File("../x".into()), PartSource::Fixture("coupon".into())] {
            let choice = AfterChoice { source, reading: Reading::default() };
            assert!(choice.commands(&run, &description).is_err());
        }
    }
}
