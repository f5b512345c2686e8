//! The motion of the splines of all passes as one trajectory.
//!
//! Every pass is run along its line with `t(s) = integral D ds`, fitted by cubic pieces that begin
//! and end at its control points and knots ([`planish_numerics::motion::timing_law`]). From the end of a pass
//! to the start of the next, with their velocities, leads a link of constant accelerations
//! ([`planish_numerics::motion::state_to_state`]): it takes the place of the turn-around or lift of the path, and needs
//! the room that braking and running up take. The motion begins and ends at rest with the tool off
//! by links at the ends of the first and last pass.

use std::ops::Range;

use ndarray::Array2;
use planish_numerics::{
    bspline::Knots,
    motion::state_to_state::{AxisLink, link},
    motion::timing_law,
    quadrature::gauss_legendre,
};
use planish_types::{Invalid, Limits, Surface, Tif, Trajectory, TrajectoryBuilder};
use serde::Serialize;

use crate::{
    columns::{add_rate, window},
    passes::{Pass, is_inside},
};

/// Fraction of the machine's limits that a link (the motion from one pass to the next) leaves free. The passes leave
/// twice as much, so that the velocities at their ends are within those of a link. Larger: slower links. Smaller:
/// rounding exceeds the limits.
const MARGIN: f64 = 0.5e-6;

/// Shortest piece of a link, in units of the rounding of the total time of the passes. A shorter one is left out,
/// because it vanishes when times are added. Larger: a lower limit on the acceleration of links. Smaller: pieces
/// without a duration.
const LEAST_ROUNDINGS: f64 = 4.0;

/// Largest change of the velocity in the time of the shortest piece, mm/s. It is a tenth of the step that
/// `planish verify` takes for rounding. Links use no larger acceleration, whatever the machine allows. Larger: dropped
/// pieces cause velocity steps that `planish verify` reports. Smaller: slower links on machines with large
/// accelerations.
const LARGEST_STEP_MM_PER_S: f64 = 1e-7;

/// Numbers and times of the links, the motions from the end of a pass to the start of the next.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Links {
    /// Number of links with the tool on, which replace the turn-arounds of the path.
    pub turn_arounds: usize,
    /// Number of links with the tool off, which replace the lifts of the path.
    pub lifts: usize,
    /// Time of all links, with those at the start and the end of the motion, s.
    pub total_time_s: f64,
    /// Time of the links with the tool on, s.
    pub tool_on_s: f64,
    /// Number of links with the tool on that enter the clear aperture; their removal is taken into account.
    pub entering_aperture: usize,
}

/// Deviation of the cubic pieces from the motion t(s) of the splines.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct FitReport {
    /// Number of cubic pieces of all passes.
    pub pieces: usize,
    /// Largest distance between the pieces and the motion of the splines at equal times, mm.
    pub largest_error_mm: f64,
}

/// The motion of all passes, with its links and the error of its fit.
#[derive(Clone, Debug)]
pub struct Motion {
    /// Motion as cubic pieces.
    pub trajectory: Trajectory,
    /// Numbers and times of the links between the passes.
    pub links: Links,
    /// Deviation of the cubic pieces from the motion t(s) of the splines.
    pub fit: FitReport,
    /// Index ranges of the segments of the trajectory that are links with the tool on.
    links_on: Vec<Range<usize>>,
}

