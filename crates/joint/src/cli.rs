//! The command line.

use std::path::PathBuf;

use clap::Args;
use planish_dwell::residual::Free;
use planish_form::{Form, FormFile};
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status,
    flags::{MachineArgs, MirrorArgs, OutputArgs, PathArgs},
    say, task, warn, with_flags,
};
use planish_joint::{
    FurtherAxes, JointPlan, JointReport, JointSettings, MachineAxes, Price, plan,
    plan_with_further_axes,
};
use planish_types::{
    DwellTime, PathDistance, Trajectory,
    outcome::plan::PlanOutcome,
    plausible::{self, Rms},
};

#[derive(Args)]
pub struct Joint {
    #[command(flatten)]
    mirror: MirrorArgs,
    #[command(flatten)]
    path: PathArgs,
    #[command(flatten)]
    machine: MachineArgs,
    /// Form of the part: a form file [JSON], or its height along z [surface artifact]; a plane without it. It acts on
    /// the plan for a machine with more axes than x and y
    #[arg(long, value_name = "PATH")]
    form: Option<PathBuf>,
    /// Smallest dwell time per length (1 / largest feedrate), s/mm
    #[arg(long, value_name = "T", default_value_t = JointSettings::default().min_dwell_s_per_mm)]
    min_dwell_s_per_mm: f64,
    #[command(flatten)]
    price: PriceArgs,
    /// Low-order terms of the map that need not be removed
    #[arg(long, value_enum, default_value = "piston")]
    free: Free,
    /// Tikhonov weight of the squared distance to the least dwell density, relative to the strongest node. It is lowered
    /// where this pull would be more than 1 % of the objective [default: 1e-5]
    #[arg(long, value_name = "A")]
    tikhonov: Option<f64>,
    /// Weight of the squared differences of neighbouring densities, relative to the strongest node
    #[arg(long, value_name = "B", default_value_t = JointSettings::default().difference_weight)]
    difference_weight: f64,
    /// Largest distance of the motion from a corner of the path, mm [default: a fifth of the TIF's width]
    #[arg(long, value_name = "E")]
    corner_deviation_mm: Option<f64>,
    /// Radius of rounded corners, mm: an upper limit, because `--corner-deviation-mm` may ask for less [default: the
    /// TIF's width]
    #[arg(long, value_name = "R")]
    corner_radius_mm: Option<f64>,
    /// Largest distance of the nodes of the density, mm [default: 0.6 of the TIF's width, more where
    /// so many would take minutes, and less where there are few]
    #[arg(long, value_name = "L")]
    node_spacing_mm: Option<f64>,
    /// Number of refinements: each adds nodes in the middle of the spans where they lower the objective most. Fewer
    /// are made where the solver would take minutes
    #[arg(long, value_name = "K", default_value_t = JointSettings::default().refinements)]
    refinements: usize,
    /// Relative duality gap at which the solver ends. It bounds the objective under fixed tangents of the limits,
    /// because the exact limits are not convex. Rounds with new tangents follow until one gains less than a quarter
    /// of it
    #[arg(long, value_name = "G", default_value_t = JointSettings::default().relative_gap)]
    relative_gap: f64,
    /// Largest number of iterations of the solver
    #[arg(long, value_name = "N", default_value_t = JointSettings::default().max_iterations)]
    max_iterations: usize,
    #[command(flatten)]
    output: OutputArgs,
}

/// Price of time.
#[derive(Args)]
#[group(multiple = false)]
struct PriceArgs {
    /// Price of a second, relative to half the mean square of the residual, nm^2/s
    #[arg(long, visible_alias = "time-weight", value_name = "L")]
    time_weight_nm2_per_s: Option<f64>,
    /// Elasticity of the plan: percentage by which one percent more time would lower the mean square of the residual
    /// [default: 0.5]
    #[arg(long, value_name = "X")]
    time_elasticity: Option<f64>,
}

impl Joint {
    fn settings(&self) -> JointSettings {
        JointSettings {
            min_dwell_s_per_mm: self.min_dwell_s_per_mm,
            price: match (self.price.time_weight_nm2_per_s, self.price.time_elasticity) {
                (Some(price), _) => Price::Nm2PerS(price),
                (None, Some(x)) => Price::Elasticity(x),
                (None, None) => JointSettings::default().price,
            },
            tikhonov: self.tikhonov,
            difference_weight: self.difference_weight,
            free: self.free,
            corner_deviation_mm: self.corner_deviation_mm,
            corner_radius_mm: self.corner_radius_mm,
            node_spacing_mm: self.node_spacing_mm,
            refinements: self.refinements,
            relative_gap: self.relative_gap,
            max_iterations: self.max_iterations,
        }
    }

