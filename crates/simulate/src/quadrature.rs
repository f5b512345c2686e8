//! Quadrature along the motion that is exact for a TIF given on a lattice.
//!
//! Seen from the lattice of the samples, `R` is a bicubic polynomial of the tool position inside
//! a lattice cell, with kinks at the cell borders and jumps where its samples end. So the motion
//! is cut where it crosses a line of the lattice, and each piece gets a Gauss rule: the integrand
//! is a polynomial there. With straight uniform motion along an axis (degree 3) two points would
//! be exact; three are exact up to degree 5, and what is left of the degrees above (diagonal,
//! accelerated motion) is the product of small numbers.
//!
//! All that a piece gives to the sixteen nodes around its cell are the integrals
//!
//! ```text
//! M[b][a] = integral over the piece of w_b(f_y(t)) w_a(f_x(t)) dt
//! ```
//!
//! of Keys' weights, which sum to its duration, times the rate factor of the segment: a tool that
//! removes at half its rate is one that stands for half the time.

use std::ops::Range;

use planish_numerics::{keys, polynomial, quadrature::gauss_legendre};
use planish_types::Segment;

/// Gauss points of a piece.
pub const POINTS: usize = 3;

/// Error of the cuts, in cells: a piece of a TIF with a border of a nm/s is 1e-11 of the time of
/// a cell too long.
const CUT_TOLERANCE: f64 = 1e-11;

/// A piece below this fraction of its segment is rounding: two axes that cross at the same time.
const SHORTEST: f64 = 1e-13;

/// The lattice cells of one axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cells {
    /// Where cell 0 begins, mm.
    pub origin_mm: f64,
    /// Size of a cell, mm; > 0.
    pub step_mm: f64,
    /// Where in every cell the motion is cut besides, in (0, 1): the upper edge of the TIF.
    pub inner: Option<f64>,
}

/// The cells `low` .. `high` [x, y].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Window {
    /// First cell.
    pub low: [i64; 2],
    /// One beyond the last.
    pub high: [i64; 2],
}

/// Smallest and largest lattice coordinate [x, y] of a segment.
#[derive(Clone, Copy, Debug)]
pub struct Reach {
    /// Index in the trajectory.
    pub segment: usize,
    range: [[f64; 2]; 2],
}

impl Reach {
    /// Whether some of it may be in the cells `window` along an axis.
    pub fn is_in(&self, axis: usize, window: &Range<i64>) -> bool {
        let [low, high] = self.range[axis];
        // One cell more than rounding needs.
        high >= (window.start - 1) as f64 && low <= (window.end + 1) as f64
    }
}

/// A piece of the motion within one cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Piece {
    /// Cell [x, y].
    pub cell: [i64; 2],
    /// Offset in the cell [x, y] at the middle of the piece; 0 on a line.
    pub offset: [f64; 2],
    /// M of the module, `[b][a]` (y, x), s.
    pub seconds: [[f64; 4]; 4],
    /// Quadrature points.
    pub points: usize,
}

/// Cuts motions at the cells of a lattice.
pub struct Cutter {
    cells: [Cells; 2],
    rule: [(f64, f64); POINTS],
    cuts: Vec<f64>,
}

impl Cutter {
    /// For cells along [x, y].
    pub fn new(cells: [Cells; 2]) -> Self {
        Self { cells, rule: gauss_legendre(), cuts: Vec::new() }
    }

    /// How far `segment`, which has the index `index`, goes on the lattice.
    pub fn reach(&self, index: usize, segment: &Segment<'_>) -> Reach {
        let range = self.on_lattice(segment).map(|c| {
            let r = polynomial::range(&c, segment.duration_s);
            [r.min, r.max]
        });
        Reach { segment: index, range }
    }

    /// Calls `each` with the pieces of `segment` in the window, in the order of time.
    pub fn pieces(&mut self, segment: &Segment<'_>, window: &Window, mut each: impl FnMut(&Piece)) {
        let c = self.on_lattice(segment);
        if c.iter().all(|axis| axis[1..] == [0.0; 3]) {
            // At rest: the integrand is constant.
            let at = c.map(|c| keys::split(c[0]));
            if let Some(cell) = window.cell(at) {
                let offset = at.map(|(_, f)| f);
                let mut piece = Piece { cell, offset, seconds: [[0.0; 4]; 4], points: 1 };
                piece.add(offset, segment.rate_factor * segment.duration_s);
                each(&piece);
            }
            return;
        }
        self.cut(&c, segment.duration_s, window);
        let shortest = SHORTEST * segment.duration_s;
        let mut start = 0.0;
        for &end in &self.cuts {
            let duration = end - start;
            if duration <= shortest {
                continue;
            }
            let middle = start + 0.5 * duration;
            let split = |axis: usize| keys::split(polynomial::evaluate(&c[axis], middle));
            let at = [split(0), split(1)];
            if let Some(cell) = window.cell(at) {
                let offset = [at[0].1, at[1].1];
                let mut piece = Piece { cell, offset, seconds: [[0.0; 4]; 4], points: POINTS };
                for (node, weight) in self.rule {
                    let u = start + node * duration;
                    let f = |axis: usize| polynomial::evaluate(&c[axis], u) - cell[axis] as f64;
                    piece.add([f(0), f(1)], segment.rate_factor * weight * duration);
                }
                each(&piece);
            }
            start = end;
        }
    }