/// Makes one trajectory of all passes, whose dwell densities have the control values `d`, s/mm, on `knots`. Its cubic
/// pieces are within `tolerance_mm` of the motion of the splines; `surface` tells which links enter the aperture.
///
/// # Errors
/// Refuses limits with which a piece of the motion vanishes in the rounding of its time.
pub fn motion(
    passes: &[Pass],
    knots: &[Knots],
    d: &[Vec<f64>],
    surface: &Surface,
    limits: &Limits,
    tolerance_mm: f64,
) -> Result<Motion, Invalid> {
    let mut draft = TrajectoryBuilder::default();
    let mut links = Links::default();
    let mut links_on = Vec::new();
    let mut fit = FitReport { pieces: 0, largest_error_mm: 0.0 };
    let mut before: Option<[[f64; 2]; 2]> = None;
    let time_s: f64 = (passes.iter().zip(knots).zip(d))
        .map(|((pass, knots), d)| knots.integral(d).value(pass.length_mm()))
        .sum();
    let least_s = LEAST_ROUNDINGS * f64::EPSILON * time_s;
    let linked = LinkLimits {
        velocity: limits.max_velocity_mm_per_s().map(|v| (1.0 - MARGIN) * v),
        acceleration: limits
            .max_acceleration_mm_per_s2()
            .map(|a| ((1.0 - MARGIN) * a).min(LARGEST_STEP_MM_PER_S / least_s)),
        least_s,
    };
    for (m, pass) in passes.iter().enumerate() {
        let knots = &knots[m];
        let d = &d[m];
        let end_mm = pass.length_mm();
        let [velocity_in, velocity_out] =
            [0.0, end_mm].map(|s| pass.direction.map(|t| t / knots.value(d, s)));
        let start = [pass.start_mm, velocity_in];
        let tool_on = m > 0 && passes[m - 1].tool_on_after;
        let begin = draft.len();
        links.total_time_s += add_link(
            &mut draft,
            before.unwrap_or([pass.start_mm, [0.0; 2]]),
            start,
            tool_on,
            &linked,
        );
        if m > 0 && tool_on {
            links.turn_arounds += 1;
            links.tool_on_s += draft.duration_s()[begin..].iter().sum::<f64>();
            links.entering_aperture += usize::from(enters(&draft, begin, surface));
            links_on.push(begin..draft.len());
        } else if m > 0 {
            links.lifts += 1;
        }
        let fitted = add_pass(&mut draft, pass, knots, d, tolerance_mm);
        fit.pieces += fitted.pieces;
        fit.largest_error_mm = fit.largest_error_mm.max(fitted.largest_error_mm);
        before = Some([pass.position(end_mm), velocity_out]);
    }
    if let Some(end) = before {
        links.total_time_s += add_link(&mut draft, end, [end[0], [0.0; 2]], false, &linked);
    }
    if let Some((short_s, time_s)) = draft.vanishing_duration_s() {
        let problem = format!(
            "allow a motion with a piece of {short_s:.6e} s, which vanishes in the rounding of its time of \
             {time_s:.6e} s"
        );
        let remedy = "give the velocity and the acceleration that the machine has, in mm and s";
        return Err(Invalid::whole("axes", problem, remedy));
    }
    Ok(Motion { trajectory: draft.build()?, links, fit, links_on })
}

impl Motion {
    /// Returns the removal by the links with the tool on, shape (ny, nx), nm. It uses a 3-point Gauss rule in time, on
    /// parts in which the tool moves at most one sample step of the TIF.
    pub fn link_removal_nm(&self, tif: &Tif, surface: &Surface) -> Array2<f64> {
        let mut map = Array2::zeros(surface.grid().shape());
        let pixel = tif.grid().x.step_mm().min(tif.grid().y.step_mm());
        for i in self.links_on.iter().cloned().flatten() {
            let segment = self.trajectory.segment(i);
            let h = segment.duration_s;
            // Of constant acceleration: no faster than at its faster end, and that over its duration.
            let [first, last] = [0.0, h].map(|u| {
                let v = segment.coefficient_mm.map(|c| c[1] + 2.0 * c[2] * u);
                v[0].hypot(v[1])
            });
            let parts = (first.max(last) * h / pixel).ceil().max(1.0) as usize;
            let step = h / parts as f64;
            for part in 0..parts {
                for (u, w) in gauss_legendre::<3>() {
                    let p = segment.position_mm((part as f64 + u) * step);
                    let mut here = window(p.map(|v| (v, v)), tif, surface);
                    add_rate(&mut here, p, w * step, tif, surface);
                    here.add_to(&mut map, 1.0);
                }
            }
        }
        map
    }
}

