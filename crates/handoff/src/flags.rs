//! Flags that several programs share. Each has one name, one unit and one description.
//!
//! A command includes a group by `#[command(flatten)]`, and the group reads the inputs of its
//! flags.

// The text of a field is the help of its flag, where [JSON] is a kind of file and not a link.
#![allow(rustdoc::broken_intra_doc_links)]

use std::path::{Path, PathBuf};

use clap::Args;
use planish_types::{
    DwellTime, Invalid, Limits, Machine, Part, PathDistance, Surface, Tif, ToolPath, Trajectory,
    Transform,
    outcome::{NoMore, plan::PlanOutcome, settings::PathSettings},
};
use serde::Deserialize;

use crate::{
    Artifact, HandoffError, Inputs, Manifest, OutputFile, kind::MACHINE_FRAME, shell::warn,
    with_flags,
};

/// Flags of the mirror: desired removal and tool.
#[derive(Clone, Debug, Args)]
pub struct MirrorArgs {
    /// Map of the desired removal [surface artifact]
    #[arg(long, value_name = "DIR")]
    pub surface: PathBuf,
    /// Tool influence function [tif artifact, or tool artifact if it varies over the part]
    #[arg(long, value_name = "DIR")]
    pub tif: PathBuf,
}

impl MirrorArgs {
    /// Reads the desired removal and the tool influence function.
    ///
    /// # Errors
    /// Fails if one of them cannot be read or is not valid.
    pub fn read(&self, inputs: &mut Inputs) -> Result<(Surface, Tif), HandoffError> {
        Ok((inputs.read("surface", &self.surface)?, inputs.read_tool_with_doubt("tif", &self.tif)?))
    }
}

/// Flag of the tool path.
#[derive(Clone, Debug, Args)]
pub struct PathArgs {
    /// Tool path [tool_path artifact]
    #[arg(long, value_name = "DIR")]
    pub tool_path: PathBuf,
}

impl PathArgs {
    /// Reads the tool path.
    ///
    /// # Errors
    /// Fails if it cannot be read or is not valid.
    pub fn read(&self, inputs: &mut Inputs) -> Result<ToolPath, HandoffError> {
        inputs.read("tool-path", &self.tool_path)
    }

    /// Reads the tool path, and its overscan (distance beyond the clear aperture), mm; `None` unless its manifest
    /// states one above 0.
    ///
    /// # Errors
    /// Fails if the path cannot be read or is not valid.
    pub fn read_with_overscan(
        &self,
        inputs: &mut Inputs,
    ) -> Result<(ToolPath, Option<f64>), HandoffError> {
        let (path, manifest): (_, Option<Manifest>) =
            inputs.read_with_manifest("tool-path", &self.tool_path)?;
        let settings: PathSettings = match manifest {
            Some(manifest) => manifest.read_settings(&self.tool_path)?,
            None => PathSettings::default(),
        };
        Ok((path, settings.overscan_mm.filter(|mm| *mm > 0.0)))
    }
}

/// Flags of the plan: a tool path and its dwell times.
#[derive(Clone, Debug, Args)]
pub struct PlanArgs {
    #[command(flatten)]
    path: PathArgs,
    /// Dwell times [dwell artifact]
    #[arg(long, value_name = "DIR")]
    dwell: PathBuf,
}

impl PlanArgs {
    /// Reads the tool path, its dwell times, and the overscan of the path (distance beyond the clear aperture), mm. The
    /// overscan is `None` unless the manifest of the path states one above 0. Refuses dwell times that were made for
    /// another path.
    pub fn read(
        &self,
        inputs: &mut Inputs,
    ) -> Result<(ToolPath, DwellTime, Option<f64>), HandoffError> {
        let (path, overscan_mm) = self.path.read_with_overscan(inputs)?;
        Ok((path, read_dwell(&self.dwell, inputs)?, overscan_mm))
    }
}