    /// The motion in lattice coordinates.
    fn on_lattice(&self, segment: &Segment<'_>) -> [[f64; 4]; 2] {
        [0, 1].map(|axis| {
            let Cells { origin_mm, step_mm, .. } = self.cells[axis];
            let c = &segment.coefficient_mm[axis];
            [(c[0] - origin_mm) / step_mm, c[1] / step_mm, c[2] / step_mm, c[3] / step_mm]
        })
    }

    /// Local times at which the motion turns back on an axis, crosses a line, and ends.
    fn cut(&mut self, c: &[[f64; 4]; 2], end: f64, window: &Window) {
        self.cuts.clear();
        for axis in 0..2 {
            let d = polynomial::derivative(&c[axis]);
            let levels = [window.low[axis], window.high[axis]];
            let mut from = 0.0;
            // Monotone pieces of the axis.
            for to in polynomial::quadratic_roots(d[0], d[1], d[2], end).chain([end]) {
                if from > 0.0 {
                    self.cuts.push(from);
                }
                crossings(&c[axis], &d, [from, to], levels, 0.0, &mut self.cuts);
                if let Some(inner) = self.cells[axis].inner {
                    crossings(&c[axis], &d, [from, to], levels, inner, &mut self.cuts);
                }
                from = to;
            }
        }
        self.cuts.push(end);
        if !self.cuts.is_sorted() {
            self.cuts.sort_unstable_by(f64::total_cmp);
        }
    }
}

impl Window {
    /// The cell of two split coordinates, if it is inside.
    fn cell(&self, at: [(isize, f64); 2]) -> Option<[i64; 2]> {
        let cell = [at[0].0 as i64, at[1].0 as i64];
        let inside = |a: usize| cell[a] >= self.low[a] && cell[a] < self.high[a];
        (inside(0) && inside(1)).then_some(cell)
    }
}

impl Piece {
    /// The tool at `offset` for `time_s`.
    #[inline]
    fn add(&mut self, offset: [f64; 2], time_s: f64) {
        let (wx, wy) = (keys::weights(offset[0]), keys::weights(offset[1]));
        for (row, wy) in self.seconds.iter_mut().zip(wy) {
            let t = wy * time_s;
            row.iter_mut().zip(wx).for_each(|(m, wx)| *m += t * wx);
        }
    }
}

/// Appends the times in `between` at which the monotone p crosses i + `inner` for the integers i
/// of the closed range `levels`; `d` is p'.
fn crossings(
    p: &[f64; 4],
    d: &[f64; 4],
    between: [f64; 2],
    levels: [i64; 2],
    inner: f64,
    times: &mut Vec<f64>,
) {
    let [mut u, end] = between;
    let (p0, p1) = (polynomial::evaluate(p, u), polynomial::evaluate(p, end));
    if (p1 - p0).abs() <= keys::SNAP {
        return;
    }
    let rising = p1 > p0;
    let first = ((p0.min(p1) - inner).ceil() as i64).max(levels[0]);
    let last = ((p0.max(p1) - inner).floor() as i64).min(levels[1]);
    let mut at = p0;
    for i in 0..=last.saturating_sub(first) {
        if last < first {
            return;
        }
        let level = if rising { first + i } else { last - i } as f64 + inner;
        u = crossing(p, d, level, [u, end], at, rising);
        times.push(u);
        at = level;
    }
}

/// The time in `between` at which p, there monotone, is `level`; p is `at` at its start.
fn crossing(
    p: &[f64; 4],
    d: &[f64; 4],
    level: f64,
    between: [f64; 2],
    at: f64,
    rising: bool,
) -> f64 {
    let [start, end] = between;
    let tolerance = CUT_TOLERANCE.max(4.0 * f64::EPSILON * level.abs());
    // v t + a t^2 / 2 = level - at, in the form that does not cancel
    let (v, a) = (polynomial::evaluate(d, start), d[1] + 2.0 * d[2] * start);
    let root = (v * v + 2.0 * a * (level - at)).max(0.0).sqrt();
    let mut u = start + 2.0 * (level - at) / (if rising { v + root } else { v - root });
    for _ in 0..4 {
        if !(u >= start && u <= end) {
            break;
        }
        let error = polynomial::evaluate(p, u) - level;
        if error.abs() <= tolerance {
            return u;
        }
        let v = polynomial::evaluate(d, u);
        let step = error / v;
        u -= step;
        // What a step of Newton leaves: p'' step^2 / 2.
        let left =
            (0.5 * (d[1] + 2.0 * d[2] * u) * step * step).abs() + (d[2] * step.powi(3)).abs();
        if left <= tolerance && u >= start && u <= end {
            return u;
        }
    }
    polynomial::monotone_crossing(p, level, start, end)
}

