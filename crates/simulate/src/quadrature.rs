//! Quadrature along the motion that is exact for a TIF given on a lattice.
//!
//! Seen from the lattice of the samples, `R` is a bicubic polynomial of the tool position inside
//! a lattice cell, with kinks at the cell borders and jumps where its samples end. So the motion
//! is cut where it crosses a line of the lattice, and each piece gets a Gauss rule: the integrand
//! is a polynomial there. With straight uniform motion along an axis (degree 3) two points would
//! be exact; three are exact up to degree 5, and what is left of the degrees above (diagonal,
//! accelerated motion) is the product of small numbers.

use planish_numerics::{polynomial, quadrature::gauss_legendre};
use planish_types::{Segment, Trajectory};

/// The tool at `position_mm` for `time_s`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// Position [x, y], mm.
    pub position_mm: [f64; 2],
    /// Quadrature weight: seconds at this position.
    pub time_s: f64,
}

/// Lines `first_mm + i step_mm`, i over all integers, where the integrand is not smooth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lines {
    /// 0 for lines of constant x, 1 for lines of constant y.
    pub axis: usize,
    /// Any one of the lines, mm.
    pub first_mm: f64,
    /// Distance between the lines, mm; > 0.
    pub step_mm: f64,
}

/// Quadrature points of the time that the tool is on, cut at `lines`; only pieces of the motion
/// inside the box `low_mm` .. `high_mm` (outside it nothing is reached).
pub fn samples(
    trajectory: &Trajectory,
    lines: &[Lines],
    low_mm: [f64; 2],
    high_mm: [f64; 2],
) -> Vec<Sample> {
    let rule = gauss_legendre::<3>();
    let mut samples = Vec::new();
    let mut cuts = Vec::new();
    for segment in trajectory.segments().filter(|s| s.tool_on) {
        let c = segment.coefficient_mm;
        if c.iter().all(|axis| axis[1..] == [0.0; 3]) {
            // At rest: the integrand is constant.
            samples.push(Sample { position_mm: [c[0][0], c[1][0]], time_s: segment.duration_s });
            continue;
        }
        cut(&segment, lines, low_mm, high_mm, &mut cuts);
        for piece in cuts.windows(2) {
            let duration_s = piece[1] - piece[0];
            samples.extend(rule.iter().map(|(node, weight)| Sample {
                position_mm: segment.position_mm(piece[0] + node * duration_s),
                time_s: weight * duration_s,
            }));
        }
    }
    samples.retain(|s| (0..2).all(|a| (low_mm[a]..=high_mm[a]).contains(&s.position_mm[a])));
    samples
}

/// Local times at which the segment starts, turns back on an axis, crosses a line, and ends.
fn cut(
    segment: &Segment<'_>,
    lines: &[Lines],
    low_mm: [f64; 2],
    high_mm: [f64; 2],
    cuts: &mut Vec<f64>,
) {
    let end = segment.duration_s;
    cuts.clear();
    cuts.extend([0.0, end]);
    for axis in 0..2 {
        let c = &segment.coefficient_mm[axis];
        let d = polynomial::derivative(c);
        // Monotone pieces of the axis.
        let mut turns = vec![0.0];
        turns.extend(polynomial::quadratic_roots(d[0], d[1], d[2], end));
        turns.push(end);
        cuts.extend(&turns[1..turns.len() - 1]);
        for (piece, lines) in turns
            .windows(2)
            .flat_map(|w| lines.iter().map(move |l| (w, l)))
            .filter(|(_, l)| l.axis == axis)
        {
            let (p0, p1) = (polynomial::evaluate(c, piece[0]), polynomial::evaluate(c, piece[1]));
            let low = p0.min(p1).max(low_mm[axis]);
            let high = p0.max(p1).min(high_mm[axis]);
            let first = ((low - lines.first_mm) / lines.step_mm).ceil() as i64;
            let last = ((high - lines.first_mm) / lines.step_mm).floor() as i64;
            for i in first..=last {
                let level = lines.first_mm + i as f64 * lines.step_mm;
                cuts.push(polynomial::monotone_crossing(c, level, piece[0], piece[1]));
            }
        }
    }
    cuts.sort_by(f64::total_cmp);
    // Two axes that cross a line at the same time leave a piece of rounding size.
    cuts.dedup_by(|later, earlier| *later - *earlier <= 1e-13 * end);
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOX: ([f64; 2], [f64; 2]) = ([-100.0; 2], [100.0; 2]);

    fn trajectory(c: [[f64; 4]; 2], end: f64) -> Trajectory {
        Trajectory::new(vec![0.0, end], vec![c], vec![true], vec![0]).unwrap()
    }

    fn integral(samples: &[Sample], f: impl Fn([f64; 2]) -> f64) -> f64 {
        samples.iter().map(|s| s.time_s * f(s.position_mm)).sum()
    }

    #[test]
    fn a_kink_on_a_line_is_integrated_exactly_whichever_way_the_tool_goes() {
        // x(u) = 3u - u^2 on [0, 4] turns back at u = 1.5, x = 2.25.
        let t = trajectory([[0.0, 3.0, -1.0, 0.0], [0.0; 4]], 4.0);
        let lines = [Lines { axis: 0, first_mm: 0.5, step_mm: 1.0 }];
        let s = samples(&t, &lines, BOX.0, BOX.1);
        // f = step at 0.5: the time with x > 0.5 is 2 sqrt(1.5^2 - 0.5).
        let above = integral(&s, |p| f64::from(p[0] > 0.5));
        assert!((above - 2.0 * (2.25_f64 - 0.5).sqrt()).abs() < 1e-12, "{above}");
        // f = |x - 0.5| is quadratic in u on every piece.
        let antiderivative = |u: f64| 1.5 * u * u - u.powi(3) / 3.0 - 0.5 * u;
        let (a, b) = (1.5 - 1.75_f64.sqrt(), 1.5 + 1.75_f64.sqrt());
        let exact = 2.0 * (antiderivative(b) - antiderivative(a)) - antiderivative(4.0);
        assert!((integral(&s, |p| (p[0] - 0.5).abs()) - exact).abs() < 1e-12);
    }

    #[test]
    fn time_is_conserved_inside_the_box_and_a_lifted_tool_counts_nothing() {
        let c = [[0.0, 10.0, 0.0, 0.0], [0.0, -3.0, 0.5, 0.0]];
        let lines = [0, 1].map(|axis| Lines { axis, first_mm: 0.0, step_mm: 0.1 });
        let total = |t: &Trajectory, b: ([f64; 2], [f64; 2])| {
            samples(t, &lines, b.0, b.1).iter().map(|s| s.time_s).sum::<f64>()
        };
        assert!((total(&trajectory(c, 2.0), BOX) - 2.0).abs() < 1e-12);
        // x in [5, 12] is the time [0.5, 1.2]; both ends lie on lines.
        let time = total(&trajectory(c, 2.0), ([5.0, -100.0], [12.0, 100.0]));
        assert!((time - 0.7).abs() < 1e-12, "{time}");
        let lifted = Trajectory::new(vec![0.0, 2.0], vec![c], vec![false], vec![-1]).unwrap();
        assert_eq!(total(&lifted, BOX), 0.0);
    }

    #[test]
    fn a_resting_tool_is_one_sample() {
        let t = trajectory([[1.0, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0]], 3.0);
        let s = samples(&t, &[], BOX.0, BOX.1);
        assert_eq!(s, [Sample { position_mm: [1.0, 2.0], time_s: 3.0 }]);
    }
}
