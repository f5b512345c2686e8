//! The motion along the curves: cubic pieces in time.
//!
//! Along the curve the motion of a span is one cubic s(u) ([`crate::mesh`]). On a line that is the motion itself.
//! On a clothoid each axis is the cubic with the positions and velocities of q(s(u)) at both ends of a piece; the
//! heading turns by at most 0.15 rad on it, which leaves a distance below `l^4 kappa^3 / 384` and an
//! acceleration off by a twelfth of the turn squared.

use planish_numerics::polynomial;
use planish_types::{Invalid, Limits, ToolPath, Trajectory, TrajectoryBuilder};

use crate::{
    curve::Curve,
    mesh::{Mesh, Span},
};

/// Turn of the heading on a cubic piece, rad: its acceleration is off by less than 2e-3 of itself.
const MAX_TURN_RAD: f64 = 0.15;

/// Breaks nearer to each other than this are one, mm: far above the rounding of arc lengths, far below anything
/// that a machine or a TIF notices.
const SAME_BREAK_MM: f64 = 1e-7;

/// The motion, and how closely it follows the curve.
pub struct Motion {
    /// Cubic pieces; each serves the segment of the path that it follows.
    pub trajectory: Trajectory,
    /// Span of every piece.
    pub span: Vec<usize>,
    /// Largest distance of a cubic piece from q(s(u)) at the middle of its time, mm.
    pub fit_error_mm: f64,
}

/// The motion for the densities of the nodes.
pub fn motion(
    curves: &[Curve],
    mesh: &Mesh,
    path: &ToolPath,
    density: &[f64],
) -> Result<Motion, Invalid> {
    let mut builder = TrajectoryBuilder::default();
    let mut fit_error_mm = 0.0f64;
    let mut span_of_piece = Vec::new();
    for (i, span) in mesh.spans.iter().enumerate() {
        let curve = &curves[span.curve];
        let (of, duration_s) = (span.densities(density), span.duration_s(density));
        let tau = |s: f64| span.tau_at(s - span.from_mm, of);
        let breaks = breaks(curve, span);
        let taus: Vec<f64> = breaks.iter().map(|s| tau(*s)).collect();
        let last = breaks.len() - 1;
        for k in 0..last {
            let (ta, tb) =
                (if k == 0 { 0.0 } else { taus[k] }, if k + 1 == last { 1.0 } else { taus[k + 1] });
            let piece = curve.piece_at(0.5 * (breaks[k] + breaks[k + 1]));
            let (from, to) = (span.at(ta, of), span.at(tb, of));
            let h = (tb - ta) * duration_s;
            let there = |s_mm: f64| piece.at(span.from_mm + s_mm - piece.from_mm);
            let start = there(from.s_mm);
            let coefficient_mm = if piece.is_straight() {
                let (v, a) = (from.feed_mm_per_s, from.acceleration_mm_per_s2);
                let jerk = (to.acceleration_mm_per_s2 - a) / h;
                [0, 1].map(|axis| {
                    let t = start.tangent[axis];
                    [start.point_mm[axis], t * v, 0.5 * t * a, t * jerk / 6.0]
                })
            } else {
                let end = there(to.s_mm);
                let cubic = [0, 1].map(|axis| {
                    let (p, q) = (start.point_mm[axis], end.point_mm[axis]);
                    let m = start.tangent[axis] * from.feed_mm_per_s;
                    let n = end.tangent[axis] * to.feed_mm_per_s;
                    // Hermite: p + m u + (3 (q - p) / h - 2 m - n) u^2 / h + (m + n - 2 (q - p) / h) u^3 / h^2
                    let mean = (q - p) / h;
                    [p, m, (3.0 * mean - 2.0 * m - n) / h, (m + n - 2.0 * mean) / (h * h)]
                });
                let middle = there(span.at(0.5 * (ta + tb), of).s_mm).point_mm;
                let [dx, dy] =
                    [0, 1].map(|axis| polynomial::evaluate(&cubic[axis], 0.5 * h) - middle[axis]);
                fit_error_mm = fit_error_mm.max(dx.hypot(dy));
                cubic
            };
            let on = path.tool_on()[piece.segment];
            span_of_piece.push(i);
            builder.push(h, coefficient_mm, on, Some(piece.segment));
        }
    }
    Ok(Motion { trajectory: builder.build()?, span: span_of_piece, fit_error_mm })
}

impl Motion {
    /// Largest use of a limit on acceleration on every span, 1 being all of it.
    pub fn use_of_acceleration(&self, spans: usize, limits: &Limits) -> Vec<f64> {
        let mut used = vec![0.0f64; spans];
        for (segment, span) in self.trajectory.segments().zip(&self.span) {
            for (c, axis) in segment.coefficient_mm.iter().zip(limits.axes()) {
                // Linear in time: largest at an end.
                let ends = [2.0 * c[2], 2.0 * c[2] + 6.0 * c[3] * segment.duration_s];
                let most = axis.max_acceleration_mm_per_s2();
                used[*span] = ends.iter().fold(used[*span], |m, a| m.max(a.abs() / most));
            }
        }
        used
    }
}

/// Arc lengths between which the motion on a span is one cubic piece.
fn breaks(curve: &Curve, span: &Span) -> Vec<f64> {
    let mut at = vec![span.from_mm];
    let first = curve.pieces().partition_point(|p| p.to_mm() <= span.from_mm);
    for piece in curve.pieces()[first..].iter().take_while(|p| p.from_mm < span.to_mm) {
        let (from, to) = (piece.from_mm.max(span.from_mm), piece.to_mm().min(span.to_mm));
        let parts = (piece.turn_rad() / MAX_TURN_RAD).ceil().max(1.0);
        // Equal lengths of a clothoid turn by at most twice the mean.
        let parts = if piece.is_straight() { 1 } else { 2 * parts as usize };
        at.extend((1..=parts).map(|k| from + (to - from) * k as f64 / parts as f64));
    }
    let end = span.to_mm;
    at.retain(|s| *s == span.from_mm || *s > span.from_mm + SAME_BREAK_MM);
    at.retain(|s| *s < end - SAME_BREAK_MM);
    at.push(end);
    at.dedup_by(|b, a| *b - *a < SAME_BREAK_MM && *b != end);
    at
}