    /// Computes the plan, writes it and returns the verdict.
    ///
    /// # Errors
    ///
    /// Refuses inputs that cannot be read or do not fit each other. Fails where the plan fails or the output cannot be
    /// written.
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = self.settings();
        let mut inputs = Inputs::new();
        let (surface, tif) = self.mirror.read(&mut inputs)?;
        let path = self.path.read(&mut inputs)?;
        let machine = inputs.read_machine(&self.machine.machine)?;
        let form = match &self.form {
            Some(path) => inputs.read_form("form", path)?.form,
            None => Form::new(&FormFile::plane(), None)?,
        };
        let further = MachineAxes::new(&machine, &form)?;
        let task = task!("joint", settings);
        let parts = [("dwell", DwellTime::KIND), ("trajectory", Trajectory::KIND)];
        let mut output = match Output::directories(&self.output, parts).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };

        plausible::check_path(&surface, &tif, &path)?;
        let limits = machine.limits_on_part();
        let plan = match &further {
            None => plan(&surface, &tif, &path, &limits, &settings),
            Some(axes) => {
                let machine = (&limits, axes as &dyn FurtherAxes);
                plan_with_further_axes(&surface, &tif, &path, machine, &settings)
            }
        };
        let plan = plan.map_err(Failure::with_flags)?;

        let r = &plan.report;
        let rms = Rms::of_surface(plan.removal.residual());
        let total_time_s = plan.trajectory.total_time_s();
        // The corners are rounded as the settings allow, which the tolerance of the motion includes.
        let tolerance_mm = path.tolerance_mm(None)?.max(r.corner_deviation_mm);
        let distance = PathDistance::new(&plan.trajectory, &path, Some(tolerance_mm))?;
        let excess = distance.excess().map(|excess| {
            format!(
                "{excess}; a smaller `corner_deviation_mm` keeps the plan closer to its corners"
            )
        });
        let negative = plan.negative(&surface).or(excess);
        let status = negative.map_or(Status::Done, |text| Status::Negative(with_flags(&text)));
        let outcome = PlanOutcome {
            end: Some(r.end.into()),
            rms_nm: Some(rms.rms_nm),
            rms_detilted_nm: Some(rms.detilted_nm),
            total_time_s: Some(total_time_s),
            limits_respected: Some(plan.refused.is_none()),
            path_distance: Some(distance),
            report: Some(r),
            ..PlanOutcome::default()
        };
        output.write(&plan.dwell, &outcome, &status)?;
        output.write(&plan.trajectory, outcome, &status)?;
        self.say(&plan, rms.rms_nm);
        say(format!("joint: the motion is {distance}"));
        if let Some(warning) = r.tif_lattice.and_then(|lattice| lattice.warning()) {
            warn(warning);
        }
        if self.form.is_some() && further.is_none() {
            say(
                "joint: the machine has the axes x and y alone, so that the form does not act on the plan",
            );
        }
        Ok(status)
    }

    fn say(&self, plan: &JointPlan, rms_nm: f64) {
        let r = &plan.report;
        if let Some(widened) = r.widened {
            say(format!(
                "joint: nodes {:.3} mm apart in the place of {:.3}, because the solver would take minutes with as many; \
                 closer ones (--node-spacing-mm) leave less",
                widened.to_mm, widened.from_mm
            ));
        }
        say(format!(
            "joint: {} after {} steps, proven within {:.1e} of the least objective of {}; {:.4} nm in {:.2} s at \
             {:.3e} nm^2/s, the pull to the floor is {:.2} % of the objective; {} nodes, points moved by at most \
             {:.3} mm, {} corners rounded by at most {:.3} mm -> {}",
            r.end,
            r.iterations,
            r.relative_gap(),
            r.proven.gap_covers.as_deref().unwrap_or_default(),
            rms_nm,
            plan.trajectory.total_time_s(),
            r.price_nm2_per_s,
            100.0 * r.pull_part,
            r.nodes,
            r.points_moved_mm,
            r.corners,
            r.corner_deviation_mm,
            self.output.out.display()
        ));
        say_of_axes(r);
    }
}

fn say_of_axes(r: &JointReport) {
    if r.axes.is_empty() {
        return;
    }
    let names: Vec<&str> = r.axes.iter().map(|axis| axis.name.as_str()).collect();
    say(format!(
        "joint: planned with the axes {}; above nine tenths of what the plan may use of a limit: {}",
        names.join(", "),
        r.near_limits()
    ));
    if let Some(factor) = r.slowed_by {
        say(format!(
            "joint: after {} rounds an axis still exceeded a limit, so that all times are longer by a factor {factor:.6}",
            r.rounds
        ));
    }
}
