//! Motion of all axes from a motion of the contact point.

use planish_form::Form;
use planish_kinematics::AxisMap;
use planish_numerics::polynomial::evaluate;
use planish_types::{
    AxesMotion, Invalid, Kinematics, Machine, Trajectory,
    outcome::axes::{MotionReport, SlowedReport, SpindleReport},
};

use crate::{
    MotionSettings,
    piece::{AxesPiece, AxesPieces, INNER_POINTS, distance_mm, planned_part, stretched_s},
    slow::{Excess, slow},
};

/// Largest number of rounds in which pieces are halved because the stretch of time bends their cubics. Larger: memory
/// for 2^n pieces. Smaller: long segments that are slowed down strongly are refused. Chosen: the distance from the path
/// falls by about 16 with each.
const MOST_ROUNDS: usize = 10;

/// Computes the motion of the axes of `machine` while the contact point follows `trajectory` over the part `form`, and
/// its report.
///
/// Slows the motion down where an axis would exceed a limit. A step of the velocity in `trajectory` itself stays.
///
/// # Errors
///
/// Refuses a tolerance that is not plausible, and a trajectory whose removal rate differs from that of the TIF. Refuses
/// a placement of the part without an inverse, and a trajectory that leaves the form. Refuses a motion that the axes
/// cannot follow within the tolerance, and one in which the axis c of a spindle jumps.
pub fn motion(
    trajectory: &Trajectory,
    machine: &Machine,
    form: &Form,
    settings: &MotionSettings,
) -> Result<(AxesMotion, MotionReport), Invalid> {
    settings.check()?;
    trajectory.check_rate_is_constant()?;
    let map = AxisMap::new(machine, form)?;
    let axes = machine.axes();
    let planned = AxesPieces {
        map: &map,
        trajectory,
        turning: axes.iter().position(|a| a.name == "c"),
        tolerance_mm: 1e-3 * settings.contact_tolerance_um,
        min_segment_s: machine.limits().min_segment_s(),
    };
    let (pieces, stretch, worst) = slowed(&planned, machine)?;
    let executed = executed(&pieces, &stretch, machine, trajectory)?;

    let largest_stretch = stretch.iter().fold(1.0, |a: f64, b| a.max(*b));
    let slowest = worst.map(|(worst, time_s)| SlowedReport {
        axis: axes[worst.axis].name.into(),
        quantity: worst.quantity.into(),
        ratio: worst.ratio,
        time_s,
        largest_stretch,
    });
    let away = farthest(&map, &pieces, &stretch, &executed, trajectory);
    let report = MotionReport {
        axes: axes.iter().map(|a| a.name.into()).collect(),
        units: axes.iter().map(|a| a.unit().into()).collect(),
        segment_count: executed.len(),
        contact_deviation_um: 1e3 * away.distance_mm,
        contact_deviation_time_s: away.time_s,
        gap_um: 1e3 * away.gap_mm,
        off_normal_deg: largest_off_normal_deg(&map, &executed),
        planned_time_s: trajectory.total_time_s(),
        total_time_s: executed.total_time_s(),
        added_tool_on_time_s: match slowest {
            Some(_) => added_s(&executed, &pieces, |k| executed.tool_on()[k]),
            None => 0.0,
        },
        slowed: slowest,
        spindle: planned.turning.map(|c| {
            let radii_mm = pieces.iter().map(|piece| {
                map.radius_mm(trajectory.segment(piece.segment).position_mm(piece.from_s))
            });
            let radii_mm: Vec<f64> = radii_mm.collect();
            let limit = axes[c].max_velocity;
            let too_fast =
                pieces.iter().zip(&radii_mm).filter(|(p, _)| p.start[c][1].abs() > limit);
            let c_limit_radius_mm = too_fast.map(|(_, radius)| *radius).fold(0.0, f64::max);
            SpindleReport {
                least_radius_mm: radii_mm.iter().copied().fold(f64::INFINITY, f64::min),
                c_limit_radius_mm,
                added_time_within_s: if c_limit_radius_mm > 0.0 {
                    added_s(&executed, &pieces, |k| radii_mm[k] <= c_limit_radius_mm)
                } else {
                    0.0
                },
            }
        }),
        path_distance: None,
    };
    Ok((executed, report))
}

