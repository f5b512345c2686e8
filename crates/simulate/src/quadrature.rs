//! Quadrature along the motion that is exact for a TIF given on a lattice.
//!
//! Seen from the lattice of the samples, `R` is a bicubic polynomial of the tool position inside a lattice cell, with
//! kinks at the cell borders and jumps where its samples end. So the motion is cut where it crosses a line of the
//! lattice. Each piece gets a Gauss rule, which with N points is exact up to the degree 2N - 1. Keys' weights are
//! cubics of the offsets in the cell, and these are cubics of the time, so that the degree of the integrand, and the
//! points of a rule without an error, are
//!
//! | motion in the piece | degree | points |
//! |---|---|---|
//! | uniform along an axis | 3 | 2 |
//! | along an axis | 9 | 5 |
//! | uniform, oblique | 6 | 4 |
//! | any other | 18 | 10 |
//!
//! Motion that is nearly one of these gets five points where what they leave out is below 1e-10 of the weights.
//!
//! All that a piece gives to the sixteen nodes around its cell are the integrals
//!
//! ```text
//! M[b][a] = integral over the piece of w_b(f_y(t)) w_a(f_x(t)) dt
//! ```
//!
//! of Keys' weights, which sum to its duration, times the rate factor of the segment: a tool that
//! removes at half its rate is one that stands for half the time. The rate of a tool that varies, [`Weight`], is a
//! factor under the integral. It is not a polynomial of low degree, so that such pieces have five points, or ten. The
//! motion is cut at the knots of a weight by place, too. The error is then that of the terms of a smooth weight that
//! the rule leaves out, and of the knots of weights by direction and time.

use std::ops::Range;

use planish_numerics::{keys, polynomial, quadrature::gauss_legendre};
use planish_types::{Grid, Headings, Segment, Variation};

/// Error of the position of the cuts, in cells. Where the TIF ends with a step, the step acts too long by up to this
/// fraction of the time in which the tool crosses a cell. Larger: a larger error at steep borders. Smaller: below the
/// rounding of the cuts.
const CUT_TOLERANCE: f64 = 1e-11;

/// Distance, in cells, up to which an axis counts as at rest over a piece; the error of the weights is below 1e-10.
/// Larger: a larger error. Smaller: more quadrature points.
const STILL: f64 = 1e-11;
/// Difference from uniform motion over a piece, in cells, up to which the motion counts as uniform; the error of the
/// weights is below 1e-10. Larger: a larger error. Smaller: more quadrature points.
const UNIFORM: f64 = 1e-9;

/// Distance of the slower axis over a piece, in cells, up to which it has five quadrature points instead of ten. Five
/// points leave 1.4e-6 of the terms of the 10th degree and above, which all have this distance as a factor. Larger: a
/// larger error. Smaller: more pieces with ten points.
const SMALL_WAY: f64 = 1e-5;

/// Difference from uniform motion, in cells, up to which a piece has five quadrature points instead of ten. The terms
/// of the 10th degree and above are at most 34 times its square. Larger: a larger error. Smaller: more pieces with ten
/// points.
const NEARLY_UNIFORM: f64 = 1e-3;

/// Smallest duration of a piece, as a fraction of that of its segment; a shorter one is left out. It is rounding where
/// two axes cross a border at the same time. Larger: short pieces are lost. Smaller: pieces that only rounding makes.
const SHORTEST: f64 = 1e-13;

/// Difference of two cuts, as a fraction of the duration of the segment, up to which a knot of a weight counts as on a
/// line of the lattice. Larger: the line is crossed at a wrong time. Smaller: more pieces.
const SAME_CUT: f64 = 1e-11;

/// The lattice cells of the tool position along one axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NodeCells {
    /// Coordinate at which cell 0 begins, mm.
    pub origin_mm: f64,
    /// Size of a cell, mm; > 0.
    pub step_mm: f64,
    /// Position in every cell, in (0, 1), of a further cut of the motion, for the upper edge of the TIF; `None` if it
    /// is not needed.
    pub inner: Option<f64>,
}

