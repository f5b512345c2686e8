//! Motion along the curves: cubic pieces in time.
//!
//! Along the curve the motion of a span is one cubic s(u) ([`crate::mesh`]). On a line that is the motion itself.
//! On a clothoid each axis is the cubic with the positions and velocities of q(s(u)) at both ends of a piece. Pieces
//! are halved until the acceleration at their ends is that of q(s(u)) within 2e-3 of the limit. So the cubic keeps
//! every limit that q(s(u)) keeps with a margin. The same holds for the accelerations of further axes.

use planish_numerics::{parallel, polynomial};
use planish_types::{Invalid, Limits, ToolPath, Trajectory, TrajectoryBuilder};

use crate::{
    axes::Further,
    curve::Curve,
    mesh::{Kinematics, Mesh, Span},
    piece::{CurvePiece, Station},
};

/// Largest difference of the acceleration at the ends of a cubic piece from that of the exact motion q(s(u)), as a
/// fraction of the limit. Larger: fewer pieces, and accelerations beyond the margins of [`crate::limits`]. Smaller:
/// more pieces. Chosen below these margins.
const MAX_ACCELERATION_ERROR: f64 = 2e-3;

/// Largest distance of a cubic piece from the exact motion q(s(u)) at the middle of its time, mm. Larger: fewer pieces,
/// further from the curve. Smaller: more pieces. Chosen: a machine follows no closer.
const MAX_FIT_ERROR_MM: f64 = 1e-4;

/// Largest distance between two ends of pieces that count as one, mm. Larger: pieces of the curve are left out.
/// Smaller: pieces that are rounding of arc lengths. Chosen far above that rounding, and far below anything that a
/// machine or a TIF notices. The curvature is continuous, so there is no step at an end that is left out.
const SAME_BREAK_MM: f64 = 1e-5;

/// Least length of a piece that may be halved, mm. Larger: pieces that do not follow the curve. Smaller: halves whose
/// acceleration is rounding of their positions. Chosen.
const SHORTEST_PARTED_MM: f64 = 1e-3;

/// Motion along the curves, and its largest distance from the exact motion.
pub struct Motion {
    /// Cubic pieces; each belongs to the segment of the path that it follows.
    pub trajectory: Trajectory,
    /// Index of the span of the mesh for every piece.
    pub span: Vec<usize>,
    /// Largest distance of a cubic piece from the exact motion q(s(u)) at the middle of its time, mm.
    pub fit_error_mm: f64,
}

/// Returns the cubic pieces of the motion along the curves for the densities of the nodes (nodes), s/mm.
///
/// # Errors
///
/// Fails where a density is so large that a time is not finite.
pub fn motion(
    curves: &[Curve],
    mesh: &Mesh,
    path: &ToolPath,
    limits: &Limits,
    further: Option<&Further<'_>>,
    density: &[f64],
) -> Result<Motion, Invalid> {
    let most = limits.axes().each_ref().map(|a| a.max_acceleration_mm_per_s2());
    let pieces = parallel::map(mesh.spans.len(), &|i| {
        let span = &mesh.spans[i];
        let on_span = OnSpan { span, densities: span.densities(density), further };
        on_span.cubics(&curves[span.curve], span.duration_s(density), most)
    });
    let mut builder = TrajectoryBuilder::default();
    let mut fit_error_mm = 0.0f64;
    let mut span_of_piece = Vec::new();
    for (i, pieces) in pieces.into_iter().enumerate() {
        for Timed { duration_s, cubic, segment } in pieces {
            fit_error_mm = fit_error_mm.max(cubic.fit_error_mm);
            span_of_piece.push(i);
            let on = path.tool_on()[segment];
            builder.push(duration_s, cubic.coefficient_mm, on, Some(segment));
        }
    }
    Ok(Motion { trajectory: builder.build()?, span: span_of_piece, fit_error_mm })
}

impl Motion {
    /// Returns the largest ratio of an acceleration of x or y to its limit on every span of the mesh (`spans` in all).
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

/// Span of the mesh with the densities of its nodes, s/mm.
struct OnSpan<'a> {
    span: &'a Span,
    densities: [Option<f64>; 2],
    further: Option<&'a Further<'a>>,
}

/// Cubic piece of the motion.
struct Cubic {
    coefficient_mm: [[f64; 4]; 2],
    /// Length of the curve along the piece, mm.
    length_mm: f64,
    /// Distance from the exact motion q(s(u)) at the middle of its time, mm.
    fit_error_mm: f64,
    /// Largest difference of an acceleration of x, y or a further axis at its ends from that of the exact motion
    /// q(s(u)), as a fraction of the limit.
    acceleration_error: f64,
}

/// Cubic piece of the motion with its duration, s, and the segment of the path that it follows.
struct Timed {
    duration_s: f64,
    cubic: Cubic,
    segment: usize,
}

