//! Dwell-time density as a trigonometric spline of arc length, raised until the machine can follow.
//!
//! The tool moves along the path at the feedrate `1/D`; the dwell-time density `D` (s/mm) joins the
//! densities `d` of the dwell points by half a period of a cosine. On a piece of length `L` from
//! density `d1` to `d2`, with `x = (s - s1)/L`, `M1 = d2 - d1`, `M2 = d1 + d2`, `e = M1/M2`:
//!
//! ```text
//! D(x) = M2/2 - M1/2 cos(pi x)                                                               (1)
//! t(x) = T (x - e/pi sin(pi x)),    T = L M2/2                      Kepler's equation        (2)
//! a    = -D'/D^3,  |a| <= 4 pi |M1| sqrt(1 - c^2) / (L M2^3 (1 + r c)^3)                     (3)
//!        r = |M1|/M2,  c = (1 - sqrt(1 + 24 r^2)) / (4 r)           exact peak
//! ```
//!
//! The acceleration is zero at every node, so it is continuous along the path.
//!
//! 1. *Densities.* Segment `k` of length `l_k` keeps its dwell time `t_k`: by (2) its time is linear
//!    in the densities of its own dwell point and its two neighbours, a tridiagonal system. (The
//!    source takes `d_k = t_k / l_k`, which smooths the dwell times.) Where the solution falls below
//!    half of that, half of it is held, and the others are solved again.
//! 2. *Repair.* Every density is raised by the smallest offset `delta >= 0` at which no feedrate exceeds
//!    its limit (`delta >= 1/v_max - min d`) and no piece its acceleration limit, by (3). The offset adds
//!    a constant to the density of the removal. That is a piston if the overscan is large enough.
//!    [`Repair::Local`] raises only the nodes that need it instead.
//! 3. *Corners.* Where the direction changes from `u1` to `u2`, the tool leaves the path at the distance
//!    `b` before the corner and joins it at the distance `b` after it. It moves on a parabola of constant
//!    acceleration, at a density that the axes can follow:
//!
//! ```text
//! a = v^2 (u2 - u1) / (2 b)     d >= sqrt(|u2 - u1| / (2 b a_max)) per axis     deviation b |u2 - u1| / 4
//! ```
//!
//!    The nodes before and after it are raised as far as the acceleration along the path needs it.
//! 4. *Links.* A pass starts and ends at its feedrate. With the tool off, the motion accelerates to
//!    it and brakes after it on the extended line, at constant acceleration. Lifts are links within
//!    all limits.
//! 5. *Fit.* (2) is inverted and fitted by cubic Hermite polynomials in time, with exact velocities
//!    at their ends, cut until they are within the tolerance of the position and within the limits.
//! 6. *Proof.* Every piece must keep the limits by (3), and every cubic of it by its own extrema. Else
//!    the smaller density of the piece is raised to the geometric mean of the two, and its neighbours
//!    as far as they need it. After a few rounds an offset is added to all densities. The report says
//!    so.
//!
//! Segments whose length is rounding have no density: their time goes to the neighbours in the pass.
//!
//! Source: the trigonometric-spline scheduler of Opt. Express 32 (2024) 9255, Eqs 3-17. Corrected:
//! its Eq. 5 has the factor 8 L for 4/L and the wrong sign, and Eqs 9-16 follow it; the peak (3)
//! replaces its bound `|M1| pi / (2 L min(d)^3)`. Corners, links and axis limits are ours.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | s | `arc_length_mm` | (m) | mm |
//! | d | `density` | (m) | s/mm |
//! | L | `length_mm` | - | mm |
//! | delta | `offset_s_per_mm` | - | s/mm |
//! | b | `half_length_mm` | - | mm |

mod motion;
mod passes;
mod repair;
mod report;
mod spline;

use planish_numerics::motion::timing_law;
use planish_types::{DwellDensity, DwellTime, Invalid, Limits, ToolPath, Trajectory};
use serde::Serialize;

pub use self::{repair::Repair, report::TrigSplineReport, spline::TrigPiece};