/// Returns the sum of the times by which the executed pieces are longer than planned, s, over the pieces for whose
/// index `chosen` returns true.
fn added_s(executed: &AxesMotion, pieces: &[AxesPiece], chosen: impl Fn(usize) -> bool) -> f64 {
    let chosen = (0..pieces.len()).filter(|k| chosen(*k));
    chosen.map(|k| executed.duration_s(k) - pieces[k].duration_s()).sum()
}

/// Pieces, factors of the stretch of time at their ends, and the worst excess of the unslowed motion. With it comes the
/// time at which its piece starts in the unslowed motion, s. `None` if nothing exceeds a limit.
type SlowedPieces = (Vec<AxesPiece>, Vec<f64>, Option<(Excess, f64)>);

/// Slows the pieces down to the limits of the axes, and halves those that leave the path because of it, until none
/// does. Refuses a motion that still needs it after [`MOST_ROUNDS`] rounds.
fn slowed(planned: &AxesPieces<'_>, machine: &Machine) -> Result<SlowedPieces, Invalid> {
    let mut pieces = planned.all()?;
    let mut first = None;
    for round in 0..=MOST_ROUNDS {
        let slowed = slow(&pieces, machine.axes());
        if round == 0 {
            first = slowed.worst.map(|worst| {
                let piece: &AxesPiece = &pieces[worst.piece];
                (worst, planned.trajectory.break_time_s()[piece.segment] + piece.from_s)
            });
        }
        let stretch: Vec<f64> = slowed.stretch.iter().map(|w| w * slowed.whole).collect();
        match planned.finer(&pieces, &stretch)? {
            Some(finer) if round < MOST_ROUNDS => pieces = finer,
            Some(_) => break,
            None => return Ok((pieces, stretch, first)),
        }
    }
    let problem =
        "needs time that is stretched too unevenly for the tolerance of the contact point";
    let remedy = "give a larger `contact_tolerance_um`, or a motion that keeps more distance from the limits";
    Err(Invalid::whole("trajectory", problem, remedy))
}

/// Returns the motion of the axes: the cubics of the pieces, with the stretch of time at their ends.
fn executed(
    pieces: &[AxesPiece],
    stretch: &[f64],
    machine: &Machine,
    trajectory: &Trajectory,
) -> Result<AxesMotion, Invalid> {
    let is_stretched = stretch.iter().any(|w| *w != 1.0);
    let mut break_time_s = vec![trajectory.break_time_s()[0]];
    let mut coefficient = Vec::new();
    // Two axes that read an affine map of the part run the cubics of the motion itself.
    let is_same = !is_stretched && *machine.kinematics() == Kinematics::Xy;
    let same = match machine.part_to_axes() {
        _ if !is_same => None,
        Some(there) => Some(there.trajectory(trajectory)?),
        None => Some(trajectory.clone()),
    };
    for (k, piece) in pieces.iter().enumerate() {
        let ends = [stretch[k], stretch[k + 1]];
        let h = stretched_s(piece, ends);
        match &same {
            Some(motion) => coefficient.extend(motion.coefficient_mm()[piece.segment]),
            None => coefficient.extend(piece.cubics(h, ends)),
        }
        let ends_segment = pieces.get(k + 1).is_none_or(|next| next.segment > piece.segment);
        break_time_s.push(if is_stretched {
            break_time_s[k] + h
        } else if ends_segment {
            trajectory.break_time_s()[piece.segment + 1]
        } else {
            trajectory.break_time_s()[piece.segment] + piece.to_s
        });
    }
    AxesMotion::new(
        break_time_s,
        coefficient,
        pieces.iter().map(|p| trajectory.tool_on()[p.segment]).collect(),
        pieces.iter().map(|p| trajectory.dwell_index()[p.segment]).collect(),
    )
}