impl NodeCells {
    /// Returns the coefficients, in cells, of the motion along the axis with the coefficients `c_mm`.
    fn coordinate(&self, c_mm: &[f64; 4]) -> [f64; 4] {
        let Self { origin_mm, step_mm, .. } = self;
        [(c_mm[0] - origin_mm) / step_mm, c_mm[1] / step_mm, c_mm[2] / step_mm, c_mm[3] / step_mm]
    }
}

/// A rectangle of cells, from `low` up to, but without, `high`, along [x, y].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Window {
    /// Indices of the first cell along [x, y].
    pub low: [i64; 2],
    /// Indices after those of the last cell along [x, y].
    pub high: [i64; 2],
}

/// Range of the lattice coordinates [x, y] of a segment of the motion.
#[derive(Clone, Copy, Debug)]
pub struct Reach {
    /// Index of the segment in the trajectory.
    pub segment: usize,
    range: [[f64; 2]; 2],
}

impl Reach {
    /// Returns true if some part of the segment may lie in the cells `window` along an axis (0: x, 1: y).
    pub fn is_in(&self, axis: usize, window: &Range<i64>) -> bool {
        let [low, high] = self.range[axis];
        // One cell more than rounding needs.
        high >= (window.start - 1) as f64 && low <= (window.end + 1) as f64
    }
}

/// Weight of one kernel of a tool that varies, as a function of the position, direction and time of the tool.
#[derive(Clone, Copy)]
pub struct Weight<'a> {
    /// The variation of the tool.
    pub variation: &'a Variation,
    /// Index of the kernel.
    pub kernel: usize,
    /// Directions of the motion in every segment.
    pub headings: &'a Headings,
}

impl Weight<'_> {
    /// Returns the weight at the time `u_s` since the start of the segment with this `index`.
    fn value(&self, index: usize, segment: &Segment<'_>, u_s: f64) -> f64 {
        let time_s = segment.start_s + u_s;
        let of_time = self.variation.time_factor().map_or(1.0, |time| time.factor_at(time_s));
        of_time * self.variation.weight(self.kernel, self.headings.pose(index, segment, u_s))
    }

    /// Returns the mean weight over a segment in which the tool rests; `index` is that of the segment.
    fn at_rest(&self, index: usize, segment: &Segment<'_>) -> f64 {
        let from_s = segment.start_s;
        let to_s = segment.start_s + segment.duration_s;
        let of_time = self.variation.time_factor().map_or(1.0, |time| time.mean(from_s, to_s));
        of_time * self.variation.weight(self.kernel, self.headings.pose(index, segment, 0.0))
    }
}

/// A piece of the motion within one cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CellPiece {
    /// Indices of the cell along [x, y].
    pub cell: [i64; 2],
    /// Offset of the tool in the cell [x, y], in cells, at the middle of the piece; 0 on a line of the lattice.
    pub offset: [f64; 2],
    /// Integrals M of the module, s, `[b][a]` for the weights along (y, x), times the rate factor of the segment and
    /// the weight of the kernel.
    pub seconds: [[f64; 4]; 4],
    /// Number of quadrature points of the piece.
    pub points: usize,
}

/// Cuts motions at the borders of the cells of a lattice.
pub struct Cutter {
    cells: [NodeCells; 2],
    rules: Rules,
    cuts: Vec<f64>,
}

impl Cutter {
    /// Makes a cutter for cells along [x, y].
    pub fn new(cells: [NodeCells; 2]) -> Self {
        Self { cells, rules: Rules::new(), cuts: Vec::new() }
    }