#[cfg(test)]
mod tests {
    use planish_types::Trajectory;

    use super::*;

    const ALL: Window = Window { low: [-1000; 2], high: [1000; 2] };

    fn trajectory(c: [[f64; 4]; 2], end: f64) -> Trajectory {
        Trajectory::new(vec![0.0, end], vec![c], vec![true], vec![Some(0)]).unwrap()
    }

    fn cells(first: f64, step: f64) -> [Cells; 2] {
        [Cells { origin_mm: first, step_mm: step, inner: None }; 2]
    }

    fn pieces(t: &Trajectory, cells: [Cells; 2], window: &Window) -> Vec<Piece> {
        let mut pieces = vec![];
        let mut cutter = Cutter::new(cells);
        t.segments().for_each(|s| cutter.pieces(&s, window, |p| pieces.push(*p)));
        pieces
    }

    fn seconds(p: &Piece) -> f64 {
        p.seconds.iter().flatten().sum()
    }

    #[test]
    fn a_jump_on_a_line_is_integrated_exactly_whichever_way_the_tool_goes() {
        // x(u) = 3u - u^2 on [0, 4] turns back at u = 1.5, x = 2.25.
        let t = trajectory([[0.0, 3.0, -1.0, 0.0], [0.0; 4]], 4.0);
        let pieces = pieces(&t, cells(0.5, 1.0), &ALL);
        // The time with x > 0.5 is 2 sqrt(1.5^2 - 0.5).
        let above: f64 = pieces.iter().filter(|p| p.cell[0] >= 0).map(seconds).sum();
        assert!((above - 2.0 * (2.25_f64 - 0.5).sqrt()).abs() < 1e-11, "{above}");
        // Keys' weights reproduce x: its integral is 8 u^2 / 2 - u^3 / 3 at the end.
        let x = |p: &Piece| {
            let at = |a: usize| 0.5 + (p.cell[0] + a as i64 - 1) as f64;
            (0..4).map(|a| at(a) * (0..4).map(|b| p.seconds[b][a]).sum::<f64>()).sum::<f64>()
        };
        let integral: f64 = pieces.iter().map(x).sum();
        assert!((integral - (1.5 * 16.0 - 64.0 / 3.0)).abs() < 1e-11, "{integral}");
    }

    #[test]
    fn time_is_conserved_and_pieces_stay_in_their_cell() {
        let motions = [
            [[0.0, 10.0, 0.0, 0.0], [0.0, -3.0, 0.5, 0.0]],
            // from rest to rest, and with two turns
            [[0.0, 0.0, 15.0, -5.0], [1.0, 0.0, 0.0, 0.0]],
            [[0.05, 3.0, -4.0, 1.3], [7.0, 0.0, -20.0, 10.0]],
            // along a line of the lattice
            [[0.0, 1.0, 0.0, 0.0], [0.3, 0.0, 0.0, 0.0]],
        ];
        for c in motions {
            for inner in [None, Some(0.3)] {
                let cells = cells(0.0, 0.1).map(|c| Cells { inner, ..c });
                let t = trajectory(c, 2.0);
                let found = pieces(&t, cells, &ALL);
                let total: f64 = found.iter().map(seconds).sum();
                assert!((total - 2.0).abs() < 1e-12, "{c:?}: {total}");
                // Weights w_-1 and w_2 are never positive within a cell.
                for p in &found {
                    let outer = (0..4).map(|b| p.seconds[b][0].max(p.seconds[b][3])).sum::<f64>();
                    assert!(outer <= 2.0 * seconds(p), "{p:?}");
                    let sums = (0..4).map(|a| (0..4).map(|b| p.seconds[b][a]).sum::<f64>());
                    assert!(sums.zip([-1.0, 1.0, 1.0, -1.0]).all(|(s, sign)| s * sign > -1e-12));
                }
            }
        }
    }

    #[test]
    fn only_the_window() {
        let c = [[0.0, 10.0, 0.0, 0.0], [0.0, -3.0, 0.5, 0.0]];
        // x in [5, 12] is the time [0.5, 1.2].
        let window = Window { low: [50, -1000], high: [120, 1000] };
        let time: f64 =
            pieces(&trajectory(c, 2.0), cells(0.0, 0.1), &window).iter().map(seconds).sum();
        assert!((time - 0.7).abs() < 1e-11, "{time}");
    }

    #[test]
    fn a_resting_tool_is_one_piece() {
        let t = trajectory([[1.25, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0]], 3.0);
        let found = pieces(&t, cells(0.0, 0.5), &ALL);
        let [p] = found.as_slice() else { panic!("{found:?}") };
        assert_eq!((p.cell, p.offset, p.points), ([2, 4], [0.5, 0.0], 1));
        assert_eq!(seconds(p), 3.0);
    }
}