impl OnSpan<'_> {
    /// Returns the cubic pieces of the motion on the span, which takes `duration_s`; `most` are the acceleration limits
    /// of x and y, mm/s^2.
    fn cubics(&self, curve: &Curve, duration_s: f64, most: [f64; 2]) -> Vec<Timed> {
        let mut cubics = Vec::new();
        for (piece, from, to) in self.parts(curve) {
            // From the last time on: those of the pieces that are still to be made.
            let mut ends = vec![to];
            let mut start = from;
            while let Some(end) = ends.pop() {
                let h = (end - start) * duration_s;
                let cubic = self.cubic(piece, [start, end], h, most);
                let follows = cubic.acceleration_error <= MAX_ACCELERATION_ERROR
                    && cubic.fit_error_mm <= MAX_FIT_ERROR_MM;
                if !follows && cubic.length_mm > SHORTEST_PARTED_MM {
                    ends.extend([end, 0.5 * (start + end)]);
                    continue;
                }
                cubics.push(Timed { duration_s: h, cubic, segment: piece.segment });
                start = end;
            }
        }
        cubics
    }

    /// Returns the pieces of the curve on the span, each with the fractions of the time of the span at which it begins
    /// and ends.
    fn parts<'c>(&self, curve: &'c Curve) -> Vec<(&'c CurvePiece, f64, f64)> {
        let span = self.span;
        let first = curve.pieces().partition_point(|p| p.to_mm() <= span.from_mm + SAME_BREAK_MM);
        let here =
            curve.pieces()[first..].iter().take_while(|p| p.from_mm < span.to_mm - SAME_BREAK_MM);
        let mut parts: Vec<(&CurvePiece, f64, f64)> = Vec::new();
        for piece in here {
            let from = parts.last().map_or(0.0, |(_, _, to)| *to);
            let to_mm = piece.to_mm();
            let ends_span = to_mm >= span.to_mm - SAME_BREAK_MM;
            let to =
                if ends_span { 1.0 } else { span.tau_at(to_mm - span.from_mm, self.densities) };
            parts.push((piece, from, to));
        }
        parts
    }

    /// Returns the motion along the curve at the fraction `tau` of the time of the span, with position, direction and
    /// curvature there.
    fn state(&self, piece: &CurvePiece, tau: f64) -> (Kinematics, Station) {
        let along = self.span.kinematics(tau, self.densities);
        (along, piece.station(self.span.from_mm + along.s_mm - piece.from_mm))
    }

    /// Fits a cubic to the motion on a piece of the curve between two fractions of the time of the span, `h` seconds
    /// apart. `most` are the acceleration limits of x and y, mm/s^2.
    fn cubic(&self, piece: &CurvePiece, taus: [f64; 2], h: f64, most: [f64; 2]) -> Cubic {
        let [(from, start), (to, end)] = taus.map(|tau| self.state(piece, tau));
        let length_mm = to.s_mm - from.s_mm;
        if piece.is_straight() {
            let v = from.feed_mm_per_s;
            let a = from.acceleration_mm_per_s2;
            let jerk = (to.acceleration_mm_per_s2 - a) / h;
            let coefficient_mm = [0, 1].map(|axis| {
                let t = start.tangent[axis];
                [start.point_mm[axis], t * v, 0.5 * t * a, t * jerk / 6.0]
            });
            return Cubic { coefficient_mm, length_mm, fit_error_mm: 0.0, acceleration_error: 0.0 };
        }
        let coefficient_mm = [0, 1].map(|axis| {
            let p = start.point_mm[axis];
            let q = end.point_mm[axis];
            let m = start.tangent[axis] * from.feed_mm_per_s;
            let n = end.tangent[axis] * to.feed_mm_per_s;
            // Hermite: p + m u + (3 (q - p) / h - 2 m - n) u^2 / h + (m + n - 2 (q - p) / h) u^3 / h^2
            let mean = (q - p) / h;
            [p, m, (3.0 * mean - 2.0 * m - n) / h, (m + n - 2.0 * mean) / (h * h)]
        });
        // p'' = q'' s'^2 + q' s'',   q'' = kappa (-q'_y, q'_x)
        let exact = [(from, start), (to, end)].map(|(along, there)| {
            let [tx, ty] = there.tangent;
            let across = there.curvature_per_mm * along.feed_mm_per_s.powi(2);
            let a = along.acceleration_mm_per_s2;
            [a * tx - across * ty, a * ty + across * tx]
        });
        let mut acceleration_error = 0.0f64;
        let ends = [(from, start), (to, end)];
        for ((u, exact), (along, there)) in [0.0, h].into_iter().zip(exact).zip(ends) {
            if let Some(further) = self.further {
                let of_cubic = coefficient_mm.map(|c| 2.0 * c[2] + 6.0 * c[3] * u);
                let velocity = there.tangent.map(|t| t * along.feed_mm_per_s);
                let error = further.acceleration_error(there.point_mm, velocity, [of_cubic, exact]);
                acceleration_error = acceleration_error.max(error);
            }
            for ((c, exact), most) in coefficient_mm.iter().zip(exact).zip(most) {
                let error = (2.0 * c[2] + 6.0 * c[3] * u - exact).abs();
                acceleration_error = acceleration_error.max(error / most);
            }
        }
        let (_, middle) = self.state(piece, 0.5 * (taus[0] + taus[1]));
        let off = [0, 1].map(|axis| {
            polynomial::evaluate(&coefficient_mm[axis], 0.5 * h) - middle.point_mm[axis]
        });
        Cubic { coefficient_mm, length_mm, fit_error_mm: off[0].hypot(off[1]), acceleration_error }
    }
}