    /// Returns the range of lattice coordinates of `segment`, which has this `index` in the trajectory.
    pub fn reach(&self, index: usize, segment: &Segment<'_>) -> Reach {
        let range = self.on_lattice(segment).map(|c| {
            let r = polynomial::range(&c, segment.duration_s);
            [r.min, r.max]
        });
        Reach { segment: index, range }
    }

    /// Calls `each` with the pieces of `segment` in the cells of `window`, in the order of time; `index` is that of the
    /// segment in the trajectory. A `weight` multiplies the seconds of the pieces.
    pub fn pieces(
        &mut self,
        (index, segment): (usize, &Segment<'_>),
        window: &Window,
        weight: Option<&Weight<'_>>,
        mut each: impl FnMut(&CellPiece),
    ) {
        let c = self.on_lattice(segment);
        if c.iter().all(|axis| axis[1..] == [0.0; 3]) {
            // At rest: the integrand is constant.
            let split = c.map(|c| keys::split(c[0]));
            if let Some(cell) = window.cell(split) {
                let offset = split.map(|(_, f)| f);
                let mut seconds = segment.rate_factor * segment.duration_s;
                if let Some(weight) = weight {
                    seconds *= weight.at_rest(index, segment);
                }
                let [wx, wy] = offset.map(keys::weights);
                each(&CellPiece { cell, offset, seconds: outer(wx, wy, seconds), points: 1 });
            }
            return;
        }
        self.cut(&c, segment.duration_s, window);
        if let Some(weight) = weight {
            self.cut_at_knots(segment, weight.variation.positions());
        }
        let shortest = SHORTEST * segment.duration_s;
        let mut start = 0.0;
        for &end in &self.cuts {
            let duration = end - start;
            if duration <= shortest {
                continue;
            }
            let middle = start + 0.5 * duration;
            let split = c.map(|c| keys::split(polynomial::evaluate(&c, middle)));
            if let Some(cell) = window.cell(split) {
                let offset = split.map(|(_, f)| f);
                let local = [0, 1].map(|axis| within(&c[axis], cell[axis], start, duration));
                let seconds = segment.rate_factor * duration;
                let piece = match weight {
                    None => self.rules.piece(cell, offset, &local, seconds),
                    Some(weight) => self.rules.weighted_piece(cell, offset, &local, seconds, |u| {
                        weight.value(index, segment, start + u * duration)
                    }),
                };
                each(&piece);
            }
            start = end;
        }
    }

    /// Returns the coefficients of the motion [x, y] in lattice coordinates, in cells.
    fn on_lattice(&self, segment: &Segment<'_>) -> [[f64; 4]; 2] {
        [0, 1].map(|axis| self.cells[axis].coordinate(&segment.coefficient_mm[axis]))
    }

    /// Fills `self.cuts` with the times, s, at which the motion turns back on an axis, crosses a line of the lattice
    /// within `window`, or ends. `c` is the segment in lattice coordinates and `end` its duration; the times count from
    /// its start.
    fn cut(&mut self, c: &[[f64; 4]; 2], end: f64, window: &Window) {
        self.cuts.clear();
        for axis in 0..2 {
            let d = polynomial::derivative(&c[axis]);
            let levels = [window.low[axis], window.high[axis]];
            for piece in monotone_pieces(&d, end) {
                if piece[0] > 0.0 {
                    self.cuts.push(piece[0]);
                }
                crossings(&c[axis], &d, piece, levels, 0.0, &mut self.cuts);
                if let Some(inner) = self.cells[axis].inner {
                    crossings(&c[axis], &d, piece, levels, inner, &mut self.cuts);
                }
            }
        }
        self.cuts.push(end);
        if !self.cuts.is_sorted() {
            self.cuts.sort_unstable_by(f64::total_cmp);
        }
    }

    /// Adds to `self.cuts` the times, s, at which `segment` crosses a line of the grid `knots`, on which the weights of
    /// a tool that varies by place are given.
    fn cut_at_knots(&mut self, segment: &Segment<'_>, knots: &Grid) {
        let before = self.cuts.len();
        for (axis, knots) in [&knots.x, &knots.y].into_iter().enumerate() {
            let cells =
                NodeCells { origin_mm: knots.start_mm(), step_mm: knots.step_mm(), inner: None };
            let c = cells.coordinate(&segment.coefficient_mm[axis]);
            let d = polynomial::derivative(&c);
            let levels = [0, knots.len() as i64 - 1];
            for piece in monotone_pieces(&d, segment.duration_s) {
                crossings(&c, &d, piece, levels, 0.0, &mut self.cuts);
            }
        }
        if self.cuts.len() == before {
            return;
        }
        self.cuts.sort_unstable_by(f64::total_cmp);
        // Knots on lines of the lattice are cut once.
        let least = SAME_CUT * segment.duration_s;
        self.cuts.dedup_by(|later, earlier| *later - *earlier <= least);
        if let Some(last) = self.cuts.last_mut() {
            *last = segment.duration_s;
        }
    }
}

impl Window {
    /// Returns the cell [x, y] of two coordinates that are split into whole and fraction; `None` if it is not in the
    /// window.
    fn cell(&self, at: [(isize, f64); 2]) -> Option<[i64; 2]> {
        let cell = [at[0].0 as i64, at[1].0 as i64];
        let is_inside = (0..2).all(|a| cell[a] >= self.low[a] && cell[a] < self.high[a]);
        if is_inside { Some(cell) } else { None }
    }
}

/// Gauss rules with the numbers of points of the table of the module: pairs of node (0 to 1) and weight.
struct Rules {
    two: [(f64, f64); 2],
    four: [(f64, f64); 4],
    five: [(f64, f64); 5],
    ten: [(f64, f64); 10],
}

impl Rules {
    fn new() -> Self {
        Self {
            two: gauss_legendre(),
            four: gauss_legendre(),
            five: gauss_legendre(),
            ten: gauss_legendre(),
        }
    }