/// Reads the dwell times of the flag `--dwell`. The tool path must have been read before; dwell times that were made
/// for another path are refused. Fails if they cannot be read or are not valid.
pub fn read_dwell(dir: &Path, inputs: &mut Inputs) -> Result<DwellTime, HandoffError> {
    let (dwell, manifest) = inputs.read_with_manifest("dwell", dir)?;
    inputs.refuse_unrelated("dwell", manifest.as_ref(), "tool-path")?;
    Ok(dwell)
}

/// Flag of the motion.
#[derive(Clone, Debug, Args)]
pub struct TrajectoryArgs {
    /// Motion [trajectory artifact]
    #[arg(long, value_name = "DIR")]
    pub trajectory: PathBuf,
}

impl TrajectoryArgs {
    /// Reads the motion of the flag `--trajectory`.
    ///
    /// # Errors
    /// Fails if it cannot be read or is not valid.
    pub fn read(&self, inputs: &mut Inputs) -> Result<Trajectory, HandoffError> {
        inputs.read("trajectory", &self.trajectory)
    }

    /// Reads the motion, in the coordinates of the part, and the mirror (tool and desired removal). Warns if the
    /// motion was made from another mirror.
    ///
    /// # Errors
    /// Fails if one of them cannot be read or is not valid, or if the motion is not in the coordinates of the part.
    pub fn read_over(
        &self,
        mirror: &MirrorArgs,
        inputs: &mut Inputs,
    ) -> Result<(Trajectory, Tif, Surface), HandoffError> {
        let (trajectory, manifest) = self.read_on_part(inputs)?;
        Self::read_mirror(trajectory, manifest.as_ref(), mirror, inputs)
    }

    /// Reads the motion, in the coordinates of the part or of the machine, and the mirror (tool and desired removal).
    /// Warns if the motion was made from another mirror.
    ///
    /// # Errors
    /// Fails if one of them cannot be read or is not valid.
    pub fn read_on_machine(
        &self,
        mirror: &MirrorArgs,
        inputs: &mut Inputs,
    ) -> Result<(Trajectory, Tif, Surface), HandoffError> {
        let (trajectory, manifest) = inputs.read_with_manifest("trajectory", &self.trajectory)?;
        Self::read_mirror(trajectory, manifest.as_ref(), mirror, inputs)
    }

    /// Reads a motion in the coordinates of the part, with its manifest (`None` if it has none). Refuses a motion whose
    /// manifest states other coordinates, and one that cannot be read or is not valid.
    pub fn read_on_part(
        &self,
        inputs: &mut Inputs,
    ) -> Result<(Trajectory, Option<Manifest>), HandoffError> {
        let (trajectory, manifest): (Trajectory, _) =
            inputs.read_with_manifest("trajectory", &self.trajectory)?;
        if let Some(other) = manifest.as_ref().filter(|m| m.frame != Trajectory::KIND.frame) {
            let problem = format!(
                "is in other coordinates than the map ({}); take it back to those of the part by planish register \
                 apply --inverse",
                other.frame
            );
            return Err(HandoffError::new(&self.trajectory, problem));
        }
        Ok((trajectory, manifest))
    }

    /// Reads a motion and a machine, and transforms the motion to the coordinates of the axes. A motion that
    /// planish register has already transformed to a machine stays as it is.
    ///
    /// Refuses a motion that was made for another machine than that of `machine`, unless
    /// `--other-machine` accepts it.
    pub fn read_on_axes(
        &self,
        machine: &AxesArgs,
        inputs: &mut Inputs,
    ) -> Result<OnAxes, HandoffError> {
        let (motion, manifest): (Trajectory, _) =
            inputs.read_with_manifest("trajectory", &self.trajectory)?;
        let machine = machine.read(&self.trajectory, manifest.as_ref(), inputs)?;
        let was_there = manifest.as_ref().is_some_and(|m| m.frame == MACHINE_FRAME);
        let part_to_axes = machine.part_to_axes().filter(|_| !was_there).cloned();
        let motion = match &part_to_axes {
            Some(transform) => transform
                .trajectory(&motion)
                .map_err(|e| HandoffError::new(&self.trajectory, e.to_string()))?,
            None => motion,
        };
        Ok(OnAxes { motion, manifest, machine, was_there, part_to_axes })
    }