/// Limits of the motion of a link, for the axes x and y, and its shortest piece, s.
struct LinkLimits {
    velocity: [f64; 2],
    acceleration: [f64; 2],
    least_s: f64,
}

/// Adds a link from one state [position, velocity] to another, mm and mm/s, without its pieces that are too short.
/// Returns its duration, s.
fn add_link(
    draft: &mut TrajectoryBuilder,
    from: [[f64; 2]; 2],
    to: [[f64; 2]; 2],
    tool_on: bool,
    limits: &LinkLimits,
) -> f64 {
    let axes = [0, 1].map(|k| AxisLink {
        from: [from[0][k], from[1][k]],
        to: [to[0][k], to[1][k]],
        max_velocity: limits.velocity[k],
        max_acceleration: limits.acceleration[k],
    });
    let mut pieces = link(&axes);
    pieces.retain(|piece| piece.duration > limits.least_s);
    for piece in &pieces {
        draft.push(piece.duration, piece.coefficient, tool_on, None);
    }
    pieces.iter().map(|p| p.duration).sum()
}

/// Adds the cubic pieces of a pass with the control values `d`; returns the error of their fit.
fn add_pass(
    draft: &mut TrajectoryBuilder,
    pass: &Pass,
    knots: &Knots,
    d: &[f64],
    tolerance_mm: f64,
) -> FitReport {
    let integral = knots.integral(d);
    let fit = timing_law::fit(
        |s| integral.value(s),
        |s| knots.value(d, s),
        &breaks(pass, knots),
        tolerance_mm,
        // D >= 1/F holds exactly; the margin of the pass is for the pieces.
        pass.max_feed_mm_per_s * (1.0 + MARGIN),
        pass.max_acceleration_mm_per_s2,
    );
    for piece in &fit.pieces {
        // x = x0 + t_x s(u), y likewise
        let [s0, s1, s2, s3] = piece.coefficient;
        let coefficient = [0, 1].map(|k| {
            let t = pass.direction[k];
            [pass.start_mm[k] + t * s0, t * s1, t * s2, t * s3]
        });
        let middle = 0.5 * (piece.start + piece.end);
        let inner = &pass.node_mm[1..pass.node_mm.len() - 1];
        let segment = pass.first_segment + inner.partition_point(|s| *s <= middle);
        draft.push(piece.duration, coefficient, true, Some(segment));
    }
    FitReport { pieces: fit.pieces.len(), largest_error_mm: fit.largest_error }
}

/// Returns true if the motion from the segment `begin` on enters the clear aperture, tested at 9 points of each
/// segment.
fn enters(draft: &TrajectoryBuilder, begin: usize, surface: &Surface) -> bool {
    (begin..draft.len()).any(|i| {
        (0..=8).any(|k| {
            let u = draft.duration_s()[i] * f64::from(k) / 8.0;
            let p =
                draft.coefficient_mm()[i].map(|c| planish_numerics::polynomial::evaluate(&c, u));
            is_inside(surface, p)
        })
    })
}

/// Returns the arc lengths of the points of the path and of the knots of a pass, mm, ascending; the cubic pieces end
/// there.
fn breaks(pass: &Pass, knots: &Knots) -> Vec<f64> {
    let mut breaks: Vec<f64> = pass.node_mm.iter().chain(knots.breaks()).copied().collect();
    breaks.sort_by(f64::total_cmp);
    // Nearer than 0.1 nm they are the same place, or a piece might vanish in the rounding of times; the ends stay.
    breaks.dedup_by(|b, a| *b - *a < 1e-7);
    *breaks.last_mut().expect("a pass has two ends") = pass.length_mm();
    breaks
}