    /// Returns the integrals over a piece in a cell. `offset` is that at its middle, `motion` the cubics [x, y] of
    /// [`within`], and `seconds` its duration.
    fn piece(
        &self,
        cell: [i64; 2],
        offset: [f64; 2],
        motion: &[[f64; 4]; 2],
        seconds: f64,
    ) -> CellPiece {
        let [x, y] = motion;
        let (least_way, most_bent) = (way(x).min(way(y)), bend(x).max(bend(y)));
        let (seconds, points) = if way(y) <= STILL {
            let (wx, points) = self.weights_along(x);
            (outer(wx, keys::weights(offset[1]), seconds), points)
        } else if way(x) <= STILL {
            let (wy, points) = self.weights_along(y);
            (outer(keys::weights(offset[0]), wy, seconds), points)
        } else if most_bent <= UNIFORM {
            (products(&self.four, motion, seconds, |_| 1.0), 4)
        } else if least_way <= SMALL_WAY || most_bent <= NEARLY_UNIFORM {
            (products(&self.five, motion, seconds, |_| 1.0), 5)
        } else {
            (products(&self.ten, motion, seconds, |_| 1.0), 10)
        };
        CellPiece { cell, offset, seconds, points }
    }

    /// Returns the mean of Keys' four weights over a motion along one axis, and the number of points of the rule.
    fn weights_along(&self, p: &[f64; 4]) -> ([f64; 4], usize) {
        if bend(p) <= UNIFORM {
            (mean_weights(&self.two, p), 2)
        } else {
            (mean_weights(&self.five, p), 5)
        }
    }