    fn read_mirror(
        trajectory: Trajectory,
        manifest: Option<&Manifest>,
        mirror: &MirrorArgs,
        inputs: &mut Inputs,
    ) -> Result<(Trajectory, Tif, Surface), HandoffError> {
        let tif = inputs.read_tool_with_doubt("tif", &mirror.tif)?;
        let surface = inputs.read("surface", &mirror.surface)?;
        for other in ["tif", "surface"] {
            inputs.warn_unrelated("trajectory", manifest, other);
        }
        Ok((trajectory, tif, surface))
    }
}

/// Motion in the coordinates of the axes of a machine, with the machine and the transform that took it there.
#[derive(Clone, Debug)]
pub struct OnAxes {
    /// Motion in the coordinates of the axes.
    pub motion: Trajectory,
    /// Manifest of the motion; `None` if it has none.
    pub manifest: Option<Manifest>,
    /// Machine whose axes run the motion.
    pub machine: Machine,
    /// True if the motion that was read was in machine coordinates already, so that nothing transformed it.
    pub was_there: bool,
    /// Transform that was applied to the motion; `None` if the coordinates of part and axes are
    /// equal, or if the motion was in machine coordinates already.
    pub part_to_axes: Option<Transform>,
}

/// Flag of the machine.
#[derive(Clone, Debug, Args)]
pub struct MachineArgs {
    /// Machine and its limits [JSON]
    #[arg(long, value_name = "FILE")]
    pub machine: PathBuf,
}

/// Flags of the machine whose axes run a motion.
#[derive(Clone, Debug, Args)]
pub struct AxesArgs {
    /// Flag of the machine file.
    #[command(flatten)]
    pub machine: MachineArgs,
    /// Accept a motion that was made for another machine file
    #[arg(long)]
    pub other_machine: bool,
}

impl AxesArgs {
    /// Reads the machine whose axes run the motion at `path`. `made` is the manifest of the motion; `None` if it has
    /// none.
    ///
    /// Refuses a motion that was made for another machine, unless `--other-machine` accepts it.
    pub fn read(
        &self,
        path: &Path,
        made: Option<&Manifest>,
        inputs: &mut Inputs,
    ) -> Result<Machine, HandoffError> {
        let machine = inputs.read_machine(&self.machine.machine)?;
        if let Some(problem) = inputs.made_for_another_machine(made) {
            if !self.other_machine {
                let problem = format!(
                    "{problem}; give the machine file that it was planned with, plan again, or give --other-machine if \
                     you mean another one"
                );
                return Err(HandoffError::new(path, problem));
            }
            warn(format!("{}: {problem}", path.display()));
        }
        Ok(machine)
    }
}

impl MachineArgs {
    /// Reads the limits of a motion along x and y of the part, which a plan has to keep. Fails if the machine file
    /// cannot be read or describes no machine.
    pub fn read(&self, inputs: &mut Inputs) -> Result<Limits, HandoffError> {
        Ok(inputs.read_machine(&self.machine)?.limits_on_part())
    }
}

/// Flag of the tolerance of a motion beside its path.
#[derive(Clone, Copy, Debug, Args)]
pub struct PathDistanceArgs {
    /// Largest distance of the motion from the tool path with the tool on, mm [default: half the distance of the lines
    /// of the path, but not more than its overscan]
    #[arg(long, value_name = "D", allow_negative_numbers = true)]
    pub max_path_distance_mm: Option<f64>,
}