use self::{
    motion::Motion,
    passes::{Pass, density_of, runs_with_tool_on},
    repair::{PROOF_ROUNDS, ease, repair, slow_at_corners},
};
use crate::{ScheduleError, Scheduled, Scheduler, check_lengths};

/// Settings of the scheduler `trig-spline`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TrigSplineSettings {
    /// Repair of the dwell-time densities that the machine cannot follow: an offset, or local changes.
    pub repair: Repair,
    /// Largest distance of the motion from a corner, mm; >= 1e-9. Larger: corners are passed faster, and the tool is
    /// farther from the path. Default 0.02 mm: a hundredth of the smallest tools, and enough to turn by 90 degrees at
    /// 10 mm/s with 1000 mm/s^2. It is at most the usual tolerance of the path.
    pub corner_deviation_mm: f64,
    /// Largest error of the position in the fit by cubics, mm; >= 1e-9. Larger: a motion less like the spline. Smaller:
    /// more cubics. Default 1e-6 mm.
    pub fit_tolerance_mm: f64,
}

impl Default for TrigSplineSettings {
    fn default() -> Self {
        Self { repair: Repair::Offset, corner_deviation_mm: 0.02, fit_tolerance_mm: 1e-6 }
    }
}

impl TrigSplineSettings {
    fn check(&self) -> Result<(), Invalid> {
        for (name, value) in [
            ("corner_deviation_mm", self.corner_deviation_mm),
            ("fit_tolerance_mm", self.fit_tolerance_mm),
        ] {
            if !(value.is_finite() && value >= timing_law::LEAST_TOLERANCE_MM) {
                let problem = format!("is {value:?}");
                let least = timing_law::LEAST_TOLERANCE_MM;
                let remedy = format!("a tolerance is positive and finite, at least {least:e} mm");
                return Err(Invalid::whole(name, problem, remedy));
            }
        }
        Ok(())
    }
}

/// Motion, its dwell-time density, and the report of the changes.
#[derive(Clone, Debug)]
pub struct TrigSplineSchedule {
    /// Motion of the tool.
    pub trajectory: Trajectory,
    /// Nodes of the spline of the dwell-time density; `None` if no pass has a length.
    pub density: Option<DwellDensity>,
    /// Changes of the densities, and errors of the motion.
    pub report: TrigSplineReport,
}

impl TrigSplineSettings {
    /// Returns the settings with a corner deviation of at most the usual tolerance of the path; unchanged if that is 0.
    fn near(&self, path: &ToolPath) -> Result<Self, Invalid> {
        let tolerance_mm = path.tolerance_mm(None)?;
        let corner_deviation_mm = if tolerance_mm > 0.0 {
            self.corner_deviation_mm.min(tolerance_mm)
        } else {
            self.corner_deviation_mm
        };
        Ok(Self { corner_deviation_mm, ..*self })
    }
}

impl Scheduler for TrigSplineSettings {
    fn name(&self) -> &'static str {
        "trig-spline"
    }

    fn kind(&self) -> Option<&'static str> {
        Some(self.repair.name())
    }

    fn schedule(
        &self,
        path: &ToolPath,
        dwell: &DwellTime,
        limits: &Limits,
    ) -> Result<Scheduled, ScheduleError> {
        Ok(Scheduled::compared(schedule(path, dwell, limits, self)?.trajectory, dwell)?)
    }
}