    /// Returns the integrals over a piece with a weight, which is a function of the fraction of the piece, 0 to 1.
    fn weighted_piece(
        &self,
        cell: [i64; 2],
        offset: [f64; 2],
        motion: &[[f64; 4]; 2],
        seconds: f64,
        weight: impl Fn(f64) -> f64,
    ) -> CellPiece {
        let [x, y] = motion;
        let (least_way, most_bent) = (way(x).min(way(y)), bend(x).max(bend(y)));
        let (seconds, points) = if least_way <= SMALL_WAY || most_bent <= NEARLY_UNIFORM {
            (products(&self.five, motion, seconds, weight), 5)
        } else {
            (products(&self.ten, motion, seconds, weight), 10)
        };
        CellPiece { cell, offset, seconds, points }
    }
}

/// Returns an upper bound of the difference of a cubic on 0..1 from uniform motion.
fn bend(p: &[f64; 4]) -> f64 {
    p[2].abs() + p[3].abs()
}

/// Returns an upper bound of the distance that a cubic on 0..1 covers.
fn way(p: &[f64; 4]) -> f64 {
    p[1].abs() + bend(p)
}

/// Returns the cubic p as a function of the fraction, 0 to 1, of the piece that begins at `start`, counted from its
/// cell.
fn within(p: &[f64; 4], cell: i64, start: f64, duration: f64) -> [f64; 4] {
    let [p0, p1, p2, p3] = polynomial::shifted(p, start);
    let square = duration * duration;
    [p0 - cell as f64, p1 * duration, p2 * square, p3 * square * duration]
}

/// Returns the mean of Keys' four weights over the motion `p`, by the Gauss rule `rule`.
#[inline]
fn mean_weights<const N: usize>(rule: &[(f64, f64); N], p: &[f64; 4]) -> [f64; 4] {
    let mut mean = [0.0; 3];
    for (node, weight) in rule {
        let f = polynomial::evaluate(p, *node);
        let mut power = *weight;
        for mean in &mut mean {
            power *= f;
            *mean += power;
        }
    }
    keys::mean_weights(mean)
}

/// Returns the mean over a piece of the products of Keys' weights along both axes and `factor`, times `seconds`,
/// `[b][a]` for (y, x). The motion [x, y] and `factor` are functions of the fraction of the piece, 0 to 1.
#[inline]
fn products<const N: usize>(
    rule: &[(f64, f64); N],
    [x, y]: &[[f64; 4]; 2],
    seconds: f64,
    factor: impl Fn(f64) -> f64,
) -> [[f64; 4]; 4] {
    let mut sums = [[0.0; 4]; 4];
    for (node, weight) in rule {
        let factor = factor(*node);
        let wx = keys::weights(polynomial::evaluate(x, *node));
        let wy = keys::weights(polynomial::evaluate(y, *node));
        for (row, wy) in sums.iter_mut().zip(wy) {
            let t = weight * seconds * factor * wy;
            row.iter_mut().zip(wx).for_each(|(m, wx)| *m += t * wx);
        }
    }
    sums
}

/// Returns the products `[b][a]` of the weights `wx` along x (index a) and `wy` along y (index b), times `seconds`.
#[inline]
fn outer(wx: [f64; 4], wy: [f64; 4], seconds: f64) -> [[f64; 4]; 4] {
    wy.map(|wy| wx.map(|wx| seconds * wy * wx))
}

/// Returns the pieces [from, to] of the times from 0 to `end` in which the cubic with the derivative `d` is monotone.
fn monotone_pieces(d: &[f64; 4], end: f64) -> impl Iterator<Item = [f64; 2]> {
    let mut from = 0.0;
    polynomial::quadratic_roots(d[0], d[1], d[2], end)
        .chain([end])
        .map(move |to| [std::mem::replace(&mut from, to), to])
}

/// Appends the times in `between` at which p, monotone there, crosses i + `inner`. The integers i are those of the
/// closed range `levels`; `d` is the derivative of p.
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

/// Returns the time in `between` at which p, monotone there, has the value `level`. `at` is its value at the start, `d`
/// its derivative, and `rising` its direction.
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
    let v = polynomial::evaluate(d, start);
    let a = d[1] + 2.0 * d[2] * start;
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
    use ndarray::Array2;
    use planish_types::{Axis, Pose, Tif, Trajectory, VaryingTif};