impl PathDistanceArgs {
    /// Returns the largest allowed distance of a motion from `path`, mm: the value of the flag, otherwise half the
    /// distance of the lines of the path, but not more than `overscan_mm`, if that is known.
    ///
    /// # Errors
    /// Fails if the tolerance is negative or not finite.
    pub fn tolerance_mm(&self, path: &ToolPath, overscan_mm: Option<f64>) -> Result<f64, Invalid> {
        let tolerance_mm = path.tolerance_mm(self.max_path_distance_mm)?;
        Ok(match (self.max_path_distance_mm, overscan_mm) {
            (None, Some(overscan_mm)) => tolerance_mm.min(overscan_mm),
            _ => tolerance_mm,
        })
    }
}

/// Flags of the distance of a motion from its path, for a judge.
#[derive(Clone, Debug, Args)]
pub struct NearPathArgs {
    /// Tool path of the motion: its distance from there is judged [tool_path artifact]
    #[arg(long, value_name = "DIR")]
    pub tool_path: Option<PathBuf>,
    #[command(flatten)]
    distance: PathDistanceArgs,
}

impl NearPathArgs {
    /// Returns the distance of a motion, in the coordinates of the axes, from the tool path. Without a tool path it is
    /// the distance that the manifest of the motion states; `None` if it states none. The flag sets the tolerance by
    /// which it is judged, otherwise the manifest, otherwise the distance of the lines of the path.
    ///
    /// # Errors
    /// Fails if the path cannot be read, is in other coordinates than the motion or belongs to another motion, or if
    /// the tolerance is negative or not finite.
    pub fn measure(
        &self,
        motion: &OnAxes,
        inputs: &mut Inputs,
    ) -> Result<Option<PathDistance>, HandoffError> {
        let stated = self.stated(motion.manifest.as_ref())?;
        let Some(dir) = &self.tool_path else { return Ok(stated) };
        let (path, manifest): (ToolPath, _) = inputs.read_with_manifest("tool-path", dir)?;
        let refuse = |e: Invalid| HandoffError::new(dir, with_flags(&e.to_string()));
        let is_there = manifest.is_some_and(|m| m.frame == MACHINE_FRAME);
        if is_there != motion.was_there {
            let [with, without] = ["the machine", "the part"];
            let (own, other) = if is_there { (with, without) } else { (without, with) };
            let problem = format!(
                "is in the coordinates of {own}, and the motion in those of {other}; transform one of them by \
                 planish register apply"
            );
            return Err(HandoffError::new(dir, problem));
        }
        let path = match &motion.part_to_axes {
            Some(transform) => transform.tool_path(&path).map_err(refuse)?,
            None => path,
        };
        let tolerance_mm = self.distance.max_path_distance_mm.or(stated.map(|s| s.tolerance_mm));
        PathDistance::new(&motion.motion, &path, tolerance_mm).map(Some).map_err(refuse)
    }

    /// Returns the distance from the path that the manifest of a motion states, judged by the tolerance of the flag if
    /// that is given. `None` if the manifest states none. `made` is the manifest of the motion.
    ///
    /// # Errors
    /// Refuses a tolerance that is negative or not finite.
    pub fn stated(&self, made: Option<&Manifest>) -> Result<Option<PathDistance>, HandoffError> {
        let stated = made.and_then(path_distance_of);
        let tolerance_mm = self.distance.max_path_distance_mm;
        if let Some(mm) = tolerance_mm.filter(|mm| !(mm.is_finite() && *mm >= 0.0)) {
            return Err(HandoffError::new(
                Path::new("--max-path-distance-mm"),
                format!("is {mm}; give the largest distance of the motion from its path, mm"),
            ));
        }
        Ok(stated.map(|stated| stated.judged_by(tolerance_mm.unwrap_or(stated.tolerance_mm))))
    }
}

/// Returns the distance of a motion from its path that the manifest `made` states; `None` if it states none.
pub fn path_distance_of(made: &Manifest) -> Option<PathDistance> {
    PlanOutcome::<NoMore>::deserialize(&made.outcome).ok()?.path_distance
}