/// Number of golden sections that narrow the time interval around the largest of the angles at equally spaced times.
/// Larger: more time, no effect. Smaller: a less exact angle. Derived: they shrink the interval by 0.618^30 = 5e-7.
const GOLDEN_SECTIONS: usize = 30;

/// Returns the largest angle between tool and normal on an executed motion, degrees. It compares equally spaced points
/// of every segment, and refines the largest one by golden sections.
fn largest_off_normal_deg(map: &AxisMap, executed: &AxesMotion) -> f64 {
    let parts = INNER_POINTS + 1;
    let mut largest = 0.0;
    let mut place = (0, 0);
    for k in 0..executed.len() {
        for j in 0..=parts {
            let angle = off_normal_deg(map, executed, k, j as f64 / parts as f64);
            if angle > largest {
                largest = angle;
                place = (k, j);
            }
        }
    }
    let (k, j) = place;
    let [mut low, mut high] =
        [j.saturating_sub(1), (j + 1).min(parts)].map(|j| j as f64 / parts as f64);
    let golden = 0.5 * (5.0_f64.sqrt() - 1.0);
    for _ in 0..GOLDEN_SECTIONS {
        let [left, right] = [high - golden * (high - low), low + golden * (high - low)];
        let [of_left, of_right] = [left, right].map(|part| off_normal_deg(map, executed, k, part));
        largest = largest.max(of_left).max(of_right);
        if of_left > of_right { high = right } else { low = left }
    }
    largest
}

/// Returns the angle between tool and normal after the fraction `part` (0 to 1) of the duration of segment `k`,
/// degrees. It is 0 if the tool meets no surface.
fn off_normal_deg(map: &AxisMap, executed: &AxesMotion, k: usize, part: f64) -> f64 {
    let u = part * executed.duration_s(k);
    let q: Vec<f64> = executed.segment(k).iter().map(|c| evaluate(c, u)).collect();
    map.contact(&q).map_or(0.0, |contact| contact.off_normal_deg)
}

/// Largest distance of an executed motion from the path, with its time. Largest magnitude of the gap between the tip of
/// the tool and the surface.
struct Farthest {
    distance_mm: f64,
    time_s: f64,
    gap_mm: f64,
}

/// Returns the largest distances of the executed motion, measured at points inside every segment. The distance is
/// infinite if the tool meets no surface.
fn farthest(
    map: &AxisMap,
    pieces: &[AxesPiece],
    stretch: &[f64],
    executed: &AxesMotion,
    trajectory: &Trajectory,
) -> Farthest {
    let mut farthest =
        Farthest { distance_mm: 0.0, time_s: executed.break_time_s()[0], gap_mm: 0.0 };
    for (k, piece) in pieces.iter().enumerate() {
        let c = &trajectory.coefficient_mm()[piece.segment];
        let h = executed.duration_s(k);
        for j in 1..=INNER_POINTS {
            let part = j as f64 / (INNER_POINTS + 1) as f64;
            let q: Vec<f64> = executed.segment(k).iter().map(|c| evaluate(c, part * h)).collect();
            let Some(contact) = map.contact(&q) else {
                farthest = Farthest { distance_mm: f64::INFINITY, ..farthest };
                continue;
            };
            let f = planned_part(part, [stretch[k], stretch[k + 1]]);
            let distance = distance_mm(c, piece, f, contact.point_mm);
            if distance > farthest.distance_mm {
                farthest.distance_mm = distance;
                farthest.time_s = executed.break_time_s()[k] + part * h;
            }
            farthest.gap_mm = farthest.gap_mm.max(contact.gap_mm.abs());
        }
    }
    farthest
}
