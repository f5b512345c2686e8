//! A program in several files: --parts and --max-lines.

use std::path::PathBuf;

use planish_export::{Program, ProgramSettings, cuts, in_parts, joins_without_stop};
use planish_handoff::{Failure, Inputs, OutputFile, Status, flags::OutputFileArgs, say, warn};
use planish_types::PathDistance;

use super::{AboutFile, Companion, Export, MotionInput, beside, refuse_foreign_about};

/// Largest number of parts of a program. Larger: more files than anybody loads. Smaller: long programs are refused.
const MOST_PARTS: usize = 9999;

impl Export {
    /// Makes the parts of the program: as many as --parts, or so many that none has more than --max-lines lines.
    pub(super) fn in_parts(
        &self,
        motion: &MotionInput,
        settings: &ProgramSettings,
        inputs: &Inputs,
    ) -> Result<Vec<Program>, Failure> {
        let whole = motion.program(self.controller, settings, &self.common.part.part(), inputs)?;
        let segments = whole.about.segments;
        let most = segments.min(MOST_PARTS);
        if let Some(parts) = self.common.parts {
            if !(1..=most).contains(&parts) {
                let problem = format!("--parts: is {parts}; give a number from 1 to {most}");
                return Err(Failure::new(problem));
            }
            return self.cut(motion, &whole, settings, parts, inputs);
        }
        let max_lines = self.common.max_lines.unwrap_or(usize::MAX);
        let mut parts = whole.text.lines().count().div_ceil(max_lines.max(1));
        while parts <= most {
            let made = self.cut(motion, &whole, settings, parts, inputs)?;
            let longest = made.iter().map(|part| part.text.lines().count()).max().unwrap_or(0);
            if longest <= max_lines {
                return Ok(made);
            }
            // At least one more; the heads of the parts are why it may not be enough.
            parts = (parts * longest / max_lines.max(1)).max(parts + 1);
        }
        Err(Failure::new(format!(
            "--max-lines: is {max_lines}, and the head of a part alone may have more; give a larger number"
        )))
    }

    /// Makes `parts` parts of the program.
    fn cut(
        &self,
        motion: &MotionInput,
        whole: &Program,
        settings: &ProgramSettings,
        parts: usize,
        inputs: &Inputs,
    ) -> Result<Vec<Program>, Failure> {
        let cuts = cuts(whole.about.segments, parts);
        if joins_without_stop(self.controller, settings) {
            return Ok(in_parts(whole, self.controller, settings, &cuts));
        }
        let parts = cuts.windows(2).enumerate().map(|(k, cut)| {
            let settings = ProgramSettings { marks: Some([cut[0], cut[1]]), ..settings.clone() };
            let mut part =
                motion.program(self.controller, &settings, &self.common.part.part(), inputs)?;
            part.about.part = Some(planish_export::ProgramPart {
                number: k + 1,
                parts: cuts.len() - 1,
                joins: false,
                first_mark: cut[0],
                after: None,
            });
            Ok(part)
        });
        parts.collect()
    }

    /// Writes the parts, and the JSON file beside each.
    pub(super) fn write_parts(
        &self,
        made: &[Program],
        distance: Option<PathDistance>,
        inputs: &Inputs,
    ) -> Result<Status, Failure> {
        let OutputFileArgs { out, force } = &self.common.output;
        let mut files = Vec::new();
        let mut texts = Vec::new();
        for (k, part) in made.iter().enumerate() {
            let path = self.path_of_part(k + 1, made.len());
            let about = beside(&path);
            refuse_foreign_about(&about)?;
            files.push(OutputFile::begin("--out", &about, *force, inputs)?);
            files.push(OutputFile::begin("--out", &path, *force, inputs)?);
            let about_file = AboutFile { about: &part.about, path_distance: distance };
            texts.push(format!("{}\n", serde_json::to_string_pretty(&about_file)?));
            texts.push(part.text.clone());
        }
        if let Some(companion) = &self.companion {
            let Companion::GalilHost(path) = companion else {
                let problem = "--parts: --commands and --scan-arrays are for a program in one file";
                return Err(Failure::new(problem));
            };
            files.push(OutputFile::begin("--host-script", path, *force, inputs)?);
            texts.push(self.companion_text(&made[0])?);
        }
        OutputFile::write_together(files.into_iter().zip(texts.iter().map(String::as_bytes)))?;
        for warning in &made[0].about.warnings {
            warn(warning);
        }
        let joins = made[0].about.part.as_ref().is_some_and(|part| part.joins);
        let lines = made.iter().map(|part| part.text.lines().count()).max().unwrap_or(0);
        say(format!(
            "planish export: {} parts of up to {lines} lines, {} -> {}",
            made.len(),
            if joins {
                "one motion without a stop between them"
            } else {
                "each from rest to rest, with the tool off in its run-up and run-down"
            },
            out.display()
        ));
        Ok(Status::Done)
    }

    /// Returns the path of part `number` of `count`: `run.part-2-of-3.dmc` for `run.dmc`, with as many digits for each
    /// number, so that names ascend.
    fn path_of_part(&self, number: usize, count: usize) -> PathBuf {
        let OutputFileArgs { out, .. } = &self.common.output;
        let stem = out.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let digits = count.to_string().len();
        let mut name = format!("{stem}.part-{number:0digits$}-of-{count}");
        if let Some(ending) = out.extension() {
            name += &format!(".{}", ending.to_string_lossy());
        }
        out.with_file_name(name)
    }
}