/// Schedules `path` with the times `dwell` within `limits`; the report has the changes of the densities.
///
/// # Errors
///
/// Refuses dwell times of another path, a path without a length whose dwell times are all zero, and tolerances out of
/// range. Refuses dwell times whose motion rounding keeps from being proven within the limits, and those with a piece
/// that vanishes in the rounding of the total time.
pub fn schedule(
    path: &ToolPath,
    dwell: &DwellTime,
    limits: &Limits,
    settings: &TrigSplineSettings,
) -> Result<TrigSplineSchedule, ScheduleError> {
    check_lengths(path, dwell)?;
    settings.check()?;
    let settings = &settings.near(path)?;
    let mut report = TrigSplineReport::default();
    let mut passes: Vec<Pass> = runs_with_tool_on(path)
        .map(|run| Pass::new(path, dwell, limits, settings.corner_deviation_mm, run, &mut report))
        .collect();
    report.passes = passes.len();
    let moving = passes.iter().filter(|p| !p.straights.is_empty());
    report.held_added_s =
        moving.map(|p| p.duration_s() - dwell.dwell_s()[p.run.clone()].iter().sum::<f64>()).sum();
    repair(&mut passes, settings.repair, &mut report);
    slow_at_corners(&mut passes, &mut report);
    let mut round = 0;
    let mut motion = loop {
        let tolerance_mm = settings.fit_tolerance_mm;
        let motion = Motion::along(path, dwell, limits, tolerance_mm, &passes, report.clone());
        let Some(&(pass, node)) = motion.unproven.first() else { break motion };
        if round == PROOF_ROUNDS {
            let straight = &passes[pass].straights[passes[pass].straight_of[node]];
            let problem = "gives a motion that rounding keeps from being proven within the limits";
            let remedy = "raise the dwell times that are orders of magnitude below the others";
            return Err(Invalid::at_index("dwell_s", straight.index, problem, remedy).into());
        }
        ease(&mut passes, &motion.unproven, round, &mut report);
        round += 1;
    };
    for piece in passes.iter().flat_map(Pass::pieces) {
        let acceleration = piece.shape.peak_acceleration() / piece.max_acceleration;
        motion.report.acceleration_use = motion.report.acceleration_use.max(acceleration);
    }
    for node in passes.iter().flat_map(|p| &p.nodes) {
        motion.report.feed_use = motion.report.feed_use.max(node.fastest / node.density);
    }
    if motion.made.is_empty() {
        return Err(Invalid::whole("dwell_s", "is zero everywhere", "give a dwell time").into());
    }
    if let Some((short_s, time_s)) = motion.made.vanishing_duration_s() {
        let problem = format!(
            "gives a motion with a piece of {short_s:.6e} s, which vanishes in the rounding of its time \
             of {time_s:.6e} s"
        );
        let remedy = "raise the dwell times that are orders of magnitude below the others";
        return Err(Invalid::whole("dwell_s", problem, remedy).into());
    }
    let trajectory = motion.made.build()?;
    Ok(TrigSplineSchedule {
        trajectory,
        density: density_of(path, &passes)?,
        report: motion.report,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    use planish_testkit::{machine, numbers};

    fn straight(n: usize, step: f64) -> ToolPath {
        let points = (0..=n).map(|i| [step * i as f64, 3.0]).collect();
        ToolPath::through(points, vec![true; n], vec![0; n]).unwrap()
    }

    /// Returns the time of each of the `n` segments of the path in the motion, s.
    fn times(t: &Trajectory, n: usize) -> Vec<f64> {
        t.served_s(n, |_| true).unwrap()
    }

    #[test]
    fn every_segment_keeps_its_dwell_time_along_a_line_and_around_corners() {
        let free = machine([1e6; 2], [1e9; 2]);
        let t: Vec<f64> = (0..40).map(|i| 1.0 + 0.3 * (0.7 * f64::from(i)).sin()).collect();
        let corners: Vec<[f64; 2]> =
            (0..=40).map(|i| [f64::from(i / 2), f64::from((i + 1) / 2)]).collect();
        let stairs = ToolPath::through(corners, vec![true; 40], vec![0; 40]).unwrap();
        for path in [straight(40, 0.8), stairs] {
            let dwell = DwellTime::new(t.clone()).unwrap();
            let s = schedule(&path, &dwell, &free, &TrigSplineSettings::default()).unwrap();
            assert_eq!((s.report.held_densities, s.report.slowed_corners), (0, 0));
            for (i, (found, wanted)) in times(&s.trajectory, 40).iter().zip(&t).enumerate() {
                // Rounding of times of 40 s.
                assert!((found - wanted).abs() < 1e-12, "{i}: {found} {wanted}");
            }
        }
    }

    #[test]
    fn no_segment_has_less_than_its_dwell_time_where_densities_are_held() {
        // Lengths from 0.01 to 1.2 mm and times that have nothing to do with them: many densities would be negative.
        let free = machine([1e6; 2], [1e9; 2]);
        let mut random = numbers(5);
        let (mut points, mut t) = (vec![[0.0, 3.0]], Vec::new());
        for _ in 0..400 {
            points.push([points[points.len() - 1][0] + 0.01 * 120f64.powf(random()), 3.0]);
            t.push(0.01 + 0.2 * random());
        }
        let path = ToolPath::through(points, vec![true; 400], vec![0; 400]).unwrap();
        let dwell = DwellTime::new(t.clone()).unwrap();
        let s = schedule(&path, &dwell, &free, &TrigSplineSettings::default()).unwrap();
        assert!(s.report.held_densities > 20);
        for (i, (found, wanted)) in times(&s.trajectory, 400).iter().zip(&t).enumerate() {
            assert!(*found > wanted * (1.0 - 1e-6), "{i}: {found} {wanted}");
        }
    }

    #[test]
    fn equal_density_is_constant_feed() {
        let s = schedule(
            &straight(10, 0.5),
            &DwellTime::new(vec![0.25; 10]).unwrap(),
            &machine([10.0; 2], [10.0; 2]),
            &TrigSplineSettings::default(),
        )
        .unwrap();
        for k in 1..s.trajectory.len() - 1 {
            let c = s.trajectory.coefficient_mm()[k][0];
            assert!((c[1] - 2.0).abs() < 1e-12 && c[2].abs() + c[3].abs() < 1e-9, "{k}: {c:?}");
        }
        // Run-up and brake of v/a = 0.2 s each, and the dwell time.
        assert!((s.trajectory.total_time_s() - 2.9).abs() < 1e-4);
        assert_eq!(s.report.links, 2);
        assert!((s.report.feed_use - 0.2).abs() < 1e-12 && s.report.acceleration_use < 1e-9);
    }

    #[test]
    fn the_offset_is_what_the_feed_limit_asks_for() {
        // One dwell point of no time: delta = 1/v_max - 0.
        let mut t = vec![1.0; 21];
        t[10] = 0.0;
        let dwell = DwellTime::new(t).unwrap();
        let limits = machine([66.6667; 2], [1e9; 2]);
        let s =
            schedule(&straight(21, 1.0), &dwell, &limits, &TrigSplineSettings::default()).unwrap();
        assert!((s.report.feed_offset_s_per_mm - 0.015).abs() < 1e-5, "{:?}", s.report);
        assert!(s.report.feed_use <= 1.0 && s.report.feed_use > 0.999);
    }

    #[test]
    fn a_blend_is_tangent_to_both_segments_and_within_its_deviation() {
        for angle in [0.01_f64, 0.5, 1.57, 2.8, PI] {
            let end = [1.0 + angle.cos(), angle.sin()];
            let points = vec![[0.0, 0.0], [1.0, 0.0], end];
            let path = ToolPath::through(points, vec![true; 2], vec![0; 2]).unwrap();
            let dwell = DwellTime::new(vec![0.5, 0.5]).unwrap();
            let limits = machine([50.0; 2], [300.0, 200.0]);
            let s = schedule(&path, &dwell, &limits, &TrigSplineSettings::default()).unwrap();
            assert_eq!(s.report.corners, 1);
            let corner = [1.0, 0.0];
            let distance = |p: [f64; 2]| (p[0] - corner[0]).hypot(p[1] - corner[1]);
            let nearest = s
                .trajectory
                .segments()
                .flat_map(|s| [s.position_mm(0.0), s.position_mm(s.duration_s)])
                .map(distance)
                .fold(f64::INFINITY, f64::min);
            let deviation = s.report.largest_corner_deviation_mm;
            assert!(deviation <= 0.02 + 1e-15, "{deviation}");
            assert!((nearest - deviation).abs() < 1e-12, "{angle}: {nearest} {deviation}");
        }
    }
}