/// Flags of the smallest dwell time.
#[derive(Clone, Debug, Args)]
pub struct FloorArgs {
    /// Smallest dwell time of every dwell point, s [default: 0]
    #[arg(long, value_name = "T", conflicts_with = "min_dwell_s_per_mm")]
    min_dwell_s: Option<f64>,
    /// Smallest dwell time per length (1 / largest feedrate), s/mm
    #[arg(long, value_name = "T")]
    min_dwell_s_per_mm: Option<f64>,
    /// Smallest dwell time per length from a machine file, s/mm: 1 / largest velocity of its faster
    /// axis [JSON]
    #[arg(long, value_name = "FILE", conflicts_with_all = ["min_dwell_s", "min_dwell_s_per_mm"])]
    min_dwell_of_machine: Option<PathBuf>,
}

impl FloorArgs {
    /// Returns the smallest dwell time that the flags ask for; 0 s per dwell point without a flag. `seconds` makes the
    /// bound from a time per dwell point, s, `seconds_per_mm` from a time per length, s/mm. A machine file gives one
    /// over the largest velocity of its faster axis.
    ///
    /// # Errors
    /// Fails if the machine file cannot be read or is not valid.
    pub fn bound<B>(
        &self,
        seconds: fn(f64) -> B,
        seconds_per_mm: fn(f64) -> B,
    ) -> Result<B, HandoffError> {
        if let Some(file) = &self.min_dwell_of_machine {
            // The machine is not recorded as an input, because the bound itself is a setting.
            let limits = Inputs::new().read_machine(file)?.limits_on_part();
            let fastest = limits.max_velocity_mm_per_s().into_iter().fold(0.0, f64::max);
            return Ok(seconds_per_mm(fastest.recip()));
        }
        Ok(match (self.min_dwell_s, self.min_dwell_s_per_mm) {
            (_, Some(rate)) => seconds_per_mm(rate),
            (time, None) => seconds(time.unwrap_or(0.0)),
        })
    }
}

/// Flags of the directory for an artifact.
#[derive(Clone, Debug, Args)]
pub struct OutputArgs {
    /// Output directory
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Replace an existing output that was made from other inputs or settings
    #[arg(long)]
    pub force: bool,
    /// File for the wall time of the stage, s, and its peak memory, MiB, as JSON (not part of the
    /// artifact, which is the same for the same command)
    #[arg(long, value_name = "FILE")]
    pub wall_time: Option<PathBuf>,
}

/// Flags that state what part it is, for the head of a report or of a program.
#[derive(Clone, Debug, Args)]
pub struct PartArgs {
    /// Name of the part
    #[arg(long, value_name = "NAME")]
    pub part_name: Option<String>,
    /// Number of the part, or of its order
    #[arg(long, value_name = "NUMBER")]
    pub part_number: Option<String>,
    /// Date, in any form
    #[arg(long, value_name = "DATE")]
    pub date: Option<String>,
    /// Person who runs the machine
    #[arg(long, value_name = "NAME")]
    pub operator: Option<String>,
}

impl PartArgs {
    /// Returns the statements about the part.
    pub fn part(&self) -> Part {
        let Self { part_name, part_number, date, operator } = self.clone();
        Part { name: part_name, number: part_number, date, operator }
    }
}

/// Flags of a single output file.
#[derive(Clone, Debug, Args)]
pub struct OutputFileArgs {
    /// Output file
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Replace an existing output file
    #[arg(long)]
    pub force: bool,
}

impl OutputFileArgs {
    /// Refuses an output file that is an input or a directory, that cannot be made, or that exists without `--force`.
    /// Call it before the work of the program.
    pub fn begin(&self, inputs: &Inputs) -> Result<OutputFile, HandoffError> {
        OutputFile::begin("--out", &self.out, self.force, inputs)
    }
}