    use super::*;

    const ALL: Window = Window { low: [-1000; 2], high: [1000; 2] };

    fn trajectory(c: [[f64; 4]; 2], end: f64) -> Trajectory {
        Trajectory::new(vec![0.0, end], vec![c], vec![true], vec![Some(0)]).unwrap()
    }

    fn cells(first: f64, step: f64) -> [NodeCells; 2] {
        [NodeCells { origin_mm: first, step_mm: step, inner: None }; 2]
    }

    fn pieces(t: &Trajectory, cells: [NodeCells; 2], window: &Window) -> Vec<CellPiece> {
        let mut pieces = vec![];
        let mut cutter = Cutter::new(cells);
        for s in t.segments().enumerate() {
            cutter.pieces((s.0, &s.1), window, None, |p| pieces.push(*p));
        }
        pieces
    }

    fn seconds(p: &CellPiece) -> f64 {
        p.seconds.iter().flatten().sum()
    }

    #[test]
    fn a_jump_on_a_line_is_integrated_exactly_whichever_way_the_tool_goes() {
        // x(u) = 3u - u^2 on [0, 4] turns back at u = 1.5, x = 2.25.
        let t = trajectory([[0.0, 3.0, -1.0, 0.0], [0.0; 4]], 4.0);
        let pieces = pieces(&t, cells(0.5, 1.0), &ALL);
        // The time with x > 0.5 is 2 sqrt(1.5^2 - 0.5).
        let above: f64 = pieces.iter().filter(|p| p.cell[0] >= 0).map(seconds).sum();
        // Below: cuts err by 1e-11 of a cell, and the tool crosses a cell in 0.4 s.
        assert!((above - 2.0 * (2.25_f64 - 0.5).sqrt()).abs() < 1e-11, "{above}");
        // Keys' weights reproduce x: its integral is 8 u^2 / 2 - u^3 / 3 at the end.
        let x = |p: &CellPiece| {
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
                let cells = cells(0.0, 0.1).map(|c| NodeCells { inner, ..c });
                let t = trajectory(c, 2.0);
                let found = pieces(&t, cells, &ALL);
                let total: f64 = found.iter().map(seconds).sum();
                // Rounding of a sum of some hundred durations.
                assert!((total - 2.0).abs() < 1e-12, "{c:?}: {total}");
                // Weights w_-1 and w_2 are never positive within a cell.
                for p in &found {
                    let outer = (0..4).map(|b| p.seconds[b][0].max(p.seconds[b][3])).sum::<f64>();
                    assert!(outer <= 2.0 * seconds(p), "{p:?}");
                    let sums = (0..4).map(|a| (0..4).map(|b| p.seconds[b][a]).sum::<f64>());
                    // Rounding of weights up to 1.
                    assert!(sums.zip([-1.0, 1.0, 1.0, -1.0]).all(|(s, sign)| s * sign > -1e-12));
                }
            }
        }
    }

    #[test]
    fn what_nodes_get_does_not_depend_on_how_a_motion_is_divided() {
        let motions = [
            // along an axis, uniform and not
            [[0.1, 2.5, 0.0, 0.0], [0.3, 0.0, 0.0, 0.0]],
            [[0.3, 0.0, 0.0, 0.0], [0.1, 0.2, 1.1, -0.3]],
            // oblique, uniform and not
            [[0.1, 2.5, 0.0, 0.0], [0.2, -1.6, 0.0, 0.0]],
            [[0.1, 0.0, 1.4, -0.4], [0.2, -1.6, 2.0, -0.7]],
        ];
        let nodes = |parts: usize, c: [[f64; 4]; 2]| {
            let part = 2.0 / parts as f64;
            let breaks = (0..=parts).map(|k| part * k as f64).collect();
            let cut = |k: usize| c.map(|p| polynomial::shifted(&p, part * k as f64));
            let on = (vec![true; parts], vec![Some(0); parts]);
            let t = Trajectory::new(breaks, (0..parts).map(cut).collect(), on.0, on.1).unwrap();
            let mut nodes = [[0.0; 16]; 16];
            for p in pieces(&t, cells(0.0, 1.0), &ALL) {
                for (b, row) in p.seconds.iter().enumerate() {
                    for (a, s) in row.iter().enumerate() {
                        let at = |axis: usize, k: usize| (p.cell[axis] + 7 + k as i64) as usize;
                        nodes[at(1, b)][at(0, a)] += s;
                    }
                }
            }
            nodes
        };
        for c in motions {
            let (whole, parts) = (nodes(1, c), nodes(7, c));
            let pairs = whole.as_flattened().iter().zip(parts.as_flattened());
            let error = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            // Rounding of sums of a hundred terms of order 1. Three points for uniform oblique motion leave 1.4e-4, four
            // along an axis 2.7e-6, six in the last case 4.6e-11.
            assert!(error < 1e-13, "{c:?}: {error}");
        }
    }

    #[test]
    fn knots_of_a_weight_by_place_are_cut() {
        let axis = |start, step, len| Axis::new(start, step, len).unwrap();
        let offsets = Grid { x: axis(-1.0, 1.0, 3), y: axis(-1.0, 1.0, 3) };
        // Knots every 0.7 of a cell.
        let positions = Grid { x: axis(-1.0, 0.7, 12), y: axis(-9.0, 9.0, 3) };
        let weight =
            Array2::from_shape_fn(positions.shape(), |(_, c)| 1.0 + 0.1 * (c * c % 7) as f64);
        let tif = Tif::varying(VaryingTif {
            offsets,
            kernels: vec![Array2::ones(offsets.shape())],
            positions,
            weights: vec![weight],
            azimuth: None,
            heading: None,
            pixels: None,
            time: None,
        });
        let tif = tif.unwrap();
        let variation = tif.variation().unwrap();
        let t = trajectory([[0.1, 2.5, 0.0, 0.0], [0.0; 4]], 2.0);
        let weight = Weight { variation, kernel: 0, headings: &Headings::new(&t) };
        let mut sum = 0.0;
        for s in t.segments().enumerate() {
            let mut cutter = Cutter::new(cells(0.0, 1.0));
            cutter.pieces((s.0, &s.1), &ALL, Some(&weight), |p| sum += seconds(p));
        }
        // A cubic between knots: two points of Gauss from knot to knot are exact.
        let mut bounds = vec![0.1, 5.1];
        bounds.extend(positions.x.coordinates().into_iter().filter(|x| (0.1..5.1).contains(x)));
        bounds.sort_unstable_by(f64::total_cmp);
        let mut exact = 0.0;
        for w in bounds.windows(2) {
            for (node, part) in gauss_legendre::<2>() {
                let x = w[0] + node * (w[1] - w[0]);
                exact += part * (w[1] - w[0]) / 2.5 * variation.weight(0, Pose::along_x([x, 0.0]));
            }
        }
        // Rounding of a sum of terms of order 1. Without the cuts the difference is above 1e-5.
        assert!((sum - exact).abs() < 1e-13, "{sum} {exact}");
    }

    #[test]
    fn only_the_window() {
        let c = [[0.0, 10.0, 0.0, 0.0], [0.0, -3.0, 0.5, 0.0]];
        // x in [5, 12] is the time [0.5, 1.2].
        let window = Window { low: [50, -1000], high: [120, 1000] };
        let time: f64 =
            pieces(&trajectory(c, 2.0), cells(0.0, 0.1), &window).iter().map(seconds).sum();
        // Two cuts err by 1e-11 of a cell, in which the tool is for 0.01 s.
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
